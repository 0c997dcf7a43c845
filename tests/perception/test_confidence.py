"""Test the confidence on degraded pictures; benchmarks/perception_sheet.py prints the tables of docs/perception.md."""

from __future__ import annotations

from collections import defaultdict

import numpy as np
import pytest
from benchmarks.degraded import AT_10_M, MODEL, NO_LANE, blocks, cases
from benchmarks.perception_sheet import UNDECIDED, LaneVerdict, check_case, kinds_table, reliability_table

from lavt.control.lane_watch import LANE_CONFIDENCE
from lavt.perception.detection import TRACK_CONFIDENCE
from lavt.perception.lane_detector import LaneDetector
from lavt.streams import stream

CLEAR_LANE_KINDS = (
    "as it is",
    "solid lines",
    "tar seams",
    "tree shadows",
    "worn by half",
    "overcast",
    "gamma 0.5",
    "gamma 2",
    "noise 15",
    "h264 200 kbit/s",
)
BUSY_KINDS = ("tar seams", "tree shadows")
"""The kinds of clear lane with other marks on the road."""
NOT_ALWAYS_SEARCHED = "tree shadows"
"""The kind of clear lane that a search may miss: spots of sun between leaves look like paint."""
ONE_LINE_KINDS = ("left line missing", "right line missing")
OTHER_PAINT_KINDS = ("old yellow line", "old white line", "diagonal", "arrow")
VerdictsByKind = dict[str, list[tuple[LaneVerdict, LaneVerdict]]]


@pytest.fixture(scope="module", params=[1, pytest.param(3, marks=pytest.mark.full)], ids="{} of each".format)
def verdicts(request: pytest.FixtureRequest) -> VerdictsByKind:
    """Return, for each kind, a pair of verdicts on each picture: (from searching, from tracking).

    The seed differs from that of docs/perception.md.
    """
    by_kind: VerdictsByKind = defaultdict(list)
    for case in cases(request.param, seed=7):
        by_kind[case.kind].append(check_case(case))
    return by_kind


def test_detector_and_lane_watch_share_a_threshold() -> None:
    """The detector tracks a lane exactly when the lane's confidence is enough for driving."""
    assert TRACK_CONFIDENCE == LANE_CONFIDENCE


def test_a_wrong_lane_has_low_confidence(verdicts: VerdictsByKind) -> None:
    """More than 15 % of searches find a wrong lane, but at most 2 % find one with enough confidence for driving."""
    searched = [pair[0] for kind, pairs in verdicts.items() if kind != UNDECIDED for pair in pairs]
    assert sum(verdict.wrong for verdict in searched) > 0.15 * len(searched)
    assert sum(verdict.wrong and verdict.accepted for verdict in searched) <= 0.02 * len(searched)


def test_a_tracked_lane_is_not_led_astray(verdicts: VerdictsByKind) -> None:
    """At most 2 % of tracked pictures have a wrong lane with enough confidence for driving."""
    tracked = [pair[1] for kind, pairs in verdicts.items() if kind != UNDECIDED for pair in pairs]
    assert sum(verdict.wrong and verdict.accepted for verdict in tracked) <= 0.02 * len(tracked)


@pytest.mark.parametrize("kind", CLEAR_LANE_KINDS)
def test_a_clear_lane_has_high_confidence(verdicts: VerdictsByKind, kind: str) -> None:
    """With both lines in the picture, confidence is high and the centre at 10 m is found within 0.2 m."""
    for searched, tracked in verdicts[kind]:
        assert tracked.confidence > 0.25
        assert tracked.error_m[AT_10_M] < 0.2
        assert searched.confidence > 0.25 or (searched.confidence == 0 and kind == NOT_ALWAYS_SEARCHED)
        assert searched.error_m[AT_10_M] < 0.2 or searched.confidence == 0
    assert np.median([pair[1].confidence for pair in verdicts[kind]]) > (0.4 if kind in BUSY_KINDS else 0.6)


@pytest.mark.parametrize("kind", ONE_LINE_KINDS)
def test_one_missing_line_halves_the_confidence(verdicts: VerdictsByKind, kind: str) -> None:
    """With one line missing, a tracked lane is right within 0.2 m at 10 m and has a confidence of about 0.5."""
    for _, verdict in verdicts[kind]:
        assert 0.3 < verdict.confidence < 0.6
        assert verdict.error_m[AT_10_M] < 0.2


def test_a_search_needs_two_lines(verdicts: VerdictsByKind) -> None:
    """A search finds no lane from a single line, but a tracked lane continues with a single line."""
    for searched, tracked in verdicts["one line only"]:
        assert searched.confidence == 0
        assert 0.3 < tracked.confidence < 0.6
        assert not tracked.wrong


@pytest.mark.parametrize("kind", OTHER_PAINT_KINDS)
def test_other_paint_in_the_lane_lowers_confidence(verdicts: VerdictsByKind, kind: str) -> None:
    """Other paint in the lane lowers the mean confidence by more than 0.1."""
    with_paint = np.mean([pair[1].confidence for pair in verdicts[kind]])
    assert with_paint < np.mean([pair[1].confidence for pair in verdicts["as it is"]]) - 0.1


@pytest.mark.parametrize("kind", sorted(NO_LANE - {"coarse blocks"}))
def test_pictures_without_a_lane_have_low_confidence(verdicts: VerdictsByKind, kind: str) -> None:
    """No search in a picture without a lane has enough confidence for driving."""
    assert all(not searched.accepted for searched, _ in verdicts[kind])


@pytest.mark.parametrize("side_px", [2, 4, 8, 16])
def test_blocks_of_noise_are_not_a_lane(side_px: int) -> None:
    """At most one of 20 pictures of random squares has enough confidence for driving."""
    assert sum(confidence >= LANE_CONFIDENCE for confidence in confidences_in_blocks(side_px)) <= 1


def test_blocks_as_large_as_marks_have_little_confidence() -> None:
    """Random squares with edges as long as marks have too little confidence for driving in most pictures."""
    confidences = confidences_in_blocks(32)
    assert np.median(confidences) < LANE_CONFIDENCE
    assert max(confidences) < 0.4


def confidences_in_blocks(side_px: int) -> list[float]:
    pictures = [blocks(stream(3, "blocks", number), side_px) for number in range(20)]
    return [LaneDetector(MODEL).detect(picture).confidence for picture in pictures]


def test_the_tables_are_complete(verdicts: VerdictsByKind) -> None:
    """The table of kinds has a row for every kind, and the table of reliability ends with the highest confidence."""
    pairs = [pair for verdict_pairs in verdicts.values() for pair in verdict_pairs]
    assert len(kinds_table(pairs).splitlines()) == 2 + len(verdicts)
    assert reliability_table(pair[0] for pair in pairs).splitlines()[-1].startswith("| 0.80 to 1.00 |")
