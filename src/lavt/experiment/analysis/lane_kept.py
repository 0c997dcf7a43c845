"""Whether a run kept its lane: the lane that the driver followed and the lane that the car was in.

Pure functions of the two records. `docs/metrics.md` has the definitions.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from lavt.domain import FloatArray
from lavt.experiment.analysis.latency import look_up
from lavt.experiment.analysis.tracking import absolute_error_metrics, sampled_by_distance
from lavt.recording.table import MISSING, BoolArray, IntArray, Table

SEEN_CONFIDENCE = 0.2
"""A lane with less confidence was not seen in the picture: the driver does not track it, and brakes without another."""

LINE_MARGIN_M = 0.25
"""A lane is left when a line is crossed by more than this distance. So a car on a line does not change lanes."""

SEARCHED_M = 20.0
"""The lane's point is projected onto the part of the route that is within this distance of the point's station."""

FOLLOWED_ERROR = "followed_cross_track_m"


@dataclass(frozen=True, slots=True)
class LaneNumbers:
    """Numbers of lanes at times of the server's monotonic clock: 0 is the route's lane, 1 the next one to its left."""

    mono_ns: IntArray
    numbers: IntArray

    def changes(self) -> IntArray:
        """Return the indexes at which the number differs from the one before."""
        return np.flatnonzero(np.diff(self.numbers)) + 1


def lane_numbers(offset_m: FloatArray, width_m: float) -> IntArray:
    """Return the number of the lane for each offset (m, left positive) from the centre of the route's lane.

    The number begins with the nearest lane. It changes to the nearest lane when the offset is more than `LINE_MARGIN_M`
    beyond a line of the present lane.
    """
    nearest = np.rint(offset_m / width_m).astype(np.int64)
    numbers = np.empty(len(offset_m), np.int64)
    number, limit_m = int(nearest[0]) if len(nearest) else 0, width_m / 2 + LINE_MARGIN_M
    for index, (offset, candidate) in enumerate(zip(offset_m.tolist(), nearest.tolist(), strict=True)):
        if abs(offset - number * width_m) > limit_m:
            number = candidate
        numbers[index] = number
    return numbers


def lane_kept(truth: Table, route: Table, frames: Table, lanes: Table, interval_ns: tuple[int, int]) -> dict[str, Any]:
    """Return the keys of `result.json` on the lane followed and the lane occupied.

    `truth`, `route` and `frames` are channels of the server's record, and `lanes` is the channel `lane` of the client's
    record. `interval_ns` is the driving interval. The values are None if the records do not show them.
    """
    began_ns, ended_ns = interval_ns
    truth_ns = truth.ints("mono_ns")
    drive = truth.where((truth_ns >= began_ns) & (truth_ns <= ended_ns) & np.isfinite(truth.floats("cross_track_m")))
    pictures = _seen_lanes(frames, lanes, began_ns, ended_ns)
    offset_m, width_m = _followed_offsets_m(truth, route, pictures), _median_width_m(pictures)
    if len(drive) == 0 or offset_m is None or width_m is None:
        return {**_named(absolute_error_metrics(np.zeros(0))), "lane_kept": None}
    drive_ns = drive.ints("mono_ns")
    followed = LaneNumbers(pictures.ints("captured_ns"), lane_numbers(offset_m, width_m))
    occupied = LaneNumbers(drive_ns, lane_numbers(drive.floats("cross_track_m"), width_m))
    newest = np.maximum(np.searchsorted(followed.mono_ns, drive_ns, side="right") - 1, 0)
    followed_at = followed.numbers[newest]
    error_m = drive.floats("cross_track_m") - followed_at * width_m
    columns = {"progress_m": drive.floats("progress_m"), FOLLOWED_ERROR: error_m}
    errors = sampled_by_distance(Table(drive.mono_ns, drive.wall_ns, columns), FOLLOWED_ERROR)
    return {
        **_named(absolute_error_metrics(np.abs(errors))),
        "lane_kept": {
            "lane_width_m": width_m,
            "followed_share": _share_of_time(drive_ns, followed_at == 0),
            "occupied_share": _share_of_time(drive_ns, occupied.numbers == 0),
            "own_lane_share": _share_of_time(drive_ns, (followed_at == 0) & (occupied.numbers == 0)),
            "followed_changes": len(followed.changes()),
            "occupied_changes": len(occupied.changes()),
            "changes": _events(truth, followed=followed, occupied=occupied),
        },
    }


def completed_in_own_lane(ending: str | None, kept: Mapping[str, Any] | None) -> bool | None:
    """Return whether a run was completed with the driver following, and the car in, the route's lane all the time.

    The result is None if a completed run has no `lane_kept`.
    """
    if ending != "completed":
        return False
    return None if kept is None else kept["own_lane_share"] == 1.0 and not kept["changes"]


def _named(metrics: Mapping[str, float | None]) -> dict[str, float | None]:
    return {f"followed_{name}": value for name, value in metrics.items()}


def _seen_lanes(frames: Table, lanes: Table, began_ns: int, ended_ns: int) -> Table:
    """Return the lanes that were seen in frames of the drive, in the order of capture.

    The columns are `captured_ns` (server's monotonic clock), `c0`, `c1`, `c2`, `near_m` and `width_m`.
    """
    stamps, stamped_ns, captured_ns = (frames.ints(name) for name in ("stamp_ns", "stamped_mono_ns", "capture_ns"))
    captured_ns = np.where(captured_ns == MISSING, stamped_ns, captured_ns)
    lane_stamps, first = np.unique(lanes.ints("stamp_ns"), return_index=True)
    lane_stamped_ns = look_up(stamps, stamped_ns, lane_stamps)
    lane_captured_ns = look_up(stamps, captured_ns, lane_stamps)
    detected = lanes.where(first).objects("lane")
    rows = [
        (captured, *lane["centre"], lane["near_m"], lane["width_m"])
        for captured, stamped, lane in zip(lane_captured_ns.tolist(), lane_stamped_ns.tolist(), detected, strict=True)
        if began_ns <= stamped <= ended_ns and lane is not None and lane["confidence"] >= SEEN_CONFIDENCE
    ]
    rows.sort(key=lambda row: row[0])
    times_ns = np.array([row[0] for row in rows], np.int64)
    values = np.array([row[1:] for row in rows], np.float64).reshape(-1, 5)
    names = ("c0", "c1", "c2", "near_m", "width_m")
    columns = {"captured_ns": times_ns, **{name: values[:, index] for index, name in enumerate(names)}}
    return Table(times_ns, times_ns, columns)


def _median_width_m(pictures: Table) -> float | None:
    return float(np.median(pictures.floats("width_m"))) if len(pictures) else None


def _followed_offsets_m(truth: Table, route: Table, pictures: Table) -> FloatArray | None:
    """Return the offset (m, left positive) of the lane in each picture from the centre of the route's lane.

    The lane is placed in the world by the true pose of the car at the time of capture. The result is the offset of the
    lane's centre at the nearest distance ahead at which paint was seen; None without ground truth or without a route.
    """
    points = route.objects("points")
    reference_m = np.array(points[0] if points and points[0] else np.zeros((0, 2)), np.float64)
    poses = truth.where(np.isfinite(truth.floats("x_m")) & np.isfinite(truth.floats("progress_m")))
    if len(reference_m) < 2 or len(poses) == 0 or len(pictures) == 0:
        return None
    pose_ns, captured_ns = poses.ints("mono_ns"), pictures.ints("captured_ns")
    start_ns = pose_ns[0]  # the differences are exact as floats, the times are not

    def at_capture(name: str) -> FloatArray:
        values = np.interp(captured_ns - start_ns, pose_ns - start_ns, poses.floats(name))
        return np.asarray(values, np.float64)

    x_m, y_m, heading_rad, progress_m = (at_capture(name) for name in ("x_m", "y_m", "heading_rad", "progress_m"))
    ahead_m = pictures.floats("near_m")
    left_m = pictures.floats("c0") + pictures.floats("c1") * ahead_m + pictures.floats("c2") * ahead_m**2
    cosine, sine = np.cos(heading_rad), np.sin(heading_rad)
    lane_m = np.stack([x_m + ahead_m * cosine - left_m * sine, y_m + ahead_m * sine + left_m * cosine], axis=1)
    return _offsets_from(reference_m, lane_m, progress_m + ahead_m)


def _offsets_from(reference_m: FloatArray, points_m: FloatArray, stations_m: FloatArray) -> FloatArray:
    """Return the lateral offset of points, each near a known station, from a polyline whose last line goes on."""
    last_m = reference_m[-1] - reference_m[-2]
    corners_m = np.vstack([reference_m, reference_m[-1] + last_m / np.hypot(*last_m) * 2 * SEARCHED_M])
    lines_m = np.diff(corners_m, axis=0)
    lengths_m = np.hypot(lines_m[:, 0], lines_m[:, 1])
    ends_m = np.cumsum(lengths_m)
    first = np.searchsorted(ends_m, stations_m - SEARCHED_M)
    last = np.searchsorted(ends_m - lengths_m, stations_m + SEARCHED_M)
    count = max(int(np.max(last - first)), 1)
    searched = np.clip(first[:, np.newaxis] + np.arange(count), 0, len(lines_m) - 1)
    line_x, line_y = lines_m[searched, 0], lines_m[searched, 1]
    start_x, start_y = (points_m[:, axis, np.newaxis] - corners_m[searched, axis] for axis in (0, 1))
    along = np.clip((start_x * line_x + start_y * line_y) / lengths_m[searched] ** 2, 0.0, 1.0)
    apart_x, apart_y = start_x - along * line_x, start_y - along * line_y
    distance_m = np.hypot(apart_x, apart_y)
    nearest = np.argmin(distance_m, axis=1)[:, np.newaxis]
    signed_m = np.copysign(distance_m, line_x * apart_y - line_y * apart_x)
    return np.asarray(np.take_along_axis(signed_m, nearest, axis=1)[:, 0], np.float64)


def _share_of_time(mono_ns: IntArray, is_true: BoolArray) -> float:
    """Return the share of time in which a state is true; each value is valid until the next one."""
    steps_ns = np.diff(mono_ns)
    if steps_ns.sum() <= 0:
        return float(is_true[0])
    return float(steps_ns[is_true[:-1]].sum() / steps_ns.sum())


def _events(truth: Table, **numbers: LaneNumbers) -> list[dict[str, Any]]:
    """Return all lane changes in the order of time."""
    truth_ns, progress_m = truth.ints("mono_ns"), truth.floats("progress_m")
    start_ns = truth_ns[0]
    events = [
        {
            "lane": lane,
            "mono_ns": int(lanes.mono_ns[index]),
            "progress_m": float(np.interp(lanes.mono_ns[index] - start_ns, truth_ns - start_ns, progress_m)),
            "from": int(lanes.numbers[index - 1]),
            "to": int(lanes.numbers[index]),
        }
        for lane, lanes in numbers.items()
        for index in lanes.changes()
    ]
    return sorted(events, key=lambda event: event["mono_ns"])
