"""Properties of the car, and conversions between numbers on the bus and physical values."""

from __future__ import annotations

import math

from msgspec import Struct

MAX_WHEEL_RAD = 9.6
"""The largest steering wheel angle that a command can set."""
MAX_WHEEL_RATE_RADPS = 17.5


class Mechanics(Struct, frozen=True):
    """Properties of a car with a by-wire kit."""

    steering_ratio: float = 14.8
    """Steering wheel angle divided by road wheel angle."""
    max_braking_mps2: float = 6.0
    """Deceleration at full brake: the simulator's."""
    tyre_radius_m: float = 0.33
    """Our choice: not published."""
    steering_rate_step_deg: float = 4.0
    """Step of generation 1's steering rate, in deg/s; 2 with old firmware."""

    def rate_radps(self, steps: int, step_deg: float) -> float:
        """Return a command's rate of the steering wheel; 0 means the maximum (our choice: the kit's default)."""
        return min(math.radians(steps * step_deg), MAX_WHEEL_RATE_RADPS) if steps else MAX_WHEEL_RATE_RADPS

    def tyre_radps(self, speed_mps: float) -> float:
        """Return the angular speed of the tyres."""
        return speed_mps / self.tyre_radius_m


def within(number: float, least: float, most: float) -> float:
    """Clamp a number to a range."""
    return min(max(number, least), most)


def wheel_angle(tenths_of_degree: int) -> float:
    """Return a commanded steering wheel angle in rad, within the limit."""
    return within(math.radians(tenths_of_degree / 10), -MAX_WHEEL_RAD, MAX_WHEEL_RAD)


def tenths_of_degree(angle_rad: float) -> int:
    """Return an angle in the reports' unit."""
    return round(math.degrees(angle_rad) * 10)


def hundredths_of_kmh(speed_mps: float) -> int:
    """Return a speed in the reports' unit."""
    return round(speed_mps * 360)
