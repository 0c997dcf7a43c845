"""The presets: named sets of settings of the controllers."""

from __future__ import annotations

import math
from dataclasses import dataclass

from lavt.control.lane_watch import LANE_CONFIDENCE
from lavt.control.pure_pursuit import curvature_per_m
from lavt.errors import UserError

WHEEL_LIMIT_RAD = 0.5
"""Largest road wheel angle of a car."""


@dataclass(frozen=True, slots=True)
class Preset:
    """A named set of settings.

    The lookahead steers the lane keeper, and gives the path that a vehicle without commands follows.
    """

    name: str
    lookahead_s: float
    lateral_limit_mps2: float = math.inf
    steering_limit_rad: float = WHEEL_LIMIT_RAD
    speed_mps: float = 30 / 3.6
    lane_confidence: float = LANE_CONFIDENCE
    """The lowest confidence, 0 to 1, of a lane that is followed."""

    def curvature_limit_per_m(self, speed_mps: float, wheelbase_m: float) -> float:
        """Return the smaller of the steering limit and the lateral acceleration limit at this speed, as a curvature."""
        steering_limit_per_m = curvature_per_m(self.steering_limit_rad, wheelbase_m)
        return min(steering_limit_per_m, self.lateral_limit_mps2 / max(speed_mps, 1.0) ** 2)


DESIGNED = Preset("designed", lookahead_s=1.01, lateral_limit_mps2=3.0)
"""The default preset, designed from a model and not tuned under delay.

The lookahead is the smallest one with 30 degrees of phase margin at 30 km/h, rounded up. The margin is computed by the
sampled-data model of `lavt.experiment.boundary.delay_margin`, for 81 ms from exposure to wheel command: 62 + 9 ms of
the network `paper_wifi5`, and 10 ms of processing. `benchmarks/find_designed_preset.py` prints the lookahead. 3 m/s2 is
the lateral acceleration that a vehicle allows by default. The preset is valid for the simulator's default car (steering
lag 0.12 s, no dead time).
"""

PAPER_CALIBRATED = Preset("paper_calibrated", lookahead_s=0.74, steering_limit_rad=0.21)
"""The preset that reproduces the paper, which publishes no gains.

Lookahead and steering limit (5.2 m/s2 at 30 km/h) were chosen so that the completion rate collapses between the
conditions L2 and L3, as in the paper; nothing else was fitted. The lookahead leaves a phase margin of 19 degrees at L0,
too little for a designed controller. The preset is valid for the simulator's default car.
"""

PRESETS = {preset.name: preset for preset in (DESIGNED, PAPER_CALIBRATED)}


def find_preset(name: str) -> Preset:
    """Return the preset of that name; raise `UserError` for an unknown name."""
    if name not in PRESETS:
        raise UserError(f"there is no preset {name!r}; choose one of {', '.join(sorted(PRESETS))}")
    return PRESETS[name]
