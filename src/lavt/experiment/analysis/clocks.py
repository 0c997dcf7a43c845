"""Which Delta a run goes by, and what the other opinion on it is."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.experiment.analysis.clock_offset import (
    NO_OFFSET,
    ClockOffset,
    ProbeExchanges,
    by_probe,
    by_sources,
    exchanges,
    known_samples,
)
from lavt.experiment.analysis.latency import frames_within, look_up
from lavt.recording.record import Record
from lavt.recording.table import MISSING, IntArray, Table

SAME_KERNEL = "same kernel"
PROBE = "probe"
MARGIN_NS = 5 * NS_PER_S
"""So much before and after the drive the clocks matter: at 500 ppm what was known earlier bounds Delta to 2.5 ms more,
which is more than a run may have."""


@dataclass(frozen=True, slots=True)
class RunClocks:
    """Delta of a run by name of its source, the probe's opinion, and over which wall times of client and server.

    `offset` is None where nobody knows Delta, `probe` where the probe had no answer during the drive.
    """

    source: str | None
    offset: ClockOffset | None
    probe: ClockOffset | None
    probed: ProbeExchanges
    """Exchanges during the drive."""
    client_wall_ns: IntArray
    """Beginning and end of the drive, on each host's wall clock."""
    server_wall_ns: IntArray

    @property
    def bound_ms(self) -> float | None:
        """How wrong Delta can be at most during the drive; None: nobody knows."""
        return None if self.offset is None else self._bound_ms(self.offset)

    @property
    def entry(self) -> dict[str, Any]:
        """What `result.json` says as `delta`."""
        return {
            "source": self.source,
            "ms": self._middle_ms(self.offset),
            "bound_ms": self.bound_ms,
            "drift_ppm": None if self.offset is None else self._drift_ppm(self.offset),
            "probe_ms": self._middle_ms(self.probe),
            "probe_bound_ms": None if self.probe is None else self._bound_ms(self.probe),
        }

    def disagreement_ms(self) -> tuple[float, float, float] | None:
        """Delta, the probe's Delta and the sum of both bounds where these leave no room for both; None: they agree.

        Every exchange of the drive is held against Delta at its own moment: the one that is farthest out.
        """
        if self.offset is None or self.source == PROBE or len(self.probed) == 0:
            return None
        delta_ns = self.offset.at(self.probed.client_wall_ns)
        bound_ns = self.offset.bound_at(self.probed.client_wall_ns) + self.probed.round_trip_ns / 2
        beyond_ns = np.abs(delta_ns - self.probed.delta_ns) - bound_ns
        worst = int(np.argmax(np.nan_to_num(beyond_ns, nan=-np.inf)))
        if not beyond_ns[worst] > 0:
            return None
        delta_ms, probe_ms, bound_ms = (
            float(each[worst]) / NS_PER_MS for each in (delta_ns, self.probed.delta_ns, bound_ns)
        )
        return delta_ms, probe_ms, bound_ms

    def _inner(self, offset: ClockOffset) -> IntArray:
        """Moments of an offset during the drive."""
        moments = offset.client_wall_ns
        return np.asarray(moments[(moments > self.client_wall_ns[0]) & (moments < self.client_wall_ns[1])], np.int64)

    def _bound_ms(self, offset: ClockOffset) -> float | None:
        moments = np.union1d(self._inner(offset), self.client_wall_ns)
        largest_ns = float(np.max(offset.bound_at(moments)))
        return largest_ns / NS_PER_MS if np.isfinite(largest_ns) else None

    def _middle_ms(self, offset: ClockOffset | None) -> float | None:
        if offset is None:
            return None
        began_ns, ended_ns = self.client_wall_ns.tolist()
        return float(offset.at(np.array([(began_ns + ended_ns) // 2]))[0]) / NS_PER_MS

    def _drift_ppm(self, offset: ClockOffset) -> float | None:
        """Slope of the straight line through Delta during the drive."""
        if self.source == SAME_KERNEL:
            return 0.0
        moments = self._inner(offset)
        gone_ns = (moments - moments[:1]).astype(float)
        return None if len(moments) < 2 else float(np.polyfit(gone_ns, offset.at(moments), 1)[0]) * 1e6


def clocks(server: Record, client: Record, began_ns: int, ended_ns: int) -> RunClocks:
    """Find Delta of a run that was driven between two times of the server's monotonic clock.

    Hosts that report the same name share a kernel, and so a clock: Delta is 0 and so is its bound. Else what the hosts'
    sources of time say counts, where both know it with a bound all through the drive and neither leaves it to the
    probe; else the probe alone; else what the sources say without a bound. Of all of them what was found out near the
    drive counts: while nobody drove yet a clock may have been set.
    """
    on_client_ns = drive_on_client(server, client, began_ns, ended_ns)
    of_server = _near(server.table("clock"), (began_ns, ended_ns))
    of_client = _near(client.table("clock"), on_client_ns)
    server_wall_ns = np.array([wall_ns(server, began_ns), wall_ns(server, max(began_ns, ended_ns))])
    every = exchanges(_near(client.table("clock_probe"), on_client_ns))
    probed = every.within(*server_wall_ns.tolist())
    probe = by_probe(every) if len(probed) else None
    sources = None if _left_to_the_probe(of_server, of_client) else by_sources(of_server, of_client)
    source: str | None
    offset: ClockOffset | None
    if _one_host(of_server, of_client):
        source, offset = SAME_KERNEL, NO_OFFSET
    elif sources is not None and (_is_bounded(sources, server_wall_ns) or probe is None):
        names = {name for samples in (of_server, of_client) for name in known_samples(samples).texts("source")}
        source, offset = " and ".join(sorted(names)), sources
    else:
        source, offset = (None, None) if probe is None else (PROBE, probe)
    client_wall_ns = server_wall_ns if offset is None else _on_client(offset, server_wall_ns)
    return RunClocks(source, offset, probe, probed, client_wall_ns, server_wall_ns)


def drive_on_client(server: Record, client: Record, began_ns: int, ended_ns: int) -> tuple[int, int]:
    """Give beginning and end of the drive on the client's monotonic clock, which nobody sets.

    Pictures are on both monotonic clocks, and the one that took least to be read says how these differ: others can have
    waited for seconds in a full queue. Where none was read it is all the time in which the client's clocks were
    sampled, or as much from there on as the drive took.
    """
    frames, pictures = frames_within(server.table("frame"), began_ns, ended_ns), client.table("picture")
    stamped_ns = look_up(frames.ints("stamp_ns"), frames.ints("stamped_mono_ns"), pictures.ints("stamp_ns"))
    read_ns = pictures.ints("read_mono_ns")
    ahead_ns = (read_ns - stamped_ns)[(stamped_ns != MISSING) & (read_ns != MISSING)]
    if len(ahead_ns):
        return began_ns + int(ahead_ns.min()), ended_ns + int(ahead_ns.min())
    sampled_ns = client.table("clock").mono_ns
    first_ns, last_ns = (int(sampled_ns.min()), int(sampled_ns.max())) if len(sampled_ns) else (0, 0)
    return first_ns, max(last_ns, first_ns + ended_ns - began_ns)


def _near(samples: Table, drive_ns: tuple[int, int]) -> Table:
    """Those that were taken during a drive, on the same monotonic clock, or shortly before or after it."""
    return samples.where((samples.mono_ns >= drive_ns[0] - MARGIN_NS) & (samples.mono_ns <= drive_ns[1] + MARGIN_NS))


def wall_ns(record: Record, mono_ns: int) -> int:
    """Wall time of a record's host at a time of its monotonic clock, by the nearest of its clock samples and events."""
    nearest, found_ns = None, mono_ns
    for table in (record.table("clock"), record.table("event")):
        for message_mono_ns, message_wall_ns in zip(table.mono_ns.tolist(), table.wall_ns.tolist(), strict=True):
            distance_ns = abs(message_mono_ns - mono_ns)
            if nearest is None or distance_ns < nearest:
                nearest, found_ns = distance_ns, message_wall_ns - message_mono_ns + mono_ns
    return found_ns


def _one_host(server: Table, client: Table) -> bool:
    hosts = set(server.texts("host")) | set(client.texts("host"))
    return len(server) > 0 and len(client) > 0 and len(hosts) == 1 and "" not in hosts


def _left_to_the_probe(server: Table, client: Table) -> bool:
    return PROBE in {*server.texts("source"), *client.texts("source")}


def _is_bounded(offset: ClockOffset, server_wall_ns: IntArray) -> bool:
    """Tell whether the bound is known, and from before the drive's beginning on."""
    known = np.isfinite(offset.bound_ns)
    return bool(known.all()) and bool(offset.client_wall_ns[0] <= _on_client(offset, server_wall_ns)[0])


def _on_client(offset: ClockOffset, server_wall_ns: IntArray) -> IntArray:
    """Turn wall times of the server into those of the client, where Delta hardly changes within itself."""
    guess_ns = server_wall_ns - offset.at(server_wall_ns)
    return np.asarray(server_wall_ns - offset.at(guess_ns), np.int64)
