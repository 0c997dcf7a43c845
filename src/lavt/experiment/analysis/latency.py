"""Latencies of a run, each a pure function of recorded tables. `docs/metrics.md` has the formulas.

All of them look at the driving interval only, `began_ns` to `ended_ns` on the server's monotonic clock.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from lavt.domain import NS_PER_MS, FloatArray
from lavt.experiment.analysis.clock_offset import ClockOffset
from lavt.recording.table import MISSING, IntArray, Table


def look_up(keys: IntArray, values: IntArray, wanted: IntArray) -> IntArray:
    """Value of the first of `keys` that equals each of `wanted`; `MISSING` where none does."""
    found = np.full(len(wanted), MISSING, np.int64)
    if len(keys) == 0:
        return found
    order = np.argsort(keys, kind="stable")
    place = np.minimum(np.searchsorted(keys[order], wanted), len(keys) - 1)
    hit = (keys[order][place] == wanted) & (wanted != MISSING)
    found[hit] = values[order][place[hit]]
    return found


def frames_within(frames: Table, began_ns: int, ended_ns: int) -> Table:
    """Frames that were stamped in the driving interval."""
    stamped_ns = frames.ints("stamped_mono_ns")
    return frames.where((stamped_ns >= began_ns) & (stamped_ns <= ended_ns))


def rtp_timestamp(stamp_ns: IntArray) -> IntArray:
    """RTP timestamps (90 kHz, modulo 2^32) of frames with these stamps."""
    # stamp * 9 would not fit into 64 bits: 90 kHz is 9 ticks every 100 us, so whole 100 us are taken out first.
    whole, rest_ns = np.divmod(stamp_ns, 100_000)
    return np.asarray((whole * 9 + rest_ns * 9 // 100_000) % 2**32, np.int64)


def pictures_of(pictures: Table, frames: Table) -> Table:
    """Pictures that were made from `frames`: by stamp where it could be read, by RTP timestamp where not."""
    stamps = frames.ints("stamp_ns")
    by_stamp = np.isin(pictures.ints("stamp_ns"), stamps)
    by_packet = np.isin(pictures.ints("rtp_timestamp"), rtp_timestamp(stamps))
    return pictures.where(np.where(pictures.flags("readable"), by_stamp, by_packet))


def decoded_pictures(pictures: Table) -> Table:
    """Those for which the decoder gave a picture; a record that does not say of one counts it."""
    return pictures.where(np.array([decoded is not False for decoded in pictures.objects("decoded")], np.bool_))


def video_latency_ns(pictures: Table, offset: ClockOffset) -> IntArray:
    """tau_v of every readable picture: stamp written to stamp read, both by the server's clock."""
    readable = pictures.where(pictures.flags("readable") & (pictures.ints("read_wall_ns") != MISSING))
    return offset.on_server_ns(readable.ints("read_wall_ns")) - readable.ints("stamp_ns")


def control_latency_ns(admissions: Table, offset: ClockOffset, began_ns: int, ended_ns: int) -> IntArray:
    """tau_c of every command received, obeyed or refused: sent by the client to received by the server."""
    received_ns = admissions.ints("received_mono_ns")
    known = (admissions.ints("sent_wall_ns") != MISSING) & (admissions.ints("received_wall_ns") != MISSING)
    within = admissions.where(known & (received_ns >= began_ns) & (received_ns <= ended_ns))
    return within.ints("received_wall_ns") - offset.on_server_ns(within.ints("sent_wall_ns"))


@dataclass(frozen=True, slots=True)
class AcceptedLoops:
    """For each frame that led to an obeyed command: the frame, and the first such command (rows of `admission`)."""

    stamp_ns: IntArray
    stamped_mono_ns: IntArray
    commands: Table

    @property
    def loop_ns(self) -> IntArray:
        """Frame stamped to command applied, on the server's monotonic clock: no offset is in it."""
        return self.commands.ints("applied_mono_ns") - self.stamped_mono_ns

    @property
    def client_ns(self) -> IntArray:
        """Stamp read to command sent, on the client's wall clock."""
        return self.commands.ints("sent_wall_ns") - self.commands.ints("stamp_received_wall_ns")

    @property
    def actuator_ns(self) -> IntArray:
        """Command received to command applied, on the server's monotonic clock."""
        return self.commands.ints("applied_mono_ns") - self.commands.ints("received_mono_ns")


def accepted(admissions: Table) -> Table:
    """Commands that were obeyed, in the order in which they came into force."""
    chosen = np.array([verdict == "accepted" for verdict in admissions.texts("verdict")], np.bool_)
    commands = admissions.where(chosen & (admissions.ints("applied_mono_ns") != MISSING))
    order = np.argsort(commands.ints("applied_mono_ns"), kind="stable")
    columns = {name: column[order] for name, column in commands.columns.items()}
    return Table(commands.mono_ns[order], commands.wall_ns[order], columns)


def loops(frames: Table, admissions: Table, ended_ns: int) -> AcceptedLoops:
    """Pair each of `frames` with the first obeyed command that carries its stamp and was applied by `ended_ns`."""
    commands = accepted(admissions)
    commands = commands.where(commands.ints("applied_mono_ns") <= ended_ns)
    stamped_ns = look_up(frames.ints("stamp_ns"), frames.ints("stamped_mono_ns"), commands.ints("stamp_ns"))
    _, first = np.unique(commands.ints("stamp_ns"), return_index=True)
    chosen = np.zeros(len(commands), np.bool_)
    chosen[first] = True
    chosen &= stamped_ns != MISSING
    commands = commands.where(chosen)
    return AcceptedLoops(commands.ints("stamp_ns"), stamped_ns[chosen], commands)


def closure_ns(pictures: Table, paired: AcceptedLoops, offset: ClockOffset) -> IntArray:
    """How far tau_v + client time + tau_c + actuator time is from the loop latency, for every frame that has them all.

    The offset cancels in the sum; a clock that stepped, or a command that names another picture's times, does not.
    """
    readable = pictures.where(pictures.flags("readable"))
    read_wall_ns = look_up(readable.ints("stamp_ns"), readable.ints("read_wall_ns"), paired.stamp_ns)
    commands = paired.commands
    needed = [read_wall_ns, *(commands.ints(name) for name in ("sent_wall_ns", "stamp_received_wall_ns"))]
    known = np.all([times != MISSING for times in needed], axis=0) if len(commands) else np.zeros(0, np.bool_)
    tau_v_ns = offset.on_server_ns(read_wall_ns) - paired.stamp_ns
    tau_c_ns = commands.ints("received_wall_ns") - offset.on_server_ns(commands.ints("sent_wall_ns"))
    total_ns = tau_v_ns + paired.client_ns + tau_c_ns + paired.actuator_ns
    return np.asarray((total_ns - paired.loop_ns)[known], np.int64)


@dataclass(frozen=True, slots=True)
class PictureAge:
    """How old the picture behind the command in force was, weighted by time; None where no command was in force."""

    mean_ms: float | None
    p95_ms: float | None


def picture_age(frames: Table, admissions: Table, began_ns: int, ended_ns: int) -> PictureAge:
    """Mean and 95th percentile of the picture age over the driving interval, exact: the age grows with slope 1.

    `frames` are all frames of the run, because the first command in force may be older than the interval.
    """
    commands = accepted(admissions)
    stamped_ns = look_up(frames.ints("stamp_ns"), frames.ints("stamped_mono_ns"), commands.ints("stamp_ns"))
    starts_ns = np.clip(commands.ints("applied_mono_ns"), began_ns, ended_ns)
    ends_ns = np.append(starts_ns[1:], ended_ns)[: len(starts_ns)]
    used = (stamped_ns != MISSING) & (ends_ns > starts_ns)
    youngest_ms = (starts_ns - stamped_ns)[used] / NS_PER_MS
    oldest_ms = (ends_ns - stamped_ns)[used] / NS_PER_MS
    duration_ms = oldest_ms - youngest_ms
    if not used.any():
        return PictureAge(None, None)
    mean_ms = float(np.sum(duration_ms * (youngest_ms + oldest_ms) / 2) / np.sum(duration_ms))
    return PictureAge(mean_ms, _percentile_of_ramps(youngest_ms, oldest_ms, 0.95))


def ages_at_actuation_ns(frames: Table, admissions: Table, began_ns: int, ended_ns: int) -> IntArray:
    """How old its picture was when each obeyed command was applied, whether or not an earlier one was made from it."""
    commands = accepted(admissions)
    applied_ns = commands.ints("applied_mono_ns")
    stamped_ns = look_up(frames.ints("stamp_ns"), frames.ints("stamped_mono_ns"), commands.ints("stamp_ns"))
    known = (stamped_ns != MISSING) & (applied_ns >= began_ns) & (applied_ns <= ended_ns)
    return np.asarray(applied_ns[known] - stamped_ns[known], np.int64)


def _percentile_of_ramps(low: FloatArray, high: FloatArray, share: float) -> float:
    """Value below which a quantity that runs from `low` to `high` at slope 1, again and again, is for `share` of time.

    The time spent below x is piecewise linear in x: its slope is the number of ramps that x lies on.
    """
    ends = np.concatenate([low, high])
    order = np.argsort(ends, kind="stable")
    ramps = np.cumsum(np.concatenate([np.ones(len(low)), -np.ones(len(high))])[order])
    corners = ends[order]
    below = np.concatenate([[0.0], np.cumsum(ramps[:-1] * np.diff(corners))])
    return float(np.interp(share * below[-1], below, corners))


def percentiles_ms(times_ns: IntArray) -> dict[str, Any]:
    """p5, p50, p95 in milliseconds (linear between neighbours) and how many there are; null where there is none."""
    if len(times_ns) == 0:
        return {"p5": None, "p50": None, "p95": None, "n": 0}
    p5, p50, p95 = np.percentile(times_ns / NS_PER_MS, [5, 50, 95])
    return {"p5": float(p5), "p50": float(p50), "p95": float(p95), "n": len(times_ns)}
