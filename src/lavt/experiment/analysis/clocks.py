"""The clock offset Delta of a run: the estimate that is used, and the probe's independent estimate."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.experiment.analysis.clock_offset import (
    NO_OFFSET,
    ClockOffset,
    ProbeExchanges,
    known_samples,
    offset_from_probe,
    offset_from_sources,
    probe_exchanges,
)
from lavt.experiment.analysis.latency import frames_within, look_up
from lavt.recording.record import Record
from lavt.recording.table import MISSING, IntArray, Table

SAME_KERNEL = "same kernel"
PROBE = "probe"
MARGIN_NS = 5 * NS_PER_S
"""Clock data from this long before to this long after the drive are used. At 500 ppm an older sample would add more
than 2.5 ms to the bound of Delta, but in a valid run the bound is at most 2 ms."""


@dataclass(frozen=True, slots=True)
class RunClocks:
    """Delta of a run with the name of its source, the probe's estimate, and the times of the drive on both wall clocks.

    `offset` is None where Delta is unknown. `probe` is None where the probe had no answer during the drive.
    """

    source: str | None
    offset: ClockOffset | None
    probe: ClockOffset | None
    probed: ProbeExchanges
    """Exchanges during the drive."""
    client_wall_ns: IntArray
    """Start and end of the drive on the client's wall clock, (2,)."""
    server_wall_ns: IntArray
    """Start and end of the drive on the server's wall clock, (2,)."""

    @property
    def bound_ms(self) -> float | None:
        """The largest error bound of Delta during the drive; None where it is unknown."""
        return None if self.offset is None else self._bound_ms(self.offset)

    @property
    def entry(self) -> dict[str, Any]:
        """The entry `delta` of `result.json`."""
        return {
            "source": self.source,
            "ms": self._middle_ms(self.offset),
            "bound_ms": self.bound_ms,
            "drift_ppm": None if self.offset is None else self._drift_ppm(self.offset),
            "probe_ms": self._middle_ms(self.probe),
            "probe_bound_ms": None if self.probe is None else self._bound_ms(self.probe),
        }

    def disagreement_ms(self) -> tuple[float, float, float] | None:
        """Return Delta, the probe's Delta and the sum of both bounds, in ms, where the two estimates disagree.

        None where they agree. Every exchange of the drive is compared with Delta at its own time. The returned values
        are those of the exchange whose difference exceeds the bounds most.
        """
        if self.offset is None or self.source == PROBE or len(self.probed) == 0:
            return None
        delta_ns = self.offset.at(self.probed.client_wall_ns)
        bound_ns = self.offset.bound_at(self.probed.client_wall_ns) + self.probed.round_trip_ns / 2
        excess_ns = np.abs(delta_ns - self.probed.delta_ns) - bound_ns
        worst = int(np.argmax(np.nan_to_num(excess_ns, nan=-np.inf)))
        if not excess_ns[worst] > 0:
            return None
        delta_ms, probe_ms, bound_ms = (
            float(values_ns[worst]) / NS_PER_MS for values_ns in (delta_ns, self.probed.delta_ns, bound_ns)
        )
        return delta_ms, probe_ms, bound_ms

    def _times_in_drive(self, offset: ClockOffset) -> IntArray:
        """Return the client wall times of an offset that lie within the drive."""
        times = offset.client_wall_ns
        return np.asarray(times[(times > self.client_wall_ns[0]) & (times < self.client_wall_ns[1])], np.int64)

    def _bound_ms(self, offset: ClockOffset) -> float | None:
        times = np.union1d(self._times_in_drive(offset), self.client_wall_ns)
        largest_ns = float(np.max(offset.bound_at(times)))
        return largest_ns / NS_PER_MS if np.isfinite(largest_ns) else None

    def _middle_ms(self, offset: ClockOffset | None) -> float | None:
        """Return Delta in the middle of the drive."""
        if offset is None:
            return None
        began_ns, ended_ns = self.client_wall_ns.tolist()
        return float(offset.at(np.array([(began_ns + ended_ns) // 2]))[0]) / NS_PER_MS

    def _drift_ppm(self, offset: ClockOffset) -> float | None:
        """Return the slope of the straight line through Delta during the drive."""
        if self.source == SAME_KERNEL:
            return 0.0
        times = self._times_in_drive(offset)
        elapsed_ns = (times - times[:1]).astype(float)
        return None if len(times) < 2 else float(np.polyfit(elapsed_ns, offset.at(times), 1)[0]) * 1e6


def run_clocks(server: Record, client: Record, began_ns: int, ended_ns: int) -> RunClocks:
    """Return Delta of a run whose drive is an interval of the server's monotonic clock.

    Hosts that report the same name share a kernel and thus a clock: Delta and its bound are 0. Otherwise the first
    estimate in this list that is known is used:

    1. the time sources of both hosts, with a bound throughout the drive;
    2. the probe alone;
    3. the time sources without a bound.

    The time sources are not used where a host is configured to use the probe. Only data from the drive and up to
    `MARGIN_NS` before and after it are used, because a clock may have been set earlier.
    """
    on_client_ns = drive_on_client(server, client, began_ns, ended_ns)
    of_server = _near(server.table("clock"), (began_ns, ended_ns))
    of_client = _near(client.table("clock"), on_client_ns)
    server_wall_ns = np.array([wall_ns(server, began_ns), wall_ns(server, max(began_ns, ended_ns))])
    exchanges = probe_exchanges(_near(client.table("clock_probe"), on_client_ns))
    probed = exchanges.within(*server_wall_ns.tolist())
    probe = offset_from_probe(exchanges) if len(probed) else None
    sources = None if _use_probe_only(of_server, of_client) else offset_from_sources(of_server, of_client)
    source: str | None
    offset: ClockOffset | None
    if _share_kernel(of_server, of_client):
        source, offset = SAME_KERNEL, NO_OFFSET
    elif sources is not None and (_is_bounded(sources, server_wall_ns) or probe is None):
        names = {name for samples in (of_server, of_client) for name in known_samples(samples).texts("source")}
        source, offset = " and ".join(sorted(names)), sources
    else:
        source, offset = (None, None) if probe is None else (PROBE, probe)
    client_wall_ns = server_wall_ns if offset is None else _on_client(offset, server_wall_ns)
    return RunClocks(source, offset, probe, probed, client_wall_ns, server_wall_ns)


def drive_on_client(server: Record, client: Record, began_ns: int, ended_ns: int) -> tuple[int, int]:
    """Return start and end of the drive on the client's monotonic clock, which cannot be set.

    A received frame has a time on both monotonic clocks: when it was stamped and when its stamp was read. The frame
    with the shortest latency gives the difference of the clocks, because other frames may have waited for seconds in a
    full queue. Without any received frame, the whole time in which the client's clocks were sampled is returned,
    extended to at least the length of the drive.
    """
    frames, received_frames = frames_within(server.table("frame"), began_ns, ended_ns), client.table("picture")
    stamped_ns = look_up(frames.ints("stamp_ns"), frames.ints("stamped_mono_ns"), received_frames.ints("stamp_ns"))
    read_ns = received_frames.ints("read_mono_ns")
    differences_ns = (read_ns - stamped_ns)[(stamped_ns != MISSING) & (read_ns != MISSING)]
    if len(differences_ns):
        return began_ns + int(differences_ns.min()), ended_ns + int(differences_ns.min())
    sampled_ns = client.table("clock").mono_ns
    first_ns, last_ns = (int(sampled_ns.min()), int(sampled_ns.max())) if len(sampled_ns) else (0, 0)
    return first_ns, max(last_ns, first_ns + ended_ns - began_ns)


def _near(samples: Table, drive_ns: tuple[int, int]) -> Table:
    """Return the samples taken within `MARGIN_NS` of a drive on the same monotonic clock."""
    return samples.where((samples.mono_ns >= drive_ns[0] - MARGIN_NS) & (samples.mono_ns <= drive_ns[1] + MARGIN_NS))


def wall_ns(record: Record, mono_ns: int) -> int:
    """Return the wall time of a record's host at a monotonic time, from the nearest of its clock samples and events."""
    shortest_ns, result_ns = None, mono_ns
    for table in (record.table("clock"), record.table("event")):
        for message_mono_ns, message_wall_ns in zip(table.mono_ns.tolist(), table.wall_ns.tolist(), strict=True):
            distance_ns = abs(message_mono_ns - mono_ns)
            if shortest_ns is None or distance_ns < shortest_ns:
                shortest_ns, result_ns = distance_ns, message_wall_ns - message_mono_ns + mono_ns
    return result_ns


def _share_kernel(server: Table, client: Table) -> bool:
    hosts = set(server.texts("host")) | set(client.texts("host"))
    return len(server) > 0 and len(client) > 0 and len(hosts) == 1 and "" not in hosts


def _use_probe_only(server: Table, client: Table) -> bool:
    return PROBE in {*server.texts("source"), *client.texts("source")}


def _is_bounded(offset: ClockOffset, server_wall_ns: IntArray) -> bool:
    """Return whether the bound is known at every time of `offset`, and the first time is before the drive."""
    known = np.isfinite(offset.bound_ns)
    return bool(known.all()) and bool(offset.client_wall_ns[0] <= _on_client(offset, server_wall_ns)[0])


def _on_client(offset: ClockOffset, server_wall_ns: IntArray) -> IntArray:
    """Convert wall times of the server to the client's wall clock; Delta must change slowly."""
    guess_ns = server_wall_ns - offset.at(server_wall_ns)
    return np.asarray(server_wall_ns - offset.at(guess_ns), np.int64)
