"""The simulated camera, which renders the road from the car's pose."""

from __future__ import annotations

import math
from collections.abc import Sequence

from lavt.domain import NS_PER_MS, CameraModel, Pose
from lavt.vehicle.camera import CapturedFrame, newest_pose
from lavt.vehicle.sim.rendering.light import LightName
from lavt.vehicle.sim.rendering.renderer import Renderer, SceneryKind
from lavt.vehicle.sim.rendering.weather import WeatherName
from lavt.vehicle.sim.road.road import Road

MAX_EXTRAPOLATION_NS = 20 * NS_PER_MS
"""The longest extrapolation beyond the newest pose. It is longer than a step of the physics, which can be late."""


class SimCamera:
    """A `lavt.vehicle.camera.TimedCamera` that renders its pictures.

    With an exposure of 0 a frame shows the view from the newest pose at or before the frame's time. With a longer
    exposure a frame is the mean of the views from several poses, between the pose when the shutter opens and the pose
    when it closes. Both poses are interpolated.
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
        weather: WeatherName = "clear",
        exposure_ns: int = 0,
        sensor_delay_ns: int = 0,
    ) -> None:
        self.model = model
        self.rate_hz = rate_hz
        self.phase_ns = phase_ns
        self.exposure_ns = exposure_ns
        self.sensor_delay_ns = sensor_delay_ns
        self._renderer = Renderer(road, model, seed=seed, scenery=scenery, light=light, weather=weather)

    def prepare(self) -> None:
        """Fill the caches whose first use would delay a frame in real time."""
        self._renderer.prepare()

    def capture(self, number: int, at_ns: int, pose: Pose | None) -> CapturedFrame | None:
        """Render frame `number` for `pose` without motion blur; None without a pose."""
        if pose is None:
            return None
        return CapturedFrame(number, at_ns, self._renderer.render(pose, number))

    def capture_after_exposure(self, number: int, begin_ns: int, poses: Sequence[Pose]) -> CapturedFrame | None:
        """Render frame `number` with motion blur; None if all poses are later than the opening of the shutter."""
        if self.exposure_ns == 0:
            return self.capture(number, begin_ns, newest_pose(poses, begin_ns))
        begin, end = interpolate_pose(poses, begin_ns), interpolate_pose(poses, begin_ns + self.exposure_ns)
        if begin is None or end is None:
            return None
        picture = self._renderer.render_exposed(begin, end, number)
        return CapturedFrame(number, begin_ns + self.exposure_ns // 2, picture)


def interpolate_pose(poses: Sequence[Pose], at_ns: int) -> Pose | None:
    """Return the pose at a time, interpolated between poses sorted by time; None if all poses are later.

    Beyond the newest pose, the motion between the last two poses is extrapolated for at most `MAX_EXTRAPOLATION_NS`.
    This is necessary because the physics reports each pose after its time: when the shutter closes, the newest reported
    pose is a step old.
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
