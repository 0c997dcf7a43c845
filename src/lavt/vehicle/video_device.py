"""A real camera: a V4L2 device, or a file or an address that OpenCV opens, read by a thread of its own."""

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

from lavt.clock import Clock
from lavt.domain import NS_PER_MS, NS_PER_S, CameraModel, Picture, Pose
from lavt.errors import UserError
from lavt.value import value
from lavt.vehicle.camera import CapturedFrame

log = logging.getLogger(__name__)

RETRY_S: Final = 1.0
"""A camera that gives nothing is opened again so often."""
MAX_CREDIBLE_RATE_HZ: Final = 1000.0
"""Streams without a rate of their own name that of their time stamps (90 kHz), which is none of pictures."""
RATE_TOLERANCE: Final = 0.01
"""30 and 29.97 Hz are one rate."""
MAX_BUFFER_AGE_NS: Final = NS_PER_S
"""A buffer's time that lies longer ago is of another clock: V4L2 drivers hold a few pictures at most."""
WAIT_PERIODS: Final = 0.25
"""So long a picture is waited for: a camera runs by a clock of its own, and where its pictures come just when they are
asked for, many would be missed by a hair. They may be late by more than they vary, and one is missed only when the
clocks have drifted apart by a period."""
MAX_AGE_PERIODS: Final = 2
"""With equal rates a picture waits for one period at most; one that waited for two is of a camera that has stopped."""
COUNTER_NAMES: Final = (
    "pictures_read",
    "pictures_replaced",  # by a newer one, before anybody asked
    "pictures_too_old",
    "pictures_without_a_time",
    "pictures_of_another_size",
    "times_lost",
    "times_back",
    "times_opened_again",
)
CLOSE_TIMEOUT_S: Final = 2.0
_TIMEOUT_MS: Final = 3000

# A camera that is gone is said here once, in words, and not by OpenCV at each attempt.
cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)


@value
class DeviceFormat:
    """What a device gives: its pictures' size, and their rate as it says itself; None where it does not."""

    width_px: int
    height_px: int
    rate_hz: float | None

    def __str__(self) -> str:
        """Say it in words."""
        rate = "" if self.rate_hz is None else f" at {self.rate_hz:.4g} Hz"
        return f"{self.width_px}x{self.height_px}{rate}"


@value
class _BufferedPicture:
    picture: Picture
    arrived_ns: int
    capture_ns: int | None


class VideoDevice:
    """A `Camera` that gives the newest picture that came since the last one it gave.

    `device` is a V4L2 device (its path or its number), or a file or address that OpenCV opens (FFmpeg): a file is
    played at its own pace, over and over. `pixel_format` is V4L2's name of a format (four characters, such as MJPG);
    empty: the driver's choice. Raises `UserError` for what cannot be opened, or gives pictures of another size or rate
    than asked. What vanishes later is tried again each second; meanwhile there are no pictures.
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
        capture, picture = self._first_picture()
        self._due_ns = clock.now().mono_ns
        self._store(capture, picture)
        self._thread = threading.Thread(target=self._run, args=(capture,), name="camera device", daemon=True)
        self._thread.start()
        atexit.register(self.close)  # nothing else closes a camera: it shall be free when the program has ended

    @property
    def counts(self) -> Mapping[str, int]:
        """What became of the pictures, and how often the device was lost and tried again."""
        with self._changed:
            return dict(self._counts)

    def capture(self, number: int, at_ns: int, pose: Pose | None) -> CapturedFrame | None:  # noqa: ARG002 (Camera's)
        """Give the newest picture that was not given before, waiting a little for one; None when there is none.

        Nor is there one when the newest has waited for too long.
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
        """Wait until there is a picture to give; whether there is one."""
        with self._changed:
            return self._changed.wait_for(self._has_picture, timeout_s)

    def close(self) -> None:
        """Let go of the device."""
        atexit.unregister(self.close)
        self._stopped.set()
        self._thread.join(CLOSE_TIMEOUT_S)

    def _has_picture(self) -> bool:
        return self._newest is not None

    def _first_picture(self) -> tuple[cv2.VideoCapture, Picture]:
        """Open the device and read one picture, which must be as asked."""
        capture = self._open()
        picture = _read_picture(capture)
        if picture is None:
            raise UserError(_no_picture_message(self._device, is_open=capture.isOpened()))
        if self._pixel_format and round(capture.get(cv2.CAP_PROP_FOURCC)) != _fourcc(self._pixel_format):
            raise UserError(
                f"{self._device} gives no pictures in the format {self._pixel_format}: choose another camera.format "
                "(`v4l2-ctl --list-formats-ext` names them), or none"
            )
        reported_hz = capture.get(cv2.CAP_PROP_FPS)
        reported = DeviceFormat(
            picture.shape[1], picture.shape[0], reported_hz if 0 < reported_hz <= MAX_CREDIBLE_RATE_HZ else None
        )
        requested = DeviceFormat(self.model.width_px, self.model.height_px, self.rate_hz)
        if not _matches_request(reported, self.model, self.rate_hz):
            capture.release()
            raise UserError(
                f"{self._device} gives {reported}, but camera asks for {requested}: set camera.width_px, height_px and "
                "rate_hz to what it gives, or camera.format to one in which it gives that"
            )
        return capture, picture

    def _open(self) -> cv2.VideoCapture:
        """Open the device, or what cannot be read from if it is not there."""
        if not self._is_v4l2:
            limits = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, _TIMEOUT_MS, cv2.CAP_PROP_READ_TIMEOUT_MSEC, _TIMEOUT_MS]
            one_thread = [cv2.CAP_PROP_N_THREADS, 1]  # each further one of FFmpeg's is a picture of delay
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
        """Read until told to stop; open again what has ended: a file at once, anything else after a while."""
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
        """Read pictures until there are no more, or until told to stop, and tell how many there were."""
        pictures = 0
        while not self._stopped.wait(self._wait_s()):
            picture = _read_picture(capture)
            if picture is None:
                break
            pictures += 1
            self._store(capture, picture)
        return pictures

    def _wait_s(self) -> float:
        """How long the next picture of a file is not due; a device's comes by itself."""
        return max(0.0, (self._due_ns - self._clock.now().mono_ns) / NS_PER_S) if self._is_file else 0.0

    def _store(self, capture: cv2.VideoCapture, picture: Picture) -> None:
        arrived_ns = self._clock.now().mono_ns
        self._due_ns = max(self._due_ns + round(NS_PER_S / self.rate_hz), arrived_ns)  # what is late is not caught up
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
            log.warning("the camera %s gives pictures again", self._device)

    def _mark_lost(self) -> None:
        with self._changed:
            is_new = self._counts["times_lost"] == self._counts["times_back"]
            self._counts["times_lost"] += is_new
        if is_new:
            log.warning("the camera %s gives no pictures any more: it is opened again each second", self._device)


def buffer_time_ns(position_ms: float, arrived_ns: int) -> int | None:
    """Give a V4L2 buffer's time, which OpenCV tells as the position; None where it is not of the monotonic clock.

    A buffer's time is of the clock its driver likes, and OpenCV does not tell which: it counts where it lies in the
    second before the picture came. Linux, Documentation/userspace-api/media/v4l/buffer.rst.
    """
    if not math.isfinite(position_ms):
        return None
    buffer_ns = round(position_ms * NS_PER_MS)
    return buffer_ns if 0 <= arrived_ns - buffer_ns <= MAX_BUFFER_AGE_NS else None


def _fourcc(pixel_format: str) -> int:
    return cv2.VideoWriter.fourcc(*pixel_format)


def _read_picture(capture: cv2.VideoCapture) -> Picture | None:
    """Read one picture; None where there is none, or it is not in three bytes a pixel."""
    try:
        good, picture = capture.read()
    except cv2.error:  # of a picture that cannot be decoded, on some devices
        return None
    return cast("Picture", picture) if good and picture.ndim == 3 and picture.dtype == np.uint8 else None


def _matches_request(reported: DeviceFormat, model: CameraModel, rate_hz: float) -> bool:
    """Whether a device gives what it was asked for; a rate that it does not tell is not held against it."""
    is_of_size = (reported.width_px, reported.height_px) == (model.width_px, model.height_px)
    return is_of_size and (reported.rate_hz is None or math.isclose(reported.rate_hz, rate_hz, rel_tol=RATE_TOLERANCE))


def _no_picture_message(device: str, *, is_open: bool) -> str:
    if is_open:
        return f"{device} opens, but no picture comes of it: see that no other program has it, and that it is a camera"
    return (
        f"{device} cannot be opened as a camera: see that it is there (`ls -l /dev/v4l/by-id`), and that this user may "
        "read it (group video)"
    )
