"""A real camera: a V4L2 device, or a file or address that OpenCV opens, read in a thread of its own."""

from __future__ import annotations

import atexit
import logging
import math
import threading
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Final, cast

import cv2
import cv2.utils.logging
import numpy as np
from msgspec import Struct

from lavt.clock import Clock
from lavt.domain import NS_PER_MS, NS_PER_S, CameraModel, Picture, Pose
from lavt.errors import UserError
from lavt.vehicle.camera import CapturedFrame

log = logging.getLogger(__name__)

RETRY_S: Final = 1.0
"""The interval at which a camera without pictures is reopened."""
MAX_CREDIBLE_RATE_HZ: Final = 1000.0
"""A higher reported rate is ignored: streams without a frame rate report the rate of their timestamps (90 kHz)."""
RATE_TOLERANCE: Final = 0.01
"""The relative difference up to which two rates are equal, such as 30 and 29.97 Hz."""
MAX_BUFFER_AGE_NS: Final = NS_PER_S
"""A buffer time that is further in the past must be of another clock, because V4L2 drivers queue only a few pictures.
"""
WAIT_PERIODS: Final = 0.25
"""The longest wait of `capture` for a picture, in frame periods.

The camera's clock and the server's clock drift apart. If pictures arrive at about the time when they are requested,
`capture` would miss many of them because of jitter. The wait is longer than the jitter. So `capture` misses a picture
only when the clocks have drifted apart by a period.
"""
MAX_AGE_PERIODS: Final = 2
"""If the newest picture is older than this, in frame periods, the camera has stopped. A picture of a camera that runs
is requested at most one period after its arrival."""
COUNTER_NAMES: Final = (
    "pictures_read",
    "pictures_replaced",  # by a newer picture, before they were requested
    "pictures_too_old",
    "pictures_without_a_time",
    "pictures_of_another_size",
    "times_lost",
    "times_back",
    "times_opened_again",
)
CLOSE_TIMEOUT_S: Final = 2.0
_TIMEOUT_MS: Final = 3000
"""FFmpeg's limit for opening a file or address, and for reading a picture from it."""

# This module logs a lost camera once; without this OpenCV would print a message at each attempt.
cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)


class DeviceFormat(Struct, frozen=True):
    """The size and rate of a device's pictures."""

    width_px: int
    height_px: int
    rate_hz: float | None
    """None if the device reports no rate."""

    def __str__(self) -> str:
        """Return the size and rate as text."""
        rate = "" if self.rate_hz is None else f" at {self.rate_hz:.4g} Hz"
        return f"{self.width_px}x{self.height_px}{rate}"


class _BufferedPicture(Struct, frozen=True):
    picture: Picture
    arrived_ns: int
    capture_ns: int | None


class VideoDevice:
    """A `Camera` whose `capture` returns the newest picture received since the last call.

    `device` is a V4L2 device (its path or number), or a file or address that OpenCV opens with FFmpeg. A file is played
    at its frame rate in a loop. `pixel_format` is V4L2's name of a format (four characters, such as MJPG); with an
    empty name the driver chooses. Raises `UserError` if the device cannot be opened or has another size or rate than
    requested. If the device disappears later, it is reopened each second, and there are no pictures until it is back.
    """

    phase_ns = 0

    def __init__(
        self, device: str, *, model: CameraModel, rate_hz: float, clock: Clock, pixel_format: str = ""
    ) -> None:
        self.model = model
        self.rate_hz = rate_hz
        self._device = f"/dev/video{device}" if device.isdecimal() else device
        self._pixel_format = pixel_format
        self._clock = clock
        self._is_v4l2 = self._device.startswith("/dev/")
        self._is_file = Path(self._device).is_file()
        self._counts = Counter(dict.fromkeys(COUNTER_NAMES, 0))
        self._newest: _BufferedPicture | None = None
        self._changed = threading.Condition()
        self._stopped = threading.Event()
        capture, picture = self._open_and_check()
        self._due_ns = clock.now().mono_ns
        self._store(capture, picture)
        self._thread = threading.Thread(target=self._run, args=(capture,), name="camera device", daemon=True)
        self._thread.start()
        atexit.register(self.close)  # nothing else releases the device when the program ends

    @property
    def counts(self) -> Mapping[str, int]:
        """The number of pictures by outcome, and how often the device was lost, came back and was reopened."""
        with self._changed:
            return dict(self._counts)

    def capture(self, number: int, at_ns: int, pose: Pose | None) -> CapturedFrame | None:  # noqa: ARG002 (Camera's)
        """Return the newest picture that was not returned before; wait for it for a short time if there is none yet.

        Returns None if no picture arrived, or if the newest picture is too old.
        """
        with self._changed:
            self._changed.wait_for(self._has_picture, WAIT_PERIODS / self.rate_hz)
            newest, self._newest = self._newest, None
            if newest is None:
                return None
            if at_ns - newest.arrived_ns > MAX_AGE_PERIODS * NS_PER_S / self.rate_hz:
                self._counts["pictures_too_old"] += 1
                return None
            return CapturedFrame(number, newest.capture_ns, newest.picture)

    def wait(self, timeout_s: float) -> bool:
        """Wait until a picture is available; return False if none is available after the timeout."""
        with self._changed:
            return self._changed.wait_for(self._has_picture, timeout_s)

    def close(self) -> None:
        """Stop the thread, which releases the device."""
        atexit.unregister(self.close)
        self._stopped.set()
        self._thread.join(CLOSE_TIMEOUT_S)

    def _has_picture(self) -> bool:
        return self._newest is not None

    def _open_and_check(self) -> tuple[cv2.VideoCapture, Picture]:
        """Open the device and read one picture; raise `UserError` unless it has the requested format."""
        capture = self._open()
        picture = _read_picture(capture)
        if picture is None:
            raise UserError(_no_picture_message(self._device, is_open=capture.isOpened()))
        if self._pixel_format and round(capture.get(cv2.CAP_PROP_FOURCC)) != _fourcc(self._pixel_format):
            raise UserError(
                f"{self._device} has no pictures in the format {self._pixel_format}: choose another camera.format "
                "(`v4l2-ctl --list-formats-ext` lists them), or none"
            )
        reported_hz = capture.get(cv2.CAP_PROP_FPS)
        reported = DeviceFormat(
            picture.shape[1], picture.shape[0], reported_hz if 0 < reported_hz <= MAX_CREDIBLE_RATE_HZ else None
        )
        requested = DeviceFormat(self.model.width_px, self.model.height_px, self.rate_hz)
        if not _matches_request(reported, self.model, self.rate_hz):
            capture.release()
            raise UserError(
                f"{self._device} has {reported}, but camera requests {requested}: set camera.width_px, height_px and "
                "rate_hz to the device's values, or camera.format to a format that has the requested ones"
            )
        return capture, picture

    def _open(self) -> cv2.VideoCapture:
        """Open the device; if it cannot be opened, reading from the result fails."""
        if not self._is_v4l2:
            limits = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, _TIMEOUT_MS, cv2.CAP_PROP_READ_TIMEOUT_MSEC, _TIMEOUT_MS]
            one_thread = [cv2.CAP_PROP_N_THREADS, 1]  # each further FFmpeg thread adds a frame of delay
            return cv2.VideoCapture(self._device, cv2.CAP_FFMPEG, [*limits, *one_thread])
        capture = cv2.VideoCapture(self._device, cv2.CAP_V4L2)
        if capture.isOpened():
            if self._pixel_format:
                capture.set(cv2.CAP_PROP_FOURCC, _fourcc(self._pixel_format))
            capture.set(cv2.CAP_PROP_FRAME_WIDTH, self.model.width_px)
            capture.set(cv2.CAP_PROP_FRAME_HEIGHT, self.model.height_px)
            capture.set(cv2.CAP_PROP_FPS, self.rate_hz)
        return capture

    def _run(self, capture: cv2.VideoCapture) -> None:
        """Read until the camera is closed.

        When the source ends, reopen a file that had pictures at once, and anything else after `RETRY_S`.
        """
        while True:
            pictures = self._read_until_end(capture)
            capture.release()
            if self._stopped.is_set():
                return
            if not (self._is_file and pictures):
                self._mark_lost()
                self._stopped.wait(RETRY_S)
            capture = self._open()
            with self._changed:
                self._counts["times_opened_again"] += 1

    def _read_until_end(self, capture: cv2.VideoCapture) -> int:
        """Read pictures until the source ends or the camera is closed; return the number of pictures."""
        pictures = 0
        while not self._stopped.wait(self._wait_s()):
            picture = _read_picture(capture)
            if picture is None:
                break
            pictures += 1
            self._store(capture, picture)
        return pictures

    def _wait_s(self) -> float:
        """Return how long until the next picture of a file is due; 0 for other sources, because reading them blocks."""
        return max(0.0, (self._due_ns - self._clock.now().mono_ns) / NS_PER_S) if self._is_file else 0.0

    def _store(self, capture: cv2.VideoCapture, picture: Picture) -> None:
        arrived_ns = self._clock.now().mono_ns
        self._due_ns = max(self._due_ns + round(NS_PER_S / self.rate_hz), arrived_ns)  # no catching up after a delay
        capture_ns = buffer_time_ns(capture.get(cv2.CAP_PROP_POS_MSEC), arrived_ns) if self._is_v4l2 else None
        with self._changed:
            if picture.shape != (self.model.height_px, self.model.width_px, 3):
                self._counts["pictures_of_another_size"] += 1
                return
            self._counts["pictures_read"] += 1
            self._counts["pictures_without_a_time"] += capture_ns is None
            self._counts["pictures_replaced"] += self._newest is not None
            self._newest = _BufferedPicture(picture, arrived_ns, capture_ns)
            is_back = self._counts["times_lost"] > self._counts["times_back"]
            self._counts["times_back"] += is_back
            self._changed.notify_all()
        if is_back:
            log.warning("camera %s: pictures received again", self._device)

    def _mark_lost(self) -> None:
        with self._changed:
            is_new = self._counts["times_lost"] == self._counts["times_back"]
            self._counts["times_lost"] += is_new
        if is_new:
            log.warning("camera %s: no more pictures; reopening it every %g s", self._device, RETRY_S)


def buffer_time_ns(position_ms: float, arrived_ns: int) -> int | None:
    """Return a V4L2 buffer's time, which OpenCV reports as the position; None if it is not of the monotonic clock.

    The driver chooses the clock of a buffer's time, and OpenCV does not report the choice. So the time is accepted only
    if it lies in the second before the picture arrived. See Linux, Documentation/userspace-api/media/v4l/buffer.rst.
    """
    if not math.isfinite(position_ms):
        return None
    buffer_ns = round(position_ms * NS_PER_MS)
    return buffer_ns if 0 <= arrived_ns - buffer_ns <= MAX_BUFFER_AGE_NS else None


def _fourcc(pixel_format: str) -> int:
    return cv2.VideoWriter.fourcc(*pixel_format)


def _read_picture(capture: cv2.VideoCapture) -> Picture | None:
    """Read one picture; return None if there is none, or if it does not have three bytes per pixel."""
    try:
        is_read, picture = capture.read()
    except cv2.error:  # raised by some devices for a picture that cannot be decoded
        return None
    return cast("Picture", picture) if is_read and picture.ndim == 3 and picture.dtype == np.uint8 else None


def _matches_request(reported: DeviceFormat, model: CameraModel, rate_hz: float) -> bool:
    """Return whether a device has the requested size and rate; an unreported rate is accepted."""
    has_size = (reported.width_px, reported.height_px) == (model.width_px, model.height_px)
    return has_size and (reported.rate_hz is None or math.isclose(reported.rate_hz, rate_hz, rel_tol=RATE_TOLERANCE))


def _no_picture_message(device: str, *, is_open: bool) -> str:
    if is_open:
        return f"{device} opens, but has no pictures: check that no other program uses it and that it is a camera"
    return (
        f"{device} cannot be opened as a camera: check that it exists (`ls -l /dev/v4l/by-id`) and that this user is "
        "allowed to read it (group video)"
    )
