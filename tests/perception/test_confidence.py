"""Confidence over pictures that perception was not made for; benchmarks/perception_sheet.py has the figures."""

from __future__ import annotations

from collections import defaultdict

import numpy as np
import pytest
from benchmarks.degraded import MODEL, NO_LANE, blocks, cases
from benchmarks.perception_sheet import UNDECIDED, LaneVerdict, check_case, kinds_table, reliability_table

from lavt.control.lane_watch import LANE_CONFIDENCE
from lavt.perception.lane_detector import TRACK_CONFIDENCE, LaneDetector
from lavt.streams import stream

CLEAN = ("as it is", "solid lines", "tar seams", "tree shadows", "worn by half", "overcast", "gamma 0.5", "gamma 2",
         "noise 15", "h264 200 kbit/s")  # fmt: skip
HALF = ("left line missing", "right line missing")
CROSSED = ("old yellow line", "old white line", "diagonal", "arrow")
Found = dict[str, list[tuple[LaneVerdict, LaneVerdict]]]


@pytest.fixture(scope="module", params=[1, pytest.param(3, marks=pytest.mark.full)], ids="{} of each".format)
def found(request: pytest.FixtureRequest) -> Found:
    """Return pictures of each kind, other ones than those of the page, searched and followed."""
    by_kind: Found = defaultdict(list)
    for case in cases(request.param, seed=7):
        by_kind[case.kind].append(check_case(case))
    return by_kind


def test_one_threshold_decides() -> None:
    """What the detector does not follow, nobody drives by, and the other way round."""
    assert TRACK_CONFIDENCE == LANE_CONFIDENCE


def test_a_lane_that_is_wrong_is_not_believed(found: Found) -> None:
    """Of all pictures with a lane that is more than half a metre off, or with none, at most 2 % are believed."""
    searched = [pair[0] for kind, pairs in found.items() if kind != UNDECIDED for pair in pairs]
    assert sum(judged.wrong for judged in searched) > 0.15 * len(searched)
    assert sum(judged.wrong and judged.believed for judged in searched) <= 0.02 * len(searched)


def test_a_lane_that_is_followed_is_not_led_aside(found: Found) -> None:
    """Once the lane is followed, lines that cross it and everything else do not make it wrong and believed."""
    followed = [pair[1] for kind, pairs in found.items() if kind != "kerb only" for pair in pairs]
    assert sum(judged.wrong and judged.believed for judged in followed) <= 0.02 * len(followed)


@pytest.mark.parametrize("kind", CLEAN)
def test_a_lane_that_is_right_is_believed(found: Found, kind: str) -> None:
    """With both lines in the picture confidence is high, and the centre is right within 0.2 m at 10 m."""
    for judged in (judged for pair in found[kind] for judged in pair):
        assert judged.confidence > 0.25
        assert judged.error_m[1] < 0.2
    assert np.median([pair[1].confidence for pair in found[kind]]) > 0.6


@pytest.mark.parametrize("kind", HALF)
def test_half_a_lane_is_half_believed(found: Found, kind: str) -> None:
    """With one of the lines gone, the lane that was followed is right, and its confidence about a half."""
    for _, judged in found[kind]:
        assert 0.3 < judged.confidence < 0.6
        assert judged.error_m[1] < 0.2


def test_one_line_alone_is_no_beginning(found: Found) -> None:
    """A single line may be anything: no search begins at it, but the lane that was followed goes on by it."""
    for searched, followed in found["one line only"]:
        assert searched.confidence == 0
        assert 0.3 < followed.confidence < 0.6
        assert not followed.wrong


@pytest.mark.parametrize("kind", CROSSED)
def test_paint_that_crosses_the_lane_costs_confidence(found: Found, kind: str) -> None:
    """With other paint in the lane the confidence is lower than without."""
    crossed = np.mean([pair[1].confidence for pair in found[kind]])
    assert crossed < np.mean([pair[1].confidence for pair in found["as it is"]]) - 0.1


@pytest.mark.parametrize("kind", sorted(NO_LANE - {"coarse blocks"}))
def test_where_no_lane_is_none_is_begun(found: Found, kind: str) -> None:
    """In noise, darkness, blank or inverted pictures, at a kerb, a crossing line or a crosswalk no lane is found."""
    assert all(not searched.believed for searched, _ in found[kind])


@pytest.mark.parametrize("side_px", [2, 4, 8, 16])
def test_blocks_of_noise_are_no_lane(side_px: int) -> None:
    """Squares at random give no lane, in 19 of 20 pictures or more."""
    assert sum(confidence >= LANE_CONFIDENCE for confidence in of_blocks(side_px)) <= 1


def test_blocks_as_large_as_marks_are_hardly_believed() -> None:
    """Squares of 32 pixels have edges as long as marks: most give no lane, and none a confident one."""
    found = of_blocks(32)
    assert np.median(found) < LANE_CONFIDENCE
    assert max(found) < 0.4


def of_blocks(side_px: int) -> list[float]:
    pictures = [blocks(stream(3, "blocks", number), side_px) for number in range(20)]
    return [LaneDetector(MODEL).detect(picture).confidence for picture in pictures]


def test_the_tables_can_be_written(found: Found) -> None:
    """Both tables of docs/perception.md come out, with every kind and a row for each range of confidence."""
    pairs = [pair for each in found.values() for pair in each]
    assert len(kinds_table(pairs).splitlines()) == 2 + len(found)
    assert reliability_table(pair[0] for pair in pairs).splitlines()[-1].startswith("| 0.80 to 1.00 |")
