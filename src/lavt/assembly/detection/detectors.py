"""The lane detectors by name: LAVT's own, and those that packages register."""

from __future__ import annotations

from importlib.metadata import entry_points

from lavt.config.perception import BUILT_IN
from lavt.errors import UserError
from lavt.perception.calibration import CalibratedCamera
from lavt.perception.detection import DetectorFactory, DetectorSettings, PaintFinder, PictureDetector
from lavt.perception.lane_detector import LaneDetector

CUSTOM_DETECTORS = "lavt.detectors"
"""The group of entry points with which users add detectors, each a `DetectorFactory`."""


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


DETECTORS: dict[str, DetectorFactory] = {BUILT_IN: _built_in}


def check_detector(name: str) -> None:
    """Raise `UserError` with the known names for an unknown detector."""
    custom = {entry.name for entry in entry_points(group=CUSTOM_DETECTORS)}
    if name not in {*DETECTORS, *custom}:
        raise UserError(f"there is no detector {name!r}; choose one of {', '.join(sorted({*DETECTORS, *custom}))}")


def build_detector(name: str, camera: CalibratedCamera, settings: DetectorSettings) -> PictureDetector:
    """Build the detector named `name`; a finder of paint gets LAVT's own search, fit and tracking.

    Raises `UserError` for an unknown name, for a package that cannot be imported, and for an object that is neither a
    detector of lanes nor a finder of paint.
    """
    check_detector(name)
    built = _factory(name)(camera, settings)
    if isinstance(built, PictureDetector):
        return built
    if isinstance(built, PaintFinder):
        return _lane_detector(camera, settings, built)
    raise UserError(
        f"the detector {name!r} made a {type(built).__name__}, which has neither detect and forget nor find_paint: "
        "correct its package"
    )


def _factory(name: str) -> DetectorFactory:
    if name in DETECTORS:
        return DETECTORS[name]
    (entry, *_) = entry_points(group=CUSTOM_DETECTORS, name=name)
    try:
        factory: DetectorFactory = entry.load()
    except (ImportError, AttributeError) as error:
        raise UserError(f"the detector {name!r} cannot be loaded ({error}): install its package again") from error
    return factory
