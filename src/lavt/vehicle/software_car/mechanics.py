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
    """Deceleration at full brake, that of the simulator's car."""
    tyre_radius_m: float = 0.33
    """Our choice, because it is not published."""
    steering_rate_step_deg: float = 4.0
    """Step of the steering rate of generation 1, in deg/s; 2 with old firmware."""

    def rate_radps(self, steps: int, step_deg: float) -> float:
        """Return the rate of the steering wheel that a command requests in steps; 0 steps mean the largest rate.

        That 0 steps, the kit's default, mean the largest rate is our choice.
        """
        return min(math.radians(steps * step_deg), MAX_WHEEL_RATE_RADPS) if steps else MAX_WHEEL_RATE_RADPS

    def tyre_radps(self, speed_mps: float) -> float:
        """Return the angular speed of the tyres."""
        return speed_mps / self.tyre_radius_m


def clamp(number: float, lowest: float, highest: float) -> float:
    """Return the number of a range that is nearest to `number`."""
    return min(max(number, lowest), highest)


def commanded_wheel_rad(command: int) -> float:
    """Return the steering wheel angle of a command in tenths of a degree, limited to `MAX_WHEEL_RAD`."""
    return clamp(math.radians(command / 10), -MAX_WHEEL_RAD, MAX_WHEEL_RAD)


def tenths_of_degree(angle_rad: float) -> int:
    """Return an angle in the unit of reports."""
    return round(math.degrees(angle_rad) * 10)


def hundredths_of_kmh(speed_mps: float) -> int:
    """Return a speed in the unit of reports."""
    return round(speed_mps * 360)
