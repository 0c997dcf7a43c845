"""The reward of the environment: integrals of the ground truth over the time of each step."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields

from lavt.domain import NS_PER_S, GroundTruth
from lavt.errors import UserError
from lavt.gym.settings import is_number


@dataclass(frozen=True, slots=True)
class RewardWeights:
    """The weights of the terms of the reward, none of which is negative."""

    progress: float = 0.1
    """Reward for each metre of progress along the lane's centre: 0.83 a second at 30 km/h."""
    cross_track: float = 0.5
    """Penalty for a cross-track error of 1 m for 1 s; it grows with the square of the error."""
    jerk: float = 0.01
    """Penalty for a lateral jerk of 1 m/s3 for 1 s; it grows with the square of the jerk."""
    failure: float = 10.0
    """Penalty at the end of an episode that ends because the car left the lane or the asphalt, had a collision, or was
    stopped by the vehicle."""


def parse_weights(weights: Mapping[str, float] | None) -> RewardWeights:
    """Return the default weights, of which `weights` replaces some; raise `UserError` for a wrong name or value."""
    if weights is not None and not isinstance(weights, Mapping):
        raise UserError(f"reward is {weights!r}: give weights by name, such as {{'progress': 0.2}}")
    known = [field.name for field in fields(RewardWeights)]
    for name, weight in (weights or {}).items():
        if name not in known:
            raise UserError(f"there is no term {name!r} of the reward; choose among {', '.join(known)}")
        if not is_number(weight, 0.0):
            raise UserError(f"the weight of {name} is {weight!r}: give a finite number that is at least 0")
    return RewardWeights(**{name: float(weight) for name, weight in (weights or {}).items()})


class RewardMeter:
    """A meter of the reward of one drive."""

    def __init__(self, weights: RewardWeights, wheelbase_m: float) -> None:
        self._weights = weights
        self._wheelbase_m = wheelbase_m

    def terms(self, truths: Sequence[GroundTruth], *, has_failed: bool) -> dict[str, float]:
        """Return the terms of a step's reward by name; the reward is their sum.

        `truths` are those of the step, and begin with the last one of the step before. So the sums over an episode do
        not depend on the lengths of its steps.
        """
        progress_m = cross_track_m2s = jerk_m2ps5 = 0.0
        for before, after in itertools.pairwise(truths):
            step_s = (after.mono_ns - before.mono_ns) / NS_PER_S
            if step_s <= 0:
                continue
            progress_m += after.progress_m - before.progress_m
            cross_track_m2s += (before.cross_track_m**2 + after.cross_track_m**2) / 2 * step_s
            jerk_m2ps5 += (self._lateral_mps2(after) - self._lateral_mps2(before)) ** 2 / step_s
        weights = self._weights
        return {
            "progress": weights.progress * progress_m,
            "cross_track": -weights.cross_track * cross_track_m2s,
            "jerk": -weights.jerk * jerk_m2ps5,
            "failure": -weights.failure if has_failed else 0.0,
        }

    def _lateral_mps2(self, truth: GroundTruth) -> float:
        """Return the lateral acceleration of the kinematic bicycle for the speed and the angle of the road wheels."""
        return truth.speed_mps**2 * math.tan(truth.steering_rad) / self._wheelbase_m
