"""A CARLA camera as a `lavt.vehicle.camera.TimedCamera`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from lavt.domain import CameraModel, Pose
from lavt.vehicle.camera import CapturedFrame
from lavt.vehicle.carla.follower import Follower
from lavt.vehicle.carla.session import CarlaSession
from lavt.vehicle.carla.ticker import Ticker


class CarlaCamera:
    """A camera on the car; a frame's capture time is the time of its tick.

    The world is ticked or followed by `ticker`, which is set when the vehicle starts.
    """

    exposure_ns = 0

    def __init__(
        self, session: CarlaSession, model: CameraModel, *, rate_hz: float, phase_ns: int, sensor_delay_ns: int
    ) -> None:
        self._session = session
        self.model, self.rate_hz, self.phase_ns, self.sensor_delay_ns = model, rate_hz, phase_ns, sensor_delay_ns
        self.ticker: Ticker | Follower | None = None
        self._last_ns = 0
        """The due time of the tick of the last frame."""

    @property
    def counts(self) -> Mapping[str, int]:
        """The number of pictures by outcome."""
        return self._session.pictures.counts

    def capture(self, number: int, at_ns: int, pose: Pose | None) -> CapturedFrame | None:  # noqa: ARG002 (Camera's)
        """Return the picture of the tick at `at_ns`.

        In real time, wait at most a period for a tick that has no frame yet. Returns None if no picture came.
        """
        return self._capture(number, at_ns)

    def capture_after_exposure(self, number: int, begin_ns: int, poses: Sequence[Pose]) -> CapturedFrame | None:  # noqa: ARG002 (TimedCamera's)
        """Return the picture of the tick at `begin_ns`, as `capture` does."""
        return self._capture(number, begin_ns)

    def _capture(self, number: int, at_ns: int) -> CapturedFrame | None:
        ticker, timeout_s = self.ticker, self._session.settings.tick_timeout_s
        if ticker is None:
            return None
        if isinstance(ticker, Follower):
            return self._capture_newest(number, ticker)
        if ticker.is_threaded:  # then only the actuator may look for ticks, because its silence brakes
            ticked = ticker.wait_for_tick(max(self._last_ns, at_ns - round(0.5e9 / self.rate_hz)), 1 / self.rate_hz)
            timeout_s = 1 / self.rate_hz
        else:
            ticker.tick_until(at_ns)
            ticked = ticker.ticked_at(at_ns)
        if ticked is None or ticked.due_ns <= self._last_ns:
            return None
        picture = self._session.pictures.take(ticked.snapshot.frame, timeout_s)
        if picture is None:
            self._session.check_camera()
            return None
        self._last_ns = ticked.due_ns
        return CapturedFrame(number, ticked.due_ns, picture)

    def _capture_newest(self, number: int, follower: Follower) -> CapturedFrame | None:
        """Return the newest picture of a world that runs by itself, waiting for a new one at most a period."""
        newest = self._session.pictures.take_newest(1 / self.rate_hz)
        if newest is None:
            self._session.check_camera()
        ticked = None if newest is None else follower.wait_for_frame(newest[0], 1 / self.rate_hz)
        if newest is None or ticked is None or ticked.due_ns <= self._last_ns:
            return None
        self._last_ns = ticked.due_ns
        return CapturedFrame(number, ticked.due_ns, newest[1])
