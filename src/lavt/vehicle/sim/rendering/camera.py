"""The simulated camera: what a car at a pose would see of its road."""

from __future__ import annotations

import math
from collections.abc import Sequence

from lavt.domain import NS_PER_MS, CameraModel, Pose
from lavt.vehicle.camera import CapturedFrame, newest_pose
from lavt.vehicle.sim.rendering.light import LightName
from lavt.vehicle.sim.rendering.renderer import Renderer, SceneryKind
from lavt.vehicle.sim.road.road import Road

MAX_EXTRAPOLATION_NS = 20 * NS_PER_MS
"""How far beyond the newest pose the car is taken to go on as it did: the physics may lag a little."""


class SimCamera:
    """A `lavt.vehicle.camera.TimedCamera` that renders.

    With an exposure of 0 a frame shows the newest pose at or before its time. With a longer one it is the mean of what
    is seen from the pose when the shutter opens to the pose when it closes, both read between the poses that are known.
    """

    def __init__(
        self,
        *,
        model: CameraModel,
        rate_hz: float,
        phase_ns: int,
        road: Road,
        seed: int,
        scenery: SceneryKind = "full",
        light: LightName = "noon",
        exposure_ns: int = 0,
        sensor_delay_ns: int = 0,
    ) -> None:
        self._model, self._rate_hz, self._phase_ns = model, rate_hz, phase_ns
        self._exposure_ns, self._sensor_delay_ns = exposure_ns, sensor_delay_ns
        self._renderer = Renderer(road, model, seed=seed, scenery=scenery, light=light)

    @property
    def model(self) -> CameraModel:
        """Geometry of the pictures."""
        return self._model

    @property
    def rate_hz(self) -> float:
        """Frames a second."""
        return self._rate_hz

    @property
    def phase_ns(self) -> int:
        """When the shutter opens for frame 0, after the start."""
        return self._phase_ns

    @property
    def exposure_ns(self) -> int:
        """How long the shutter is open."""
        return self._exposure_ns

    @property
    def sensor_delay_ns(self) -> int:
        """From the end of the exposure to the picture being there; the time it takes to draw it comes on top."""
        return self._sensor_delay_ns

    def prepare(self) -> None:
        """Do beforehand what would make a frame late in real time."""
        self._renderer.prepare()

    def capture(self, number: int, at_ns: int, pose: Pose | None) -> CapturedFrame | None:
        """Render frame `number` for `pose`, in a moment; None without a pose."""
        if pose is None:
            return None
        return CapturedFrame(number, at_ns, self._renderer.render(pose, number))

    def expose(self, number: int, begin_ns: int, poses: Sequence[Pose]) -> CapturedFrame | None:
        """Render frame `number` as seen while the shutter was open; None when no pose is as old as its opening."""
        if self._exposure_ns == 0:
            return self.capture(number, begin_ns, newest_pose(poses, begin_ns))
        begin, end = interpolate_pose(poses, begin_ns), interpolate_pose(poses, begin_ns + self._exposure_ns)
        if begin is None or end is None:
            return None
        picture = self._renderer.render_exposed(begin, end, number)
        return CapturedFrame(number, begin_ns + self._exposure_ns // 2, picture)


def interpolate_pose(poses: Sequence[Pose], at_ns: int) -> Pose | None:
    """Read the pose at a time between those known (oldest first); None when all are later.

    Beyond the newest the motion of the last two goes on, for `LONGEST_GUESS_NS` at most: the physics tells a pose after
    its time, so the last one is a step old when the shutter closes.
    """
    before = newest_pose(poses, at_ns)
    if before is None or before.mono_ns == at_ns or len(poses) < 2:
        return before
    after = next((pose for pose in poses if pose.mono_ns > at_ns), None)
    first, second = (poses[-2], poses[-1]) if after is None else (before, after)
    if second.mono_ns <= first.mono_ns:
        return before
    until_ns = min(at_ns, second.mono_ns + MAX_EXTRAPOLATION_NS)
    share = (until_ns - first.mono_ns) / (second.mono_ns - first.mono_ns)
    turn_rad = math.remainder(second.heading_rad - first.heading_rad, 2 * math.pi)
    return Pose(
        until_ns,
        first.x_m + (second.x_m - first.x_m) * share,
        first.y_m + (second.y_m - first.y_m) * share,
        first.heading_rad + turn_rad * share,
    )
