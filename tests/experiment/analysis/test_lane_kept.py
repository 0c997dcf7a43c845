"""Tests of the lane followed and the lane occupied, on a straight route and on a bend, with lanes of 3.5 m."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np
import pytest

from lavt.experiment.analysis.lane_kept import completed_in_own_lane, followed_numbers, lane_kept, lane_numbers
from lavt.recording.table import Table, table_of

WIDTH_M = 3.5
SPEED_MPS = 10.0
BEGAN_S, ENDED_S = 1.0, 11.0
FRAME_S = 0.1


def table(rows: list[dict[str, Any]]) -> Table:
    return table_of(rows, [0] * len(rows), [0] * len(rows))


def ns(seconds: float) -> int:
    return round(seconds * 1e9)


DRIVE_NS = (ns(BEGAN_S), ns(ENDED_S))


def straight_route() -> Table:
    return table([{"points": [[float(x_m), 0.0] for x_m in range(101)]}])


def truth_of(offset_at: Callable[[float], float], until_s: float = ENDED_S + 1) -> Table:
    """Return the ground truth of a car on the straight route, with its offset from the centre at each time."""
    rows = []
    for step in range(round(until_s * 50) + 1):
        at_s = step / 50
        x_m, y_m = SPEED_MPS * (at_s - BEGAN_S), offset_at(at_s)
        pose = {"x_m": x_m, "y_m": y_m, "heading_rad": 0.0}
        rows.append({"mono_ns": ns(at_s), **pose, "progress_m": x_m, "cross_track_m": y_m})
    return table(rows)


def frames_of(**changes: Any) -> Table:
    times_s = np.arange(0.0, ENDED_S + 1, FRAME_S).tolist()
    frames = [{"stamp_ns": ns(at_s) + 7, "stamped_mono_ns": ns(at_s), "capture_ns": ns(at_s)} for at_s in times_s]
    return table([{**frame, **changes} for frame in frames])


def detected(
    offset_at: Callable[[float], float], lane_at: Callable[[float], float], confidence_at: Callable[[float], float]
) -> Table:
    """Return the lanes that a driver detects: at each time, the lane whose centre is at `lane_at`."""
    rows = []
    for at_s in np.arange(0.0, ENDED_S + 1, FRAME_S).tolist():
        lane = {
            "centre": [lane_at(at_s) - offset_at(at_s), 0.0, 0.0],
            "width_m": WIDTH_M,
            "near_m": 3.6,
            "far_m": 20.0,
            "confidence": confidence_at(at_s),
        }
        rows.append({"stamp_ns": ns(at_s) + 7, "lane": lane})
    return table(rows)


def evaluate(
    offset_at: Callable[[float], float],
    lane_at: Callable[[float], float],
    confidence_at: Callable[[float], float] = lambda _at_s: 0.9,
    **frame_changes: Any,
) -> dict[str, Any]:
    lanes = detected(offset_at, lane_at, confidence_at)
    return lane_kept(truth_of(offset_at), straight_route(), frames_of(**frame_changes), lanes, DRIVE_NS)


def stationary(value: float) -> Callable[[float], float]:
    return lambda _at_s: value


def after(at_s: float, value: float) -> Callable[[float], float]:
    """Return a function of time that is 0 before `at_s` and `value` from then on."""
    return lambda now_s: value if now_s >= at_s - 1e-9 else 0.0


def test_a_touch_of_a_line_is_no_lane_change() -> None:
    """The lane is left 0.25 m beyond its line, and entered again 0.25 m inside it."""
    assert lane_numbers(np.array([0.0, 1.76, 1.99, 1.0]), WIDTH_M).tolist() == [0, 0, 0, 0]
    assert lane_numbers(np.array([0.0, 2.01, 1.6, 1.51, 1.49]), WIDTH_M).tolist() == [0, 1, 1, 1, 0]
    assert lane_numbers(np.array([0.0, -2.01, -5.4, -5.51, -7.0, -5.1]), WIDTH_M).tolist() == [0, -1, -1, -2, -2, -2]


def test_a_jump_over_a_lane_is_one_change() -> None:
    """An offset of two widths leads to lane 2 at once; a drive can begin in another lane."""
    assert lane_numbers(np.array([0.0, 7.0, 0.0]), WIDTH_M).tolist() == [0, 2, 0]
    assert lane_numbers(np.array([-3.4, -3.4]), WIDTH_M).tolist() == [-1, -1]
    assert lane_numbers(np.zeros(0), WIDTH_M).tolist() == []


def test_a_car_in_its_lane() -> None:
    """A car 0.5 m beside the centre of the lane that it follows keeps its lane; both errors are 0.5 m."""
    result = evaluate(stationary(0.5), stationary(0.0))
    assert result["lane_kept"] == {
        "lane_width_m": WIDTH_M,
        "followed_share": 1.0,
        "followed_unknown_share": 0.0,
        "occupied_share": 1.0,
        "own_lane_share": 1.0,
        "followed_changes": 0,
        "occupied_changes": 0,
        "changes": [],
    }
    assert [result[f"followed_{name}"] for name in ("mae_m", "rms_m", "p95_m", "max_m")] == pytest.approx([0.5] * 4)


def test_a_driver_that_follows_the_next_lane() -> None:
    """A driver and a car that go to the next lane at 6 s are in their own lane half of the time.

    The error against the lane followed is that of the 0.4 m by which the car is beside it.
    """
    result = evaluate(lambda at_s: after(6.0, WIDTH_M)(at_s) + 0.4, after(6.0, WIDTH_M))
    kept = result["lane_kept"]
    assert kept["followed_share"] == pytest.approx(0.5)
    assert kept["occupied_share"] == pytest.approx(0.5)
    assert kept["own_lane_share"] == pytest.approx(0.5)
    change = {"mono_ns": ns(6.0), "progress_m": pytest.approx(50.0), "from": 0, "to": 1}
    assert kept["changes"] == [{"lane": "followed", **change}, {"lane": "occupied", **change}]
    assert result["followed_p95_m"] == pytest.approx(0.4)


def test_a_driver_may_follow_another_lane_than_the_car_is_in() -> None:
    """If the driver follows the right lane from 6 s and the car gets there at 8.5 s, the two changes are apart."""
    result = evaluate(after(8.5, -WIDTH_M), after(6.0, -WIDTH_M))
    kept = result["lane_kept"]
    assert (kept["followed_share"], kept["occupied_share"]) == pytest.approx((0.5, 0.75))
    assert kept["own_lane_share"] == pytest.approx(0.5)
    assert [(event["lane"], event["to"]) for event in kept["changes"]] == [("followed", -1), ("occupied", -1)]
    assert result["followed_max_m"] == pytest.approx(WIDTH_M)


def test_a_swing_into_the_next_lane() -> None:
    """A car that swings 2.5 m aside and back, and follows its lane all the time, changes lanes twice."""
    result = evaluate(lambda at_s: 2.5 * math.sin(math.pi * (at_s - 5)) if 5 <= at_s <= 6 else 0.0, stationary(0.0))
    kept = result["lane_kept"]
    assert (kept["followed_changes"], kept["occupied_changes"]) == (0, 2)
    assert (kept["followed_share"], kept["own_lane_share"]) == (1.0, kept["occupied_share"])
    # Out at 2.0 m and in again at 1.5 m: asin(0.8) and pi - asin(0.6), to the next row of the ground truth.
    out_s, in_s = math.asin(0.8) / math.pi, 1 - math.asin(0.6) / math.pi
    assert kept["occupied_share"] == pytest.approx(1 - (in_s - out_s) / 10, abs=0.004)


def confidence_between(confidence: float, at_s: float) -> float:
    return confidence if 5 <= at_s <= 6 else 0.9


def test_a_lane_without_confidence_is_not_followed() -> None:
    """Pictures with a confidence of less than 0.2 do not change the lane followed; 0.2 is enough."""
    for confidence, changes in ((0.19, 0), (0.2, 2)):
        result = evaluate(
            stationary(0.0),
            lambda at_s: WIDTH_M if 5 <= at_s <= 6 else 0.0,
            partial(confidence_between, confidence),
        )
        assert result["lane_kept"]["followed_changes"] == changes


UNSEEN = math.nan
UNKNOWN = None


@pytest.mark.parametrize(
    ("offsets_m", "expected"),
    [
        ([0, 0, 0, 3.5, 0], [0, 0, 0, 0, 0]),
        ([0, 0, 0, 3.5, 3.5, 0], [0, 0, 0, 0, 0, 0]),
        ([0, 0, 0, 3.5, 3.5, 3.5], [0, 0, 0, 1, 1, 1]),
        ([0, 0, 0, 3.5, -3.5, 3.5, 3.5], [0] * 7),
        ([0, 0, 0, 3.5, 1.8, 1.8, 1.8, 1.8], [0] * 8),  # within the margin of lane 0, which was not left
        ([0, 0, 0, UNSEEN, UNSEEN, 0], [0] * 6),
        ([0, 0, 0, 3.5, UNSEEN, 3.5, UNSEEN, 3.5], [0, 0, 0, 1, 1, 1, 1, 1]),
        ([0, 0, 0, *[UNSEEN] * 3, 0, 0, 0], [0, 0, 0, *[UNKNOWN] * 3, 0, 0, 0]),
        ([0, 0, 0, 3.5, 3.5, *[UNSEEN] * 4, 3.5], [0, 0, 0, 0, 0, *[UNKNOWN] * 5]),
        ([0, 0, *[UNSEEN] * 3, 0, 0], [UNKNOWN] * 7),
        ([0, 3.5, 0, 3.5], [UNKNOWN] * 4),
        ([UNSEEN, 0, 0, 0], [UNKNOWN, 0, 0, 0]),
        ([], []),
    ],
)
def test_the_lane_followed_needs_three_pictures(offsets_m: list[float], expected: list[float | None]) -> None:
    """Three pictures decide which lane is followed, and three without a lane make it unknown; fewer change nothing."""
    numbers = followed_numbers(np.array(offsets_m, np.float64), WIDTH_M)
    assert [None if math.isnan(number) else number for number in numbers.tolist()] == expected


def test_a_wrong_picture_before_a_gap_changes_nothing() -> None:
    """Two wrong pictures before a second without a lane are no lane change; the time without a lane is unknown.

    The errors against the lane followed leave this time out.
    """

    def lane_at(at_s: float) -> float:
        return WIDTH_M if 4.75 < at_s < 4.95 else 0.0

    def confidence_at(at_s: float) -> float:
        return 0.0 if 4.95 < at_s < 5.95 else 0.9

    result = evaluate(lambda at_s: 3.0 if 5.1 <= at_s <= 5.8 else 0.5, lane_at, confidence_at)
    kept = result["lane_kept"]
    assert [event["lane"] for event in kept["changes"]] == ["occupied", "occupied"]
    assert kept["followed_unknown_share"] == pytest.approx(0.1)
    assert kept["followed_share"] == kept["own_lane_share"] == pytest.approx(0.9)
    assert result["followed_max_m"] == pytest.approx(0.5)


def test_a_lane_change_while_the_lane_is_unknown() -> None:
    """A driver that finds another lane after a gap changed lanes; one that finds the same lane did not."""
    for found_m, changes in ((0.0, []), (-WIDTH_M, [(0, -1, ns(6.0))])):
        result = evaluate(stationary(0.0), after(6.0, found_m), lambda at_s: 0.0 if 4.95 < at_s < 5.95 else 0.9)
        kept = result["lane_kept"]
        assert [(event["from"], event["to"], event["mono_ns"]) for event in kept["changes"]] == changes
        assert kept["followed_changes"] == len(changes)
        assert completed_in_own_lane("completed", kept) is (not changes)


def test_only_pictures_of_the_drive_count() -> None:
    """What the driver follows before the start and after the end of the drive is not part of the result."""
    result = evaluate(stationary(0.0), lambda at_s: 0.0 if BEGAN_S <= at_s <= ENDED_S else WIDTH_M)
    assert result["lane_kept"]["own_lane_share"] == 1.0
    assert result["lane_kept"]["changes"] == []


def test_the_pose_is_that_of_the_capture() -> None:
    """The lane is placed by the pose at the capture; the stamp is used if the capture time is unknown."""

    def offset_at(at_s: float) -> float:
        return 3.0 * (at_s - 6)

    assert evaluate(offset_at, stationary(0.0))["lane_kept"]["followed_changes"] == 0
    assert evaluate(offset_at, stationary(0.0), capture_ns=None)["lane_kept"]["followed_changes"] == 0
    lanes, frames = detected(offset_at, stationary(0.0), lambda _at_s: 0.9), frames_of()
    earlier = [
        {"stamp_ns": stamp, "stamped_mono_ns": stamp - 7, "capture_ns": stamp - ns(1.0)}
        for stamp in frames.ints("stamp_ns").tolist()
    ]
    result = lane_kept(truth_of(offset_at), straight_route(), table(earlier), lanes, DRIVE_NS)
    assert result["lane_kept"]["followed_share"] == 0.0  # placed 3 m too far to the right


RADIUS_M = 42.0


def test_the_lane_of_a_bend_is_recognised_from_any_pose() -> None:
    """On a bend of 42 m radius, the route's lane is recognised from 3 m beside it and turned by 0.5 rad."""
    angles = np.arange(0.0, 1.5, 1 / RADIUS_M)
    route = table([{"points": [[RADIUS_M * math.sin(a), RADIUS_M * (1 - math.cos(a))] for a in angles.tolist()]}])
    truth, lanes = [], []
    offset_m, turned_rad = -3.0, 0.5
    for step in range(101):
        at_s = BEGAN_S + step / 10
        progress_m = step * 0.3
        angle_rad = progress_m / RADIUS_M
        x_m, y_m = (RADIUS_M - offset_m) * math.sin(angle_rad), RADIUS_M - (RADIUS_M - offset_m) * math.cos(angle_rad)
        heading_rad = angle_rad + turned_rad
        pose = {"x_m": x_m, "y_m": y_m, "heading_rad": heading_rad}
        truth.append({"mono_ns": ns(at_s), **pose, "progress_m": progress_m, "cross_track_m": offset_m})
        ahead_rad = angle_rad + np.linspace(0.1, 0.4, 20)
        dx_m = RADIUS_M * np.sin(ahead_rad) - x_m
        dy_m = RADIUS_M * (1 - np.cos(ahead_rad)) - y_m
        x_ahead_m = dx_m * math.cos(heading_rad) + dy_m * math.sin(heading_rad)
        y_left_m = dy_m * math.cos(heading_rad) - dx_m * math.sin(heading_rad)
        centre = np.polynomial.polynomial.polyfit(x_ahead_m, y_left_m, 2).tolist()
        lane = {"centre": centre, "width_m": WIDTH_M, "near_m": 4.0, "far_m": 20.0, "confidence": 1.0}
        lanes.append({"stamp_ns": ns(at_s) + 7, "lane": lane})
    result = lane_kept(table(truth), route, frames_of(), table(lanes), DRIVE_NS)
    assert result["lane_kept"]["followed_share"] == 1.0
    assert result["lane_kept"]["occupied_share"] == 0.0
    assert result["followed_p95_m"] == pytest.approx(3.0)


@pytest.mark.parametrize("missing", ["truth", "route", "frames", "lanes"])
def test_without_data_the_lane_kept_is_unknown(missing: str) -> None:
    """Without ground truth, route, frames or detected lanes, all values are null."""
    parts: dict[str, Table] = {
        "truth": truth_of(stationary(0.0)),
        "route": straight_route(),
        "frames": frames_of(),
        "lanes": detected(stationary(0.0), stationary(0.0), lambda _at_s: 0.9),
    }
    parts[missing] = table([])
    result = lane_kept(**parts, interval_ns=DRIVE_NS)
    names = ("followed_mae_m", "followed_rms_m", "followed_p95_m", "followed_max_m", "lane_kept")
    assert result == dict.fromkeys(names)


@pytest.mark.parametrize(
    ("ending", "kept", "expected"),
    [
        ("completed", {"followed_share": 1.0, "occupied_share": 1.0, "changes": []}, True),
        ("completed", {"followed_share": 0.6, "occupied_share": 1.0, "changes": []}, True),  # unknown for the rest
        ("completed", {"followed_share": 1.0, "occupied_share": 0.0, "changes": []}, False),
        ("completed", {"followed_share": 0.0, "occupied_share": 1.0, "changes": []}, False),
        ("completed", {"followed_share": 0.9, "occupied_share": 1.0, "changes": [{"lane": "followed"}]}, False),
        ("completed", None, None),
        ("collision", {"followed_share": 1.0, "occupied_share": 1.0, "changes": []}, False),
        ("safe_stop", None, False),
        (None, None, False),
    ],
)
def test_completed_in_own_lane(ending: str | None, kept: Mapping[str, Any] | None, expected: bool | None) -> None:
    """A completed run is in its own lane if the car was in no other lane and the driver followed no other lane."""
    assert completed_in_own_lane(ending, kept) is expected
