from __future__ import annotations

from importlib.metadata import EntryPoint
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from tests.perception.conftest import LANE, Scene

from lavt.assembly.detection import detectors
from lavt.assembly.detection.detectors import build_detector, check_detector
from lavt.assembly.entropy import MachineEntropy
from lavt.assembly.nodes import build_client
from lavt.clock import MachineClock
from lavt.config import ClientConfig, PerceptionConfig, RunConfig
from lavt.config_file import parse_config
from lavt.domain import CameraModel, Lane, Picture
from lavt.errors import UserError
from lavt.experiment.runs.plan import plan_run
from lavt.nodes.driver import DriverNode
from lavt.perception.calibration import CalibratedCamera, calibrated_pinhole_camera
from lavt.perception.detection import DetectorSettings
from lavt.perception.lane_detector import LaneDetector
from lavt.perception.panel import draw_panel

CAMERA = calibrated_pinhole_camera(CameraModel())
SETTINGS = DetectorSettings()


class BrightPaint:
    """A finder of paint for which everything bright below the horizon is paint."""

    def __init__(self, camera: CalibratedCamera, settings: DetectorSettings) -> None:
        self.camera, self.settings = camera, settings

    def find_paint(self, picture_bgr: Picture) -> NDArray[np.uint8]:
        """Return the mask of bright pixels in the lower half."""
        mask = np.where(picture_bgr[..., 1] > 150, 255, 0).astype(np.uint8)
        mask[: len(mask) // 2] = 0
        return mask


class WrongPaint(BrightPaint):
    """A finder of paint whose mask has half the picture's size."""

    def find_paint(self, picture_bgr: Picture) -> NDArray[np.uint8]:
        """Return a mask of the wrong size."""
        return super().find_paint(picture_bgr)[::2, ::2]


class FixedLane:
    """A detector of lanes that always finds the same lane."""

    def __init__(self, _camera: CalibratedCamera, _settings: DetectorSettings) -> None:
        self.forgets = 0

    def forget(self) -> None:
        """Count the call."""
        self.forgets += 1

    def detect(self, _picture: Picture) -> Lane:
        """Return the lane."""
        return Lane((0.5, 0.0, 0.0), 3.0, 3.6, 20.0, 0.9)


def no_detector(_camera: CalibratedCamera, _settings: DetectorSettings) -> Any:
    return "a lane"


@pytest.fixture(autouse=True)
def _registered(monkeypatch: pytest.MonkeyPatch) -> None:
    """Register the classes of this module as detectors."""
    names = {
        "bright": "BrightPaint",
        "wrong": "WrongPaint",
        "fixed": "FixedLane",
        "none": "no_detector",
        "gone": "Gone",
    }
    entries = [EntryPoint(name, f"{__name__}:{target}", detectors.CUSTOM_DETECTORS) for name, target in names.items()]

    def entry_points(group: str, name: str | None = None) -> list[EntryPoint]:
        assert group == "lavt.detectors"
        return [entry for entry in entries if name in (None, entry.name)]

    monkeypatch.setattr(detectors, "entry_points", entry_points)


def test_a_finder_of_paint_gets_the_built_in_fit() -> None:
    """A registered finder of paint replaces the test for paint; the lane comes from LAVT's fit."""
    settings = DetectorSettings(lane_width_m=3.4, track_confidence=0.1, file="eyes.yaml")
    detector = build_detector("bright", CAMERA, settings)
    assert isinstance(detector, LaneDetector)
    lane = detector.detect(Scene(CameraModel()).render(LANE, offset_m=0.4))
    assert lane.centre[0] == pytest.approx(-0.4, abs=0.05)
    assert lane.confidence > 0.9
    assert isinstance(detector._paint_finder, BrightPaint)
    assert detector._paint_finder.settings == settings


def test_a_mask_of_another_size_is_rejected() -> None:
    """A mask that does not have the picture's size is an error that names both sizes."""
    detector = build_detector("wrong", CAMERA, SETTINGS)
    with pytest.raises(UserError, match=r"WrongPaint.*\(240, 320\).*\(480, 640\)"):
        detector.detect(Scene(CameraModel()).render())


def test_a_detector_of_lanes_is_used_as_it_is() -> None:
    """A registered detector of lanes drives the client, and its panel has the picture, the lane and the confidence."""
    config = parse_config(ClientConfig, {"perception": {"detector": "fixed"}}, "test")
    node = build_client(config, MachineClock().now, MachineEntropy()).driver
    assert isinstance(node, DriverNode)
    assert isinstance(node._detector, FixedLane)
    picture = Scene(CameraModel()).render()
    drawn = draw_panel(CAMERA, node._detector, picture, node._detector.detect(picture), (200, 150))
    assert drawn.shape == (162, 3 * 200, 3)


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("eyes", "no detector 'eyes'; choose one of bright, built_in, fixed"),
        ("none", "made a str, which has neither detect and forget nor find_paint"),
        ("gone", "'gone' cannot be loaded .*install its package again"),
    ],
)
def test_a_detector_that_cannot_be_used_is_rejected(name: str, reason: str) -> None:
    """An unknown name, an object that detects nothing, and a package without the named object are user errors."""
    with pytest.raises(UserError, match=reason):
        build_detector(name, CAMERA, SETTINGS)


def test_a_run_checks_its_detector_before_it_starts() -> None:
    """A run with an unknown detector, or with a detector but no pictures, is rejected when it is planned."""
    for keys, reason in (
        ({"perception": {"detector": "eyes"}}, "no detector 'eyes'"),
        ({"perception": {"detector": "fixed"}, "fidelity": "geometry"}, "fidelity geometry has no pictures"),
        ({"perception": {"file": "eyes.yaml"}}, "leave out file"),
    ):
        with pytest.raises(UserError, match=reason):
            plan_run(parse_config(RunConfig, keys, "test"))
    check_detector("fixed")


def test_results_name_the_detector() -> None:
    """The identity of a run names a detector that is not LAVT's own, with its file."""
    planned = plan_run(RunConfig(perception=PerceptionConfig(detector="bright", file="eyes.yaml")))
    assert planned.identity["detector"] == "bright eyes.yaml"
    assert "detector" not in plan_run(RunConfig()).identity
