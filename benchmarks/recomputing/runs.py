"""The results of one run, recomputed from its records by the formulas of `docs/metrics.md`."""

from __future__ import annotations

import itertools
import json
import math
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from mcap.reader import make_reader
from numpy.typing import NDArray
from scipy import signal

Floats = NDArray[np.float64]
Row = dict[str, Any]
Record = dict[str, list[Row]]
"""The messages of each channel, in the order of the file. `publish_ns` is added to each."""

SIDES = {
    "server": ("frame", "admission", "truth", "route", "event", "clock"),
    "client": ("picture", "lane", "clock", "page_picture"),
}
"""The channels that are read."""


def read(directory: Path, side: str) -> Record:
    """Return the JSON messages of a side's record by channel."""
    record: Record = {name: [] for name in SIDES[side]}
    topics = [f"/{name}" for name in record]
    with (directory / f"{side}.mcap").open("rb") as stream:
        for _, channel, message in make_reader(stream).iter_messages(topics, log_time_order=False):
            row = {**json.loads(message.data), "publish_ns": message.publish_time}
            record[channel.topic.removeprefix("/")].append(row)
    return record


def column(rows: Iterable[Row], name: str) -> Floats:
    """Return a field of all rows; null is NaN. Times in ns must be made relative before."""
    return np.array([math.nan if row.get(name) is None else row[name] for row in rows], np.float64)


def first_by(rows: Iterable[Row], key: str) -> dict[Any, Row]:
    """Return the first row for each value of `key`."""
    found: dict[Any, Row] = {}
    for row in rows:
        if row.get(key) is not None:
            found.setdefault(row[key], row)
    return found


# The driving interval and the samples by distance.


def driving_interval(server: Record) -> tuple[int, int, str]:
    """Return start and end (ns, server's monotonic clock) and the ending."""
    began = next(index for index, event in enumerate(server["event"]) if event["kind"] == "drive_began")
    ending = next(event for event in server["event"][began:] if event["kind"] == "ending")
    return server["event"][began]["mono_ns"], ending["mono_ns"], ending["detail"]


def samples(progress_m: Floats, values: Floats) -> Floats:
    """Return the values at every 0.25 m of new progress."""
    kept, farthest = [], -math.inf
    for index, position in enumerate(progress_m.tolist()):
        if position > farthest:
            kept.append(index)
            farthest = position
    first = progress_m[0]
    positions = first + 0.25 * np.arange(math.floor((farthest - first) / 0.25 + 1e-9) + 1)
    return np.asarray(np.interp(positions, progress_m[kept], values[kept]), np.float64)


def error_metrics(prefix: str, errors: Floats) -> Row:
    """Return mean, RMS, 95th percentile and maximum of the absolute errors."""
    absolute = np.abs(errors)
    return {
        f"{prefix}mae_m": absolute.mean(),
        f"{prefix}rms_m": np.sqrt(np.mean(absolute**2)),
        f"{prefix}p95_m": np.percentile(absolute, 95),
        f"{prefix}max_m": absolute.max(),
    }


def lane_keeping(truth: list[Row], events: Counter[str]) -> Row:
    """Return the values of the section "Lane keeping"."""
    progress_m = column(truth, "progress_m")
    cross_track_m = samples(progress_m, column(truth, "cross_track_m"))
    heading_rad = np.abs(samples(progress_m, column(truth, "heading_error_rad")))
    steering_rad = column(truth, "steering_rad")
    times_s = np.array([row["mono_ns"] - truth[0]["mono_ns"] for row in truth]) / 1e9
    driven_m = progress_m.max() - progress_m[0]
    steps_s, changes_rad = np.diff(times_s), np.diff(steering_rad)
    steps_s, changes_rad = steps_s[steps_s > 0], changes_rad[steps_s > 0]
    reversals = count_reversals(steering_rad.tolist())
    return {
        **error_metrics("", cross_track_m),
        "p95_by_10m": [
            np.percentile(np.abs(cross_track_m[: end + 1]), 95) for end in range(40, len(cross_track_m), 40)
        ],
        "heading_mae_rad": heading_rad.mean(),
        "heading_rms_rad": np.sqrt(np.mean(heading_rad**2)),
        "heading_p95_rad": np.percentile(heading_rad, 95),
        "steering_rms_rad": np.sqrt(np.mean(samples(progress_m, steering_rad) ** 2)),
        "steering_rate_rms_radps": np.sqrt(np.sum(changes_rad**2 / steps_s) / np.sum(steps_s)),
        "lateral_jerk_rms_mps3": lateral_jerk_rms(times_s, truth),
        "steering_reversals_per_s": reversals / times_s[-1],
        "steering_reversals_per_km": reversals / (driven_m / 1000),
        "oscillation_hz": oscillation_hz(times_s, steering_rad),
        "collisions": events["collision"],
        "lane_invasions": events["lane_invasion"],
        "collisions_per_km": events["collision"] / (driven_m / 1000),
        "lane_invasions_per_km": events["lane_invasion"] / (driven_m / 1000),
        "distance_m": driven_m,
    }


def lateral_jerk_rms(times_s: Floats, truth: list[Row]) -> float | None:
    """Return the RMS of the change of speed x yaw rate, from samples every 0.1 s."""
    sampled_s = np.array([0.1 * number for number in range(math.ceil(times_s[-1] / 0.1 - 1e-9))])
    if len(sampled_s) < 3:
        return None
    heading_rad = np.interp(sampled_s, times_s, np.unwrap(column(truth, "heading_rad")))
    speed_mps = np.interp(sampled_s, times_s, column(truth, "speed_mps"))
    lateral_mps2 = speed_mps[1:] * (heading_rad[1:] - heading_rad[:-1]) / 0.1
    return float(np.sqrt(np.mean(((lateral_mps2[1:] - lateral_mps2[:-1]) / 0.1) ** 2)))


def count_reversals(angles_rad: Sequence[float]) -> int:
    """Return the number of turns by more than 0.01 rad against the direction before."""
    smallest = largest = extreme = angles_rad[0]
    direction, count = 0, 0
    for angle in angles_rad:
        if direction == 0:
            smallest, largest = min(smallest, angle), max(largest, angle)
            if angle - smallest > 0.01 or largest - angle > 0.01:
                direction, extreme = (1 if angle - smallest > 0.01 else -1), angle
        elif direction * (angle - extreme) > 0:
            extreme = angle
        elif direction * (extreme - angle) > 0.01:
            count, direction, extreme = count + 1, -direction, angle
    return count


def oscillation_hz(times_s: Floats, steering_rad: Floats) -> float | None:
    """Return the frequency of the highest peak of the steering's spectrum."""
    sampled = np.interp(np.arange(0.0, times_s[-1], 0.05), times_s, steering_rad)
    length = 1
    while length < 8 * len(sampled):
        length *= 2
    hertz, power = signal.periodogram(sampled, 20, window="hann", detrend="linear", scaling="spectrum", nfft=length)
    peaks = [
        index
        for index in range(1, len(power) - 1)
        if power[index] > max(power[index - 1], power[index + 1]) and max(0.1, 3 / times_s[-1]) <= hertz[index] <= 5.0
    ]
    best = max(peaks, key=lambda index: power[index], default=None)
    return float(hertz[best]) if best is not None and 2 * math.sqrt(2 * power[best]) > 0.01 else None


# The own lane.


def offset_from(points: Floats, x_m: float, y_m: float, station_m: float) -> float:
    """Return the distance (left positive) of a point from the route's polyline, near a station."""
    last = points[-1] - points[-2]
    corners = [*points, points[-1] + 100 * last / math.hypot(*last)]
    best, station, offset = math.inf, 0.0, 0.0
    for (ax, ay), (bx, by) in itertools.pairwise(corners):
        dx, dy = bx - ax, by - ay
        length = math.hypot(dx, dy)
        if station + length >= station_m - 20 and station <= station_m + 20:
            along = min(max(((x_m - ax) * dx + (y_m - ay) * dy) / length**2, 0.0), 1.0)
            px, py = x_m - ax - along * dx, y_m - ay - along * dy
            if math.hypot(px, py) < best:
                best = math.hypot(px, py)
                offset = math.copysign(best, dx * py - dy * px)
        station += length
    return offset


def numbered(offsets_m: Iterable[float], width_m: float) -> list[int]:
    """Return the lane number for each offset."""
    numbers: list[int] = []
    for offset in offsets_m:
        number = numbers[-1] if numbers else round(offset / width_m)
        if abs(offset - number * width_m) > width_m / 2 + 0.25:
            number = round(offset / width_m)
        numbers.append(number)
    return numbers


def followed_in(offsets_m: Sequence[float | None], width_m: float) -> list[int | None]:
    """Return the number of the lane followed in each picture; None if it is unknown."""
    followed: list[int | None] = []
    lane: int | None = None  # the lane followed
    streak: list[tuple[int, int]] = []  # index and number of the last pictures with the same number
    missing = 0  # successive pictures without a lane
    for index, offset in enumerate(offsets_m):
        followed.append(lane)
        missing = missing + 1 if offset is None else 0
        if missing >= 3:
            lane, streak = None, []
            followed[-3:] = [None] * 3
        if offset is None:
            continue
        stays = lane is not None and abs(offset - lane * width_m) <= width_m / 2 + 0.25
        number = lane if lane is not None and stays else round(offset / width_m)
        streak = [*(entry for entry in streak if entry[1] == number), (index, number)]
        if len(streak) >= 3 and lane != number:
            lane = number
            followed[streak[0][0] :] = [lane] * (index + 1 - streak[0][0])
    return followed


def errors_against_followed(truth: list[Row], at_rows: Sequence[int | None], width_m: float) -> Floats:
    """Return the samples of the error against the lane followed, without those next to a row where it is unknown."""
    progress_m = column(truth, "progress_m")
    known = np.array([number is not None for number in at_rows])
    numbers = np.array([number or 0 for number in at_rows])
    errors_m = samples(progress_m, column(truth, "cross_track_m") - numbers * width_m)
    return np.asarray(errors_m[samples(progress_m, known.astype(float)) == 1], np.float64)


def placed_lanes(
    server: Record, client: Record, interval: tuple[int, int]
) -> tuple[list[int], list[float | None], list[float]]:
    """Return capture times and offsets (None without a lane) of the pictures, and the widths of the seen lanes."""
    points, frames = np.array(server["route"][0]["points"]), first_by(server["frame"], "stamp_ns")
    start = server["truth"][0]["mono_ns"]
    truth_s = [row["mono_ns"] - start for row in server["truth"]]
    poses = [column(server["truth"], name) for name in ("x_m", "y_m", "heading_rad", "progress_m")]
    times: list[int] = []
    offsets: list[float | None] = []
    widths_m = []
    for stamp, message in first_by(client["lane"], "stamp_ns").items():
        frame, lane = frames.get(stamp), message["lane"]
        if frame is None or not interval[0] <= frame["stamped_mono_ns"] <= interval[1]:
            continue
        times.append(frame["stamped_mono_ns"] if frame["capture_ns"] is None else frame["capture_ns"])
        if lane["confidence"] < 0.2:
            offsets.append(None)
            continue
        x, y, heading, progress = (np.interp(times[-1] - start, truth_s, values) for values in poses)
        ahead, (c0, c1, c2) = lane["near_m"], lane["centre"]
        left = c0 + c1 * ahead + c2 * ahead**2
        world_x = x + ahead * math.cos(heading) - left * math.sin(heading)
        world_y = y + ahead * math.sin(heading) + left * math.cos(heading)
        offsets.append(offset_from(points, world_x, world_y, progress + ahead))
        widths_m.append(lane["width_m"])
    return times, offsets, widths_m


def own_lane(server: Record, client: Record, truth: list[Row], interval: tuple[int, int], ending: str) -> Row:
    """Return the values of the section "Own lane"."""
    times, offsets, widths_m = placed_lanes(server, client, interval)
    width_m = float(np.median(widths_m)) if widths_m else math.nan
    followed = followed_in(offsets, width_m)
    if all(number is None for number in followed):
        unknown = dict.fromkeys(f"followed_{name}_m" for name in ("mae", "rms", "p95", "max"))
        return {"lane_kept": None, "completed_in_own_lane": None if ending == "completed" else False, **unknown}
    occupied = numbered((row["cross_track_m"] for row in truth), width_m)
    at_rows = [followed[max(sum(captured <= row["mono_ns"] for captured in times) - 1, 0)] for row in truth]
    steps = np.diff([row["mono_ns"] for row in truth])

    def share(is_true: Sequence[bool]) -> float:
        return float(steps[np.array(is_true[:-1])].sum() / steps.sum())

    start, progress_m = truth[0]["mono_ns"], column(server["truth"], "progress_m")
    truth_s = [row["mono_ns"] - start for row in server["truth"]]
    changes = []
    for name, at_times, numbers in (
        ("followed", times, followed),
        ("occupied", [row["mono_ns"] for row in truth], occupied),
    ):
        known = [(at, number) for at, number in zip(at_times, numbers, strict=True) if number is not None]
        changes += [
            {"lane": name, "mono_ns": at, "progress_m": np.interp(at - start, truth_s, progress_m)}
            | {"from": before, "to": after}
            for (_, before), (at, after) in itertools.pairwise(known)
            if before != after
        ]
    kept = {
        "lane_width_m": width_m,
        "followed_share": share([number == 0 for number in at_rows]),
        "followed_unknown_share": share([number is None for number in at_rows]),
        "occupied_share": share([number == 0 for number in occupied]),
        "own_lane_share": share([f == 0 == o for f, o in zip(at_rows, occupied, strict=True)]),
        "followed_changes": sum(change["lane"] == "followed" for change in changes),
        "occupied_changes": sum(change["lane"] == "occupied" for change in changes),
        "changes": sorted(changes, key=lambda change: change["mono_ns"]),
    }
    own = kept["occupied_share"] == 1 and kept["followed_share"] > 0 and not changes
    return {
        "lane_kept": kept,
        "completed_in_own_lane": ending == "completed" and own,
        **error_metrics("followed_", errors_against_followed(truth, at_rows, width_m)),
    }


# Latencies.


def percentiles(values_ns: Sequence[float]) -> Row:
    """Return the percentiles in ms and the number of values."""
    values_ms = np.array(values_ns, np.float64) / 1e6
    return {**{f"p{share}": np.percentile(values_ms, share) for share in (5, 50, 95)}, "n": len(values_ms)}


def clock_offset(server: Record, client: Record, interval: tuple[int, int], shift_ns: int) -> Callable[[int], int]:
    """Return Delta as a function of the client's wall clock: 0 on one kernel, else by both sides' clock sources."""
    hosts = {row.get("host") for record in (server, client) for row in record["clock"]}
    if len(hosts) == 1 and hosts != {""}:
        return lambda _wall_ns: 0
    sides = []
    for record, shift in ((server, 0), (client, shift_ns)):
        low, high = interval[0] + shift - 5 * 10**9, interval[1] + shift + 5 * 10**9
        kept = [row for row in record["clock"] if low <= row["publish_ns"] <= high]
        sides.append([(row["wall_ns"], row["correction_s"] * 1e9) for row in kept])
    origin = sides[0][0][0]
    (server_ref, server_ns), (client_ref, client_ns) = (
        (np.array([wall - origin + ns for wall, ns in side]), np.array([ns for _, ns in side])) for side in sides
    )
    low, high = max(server_ref[0], client_ref[0]), min(server_ref[-1], client_ref[-1])
    points = sorted(ref for ref in [*server_ref, *client_ref] if low <= ref <= high)
    corrections = np.interp(points, client_ref, client_ns)
    walls, deltas = np.array(points) - corrections, corrections - np.interp(points, server_ref, server_ns)
    return lambda wall_ns: round(float(np.interp(wall_ns - origin, walls, deltas)))


def latencies(server: Record, client: Record, interval: tuple[int, int]) -> Row:
    """Return the values of the section "Latencies"."""
    began, ended = interval
    frames = first_by(server["frame"], "stamp_ns")
    in_drive = {stamp: row for stamp, row in frames.items() if began <= row["stamped_mono_ns"] <= ended}
    by_rtp = {stamp * 9 // 100_000 % 2**32 for stamp in in_drive}
    pictures = [
        row
        for row in client["picture"]
        if row["decoded"] and (row["stamp_ns"] in in_drive if row["readable"] else row["rtp_timestamp"] in by_rtp)
    ]
    readable = [row for row in pictures if row["readable"]]
    shift = min(row["read_mono_ns"] - in_drive[row["stamp_ns"]]["stamped_mono_ns"] for row in readable)
    delta = clock_offset(server, client, interval, shift)
    accepted = [row for row in server["admission"] if row["verdict"] == "accepted"]
    arrived = [row for row in accepted if began <= row["received_mono_ns"] <= ended]
    earliest = first_by(sorted(accepted, key=lambda row: row["applied_mono_ns"]), "stamp_ns")
    tau_c = [row["received_wall_ns"] - (row["sent_wall_ns"] + delta(row["sent_wall_ns"])) for row in arrived]
    loop = [
        earliest[stamp]["applied_mono_ns"] - frame["stamped_mono_ns"]
        for stamp, frame in in_drive.items()
        if stamp in earliest and earliest[stamp]["applied_mono_ns"] <= ended
    ]
    at_actuation = [
        row["applied_mono_ns"] - frames[row["stamp_ns"]]["stamped_mono_ns"]
        for row in accepted
        if began <= row["applied_mono_ns"] <= ended and row["stamp_ns"] in frames
    ]
    return {
        "tau_v_ms": percentiles(
            [row["read_wall_ns"] + delta(row["read_wall_ns"]) - row["stamp_ns"] for row in readable]
        ),
        "tau_c_ms": percentiles(tau_c),
        **page_latencies(client, in_drive, delta),
        "loop_ms": percentiles(loop),
        "age_at_actuation_ms": percentiles(at_actuation),
        "picture_age_ms": frame_age(accepted, frames, interval),
        "frames_sent": len(in_drive),
        "frames_decoded": len(pictures),
        "frames_unreadable": len(pictures) - len(readable),
    }


def page_latencies(client: Record, in_drive: dict[Any, Row], delta: Callable[[int], int]) -> Row:
    """Return the latencies from the stamp to the page of a person; without a row of these frames, all but `n` is None.

    A row counts if it has all of its times and the bound, and only the first one with its stamp.
    """
    needed = ("decoded_wall_ns", "shown_wall_ns", "bound_ns")
    complete = [row for row in client["page_picture"] if all(row.get(name) is not None for name in needed)]
    rows = [row for stamp, row in first_by(complete, "stamp_ns").items() if stamp in in_drive]
    found: Row = {}
    for name in ("decoded", "shown"):
        times = [(row[f"{name}_wall_ns"], row["stamp_ns"]) for row in rows]
        latencies_ns = [wall + delta(wall) - stamp for wall, stamp in times]
        none = {"p5": None, "p50": None, "p95": None, "n": 0, "max": None}
        measured = {**percentiles(latencies_ns), "max": max(latencies_ns) / 1e6} if latencies_ns else none
        found[f"page_{name}_ms"] = measured
    return found


def frame_age(accepted: list[Row], frames: dict[Any, Row], interval: tuple[int, int]) -> Row:
    """Return mean and 95th percentile of the frame age, weighted by time."""
    began, ended = interval
    ordered = sorted(accepted, key=lambda row: row["applied_mono_ns"])
    pieces = []  # age at the begin and at the end of the time in which a command is in force
    for index, row in enumerate(ordered):
        start = max(row["applied_mono_ns"], began)
        end = min(ordered[index + 1]["applied_mono_ns"], ended) if index + 1 < len(ordered) else ended
        if start < end and row["stamp_ns"] in frames:
            stamped = frames[row["stamp_ns"]]["stamped_mono_ns"]
            pieces.append((start - stamped, end - stamped))
    lows, highs = np.array(pieces, np.float64).T
    total = np.sum(highs - lows)
    ages = np.unique(np.concatenate([lows, highs]))
    below = np.array([np.sum(np.clip(age - lows, 0, highs - lows)) for age in ages])
    return {
        "mean": np.sum((highs - lows) * (highs + lows) / 2) / total / 1e6,
        "p95": np.interp(0.95 * total, below, ages) / 1e6,
    }


def recompute_run(directory: Path) -> Row:
    """Return the recomputed values of a run."""
    server, client = read(directory, "server"), read(directory, "client")
    began, ended, ending = driving_interval(server)
    truth = [row for row in server["truth"] if began <= row["mono_ns"] <= ended]
    events = Counter(event["kind"] for event in server["event"] if began <= event["mono_ns"] <= ended)
    return {
        "ending": ending,
        "duration_s": (ended - began) / 1e9,
        "route_length_m": server["route"][0]["length_m"],
        **lane_keeping(truth, events),
        **own_lane(server, client, truth, (began, ended), ending),
        **latencies(server, client, (began, ended)),
    }
