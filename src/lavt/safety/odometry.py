"""Where a vehicle has been by its own account: speed and road wheel angle, added up on the server's monotonic clock."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections import deque
from operator import attrgetter

from lavt.control.pure_pursuit import SEEN_FROM, Place, curvature_per_m, limited, moved
from lavt.domain import NS_PER_S, VehicleState
from lavt.value import value

SPEED_WITHIN_MPS = 100.0
CURVATURE_WITHIN_PER_M = 1.0
"""What a car reports beyond these is brought within: no sum may run away on one bad report."""


@value
class PoseFix:
    """Where the rear axle was at a time, in the frame of the first fix, and how it went on from there."""

    mono_ns: int
    travelled_m: float
    place: Place
    speed_mps: float
    curvature_per_m: float

    def at(self, mono_ns: int) -> PoseFix:
        """Tell where it is at another time if it goes on like this; never before this fix."""
        step_m = self.speed_mps * max(0, mono_ns - self.mono_ns) / NS_PER_S
        place = moved(self.place, step_m, self.curvature_per_m)
        return PoseFix(mono_ns, self.travelled_m + step_m, place, self.speed_mps, self.curvature_per_m)


class Odometry:
    """Adds up what the vehicle reports, however often it is looked at, and remembers the way for `memory_ns`.

    The car is taken as one that rolls without slip (kinematic bicycle). Between two reports it has the mean of both
    speeds and of both curvatures.
    """

    def __init__(self, wheelbase_m: float, memory_ns: int) -> None:
        self._wheelbase_m = wheelbase_m
        self._memory_ns = memory_ns
        self._fixes: deque[PoseFix] = deque()

    def note(self, vehicle: VehicleState) -> None:
        """Take over what the vehicle reports; a report that is not newer than the last one is left out.

        A speed or an angle that is no number is taken as the one before.
        """
        last = self._fixes[-1] if self._fixes else PoseFix(vehicle.mono_ns, 0.0, SEEN_FROM, 0.0, 0.0)
        if self._fixes and vehicle.mono_ns <= last.mono_ns:
            return
        speed_mps, bend_per_m = last.speed_mps, last.curvature_per_m
        if math.isfinite(vehicle.speed_mps):
            speed_mps = limited(vehicle.speed_mps, SPEED_WITHIN_MPS)
        if math.isfinite(vehicle.steering_rad):
            bend_per_m = limited(curvature_per_m(vehicle.steering_rad, self._wheelbase_m), CURVATURE_WITHIN_PER_M)
        step_m = (last.speed_mps + speed_mps) / 2 * (vehicle.mono_ns - last.mono_ns) / NS_PER_S
        place = moved(last.place, step_m, (last.curvature_per_m + bend_per_m) / 2)
        self._fixes.append(PoseFix(vehicle.mono_ns, last.travelled_m + step_m, place, speed_mps, bend_per_m))
        while len(self._fixes) > 1 and self._fixes[1].mono_ns <= vehicle.mono_ns - self._memory_ns:
            self._fixes.popleft()

    def at(self, mono_ns: int) -> PoseFix:
        """Tell where the vehicle was at a time, or will be if it goes on as it last did.

        A time before all that is remembered is taken as the first of that.
        """
        if not self._fixes:
            return PoseFix(mono_ns, 0.0, SEEN_FROM, 0.0, 0.0)
        after = bisect_right(self._fixes, mono_ns, key=attrgetter("mono_ns"))
        return self._fixes[max(0, after - 1)].at(mono_ns)
