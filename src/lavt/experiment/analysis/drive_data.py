"""What the figures of a report need of each run: its result, and what its server recorded of the drive."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lavt.domain import NS_PER_MS, FloatArray
from lavt.experiment.analysis.latency import frames_within
from lavt.experiment.analysis.metrics import driving_interval
from lavt.recording.record import Record, read_record
from lavt.recording.table import MISSING, Table

DRAWN = ("mono_ns", "x_m", "y_m", "progress_m", "cross_track_m", "steering_rad")
"""What figures show of the truth."""


@dataclass(frozen=True, slots=True)
class DriveData:
    """One run: where it is, its `result.json`, the truth of the driving interval, and the route's centre line.

    `reference_m` is (points, 2); `truth` has the columns `DRAWN`, and no rows where there was no simulator.
    """

    directory: Path
    result: Mapping[str, Any]
    truth: Table
    reference_m: FloatArray
    began_ns: int
    annotations: Mapping[str, Mapping[str, str]]
    """Versions and machine, as recorded."""

    @property
    def condition(self) -> str:
        """Name of the run's condition."""
        return str(self.result["condition"])


def read_drive(directory: Path, result: Mapping[str, Any]) -> DriveData:
    """Read what the figures need of the run in `directory`."""
    return drive_of(read_record(directory / "server.mcap", channels=("truth", "event", "route")), directory, result)


def drive_of(record: Record, directory: Path, result: Mapping[str, Any]) -> DriveData:
    """Take what the figures need out of the server's record of a run."""
    began_ns, ended_ns, _ = driving_interval(record)
    truth = record.table("truth")
    truth_ns = truth.ints("mono_ns")
    routes = record.table("route").objects("points")
    reference_m = np.array(routes[0] if routes and routes[0] else np.zeros((0, 2)), np.float64)
    within = truth.where((truth_ns >= began_ns) & (truth_ns <= ended_ns))
    columns = {name: within.columns[name] for name in DRAWN if name in within.columns}
    driven = Table(within.mono_ns, within.wall_ns, columns)
    return DriveData(directory, result, driven, reference_m, began_ns, record.annotations)


def one_of_each_condition(drives: Sequence[DriveData]) -> list[DriveData]:
    """Choose a drive of each condition, in their order: a valid one if there is one, the first of those."""
    chosen: dict[str, DriveData] = {}
    for drive in sorted(drives, key=lambda drive: not drive.result["valid"]):
        chosen.setdefault(drive.condition, drive)
    return [chosen[name] for name in sorted(chosen)]


def capture_to_stamp_ms(server_record: Path) -> float | None:
    """Median time from a frame's exposure to its stamp, which is before the loop; None where no camera told of it."""
    server = read_record(server_record, channels=("frame", "event"))
    began_ns, ended_ns, _ = driving_interval(server)
    frames = frames_within(server.table("frame"), began_ns, ended_ns)
    capture_ns = frames.ints("capture_ns")
    times_ns = (frames.ints("stamped_mono_ns") - capture_ns)[capture_ns != MISSING]
    return float(np.median(times_ns)) / NS_PER_MS if len(times_ns) else None
