"""What of the car itself a by-wire kit has to know to turn numbers on the bus into what happens, and back."""

from __future__ import annotations

import math

from lavt.value import value

MAX_WHEEL_RAD = 9.6
"""The furthest a steering wheel is turned by command."""
MAX_WHEEL_RATE_RADPS = 17.5


@value
class Mechanics:
    """A car's numbers."""

    steering_ratio: float = 14.8
    """Steering wheel angle over road wheel angle."""
    max_braking_mps2: float = 6.0
    """Deceleration at the whole of the brake: the simulator's."""
    tyre_radius_m: float = 0.33
    """Ours: no fact gives it."""
    steering_rate_step_deg: float = 4.0
    """Of generation 1: 2 deg/s with old firmware."""

    def rate_radps(self, steps: int, step_deg: float) -> float:
        """Give the rate of the steering wheel that a command names; 0 stands for the greatest (ours: a default)."""
        return min(math.radians(steps * step_deg), MAX_WHEEL_RATE_RADPS) if steps else MAX_WHEEL_RATE_RADPS

    def tyre_radps(self, speed_mps: float) -> float:
        """Give how fast the tyres turn."""
        return speed_mps / self.tyre_radius_m


def within(number: float, least: float, most: float) -> float:
    """Give the nearest number in a range."""
    return min(max(number, least), most)


def wheel_angle(tenths_of_degree: int) -> float:
    """Give a commanded steering wheel angle in rad, no further than the wheel is turned."""
    return within(math.radians(tenths_of_degree / 10), -MAX_WHEEL_RAD, MAX_WHEEL_RAD)


def tenths_of_degree(angle_rad: float) -> int:
    """Give an angle as it is reported."""
    return round(math.degrees(angle_rad) * 10)


def hundredths_of_kmh(speed_mps: float) -> int:
    """Give a speed as it is reported."""
    return round(speed_mps * 360)
