"""Test the confidence on degraded pictures; benchmarks/perception_sheet.py prints the tables of docs/perception.md."""

from __future__ import annotations

from collections import defaultdict

import numpy as np
import pytest
from benchmarks.degraded import AT_10_M, MODEL, NO_LANE, blocks, cases
from benchmarks.perception_sheet import UNDECIDED, LaneVerdict, check_case, kinds_table, reliability_table

from lavt.control.lane_watch import LANE_CONFIDENCE
from lavt.perception.lane_detector import TRACK_CONFIDENCE, LaneDetector
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
ONE_LINE_KINDS = ("left line missing", "right line missing")
OTHER_PAINT_KINDS = ("old yellow line", "old white line", "diagonal", "arrow")
VerdictsByKind = dict[str, list[tuple[LaneVerdict, LaneVerdict]]]


@pytest.fixture(scope="module", params=[1, pytest.param(3, marks=pytest.mark.full)], ids="{} of each".format)
def verdicts(request: pytest.FixtureRequest) -> VerdictsByKind:
    """Return two verdicts on each picture, by kind: when the lane was searched, and when it was followed.

    The seed differs from that of docs/perception.md.
    """
    by_kind: VerdictsByKind = defaultdict(list)
    for case in cases(request.param, seed=7):
        by_kind[case.kind].append(check_case(case))
    return by_kind


def test_detector_and_lane_watch_share_a_threshold() -> None:
    """The detector follows a lane exactly when its confidence is enough for driving."""
    assert TRACK_CONFIDENCE == LANE_CONFIDENCE


def test_a_wrong_lane_has_low_confidence(verdicts: VerdictsByKind) -> None:
    """At most 2 % of searched pictures have a wrong lane with enough confidence for driving."""
    searched = [pair[0] for kind, pairs in verdicts.items() if kind != UNDECIDED for pair in pairs]
    assert sum(verdict.wrong for verdict in searched) > 0.15 * len(searched)
    assert sum(verdict.wrong and verdict.accepted for verdict in searched) <= 0.02 * len(searched)


def test_a_followed_lane_is_not_led_astray(verdicts: VerdictsByKind) -> None:
    """At most 2 % of followed pictures have a wrong lane with enough confidence for driving."""
    followed = [pair[1] for kind, pairs in verdicts.items() if kind != "kerb only" for pair in pairs]
    assert sum(verdict.wrong and verdict.accepted for verdict in followed) <= 0.02 * len(followed)


@pytest.mark.parametrize("kind", CLEAR_LANE_KINDS)
def test_a_clear_lane_has_high_confidence(verdicts: VerdictsByKind, kind: str) -> None:
    """With both lines in the picture the confidence is high and the centre is right within 0.2 m at 10 m."""
    for verdict in (verdict for pair in verdicts[kind] for verdict in pair):
        assert verdict.confidence > 0.25
        assert verdict.error_m[AT_10_M] < 0.2
    assert np.median([pair[1].confidence for pair in verdicts[kind]]) > 0.6


@pytest.mark.parametrize("kind", ONE_LINE_KINDS)
def test_one_missing_line_halves_the_confidence(verdicts: VerdictsByKind, kind: str) -> None:
    """With one line missing, a followed lane is right and its confidence is about a half."""
    for _, verdict in verdicts[kind]:
        assert 0.3 < verdict.confidence < 0.6
        assert verdict.error_m[AT_10_M] < 0.2


def test_a_search_does_not_start_at_a_single_line(verdicts: VerdictsByKind) -> None:
    """A search finds no lane from a single line, but a followed lane continues with it."""
    for searched, followed in verdicts["one line only"]:
        assert searched.confidence == 0
        assert 0.3 < followed.confidence < 0.6
        assert not followed.wrong


@pytest.mark.parametrize("kind", OTHER_PAINT_KINDS)
def test_other_paint_in_the_lane_lowers_confidence(verdicts: VerdictsByKind, kind: str) -> None:
    """The confidence is lower with other paint in the lane than without."""
    crossed = np.mean([pair[1].confidence for pair in verdicts[kind]])
    assert crossed < np.mean([pair[1].confidence for pair in verdicts["as it is"]]) - 0.1


@pytest.mark.parametrize("kind", sorted(NO_LANE - {"coarse blocks"}))
def test_pictures_without_a_lane_have_low_confidence(verdicts: VerdictsByKind, kind: str) -> None:
    """No lane is found in noise, darkness, blank or inverted pictures, at a kerb, a crossing line or a crosswalk."""
    assert all(not searched.accepted for searched, _ in verdicts[kind])


@pytest.mark.parametrize("side_px", [2, 4, 8, 16])
def test_blocks_of_noise_are_not_a_lane(side_px: int) -> None:
    """Random squares are not a lane in at least 19 of 20 pictures."""
    assert sum(confidence >= LANE_CONFIDENCE for confidence in confidences_in_blocks(side_px)) <= 1


def test_blocks_as_large_as_marks_have_little_confidence() -> None:
    """Squares of 32 pixels, with edges as long as marks, mostly have no lane and never much confidence."""
    confidences = confidences_in_blocks(32)
    assert np.median(confidences) < LANE_CONFIDENCE
    assert max(confidences) < 0.4


def confidences_in_blocks(side_px: int) -> list[float]:
    pictures = [blocks(stream(3, "blocks", number), side_px) for number in range(20)]
    return [LaneDetector(MODEL).detect(picture).confidence for picture in pictures]


def test_the_tables_are_complete(verdicts: VerdictsByKind) -> None:
    """Both tables of docs/perception.md have a row for every kind and every range of confidence."""
    pairs = [pair for verdict_pairs in verdicts.values() for pair in verdict_pairs]
    assert len(kinds_table(pairs).splitlines()) == 2 + len(verdicts)
    assert reliability_table(pair[0] for pair in pairs).splitlines()[-1].startswith("| 0.80 to 1.00 |")
