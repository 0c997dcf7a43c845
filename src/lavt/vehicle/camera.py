"""The camera interface. Only the camera node calls it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol, runtime_checkable

from msgspec import Struct

from lavt.domain import NS_PER_S, CameraModel, FramePayload, Pose


class CapturedFrame(Struct, frozen=True):
    """A picture with its frame number and its capture time."""

    number: int
    capture_ns: int | None
    """The middle of the exposure on the server's monotonic clock; None if unknown. Of a V4L2 device it is the time that
    the driver reports: the beginning of the exposure or the end of the transfer (docs/camera.md)."""
    picture: FramePayload
    """A picture of the shape (height, width, 3), in the order blue, green, red. If the camera delivers I420, the shape
    is (height * 3 / 2, width) instead, and the picture goes into the encoder unchanged."""


class FrameTimes(Struct, frozen=True):
    """The times at which the shutter opens for each frame, or those at which it closes (server's monotonic clock)."""

    first_ns: int
    rate_hz: float

    def due_ns(self, number: int) -> int:
        """Return the time of frame `number`. It is computed from the number, so that no error accumulates."""
        return self.first_ns + round(number * NS_PER_S / self.rate_hz)


def newest_pose(poses: Sequence[Pose], at_ns: int) -> Pose | None:
    """Return the last pose at or before a time; None if all poses are later. The poses are sorted by time."""
    return next((pose for pose in reversed(poses) if pose.mono_ns <= at_ns), None)


class Camera(Protocol):
    """A source of frames, captured one at a time."""

    @property
    def model(self) -> CameraModel:
        """The geometry of the pictures."""
        ...

    @property
    def rate_hz(self) -> float:
        """Frames per second."""
        ...

    @property
    def phase_ns(self) -> int:
        """The time between the start of the server and frame 0, in [0, 1 / rate)."""
        ...

    def capture(self, number: int, at_ns: int, pose: Pose | None) -> CapturedFrame | None:
        """Return frame `number`, captured at `at_ns`; None if there is no picture.

        `pose` is the newest pose at or before `at_ns`; only a simulated camera uses it.
        """
        ...


@runtime_checkable
class TimedCamera(Camera, Protocol):
    """A camera that knows its exposure time and its sensor delay."""

    @property
    def exposure_ns(self) -> int:
        """The exposure time; 0 means an instant."""
        ...

    @property
    def sensor_delay_ns(self) -> int:
        """The time between the end of the exposure and the moment when the picture is available."""
        ...

    def capture_after_exposure(self, number: int, begin_ns: int, poses: Sequence[Pose]) -> CapturedFrame | None:
        """Return frame `number`, whose shutter opened at `begin_ns`; None if there is no picture.

        Call this method when the picture is available. `poses` are the poses known by then, oldest first; only a
        simulated camera uses them.
        """
        ...


@runtime_checkable
class CountingCamera(Camera, Protocol):
    """A camera that can lose pictures before they are requested, and counts the lost pictures."""

    @property
    def counts(self) -> Mapping[str, int]:
        """The counters so far, for the record."""
        ...
