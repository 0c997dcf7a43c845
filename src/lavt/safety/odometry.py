"""Odometry from the vehicle's reported speed and road wheel angle, on the server's monotonic clock."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections import deque
from operator import attrgetter

from msgspec import Struct

from lavt.control.pure_pursuit import ORIGIN, PlanarPose, clamp, curvature_per_m, move_along_arc
from lavt.domain import NS_PER_S, VehicleState

MAX_SPEED_MPS = 100.0
MAX_CURVATURE_PER_M = 1.0
"""Larger values in reports are clamped, so that one bad report cannot ruin the computed pose."""


class PoseFix(Struct, frozen=True):
    """The pose of the rear axle at a time, with its speed and curvature. The first fix is the origin of the poses."""

    mono_ns: int
    travelled_m: float
    """Distance since the first fix."""
    pose: PlanarPose
    speed_mps: float
    curvature_per_m: float

    def extrapolate(self, mono_ns: int) -> PoseFix:
        """Return the fix at a later time with this speed and curvature; for an earlier time, return this pose."""
        step_m = self.speed_mps * max(0, mono_ns - self.mono_ns) / NS_PER_S
        pose = move_along_arc(self.pose, step_m, self.curvature_per_m)
        return PoseFix(mono_ns, self.travelled_m + step_m, pose, self.speed_mps, self.curvature_per_m)


class Odometry:
    """Dead reckoning from the vehicle's reports, with a memory of the last `memory_ns`.

    The model is the kinematic bicycle, which rolls without slip. Between two reports it has the mean of the two speeds
    and of the two curvatures, so that the result hardly depends on the rate of the reports.
    """

    def __init__(self, wheelbase_m: float, memory_ns: int) -> None:
        self._wheelbase_m = wheelbase_m
        self._memory_ns = memory_ns
        self._fixes: deque[PoseFix] = deque()

    def update(self, vehicle: VehicleState) -> None:
        """Add a report of the vehicle; ignore a report that is not newer than the last one.

        A speed or angle that is not finite is replaced by the previous speed or angle.
        """
        last = self._fixes[-1] if self._fixes else PoseFix(vehicle.mono_ns, 0.0, ORIGIN, 0.0, 0.0)
        if self._fixes and vehicle.mono_ns <= last.mono_ns:
            return
        speed_mps, new_curvature_per_m = last.speed_mps, last.curvature_per_m
        if math.isfinite(vehicle.speed_mps):
            speed_mps = clamp(vehicle.speed_mps, MAX_SPEED_MPS)
        if math.isfinite(vehicle.steering_rad):
            new_curvature_per_m = clamp(curvature_per_m(vehicle.steering_rad, self._wheelbase_m), MAX_CURVATURE_PER_M)
        step_m = (last.speed_mps + speed_mps) / 2 * (vehicle.mono_ns - last.mono_ns) / NS_PER_S
        pose = move_along_arc(last.pose, step_m, (last.curvature_per_m + new_curvature_per_m) / 2)
        self._fixes.append(PoseFix(vehicle.mono_ns, last.travelled_m + step_m, pose, speed_mps, new_curvature_per_m))
        while len(self._fixes) > 1 and self._fixes[1].mono_ns <= vehicle.mono_ns - self._memory_ns:
            self._fixes.popleft()

    def at(self, mono_ns: int) -> PoseFix:
        """Return the fix at a time, extrapolated from the last report before this time.

        For a time before the memory, return the oldest pose in the memory.
        """
        if not self._fixes:
            return PoseFix(mono_ns, 0.0, ORIGIN, 0.0, 0.0)
        after = bisect_right(self._fixes, mono_ns, key=attrgetter("mono_ns"))
        return self._fixes[max(0, after - 1)].extrapolate(mono_ns)
