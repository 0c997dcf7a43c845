"""Latencies of a run, each a pure function of recorded tables. `docs/metrics.md` has the formulas.

All of them cover the driving interval only, `began_ns` to `ended_ns` on the server's monotonic clock.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from lavt.domain import NS_PER_MS, FloatArray
from lavt.experiment.analysis.clock_offset import ClockOffset
from lavt.recording.table import MISSING, IntArray, Table


def look_up(keys: IntArray, values: IntArray, wanted: IntArray) -> IntArray:
    """Return for each of `wanted` the value of the first equal key; `MISSING` where no key is equal."""
    found = np.full(len(wanted), MISSING, np.int64)
    if len(keys) == 0:
        return found
    order = np.argsort(keys, kind="stable")
    position = np.minimum(np.searchsorted(keys[order], wanted), len(keys) - 1)
    hit = (keys[order][position] == wanted) & (wanted != MISSING)
    found[hit] = values[order][position[hit]]
    return found


def frames_within(frames: Table, began_ns: int, ended_ns: int) -> Table:
    """Return the frames that were stamped in the driving interval."""
    stamped_ns = frames.ints("stamped_mono_ns")
    return frames.where((stamped_ns >= began_ns) & (stamped_ns <= ended_ns))


def rtp_timestamp(stamp_ns: IntArray) -> IntArray:
    """Return the RTP timestamps (90 kHz, modulo 2^32) of frames with these stamps."""
    # 90 kHz is 9 ticks per 100 us. The division comes first, because stamp * 9 exceeds 64 bits.
    whole, rest_ns = np.divmod(stamp_ns, 100_000)
    return np.asarray((whole * 9 + rest_ns * 9 // 100_000) % 2**32, np.int64)


def pictures_of(pictures: Table, frames: Table) -> Table:
    """Return the pictures of `frames`: matched by stamp where it was readable, otherwise by RTP timestamp."""
    stamps = frames.ints("stamp_ns")
    by_stamp = np.isin(pictures.ints("stamp_ns"), stamps)
    by_packet = np.isin(pictures.ints("rtp_timestamp"), rtp_timestamp(stamps))
    return pictures.where(np.where(pictures.flags("readable"), by_stamp, by_packet))


def decoded_pictures(pictures: Table) -> Table:
    """Return the pictures that were decoded; those without the field `decoded` are included."""
    return pictures.where(np.array([decoded is not False for decoded in pictures.objects("decoded")], np.bool_))


def video_latency_ns(pictures: Table, offset: ClockOffset) -> IntArray:
    """Return tau_v of every readable picture: from stamp written to stamp read, on the server's clock."""
    readable = pictures.where(pictures.flags("readable") & (pictures.ints("read_wall_ns") != MISSING))
    return offset.on_server_ns(readable.ints("read_wall_ns")) - readable.ints("stamp_ns")


def control_latency_ns(admissions: Table, offset: ClockOffset, began_ns: int, ended_ns: int) -> IntArray:
    """Return tau_c of every accepted command: from sent to received, on the server's clock.

    Only accepted commands are certain to be those of the client in control: others may have any send time.
    """
    commands = accepted_commands(admissions)
    received_ns = commands.ints("received_mono_ns")
    known = (commands.ints("sent_wall_ns") != MISSING) & (commands.ints("received_wall_ns") != MISSING)
    within = commands.where(known & (received_ns >= began_ns) & (received_ns <= ended_ns))
    return within.ints("received_wall_ns") - offset.on_server_ns(within.ints("sent_wall_ns"))


@dataclass(frozen=True, slots=True)
class AcceptedLoops:
    """The frames that led to an accepted command, each with its first such command (rows of `admission`)."""

    stamp_ns: IntArray
    stamped_mono_ns: IntArray
    commands: Table

    @property
    def loop_ns(self) -> IntArray:
        """The loop latency, from frame stamped to command applied, on the server's monotonic clock."""
        return self.commands.ints("applied_mono_ns") - self.stamped_mono_ns

    @property
    def client_ns(self) -> IntArray:
        """The client time, from stamp read to command sent, on the client's wall clock."""
        return self.commands.ints("sent_wall_ns") - self.commands.ints("stamp_received_wall_ns")

    @property
    def actuator_ns(self) -> IntArray:
        """The actuator time, from command received to command applied, on the server's monotonic clock."""
        return self.commands.ints("applied_mono_ns") - self.commands.ints("received_mono_ns")


def accepted_commands(admissions: Table) -> Table:
    """Return the accepted commands in the order in which they were applied."""
    chosen = np.array([verdict == "accepted" for verdict in admissions.texts("verdict")], np.bool_)
    commands = admissions.where(chosen & (admissions.ints("applied_mono_ns") != MISSING))
    return commands.where(np.argsort(commands.ints("applied_mono_ns"), kind="stable"))


def pair_loops(frames: Table, admissions: Table, ended_ns: int) -> AcceptedLoops:
    """Pair each of `frames` with the first accepted command that carries its stamp and was applied by `ended_ns`."""
    commands = accepted_commands(admissions)
    commands = commands.where(commands.ints("applied_mono_ns") <= ended_ns)
    stamped_ns = look_up(frames.ints("stamp_ns"), frames.ints("stamped_mono_ns"), commands.ints("stamp_ns"))
    _, first = np.unique(commands.ints("stamp_ns"), return_index=True)
    chosen = np.zeros(len(commands), np.bool_)
    chosen[first] = True
    chosen &= stamped_ns != MISSING
    commands = commands.where(chosen)
    return AcceptedLoops(commands.ints("stamp_ns"), stamped_ns[chosen], commands)


def closure_ns(pictures: Table, paired: AcceptedLoops, offset: ClockOffset) -> IntArray:
    """Return tau_v + client time + tau_c + actuator time - loop latency for every frame that has all of them.

    The clock offset cancels in the sum. A clock that stepped and a command with another picture's times do not cancel.
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
    """The time-weighted age of the picture behind the command in force; None where no command was in force."""

    mean_ms: float | None
    p95_ms: float | None


def picture_age(frames: Table, admissions: Table, began_ns: int, ended_ns: int) -> PictureAge:
    """Return the exact mean and 95th percentile of the picture age over the driving interval: it grows with slope 1.

    `frames` are all frames of the run, because the first command in force may be older than the interval.
    """
    commands = accepted_commands(admissions)
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
    return PictureAge(mean_ms, _ramp_percentile(youngest_ms, oldest_ms, 0.95))


def ages_at_actuation_ns(frames: Table, admissions: Table, began_ns: int, ended_ns: int) -> IntArray:
    """Return the frame age at actuation of every accepted command: from its frame's stamp to its application."""
    commands = accepted_commands(admissions)
    applied_ns = commands.ints("applied_mono_ns")
    stamped_ns = look_up(frames.ints("stamp_ns"), frames.ints("stamped_mono_ns"), commands.ints("stamp_ns"))
    known = (stamped_ns != MISSING) & (applied_ns >= began_ns) & (applied_ns <= ended_ns)
    return np.asarray(applied_ns[known] - stamped_ns[known], np.int64)


def _ramp_percentile(low: FloatArray, high: FloatArray, share: float) -> float:
    """Return the time-weighted percentile of a quantity that repeatedly rises from `low` to `high` with slope 1.

    The time spent below x is piecewise linear in x: its slope is the number of ramps that contain x.
    """
    ends = np.concatenate([low, high])
    order = np.argsort(ends, kind="stable")
    ramps = np.cumsum(np.concatenate([np.ones(len(low)), -np.ones(len(high))])[order])
    corners = ends[order]
    below = np.concatenate([[0.0], np.cumsum(ramps[:-1] * np.diff(corners))])
    return float(np.interp(share * below[-1], below, corners))


def percentiles_ms(times_ns: IntArray) -> dict[str, Any]:
    """Return the percentiles p5, p50, p95 in ms (interpolated linearly) and the count `n`; None without times."""
    if len(times_ns) == 0:
        return {"p5": None, "p50": None, "p95": None, "n": 0}
    p5, p50, p95 = np.percentile(times_ns / NS_PER_MS, [5, 50, 95])
    return {"p5": float(p5), "p50": float(p50), "p95": float(p95), "n": len(times_ns)}
