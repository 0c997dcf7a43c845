"""The data of a run that the figures of a report need: its result, and the server's record of the drive."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lavt.domain import NS_PER_MS, FloatArray
from lavt.experiment.analysis.latency import frames_within
from lavt.experiment.analysis.metrics import driving_interval
from lavt.recording.record import Record, evaluating, read_record
from lavt.recording.table import MISSING, Table

DRAWN_COLUMNS = ("mono_ns", "x_m", "y_m", "progress_m", "cross_track_m", "steering_rad", "speed_mps")
"""The columns of the ground truth that the report shows."""


@dataclass(frozen=True, slots=True)
class DriveData:
    """One run: its directory, its `result.json`, the ground truth of the driving interval, and the route's centre line.

    `reference_m` is the centre line, an array of shape (points, 2). `truth` has the columns `DRAWN_COLUMNS`; it has no
    rows if the vehicle is not simulated. `began_ns` is the start of the drive on the server's monotonic clock.
    """

    directory: Path
    result: Mapping[str, Any]
    truth: Table
    reference_m: FloatArray
    began_ns: int
    annotations: Mapping[str, Mapping[str, str]]
    """Versions and machine, as recorded."""
    began_wall_ns: int | None
    """The server's wall clock at the first event of its record, which in virtual time is simulated."""

    @property
    def condition(self) -> str:
        """The name of the run's condition."""
        return str(self.result["condition"])


def read_drive(directory: Path, result: Mapping[str, Any]) -> DriveData:
    """Read the data of the run in `directory` that figures need."""
    record = read_record(directory / "server.mcap", channels=("truth", "event", "route"))
    with evaluating(record.path):
        return extract_drive(record, directory, result)


def extract_drive(record: Record, directory: Path, result: Mapping[str, Any]) -> DriveData:
    """Return the data that figures need from the server's record of a run."""
    began_ns, ended_ns, _ = driving_interval(record)
    truth = record.table("truth")
    truth_ns = truth.ints("mono_ns")
    routes = record.table("route").objects("points")
    reference_m = np.array(routes[0] if routes and routes[0] else np.zeros((0, 2)), np.float64)
    drive_truth = truth.where((truth_ns >= began_ns) & (truth_ns <= ended_ns))
    columns = {name: drive_truth.columns[name] for name in DRAWN_COLUMNS if name in drive_truth.columns}
    drawn_truth = Table(drive_truth.mono_ns, drive_truth.wall_ns, columns)
    event_wall_ns = record.table("event").wall_ns
    began_wall_ns = int(event_wall_ns[0]) if len(event_wall_ns) else None
    return DriveData(directory, result, drawn_truth, reference_m, began_ns, record.annotations, began_wall_ns)


def one_of_each_condition(drives: Sequence[DriveData]) -> list[DriveData]:
    """Return one drive per condition, sorted by condition: the first valid drive or, without one, the first drive."""
    chosen: dict[str, DriveData] = {}
    for drive in sorted(drives, key=lambda drive: not drive.result["valid"]):
        chosen.setdefault(drive.condition, drive)
    return [chosen[name] for name in sorted(chosen)]


def capture_to_stamp_ms(server_record: Path) -> float | None:
    """Return the median time from the capture of a frame to its stamp; the loop latency does not include this time.

    The result is None if the camera does not report the capture time.
    """
    server = read_record(server_record, channels=("frame", "event"))
    with evaluating(server_record):
        began_ns, ended_ns, _ = driving_interval(server)
        frames = frames_within(server.table("frame"), began_ns, ended_ns)
        capture_ns = frames.ints("capture_ns")
        times_ns = (frames.ints("stamped_mono_ns") - capture_ns)[capture_ns != MISSING]
    return float(np.median(times_ns)) / NS_PER_MS if len(times_ns) else None
