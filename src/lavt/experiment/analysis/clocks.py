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
"""Clock data of the drive, and of this time before and after it, are used. At 500 ppm an older sample would add more
than 2.5 ms to the bound of Delta, but in a valid run the bound is at most 2 ms."""


@dataclass(frozen=True, slots=True)
class RunClocks:
    """Delta of a run with the name of its source, the probe's estimate, and the times of the drive on both wall clocks.

    `offset` is None if Delta is unknown. `probe` is None if the probe had no answer during the drive.
    """

    source: str | None
    offset: ClockOffset | None
    probe: ClockOffset | None
    drive_exchanges: ProbeExchanges
    """The probe's exchanges during the drive."""
    client_wall_ns: IntArray
    """Start and end of the drive on the client's wall clock, (2,)."""
    server_wall_ns: IntArray
    """Start and end of the drive on the server's wall clock, (2,)."""

    @property
    def bound_ms(self) -> float | None:
        """The largest error bound of Delta during the drive; None: unknown."""
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
        """Return Delta, the probe's Delta and the sum of both bounds, in ms; None if they cannot be compared.

        Every exchange of the drive is compared with Delta at the time of the exchange. The returned values belong to
        the exchange whose difference exceeds the bounds most or, if none does, comes nearest to them.
        """
        exchanges = self.drive_exchanges
        if self.offset is None or self.source == PROBE or len(exchanges) == 0:
            return None
        delta_ns = self.offset.at(exchanges.client_wall_ns)
        bound_ns = self.offset.bound_at(exchanges.client_wall_ns) + exchanges.round_trip_ns / 2
        excess_ns = np.abs(delta_ns - exchanges.delta_ns) - bound_ns
        worst = int(np.argmax(np.nan_to_num(excess_ns, nan=-np.inf)))
        if not np.isfinite(excess_ns[worst]):
            return None
        delta_ms, probe_ms, bound_ms = (
            float(values_ns[worst]) / NS_PER_MS for values_ns in (delta_ns, exchanges.delta_ns, bound_ns)
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
    """Return Delta of a run whose drive is between `began_ns` and `ended_ns` on the server's monotonic clock.

    Hosts that report the same kernel share its clock: Delta and its bound are 0. Otherwise the first known estimate in
    this list is used:

    1. the time sources of both hosts, with a bound throughout the drive;
    2. the probe alone;
    3. the time sources without a bound.

    The time sources are not used if a host is configured to use the probe. Only data of the drive, and up to
    `MARGIN_NS` before and after it, are used, because a clock can have been set earlier.
    """
    client_drive_ns = drive_on_client(server, client, began_ns, ended_ns)
    server_samples = _select_near(server.table("clock"), (began_ns, ended_ns))
    client_samples = _select_near(client.table("clock"), client_drive_ns)
    server_wall_ns = np.array([wall_ns_at(server, began_ns), wall_ns_at(server, max(began_ns, ended_ns))])
    exchanges = probe_exchanges(_select_near(client.table("clock_probe"), client_drive_ns))
    drive_exchanges = exchanges.select_interval(*server_wall_ns.tolist())
    probe = offset_from_probe(exchanges) if len(drive_exchanges) else None
    is_probe_only = _is_probe_only(server_samples, client_samples)
    sources = None if is_probe_only else offset_from_sources(server_samples, client_samples)
    source: str | None
    offset: ClockOffset | None
    if _is_same_kernel(server_samples, client_samples):
        source, offset = SAME_KERNEL, NO_OFFSET
    elif sources is not None and (_is_bounded(sources, server_wall_ns) or probe is None):
        names = {
            name for samples in (server_samples, client_samples) for name in known_samples(samples).texts("source")
        }
        source, offset = " and ".join(sorted(names)), sources
    else:
        source, offset = (None, None) if probe is None else (PROBE, probe)
    client_wall_ns = server_wall_ns if offset is None else _to_client_ns(offset, server_wall_ns)
    return RunClocks(source, offset, probe, drive_exchanges, client_wall_ns, server_wall_ns)


def drive_on_client(server: Record, client: Record, began_ns: int, ended_ns: int) -> tuple[int, int]:
    """Return start and end of the drive on the client's monotonic clock, which cannot be set.

    A received frame has two times: when it was stamped, on the server's monotonic clock, and when its stamp was read,
    on the client's. The frame with the shortest latency gives the difference of the clocks, because other frames can
    have waited for seconds in a full queue. Without a received frame, the result is the whole time in which the
    client's clocks were sampled, extended to at least the length of the drive.
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


def _select_near(samples: Table, drive_ns: tuple[int, int]) -> Table:
    """Return the samples of the drive and of `MARGIN_NS` before and after it, on the same monotonic clock."""
    began_ns, ended_ns = drive_ns
    return samples.where((samples.mono_ns >= began_ns - MARGIN_NS) & (samples.mono_ns <= ended_ns + MARGIN_NS))


def wall_ns_at(record: Record, mono_ns: int) -> int:
    """Return the wall time of a record's host at a monotonic time, from the nearest of its clock samples and events."""
    shortest_ns, result_ns = None, mono_ns
    for table in (record.table("clock"), record.table("event")):
        for message_mono_ns, message_wall_ns in zip(table.mono_ns.tolist(), table.wall_ns.tolist(), strict=True):
            distance_ns = abs(message_mono_ns - mono_ns)
            if shortest_ns is None or distance_ns < shortest_ns:
                shortest_ns, result_ns = distance_ns, message_wall_ns - message_mono_ns + mono_ns
    return result_ns


def _is_same_kernel(server: Table, client: Table) -> bool:
    hosts = set(server.texts("host")) | set(client.texts("host"))
    return len(server) > 0 and len(client) > 0 and len(hosts) == 1 and "" not in hosts


def _is_probe_only(server: Table, client: Table) -> bool:
    return PROBE in {*server.texts("source"), *client.texts("source")}


def _is_bounded(offset: ClockOffset, server_wall_ns: IntArray) -> bool:
    """Return whether the bound is known at every time of `offset`, and the first time is before the drive."""
    known = np.isfinite(offset.bound_ns)
    client_began_ns, _ = _to_client_ns(offset, server_wall_ns)
    return bool(known.all()) and bool(offset.client_wall_ns[0] <= client_began_ns)


def _to_client_ns(offset: ClockOffset, server_wall_ns: IntArray) -> IntArray:
    """Convert wall times of the server to the client's wall clock; Delta must change slowly."""
    guess_ns = server_wall_ns - offset.at(server_wall_ns)
    return np.asarray(server_wall_ns - offset.at(guess_ns), np.int64)
