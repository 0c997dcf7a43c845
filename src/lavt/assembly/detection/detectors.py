"""The lane detectors by name: LAVT's own, and those that packages register."""

from __future__ import annotations

import math
from collections.abc import Callable
from importlib.metadata import entry_points
from statistics import median

import numpy as np

from lavt.assembly.detection.onnx import build_network_paint
from lavt.clock import MachineClock
from lavt.config.perception import BUILT_IN, ONNX
from lavt.domain import NS_PER_MS, Now
from lavt.errors import UserError
from lavt.perception.calibration import CalibratedCamera
from lavt.perception.detection import DetectorFactory, DetectorSettings, PaintFinder, PictureDetector
from lavt.perception.lane_detector import LaneDetector

CUSTOM_DETECTORS = "lavt.detectors"
"""The group of entry points with which users add detectors, each a `DetectorFactory`."""
GREY = 85
"""The brightness of the picture with which a detector is timed."""
TIMED_PICTURES = 5


def _built_in(camera: CalibratedCamera, settings: DetectorSettings) -> PictureDetector:
    return _lane_detector(camera, settings, None)


def _lane_detector(
    camera: CalibratedCamera, settings: DetectorSettings, paint_finder: PaintFinder | None
) -> LaneDetector:
    return LaneDetector(
        camera,
        lane_width_m=settings.lane_width_m,
        stamped=settings.stamped,
        track_confidence=settings.track_confidence,
        paint_finder=paint_finder,
    )


DETECTORS: dict[str, DetectorFactory] = {BUILT_IN: _built_in, ONNX: build_network_paint}


def check_detector(name: str) -> None:
    """Raise `UserError` with the known names for an unknown detector."""
    if name in DETECTORS:  # the search of all installed packages takes some 30 ms
        return
    custom = {entry.name for entry in entry_points(group=CUSTOM_DETECTORS)}
    if name not in custom:
        raise UserError(f"there is no detector {name!r}; choose one of {', '.join(sorted({*DETECTORS, *custom}))}")


def build_detector(
    name: str,
    camera: CalibratedCamera,
    settings: DetectorSettings,
    *,
    rate_hz: float | None = None,
    now: Callable[[], Now] | None = None,
) -> PictureDetector:
    """Build the detector named `name`; a finder of paint gets LAVT's own search, fit and tracking.

    Raises `UserError` for an unknown name, for a package that cannot be imported, for an object that is neither a
    detector of lanes nor a finder of paint, and for a detector other than LAVT's own that cannot keep `rate_hz` on this
    machine by the clock `now`.
    """
    check_detector(name)
    built = _factory(name)(camera, settings)
    if isinstance(built, PaintFinder):
        built = _lane_detector(camera, settings, built)
    if not isinstance(built, PictureDetector):
        raise UserError(
            f"the detector {name!r} made a {type(built).__name__}, which has neither detect and forget nor find_paint: "
            "correct its package"
        )
    if rate_hz is not None and name != BUILT_IN:
        picture_ms = detection_ms(built, camera, now or MachineClock().now)
        if picture_ms * rate_hz > 1000:
            slower_hz = max(math.floor(1000 / picture_ms), 1)
            raise UserError(
                f"the detector {name} takes {picture_ms:.1f} ms a picture on this machine, but {rate_hz:g} pictures "
                f"a second leave {1000 / rate_hz:.1f} ms: lower camera.rate_hz of both sides to {slower_hz}, or use a "
                "faster detector"
            )
    return built


def detection_ms(detector: PictureDetector, camera: CalibratedCamera, now: Callable[[], Now]) -> float:
    """Return the median time of a detection in a grey picture, after a first one that is not counted."""
    picture = np.full((camera.height_px, camera.width_px, 3), GREY, dtype=np.uint8)
    times_ns = []
    for _ in range(1 + TIMED_PICTURES):
        begin_ns = now().mono_ns
        detector.detect(picture)
        times_ns.append(now().mono_ns - begin_ns)
    detector.forget()
    return median(times_ns[1:]) / NS_PER_MS


def _factory(name: str) -> DetectorFactory:
    if name in DETECTORS:
        return DETECTORS[name]
    (entry, *_) = entry_points(group=CUSTOM_DETECTORS, name=name)
    try:
        factory: DetectorFactory = entry.load()
    except (ImportError, AttributeError) as error:
        raise UserError(f"the detector {name!r} cannot be loaded ({error}): install its package again") from error
    return factory
