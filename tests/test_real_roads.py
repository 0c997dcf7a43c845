"""Tests of `benchmarks/real_roads.py`, without the real pictures."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from benchmarks.real_roads import (
    DATA,
    RoadPicture,
    Verdict,
    ground_points,
    judge,
    load_roads,
    outcome_table,
    reliability_table,
)

from lavt.domain import CameraModel, Lane
from lavt.perception.calibration import calibrated_pinhole_camera, picture_points

CAMERA = calibrated_pinhole_camera(CameraModel())
LINES_M = {side: np.array([[6.0, side * 1.75], [16.0, side * 1.75]]) for side in (1, -1)}
ONLY_PICTURE = """
sources: {{road: {{repository: owner/name, commit: abc, licence: MIT}}}}
cameras: {{front: {{width_px: 640, height_px: 480, field_of_view_deg: 90, x_m: 1.6, z_m: 1.4}}}}
pictures:
  - {{source: road, path: a.png, sha256: {digest}, camera: front, part: seen, left: [[100, 400], [200, 300]]}}
"""


def _lane(offset_m: float = 0.0, slope: float = 0.0, confidence: float = 0.9) -> Lane:
    return Lane((offset_m, slope, 0.0), 3.5, 3.6, 20.0, confidence)


def test_ground_points_invert_the_projection() -> None:
    """A pixel of a ground point gives this point back; points are sorted by their distance."""
    ground = np.array([[12.0, 2.0], [5.0, -1.0]])
    found = ground_points(CAMERA, picture_points(CAMERA, ground).tolist())
    assert np.allclose(found, ground[::-1], atol=1e-6)


@pytest.mark.parametrize(
    ("lane", "judgement"),
    [(_lane(0.4), "right"), (_lane(-0.7, 0.09), "partly"), (_lane(0.6), "wrong"), (_lane(slope=0.2), "wrong")],
)
def test_a_lane_is_judged_by_its_distance_from_both_lines(lane: Lane, judgement: str) -> None:
    """A lane within 0.5 m of the lines everywhere is right, in half of the places partly right, and else wrong."""
    assert judge(LINES_M, lane) == judgement


def test_a_lane_is_wrong_where_no_line_is_labelled() -> None:
    """In a picture without labelled lines every lane is wrong."""
    assert judge({}, _lane()) == "wrong"


def test_tables_count_by_confidence() -> None:
    """A lane below the threshold counts as missed; the reliability table counts it by its confidence."""
    picture = np.zeros((480, 640, 3), np.uint8)
    road = RoadPicture("a", "front", CAMERA, "seen", picture, LINES_M)
    verdicts = [Verdict(road, lane, judge(LINES_M, lane)) for lane in (_lane(), _lane(2.0), _lane(2.0, confidence=0.1))]
    assert "| both lines painted | front | 3 | 1 | 0 | 1 | 1 |" in outcome_table(verdicts, 0.2).splitlines()
    assert reliability_table(verdicts).splitlines()[2:] == [
        "| 0.05 to 0.20 | 1 | 0 | 0 | 1 | 100.0 % |",
        "| 0.80 to 1.00 | 2 | 1 | 0 | 1 | 50.0 % |",
    ]


@pytest.fixture
def write_data(tmp_path: Path) -> Callable[[str], Path]:
    """A function that writes the list of one picture with a SHA-256."""

    def write(digest: str) -> Path:
        file = tmp_path / "roads.yaml"
        file.write_text(ONLY_PICTURE.format(digest=digest))
        return file

    return write


def test_a_picture_is_read_from_the_directory(tmp_path: Path, write_data: Callable[[str], Path]) -> None:
    """A picture at OWNER/NAME/PATH is read, and its labels are on the ground."""
    file = tmp_path / "owner/name/a.png"
    file.parent.mkdir(parents=True)
    cv2.imwrite(str(file), np.full((480, 640, 3), 7, np.uint8))
    data = write_data(hashlib.sha256(file.read_bytes()).hexdigest())
    roads, skipped = load_roads(tmp_path, offline=True, parts=["seen"], data=data)
    assert not skipped
    assert roads[0].picture.shape == (480, 640, 3)
    assert list(roads[0].lines_m) == [1]
    assert load_roads(tmp_path, offline=True, parts=["unseen"], data=data) == ([], [])


def test_a_missing_or_changed_picture_is_skipped_with_a_reason(
    tmp_path: Path, write_data: Callable[[str], Path]
) -> None:
    """A picture that is not there, or has another SHA-256, is skipped, and the reason names it."""
    data = write_data("0" * 64)
    roads, skipped = load_roads(tmp_path, offline=True, parts=["seen"], data=data)
    assert (roads, len(skipped)) == ([], 1)
    assert "does not exist" in skipped[0]
    file = tmp_path / "owner/name/a.png"
    file.parent.mkdir(parents=True)
    file.write_bytes(b"another")
    roads, skipped = load_roads(tmp_path, offline=True, parts=["seen"], data=data)
    assert (roads, len(skipped)) == ([], 1)
    assert "SHA-256 differs" in skipped[0]


def test_the_listed_pictures_are_complete() -> None:
    """Without any picture, each of the 60 listed ones is skipped; the list itself has no error."""
    roads, skipped = load_roads(Path("/nonexistent"), offline=True, parts=["seen", "unseen"], data=DATA)
    assert (roads, len(skipped)) == ([], 60)
