"""What a replay shows of a run, from its records: at each moment the vehicle, and what it is driven by.

Only the server's clock is used, so a replay is also exact for two machines whose clocks differ: the picture that is
shown at a moment is the one from which the command in force was made, and its age is the frame age.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lavt.assembly.cameras import camera_of_file
from lavt.domain import NS_PER_MS, NS_PER_S, FloatArray, Lane, Picture
from lavt.errors import UserError
from lavt.experiment.analysis.latency import accepted_commands, look_up
from lavt.experiment.analysis.metrics import driving_interval
from lavt.experiment.analysis.results import read_result
from lavt.perception.calibration import CalibratedCamera
from lavt.recording.record import evaluating, read_record
from lavt.recording.table import MISSING, IntArray, Table
from lavt.transport.video.h264 import Decoder

SERVER_CHANNELS = ("truth", "event", "route", "frame", "admission")
LANE_FIELDS = ("width_m", "near_m", "far_m", "confidence")


@dataclass(frozen=True, slots=True)
class Scene:
    """A moment of a drive. None: unknown, as the true position of a real vehicle."""

    time_s: float
    """Time since the drive began."""
    stamp_ns: int | None
    """The stamp of the frame from which the command in force was made; None before the first command."""
    frame_age_ms: float | None
    truth_index: int | None
    """The index of the newest ground truth."""
    state: str
    """The safety state, or how the drive ended."""


@dataclass(frozen=True, slots=True)
class ReplayDrive:
    """The drive of one run.

    `truth` has the ground truth of the drive. `applied_ns` (ascending), `stamps_ns` and `stamped_ns` describe its
    accepted commands: when each was applied, and the stamp of its frame on the server's wall and monotonic clock.
    """

    directory: Path
    result: Mapping[str, Any]
    began_ns: int
    ended_ns: int
    truth: Table
    reference_m: FloatArray
    applied_ns: IntArray
    stamps_ns: IntArray
    stamped_ns: IntArray
    states: tuple[IntArray, tuple[str, ...]]
    """Times at which the safety state changed, ascending, and the new states."""

    @property
    def duration_s(self) -> float:
        """How long the drive took."""
        return (self.ended_ns - self.began_ns) / NS_PER_S

    def scene(self, time_s: float) -> Scene:
        """Return the moment at a time since the drive began; after the drive, its last moment."""
        now_ns = min(self.began_ns + round(time_s * NS_PER_S), self.ended_ns)
        command = _newest(self.applied_ns, now_ns)
        is_over = now_ns == self.ended_ns
        return Scene(
            (now_ns - self.began_ns) / NS_PER_S,
            None if command is None else int(self.stamps_ns[command]),
            None if command is None else float(now_ns - self.stamped_ns[command]) / NS_PER_MS,
            _newest(self.truth.ints("mono_ns"), now_ns),
            _ending(self.result) if is_over else self._state(now_ns),
        )

    def _state(self, now_ns: int) -> str:
        times_ns, names = self.states
        index = _newest(times_ns, now_ns)
        return "" if index is None else names[index].replace("_", " ")


def _ending(result: Mapping[str, Any]) -> str:
    ending = str(result.get("ending") or "record ends").replace("_", " ")
    if ending == "completed" and result.get("completed_in_own_lane") is False:
        return "completed, not in its own lane"
    return ending


def _newest(times_ns: IntArray, now_ns: int) -> int | None:
    """Return the index of the last time that is not after `now_ns`; None if there is none."""
    index = int(np.searchsorted(times_ns, now_ns, side="right")) - 1
    return index if index >= 0 else None


def read_replay_drive(directory: Path) -> ReplayDrive:
    """Read the drive of the run in `directory`; raise `UserError` or `WorkError` if its records cannot be used."""
    result = read_result(directory / "result.json")
    record = read_record(directory / "server.mcap", channels=SERVER_CHANNELS)
    with evaluating(record.path):
        began_ns, ended_ns, _ = driving_interval(record)
        truth, route, frames = (record.table(name) for name in ("truth", "route", "frame"))
        truth_ns = truth.ints("mono_ns")
        truth = truth.where((truth_ns >= began_ns) & (truth_ns <= ended_ns))
        points = route.objects("points")
        reference_m = np.array(points[0] if points and points[0] else np.zeros((0, 2)), np.float64).reshape(-1, 2)
        commands = accepted_commands(record.table("admission"))
        stamped_ns = look_up(frames.ints("stamp_ns"), frames.ints("stamped_mono_ns"), commands.ints("stamp_ns"))
        commands, stamped_ns = commands.where(stamped_ns != MISSING), stamped_ns[stamped_ns != MISSING]
        events = record.table("event")
        changes = [
            (mono_ns, detail.partition(" -> ")[2].partition(":")[0])
            for kind, mono_ns, detail in zip(
                events.texts("kind"), events.ints("mono_ns").tolist(), events.texts("detail"), strict=True
            )
            if kind == "safety"
        ]
        states = np.array([mono_ns for mono_ns, _ in changes], np.int64), tuple(state for _, state in changes)
        return ReplayDrive(
            directory,
            result,
            began_ns,
            ended_ns,
            truth,
            reference_m,
            commands.ints("applied_mono_ns"),
            commands.ints("stamp_ns"),
            stamped_ns,
            states,
        )


@dataclass(frozen=True, slots=True)
class DriverView:
    """What the driver of a run saw: access units with their stamps, in order, and the lane detected in each picture.

    `camera` is None if the run's config does not describe it.
    """

    units: Sequence[tuple[int, bytes]]
    lanes: Mapping[int, Lane]
    camera: CalibratedCamera | None

    def pictures(self, stamps_ns: Iterable[int | None]) -> Iterator[Picture | None]:
        """Yield the received picture with each stamp, and None without such a picture; the stamps must not decrease."""
        units, decoder = iter(self.units), Decoder()
        newest_ns, decoded = MISSING, None
        for stamp_ns in stamps_ns:
            while stamp_ns is not None and newest_ns < stamp_ns:
                newest_ns, unit = next(units, (stamp_ns, b""))
                decoded = decoder.decode(unit)
            yield decoded.picture if decoded is not None and newest_ns == stamp_ns else None


def read_driver_view(directory: Path) -> DriverView:
    """Read what the driver of the run in `directory` saw; raise `UserError` or `WorkError` as `read_replay_drive`."""
    record = read_record(directory / "client.mcap", channels=("lane",))
    units = record.video()
    with evaluating(record.path):
        table = record.table("lane")
        lanes = {
            stamp_ns: Lane(tuple(lane["centre"]), *(float(lane[name]) for name in LANE_FIELDS))
            for stamp_ns, lane in zip(table.ints("stamp_ns").tolist(), table.objects("lane"), strict=True)
            if lane is not None
        }
    camera = None
    with suppress(UserError):  # the calibration file of a real camera may be on another machine
        camera = camera_of_file(directory / "config.yaml")
    return DriverView(units, lanes, camera)
