"""What LAVT needs of a camera. Only the camera node calls it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol, runtime_checkable

from lavt.domain import NS_PER_S, CameraModel, FramePayload, Pose
from lavt.value import value


@value
class CapturedFrame:
    """A picture and when it was taken (server's monotonic clock, middle of exposure); None where it is not known.

    Of a V4L2 device it is what its driver says, the beginning of the exposure or the end of the transfer
    (docs/camera.md).

    The picture is (height, width, 3), blue green red, or what the camera gives in I420, (height * 3 / 2, width): that
    goes into the encoder as it is.
    """

    number: int
    capture_ns: int | None
    picture: FramePayload


@value
class FrameTimes:
    """When a camera's shutter opens (or closes) for each frame, on the server's monotonic clock."""

    first_ns: int
    rate_hz: float

    def due_ns(self, number: int) -> int:
        """When it does for frame `number`; from the number each time, so that nothing drifts."""
        return self.first_ns + round(number * NS_PER_S / self.rate_hz)


def newest_pose(poses: Sequence[Pose], at_ns: int) -> Pose | None:
    """Give the last pose at or before a time, of poses that are sorted by time; None when all are later."""
    return next((pose for pose in reversed(poses) if pose.mono_ns <= at_ns), None)


class Camera(Protocol):
    """Something that gives a frame at a time."""

    @property
    def model(self) -> CameraModel:
        """Geometry of the pictures."""
        ...

    @property
    def rate_hz(self) -> float:
        """Frames a second."""
        ...

    @property
    def phase_ns(self) -> int:
        """When frame 0 is taken, after the start, in [0, 1 / rate)."""
        ...

    def capture(self, number: int, at_ns: int, pose: Pose | None) -> CapturedFrame | None:
        """Give frame `number`, taken at `at_ns`; None when there is no picture.

        `pose` is the newest pose at or before `at_ns`; only a simulated camera has to do with it.
        """
        ...


@runtime_checkable
class TimedCamera(Camera, Protocol):
    """A camera that knows how long its shutter is open and how long its pictures take; the others need not."""

    @property
    def exposure_ns(self) -> int:
        """How long the shutter is open; 0 is a moment."""
        ...

    @property
    def sensor_delay_ns(self) -> int:
        """From the end of the exposure to the picture being there."""
        ...

    def expose(self, number: int, begin_ns: int, poses: Sequence[Pose]) -> CapturedFrame | None:
        """Give frame `number`, whose shutter opened at `begin_ns`; asked when its picture is there; None without one.

        `poses` are those known by then, oldest first; only a simulated camera has to do with them.
        """
        ...


@runtime_checkable
class CountingCamera(Camera, Protocol):
    """A camera of which pictures can get lost before anybody asks for them; the others need not count."""

    @property
    def counts(self) -> Mapping[str, int]:
        """What has happened to it so far; for the record."""
        ...
