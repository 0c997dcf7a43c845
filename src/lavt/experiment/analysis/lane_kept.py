"""Whether a run kept its lane: the lane that the driver followed and the lane that the car was in.

Pure functions of the two records. `docs/metrics.md` has the definitions.
"""

from __future__ import annotations

import math
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

PERSISTENCE_PICTURES = 3
"""The lane followed is that of so many successive pictures, and unknown after so many without a lane.

The detector averages: after 3 pictures, a lane seen before them has a weight of 0.4^3 = 6 %. So a wrong lane one width
away still moves the average by 0.22 m, which is less than `LINE_MARGIN_M`. And after 3 pictures without a lane, the
detector gives its lane up and searches. At 30 Hz, this is a tenth of a second.
"""

FOLLOWED_ERROR = "followed_cross_track_m"
FOLLOWED_UNKNOWN = "followed_unknown"


@dataclass(frozen=True, slots=True)
class LaneNumbers:
    """Numbers of lanes at times of the server's monotonic clock: 0 is the route's lane, 1 the next one to its left.

    A number is NaN where the lane is unknown.
    """

    mono_ns: IntArray
    numbers: FloatArray

    def changes(self) -> list[tuple[int, int, int]]:
        """Return time, number before and number after of each change between two known lanes."""
        known = np.flatnonzero(np.isfinite(self.numbers))
        changed = np.flatnonzero(np.diff(self.numbers[known]))
        return [
            (int(self.mono_ns[after]), int(self.numbers[before]), int(self.numbers[after]))
            for before, after in zip(known[changed].tolist(), known[changed + 1].tolist(), strict=True)
        ]


def lane_numbers(offset_m: FloatArray, width_m: float) -> FloatArray:
    """Return the number of the lane for each offset (m, left positive) from the centre of the route's lane.

    The number begins with the nearest lane. It changes to the nearest lane when the offset is more than `LINE_MARGIN_M`
    beyond a line of the present lane.
    """
    numbers, number = np.zeros(len(offset_m)), math.nan
    for index, offset in enumerate(offset_m.tolist()):
        number = numbers[index] = _next_number(offset, width_m, number)
    return numbers


def followed_numbers(offset_m: FloatArray, width_m: float) -> FloatArray:
    """Return the number of the lane followed in each picture; NaN where it is unknown.

    `offset_m` is that of the lane in each picture, NaN if no lane was seen. `PERSISTENCE_PICTURES` pictures in the same
    lane make it the lane followed, from the first of them on; fewer pictures without a lane do not interrupt them. As
    many pictures in succession without a lane make the lane followed unknown, from the first of them on.
    """
    followed = np.full(len(offset_m), math.nan)
    number = candidate = math.nan
    first = count = unseen = 0
    for index, offset in enumerate(offset_m.tolist()):
        if math.isnan(offset):
            unseen += 1
            if unseen == PERSISTENCE_PICTURES:
                number, candidate = math.nan, math.nan
                followed[index - unseen + 1 : index] = math.nan
        else:
            unseen = 0
            seen = _next_number(offset, width_m, number)
            if seen != candidate:
                candidate, first, count = seen, index, 0
            count += 1
            if count == PERSISTENCE_PICTURES:
                number = candidate
                followed[first:index] = number
        followed[index] = number
    return followed


def _next_number(offset_m: float, width_m: float, number: float) -> float:
    """Return the present lane's number if the offset is within its lines and margin, otherwise the nearest lane's."""
    if abs(offset_m - number * width_m) <= width_m / 2 + LINE_MARGIN_M:
        return number
    return float(round(offset_m / width_m))


def lane_kept(truth: Table, route: Table, frames: Table, lanes: Table, interval_ns: tuple[int, int]) -> dict[str, Any]:
    """Return the keys of `result.json` on the lane followed and the lane occupied.

    `truth`, `route` and `frames` are channels of the server's record, and `lanes` is the channel `lane` of the client's
    record. `interval_ns` is the driving interval. The values are None if the records do not show them.
    """
    began_ns, ended_ns = interval_ns
    truth_ns = truth.ints("mono_ns")
    drive = truth.where((truth_ns >= began_ns) & (truth_ns <= ended_ns) & np.isfinite(truth.floats("cross_track_m")))
    pictures = _detected_lanes(frames, lanes, began_ns, ended_ns)
    offset_m, width_m = _followed_offsets_m(truth, route, pictures), _median_width_m(pictures)
    numbers = np.zeros(0) if offset_m is None or width_m is None else followed_numbers(offset_m, width_m)
    if len(drive) == 0 or width_m is None or not np.isfinite(numbers).any():
        return {**_named(absolute_error_metrics(np.zeros(0))), "lane_kept": None}
    drive_ns, cross_track_m = drive.ints("mono_ns"), drive.floats("cross_track_m")
    followed = LaneNumbers(pictures.ints("captured_ns"), numbers)
    occupied = LaneNumbers(drive_ns, lane_numbers(cross_track_m, width_m))
    newest = np.maximum(np.searchsorted(followed.mono_ns, drive_ns, side="right") - 1, 0)
    followed_at = followed.numbers[newest]
    return {
        **_named(absolute_error_metrics(_known_errors_m(drive, cross_track_m - followed_at * width_m))),
        "lane_kept": {
            "lane_width_m": width_m,
            "followed_share": _share_of_time(drive_ns, followed_at == 0),
            "followed_unknown_share": _share_of_time(drive_ns, np.isnan(followed_at)),
            "occupied_share": _share_of_time(drive_ns, occupied.numbers == 0),
            "own_lane_share": _share_of_time(drive_ns, (followed_at == 0) & (occupied.numbers == 0)),
            "followed_changes": len(followed.changes()),
            "occupied_changes": len(occupied.changes()),
            "changes": _events(truth, followed=followed, occupied=occupied),
        },
    }


def _known_errors_m(drive: Table, error_m: FloatArray) -> FloatArray:
    """Return the absolute errors by distance; a sample next to a row whose error is unknown (NaN) is left out."""
    unknown = np.isnan(error_m)
    columns = {
        "progress_m": drive.floats("progress_m"),
        FOLLOWED_ERROR: np.where(unknown, 0.0, error_m),
        FOLLOWED_UNKNOWN: unknown.astype(np.float64),
    }
    rows = Table(drive.mono_ns, drive.wall_ns, columns)
    is_known = sampled_by_distance(rows, FOLLOWED_UNKNOWN) == 0
    return np.asarray(np.abs(sampled_by_distance(rows, FOLLOWED_ERROR)[is_known]), np.float64)


def completed_in_own_lane(ending: str | None, kept: Mapping[str, Any] | None) -> bool | None:
    """Return whether a run was completed with the car in the route's lane all the time, and no other lane followed.

    The result is None if a completed run has no `lane_kept`.
    """
    if ending != "completed":
        return False
    if kept is None:
        return None
    return kept["occupied_share"] == 1.0 and kept["followed_share"] > 0.0 and not kept["changes"]


def _named(metrics: Mapping[str, float | None]) -> dict[str, float | None]:
    return {f"followed_{name}": value for name, value in metrics.items()}


def _detected_lanes(frames: Table, lanes: Table, began_ns: int, ended_ns: int) -> Table:
    """Return the lane in each frame of the drive in which the driver looked for it, in the order of capture.

    The columns are `captured_ns` (server's monotonic clock), `c0`, `c1`, `c2`, `near_m` and `width_m`. All but the
    first are NaN if no lane was seen.
    """
    stamps, stamped_ns, captured_ns = (frames.ints(name) for name in ("stamp_ns", "stamped_mono_ns", "capture_ns"))
    captured_ns = np.where(captured_ns == MISSING, stamped_ns, captured_ns)
    lane_stamps, first = np.unique(lanes.ints("stamp_ns"), return_index=True)
    lane_stamped_ns = look_up(stamps, stamped_ns, lane_stamps)
    lane_captured_ns = look_up(stamps, captured_ns, lane_stamps)
    detected = lanes.where(first).objects("lane")
    rows = [
        (captured, *_lane_values(lane))
        for captured, stamped, lane in zip(lane_captured_ns.tolist(), lane_stamped_ns.tolist(), detected, strict=True)
        if began_ns <= stamped <= ended_ns
    ]
    rows.sort(key=lambda row: row[0])
    times_ns = np.array([row[0] for row in rows], np.int64)
    values = np.array([row[1:] for row in rows], np.float64).reshape(-1, 5)
    names = ("c0", "c1", "c2", "near_m", "width_m")
    columns = {"captured_ns": times_ns, **{name: values[:, index] for index, name in enumerate(names)}}
    return Table(times_ns, times_ns, columns)


def _lane_values(lane: Mapping[str, Any] | None) -> tuple[float, ...]:
    if lane is None or lane["confidence"] < SEEN_CONFIDENCE:
        return (math.nan,) * 5
    return *lane["centre"], lane["near_m"], lane["width_m"]


def _median_width_m(pictures: Table) -> float | None:
    widths_m = pictures.floats("width_m")
    seen = np.isfinite(widths_m)
    return float(np.median(widths_m[seen])) if seen.any() else None


def _followed_offsets_m(truth: Table, route: Table, pictures: Table) -> FloatArray | None:
    """Return the offset (m, left positive) of the lane in each picture from the centre of the route's lane.

    The lane is placed in the world by the true pose of the car at the time of capture. The result is the offset of the
    lane's centre at the nearest distance ahead at which paint was seen, NaN if no lane was seen; None without ground
    truth or without a route.
    """
    points = route.objects("points")
    reference_m = np.array(points[0] if points and points[0] else np.zeros((0, 2)), np.float64)
    poses = truth.where(np.isfinite(truth.floats("x_m")) & np.isfinite(truth.floats("progress_m")))
    is_seen = np.isfinite(pictures.floats("near_m"))
    if len(reference_m) < 2 or len(poses) == 0 or not is_seen.any():
        return None
    offset_m = np.full(len(pictures), math.nan)
    offset_m[is_seen] = _offsets_at_capture(reference_m, poses, pictures.where(is_seen))
    return offset_m


def _offsets_at_capture(reference_m: FloatArray, poses: Table, pictures: Table) -> FloatArray:
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
            "mono_ns": mono_ns,
            "progress_m": float(np.interp(mono_ns - start_ns, truth_ns - start_ns, progress_m)),
            "from": before,
            "to": after,
        }
        for lane, lanes in numbers.items()
        for mono_ns, before, after in lanes.changes()
    ]
    return sorted(events, key=lambda event: event["mono_ns"])
