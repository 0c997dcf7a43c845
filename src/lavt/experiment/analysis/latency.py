"""Latencies of a run, each a pure function of recorded tables. `docs/metrics.md` has the formulas.

All latencies cover the driving interval only: the time between `began_ns` and `ended_ns` on the server's monotonic
clock.

`frames` are rows of the server's channel `frame`, one for each stamped frame. `received_frames` are rows of the
client's channel `picture`, one for each frame that the client received and tried to decode. `command_verdicts` are rows
of the server's channel `admission`, one for each command that reached the gate. `page_pictures` are rows of the
client's channel `page_picture`, one for each frame that the page of the person who drives has shown.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from lavt.domain import NS_PER_MS, FloatArray
from lavt.experiment.analysis.clock_offset import ClockOffset
from lavt.recording.table import MISSING, IntArray, Table


def look_up(keys: IntArray, values: IntArray, searched_keys: IntArray) -> IntArray:
    """Return for each of `searched_keys` the value of the first equal key in `keys`; `MISSING` if no key is equal.

    `values[i]` is the value of `keys[i]`.
    """
    found = np.full(len(searched_keys), MISSING, np.int64)
    if len(keys) == 0:
        return found
    order = np.argsort(keys, kind="stable")
    position = np.minimum(np.searchsorted(keys[order], searched_keys), len(keys) - 1)
    is_found = (keys[order][position] == searched_keys) & (searched_keys != MISSING)
    found[is_found] = values[order][position[is_found]]
    return found


def frames_within(frames: Table, began_ns: int, ended_ns: int) -> Table:
    """Return the frames that were stamped in the driving interval."""
    stamped_ns = frames.ints("stamped_mono_ns")
    return frames.where((stamped_ns >= began_ns) & (stamped_ns <= ended_ns))


def rtp_timestamp(stamp_ns: IntArray) -> IntArray:
    """Return the RTP timestamps (90 kHz, modulo 2^32) of frames with these stamps."""
    # 90 kHz is 9 ticks per 100 us. The division comes first, because stamp * 9 exceeds 64 bits.
    hundreds_of_us, rest_ns = np.divmod(stamp_ns, 100_000)
    return np.asarray((hundreds_of_us * 9 + rest_ns * 9 // 100_000) % 2**32, np.int64)


def received_frames_of(received_frames: Table, frames: Table) -> Table:
    """Return the rows of received frames that belong to `frames`.

    A row is matched by the frame's stamp if the client could read it, otherwise by the RTP timestamp.
    """
    stamps = frames.ints("stamp_ns")
    matches_stamp = np.isin(received_frames.ints("stamp_ns"), stamps)
    matches_timestamp = np.isin(received_frames.ints("rtp_timestamp"), rtp_timestamp(stamps))
    return received_frames.where(np.where(received_frames.flags("readable"), matches_stamp, matches_timestamp))


def decoded_frames(received_frames: Table) -> Table:
    """Return the rows of received frames that were decoded to a picture.

    Older records do not have the field `decoded`; all their rows are returned.
    """
    is_decoded = [decoded is not False for decoded in received_frames.objects("decoded")]
    return received_frames.where(np.array(is_decoded, np.bool_))


def video_latency_ns(received_frames: Table, offset: ClockOffset) -> IntArray:
    """Return tau_v of every received frame with a readable stamp: the time between writing and reading the stamp.

    Both times are on the server's wall clock.
    """
    is_known = received_frames.flags("readable") & (received_frames.ints("read_wall_ns") != MISSING)
    readable = received_frames.where(is_known)
    return offset.to_server_ns(readable.ints("read_wall_ns")) - readable.ints("stamp_ns")


def page_pictures_of(page_pictures: Table, frames: Table) -> Table:
    """Return the first row of each of `frames` that the page of the person who drives has shown.

    Rows without all of their times are left out.
    """
    names = ("stamp_ns", "decoded_wall_ns", "shown_wall_ns", "bound_ns")
    is_known = np.all([page_pictures.ints(name) != MISSING for name in names], axis=0)
    known = page_pictures.where(is_known & np.isin(page_pictures.ints("stamp_ns"), frames.ints("stamp_ns")))
    _, first = np.unique(known.ints("stamp_ns"), return_index=True)
    return known.where(np.sort(first))


def page_latency_ns(page_pictures: Table, time: str, offset: ClockOffset) -> IntArray:
    """Return the times between writing the stamp of each picture and its `time` in the page.

    `time` is a field of the channel `page_picture` on the client's wall clock. Both times are on the server's.
    """
    return offset.to_server_ns(page_pictures.ints(time)) - page_pictures.ints("stamp_ns")


def control_latency_ns(command_verdicts: Table, offset: ClockOffset, began_ns: int, ended_ns: int) -> IntArray:
    """Return tau_c of every accepted command: the time between sending and reception, on the server's wall clock.

    Rejected commands are left out: they can come from anyone and have any send time.
    """
    commands = accepted_commands(command_verdicts)
    received_ns = commands.ints("received_mono_ns")
    known = (commands.ints("sent_wall_ns") != MISSING) & (commands.ints("received_wall_ns") != MISSING)
    within = commands.where(known & (received_ns >= began_ns) & (received_ns <= ended_ns))
    return within.ints("received_wall_ns") - offset.to_server_ns(within.ints("sent_wall_ns"))


@dataclass(frozen=True, slots=True)
class FramesWithCommands:
    """The frames from which an accepted command was made.

    `commands` has the first accepted command of each frame (rows of the channel `admission`), in the order of
    application. The stamps are in the same order.
    """

    stamp_ns: IntArray
    stamped_mono_ns: IntArray
    commands: Table

    @property
    def loop_ns(self) -> IntArray:
        """The loop latency, from the stamp to the application of the command, on the server's monotonic clock."""
        return self.commands.ints("applied_mono_ns") - self.stamped_mono_ns

    @property
    def client_ns(self) -> IntArray:
        """The client time, from reading the stamp to sending the command, on the client's wall clock."""
        return self.commands.ints("sent_wall_ns") - self.commands.ints("stamp_received_wall_ns")

    @property
    def actuator_ns(self) -> IntArray:
        """The actuator time, from reception to application of the command, on the server's monotonic clock."""
        return self.commands.ints("applied_mono_ns") - self.commands.ints("received_mono_ns")


def accepted_commands(command_verdicts: Table) -> Table:
    """Return the accepted commands in the order in which they were applied."""
    is_accepted = np.array([verdict == "accepted" for verdict in command_verdicts.texts("verdict")], np.bool_)
    commands = command_verdicts.where(is_accepted & (command_verdicts.ints("applied_mono_ns") != MISSING))
    return commands.where(np.argsort(commands.ints("applied_mono_ns"), kind="stable"))


def frames_with_commands(frames: Table, command_verdicts: Table, ended_ns: int) -> FramesWithCommands:
    """Pair each of `frames` with the first accepted command that carries its stamp and was applied by `ended_ns`.

    Frames without such a command are left out.
    """
    commands = accepted_commands(command_verdicts)
    commands = commands.where(commands.ints("applied_mono_ns") <= ended_ns)
    stamped_ns = look_up(frames.ints("stamp_ns"), frames.ints("stamped_mono_ns"), commands.ints("stamp_ns"))
    _, first = np.unique(commands.ints("stamp_ns"), return_index=True)
    chosen = np.zeros(len(commands), np.bool_)
    chosen[first] = True
    chosen &= stamped_ns != MISSING
    commands = commands.where(chosen)
    return FramesWithCommands(commands.ints("stamp_ns"), stamped_ns[chosen], commands)


def latency_sum_error_ns(received_frames: Table, paired: FramesWithCommands, offset: ClockOffset) -> IntArray:
    """Return tau_v + client time + tau_c + actuator time - loop latency, for every frame for which all are known.

    An error of the clock offset cancels in the sum. Errors from a clock step, or from times of the wrong frame, remain.
    """
    readable = received_frames.where(received_frames.flags("readable"))
    read_wall_ns = look_up(readable.ints("stamp_ns"), readable.ints("read_wall_ns"), paired.stamp_ns)
    commands = paired.commands
    needed = [read_wall_ns, *(commands.ints(name) for name in ("sent_wall_ns", "stamp_received_wall_ns"))]
    known = np.all([times != MISSING for times in needed], axis=0) if len(commands) else np.zeros(0, np.bool_)
    tau_v_ns = offset.to_server_ns(read_wall_ns) - paired.stamp_ns
    tau_c_ns = commands.ints("received_wall_ns") - offset.to_server_ns(commands.ints("sent_wall_ns"))
    total_ns = tau_v_ns + paired.client_ns + tau_c_ns + paired.actuator_ns
    return np.asarray((total_ns - paired.loop_ns)[known], np.int64)


@dataclass(frozen=True, slots=True)
class FrameAge:
    """The time-weighted age of the frame from which the command in force was made.

    Both values are None if no command was in force during the drive.
    """

    mean_ms: float | None
    p95_ms: float | None


def frame_age(frames: Table, command_verdicts: Table, began_ns: int, ended_ns: int) -> FrameAge:
    """Return the mean and the 95th percentile of the frame age during the driving interval.

    Both are exact: while a command is in force, the age of its frame grows by 1 s per second. `frames` are all frames
    of the run, because the first command in force can come from a frame that was stamped before the interval.
    """
    commands = accepted_commands(command_verdicts)
    stamped_ns = look_up(frames.ints("stamp_ns"), frames.ints("stamped_mono_ns"), commands.ints("stamp_ns"))
    starts_ns = np.clip(commands.ints("applied_mono_ns"), began_ns, ended_ns)
    ends_ns = np.append(starts_ns[1:], ended_ns)[: len(starts_ns)]
    in_force = (stamped_ns != MISSING) & (ends_ns > starts_ns)
    youngest_ms = (starts_ns - stamped_ns)[in_force] / NS_PER_MS
    oldest_ms = (ends_ns - stamped_ns)[in_force] / NS_PER_MS
    duration_ms = oldest_ms - youngest_ms
    if not in_force.any():
        return FrameAge(None, None)
    mean_ms = float(np.sum(duration_ms * (youngest_ms + oldest_ms) / 2) / np.sum(duration_ms))
    return FrameAge(mean_ms, _ramp_percentile(youngest_ms, oldest_ms, 0.95))


def ages_at_actuation_ns(frames: Table, command_verdicts: Table, began_ns: int, ended_ns: int) -> IntArray:
    """Return the frame age at actuation of every accepted command: from the frame's stamp to the application."""
    commands = accepted_commands(command_verdicts)
    applied_ns = commands.ints("applied_mono_ns")
    stamped_ns = look_up(frames.ints("stamp_ns"), frames.ints("stamped_mono_ns"), commands.ints("stamp_ns"))
    known = (stamped_ns != MISSING) & (applied_ns >= began_ns) & (applied_ns <= ended_ns)
    return np.asarray(applied_ns[known] - stamped_ns[known], np.int64)


def _ramp_percentile(low: FloatArray, high: FloatArray, share: float) -> float:
    """Return the time-weighted percentile `share` of a quantity that rises in ramps, all with slope 1.

    Ramp i rises from `low[i]` to `high[i]`. The time that the quantity spends below x is piecewise linear in x, and the
    slope of that function is the number of ramps that contain x.
    """
    ends = np.concatenate([low, high])
    order = np.argsort(ends, kind="stable")
    ramp_counts = np.cumsum(np.concatenate([np.ones(len(low)), -np.ones(len(high))])[order])
    corners = ends[order]
    time_below = np.concatenate([[0.0], np.cumsum(ramp_counts[:-1] * np.diff(corners))])
    return float(np.interp(share * time_below[-1], time_below, corners))


def percentiles_ms(times_ns: IntArray) -> dict[str, Any]:
    """Return the percentiles p5, p50, p95 in ms (interpolated linearly; None without times) and the count `n`."""
    if len(times_ns) == 0:
        return {"p5": None, "p50": None, "p95": None, "n": 0}
    p5, p50, p95 = np.percentile(times_ns / NS_PER_MS, [5, 50, 95])
    return {"p5": float(p5), "p50": float(p50), "p95": float(p95), "n": len(times_ns)}
