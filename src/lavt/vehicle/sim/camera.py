"""The simulated camera: what a car at a pose would see of its road."""

from __future__ import annotations

from lavt.domain import CameraModel, Pose
from lavt.vehicle.camera import CapturedFrame
from lavt.vehicle.sim.renderer import Renderer, SceneryKind
from lavt.vehicle.sim.road import Road


class SimCamera:
    """A `lavt.vehicle.camera.Camera` that renders; its exposure is a moment: a frame is taken when it is asked for."""

    def __init__(
        self,
        *,
        model: CameraModel,
        rate_hz: float,
        phase_ns: int,
        road: Road,
        seed: int,
        scenery: SceneryKind = "full",
    ) -> None:
        self._model, self._rate_hz, self._phase_ns = model, rate_hz, phase_ns
        self._renderer = Renderer(road, model, seed=seed, scenery=scenery)

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
        """When frame 0 is taken, after the start."""
        return self._phase_ns

    def prepare(self) -> None:
        """Paint the ground along the route beforehand: a frame that has to wait for it is late in real time."""
        self._renderer.prepare()

    def capture(self, number: int, at_ns: int, pose: Pose | None) -> CapturedFrame | None:
        """Render frame `number` for `pose`; None without a pose."""
        if pose is None:
            return None
        return CapturedFrame(number, at_ns, self._renderer.render(pose, number))
