"""Reasons from the clocks for which a run is invalid: one reason per cause, without its consequences."""

from __future__ import annotations

import numpy as np

from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.experiment.analysis.clock_offset import follows_peer
from lavt.experiment.analysis.clocks import MARGIN_NS, PROBE, SAME_KERNEL, RunClocks, drive_on_client
from lavt.recording.record import Record
from lavt.recording.table import MISSING, IntArray, Table

STEP_LIMIT_MS = 5.0
"""A wall clock that moves this much relative to the monotonic clock between two samples was set. Steering, however
fast, moves both (clock_gettime(2)) and is not a step."""
POLL_LIMIT_S = 2.5
"""Clocks are sampled every second: at most one sample may be late or missing."""
CLOCK_BOUND_LIMIT_MS = 2.0
"""With a larger bound, the split of the loop latency into tau_v and tau_c is too uncertain."""
PATH_LIMIT_MS = 1.0
"""With a round trip this much longer than the probe's, NTP does not take the probe's path."""
STILL_LIMIT_POLLS = 5
"""After this many polls without a good sample, chrony only extrapolates."""
STILL_LEAST_S = 5.0
"""A shorter time without a good sample is accepted at any poll interval: a busy machine loses some of many samples."""

Sides = tuple[tuple[str, Table, Table, IntArray], ...]
"""For each side: name, its clock samples, the other side's, and start and end of the drive on its wall clock."""


def step_reasons(server: Record, client: Record, clocks: RunClocks, began_ns: int, ended_ns: int) -> list[str]:
    """Return a reason for each wall clock that was set near the drive; two sides on one kernel share one clock."""
    found = {
        "server": _step_ms(server.table("clock"), (began_ns, ended_ns)),
        "client": _step_ms(client.table("clock"), drive_on_client(server, client, began_ns, ended_ns)),
    }
    reasons = [f"the wall clock of the {side} stepped by {ms:+.1f} ms" for side, ms in found.items() if ms is not None]
    return reasons[:1] if clocks.source == SAME_KERNEL else reasons


def _step_ms(samples: Table, drive_ns: tuple[int, int]) -> float | None:
    mono_ns, wall_ns = samples.ints("mono_ns"), samples.ints("wall_ns")
    known = (mono_ns != MISSING) & (wall_ns != MISSING)
    mono_ns, wall_ns = mono_ns[known], wall_ns[known]
    near = (mono_ns[1:] > drive_ns[0] - MARGIN_NS) & (mono_ns[:-1] < drive_ns[1] + MARGIN_NS)
    jumps_ms = np.diff(wall_ns - mono_ns)[near] / NS_PER_MS
    if len(jumps_ms) == 0 or np.max(np.abs(jumps_ms)) <= STEP_LIMIT_MS:
        return None
    return float(jumps_ms[np.argmax(np.abs(jumps_ms))])


def poll_reasons(server: Record, client: Record, began_ns: int, ended_ns: int) -> list[str]:
    """Return a reason for each side that lacks clock samples between the start and the end of the drive.

    Without them the clock offset is only a guess.
    """
    if began_ns > ended_ns:
        return []
    server_ns, client_ns = _sampled_ns(server), _sampled_ns(client)
    client_began_ns, client_ended_ns = drive_on_client(server, client, began_ns, ended_ns)
    longest_ns = {
        "server": max(
            *(
                min(np.abs(server_ns - edge_ns).tolist(), default=ended_ns - began_ns)
                for edge_ns in (began_ns, ended_ns)
            ),
            _longest_gap_ns(server_ns, began_ns, ended_ns),
        ),
        "client": _longest_gap_ns(client_ns, client_began_ns, client_ended_ns),
    }
    limit_ns = POLL_LIMIT_S * NS_PER_S
    reasons = [
        f"the clock of the {side} was not sampled for {gap_ns / NS_PER_S:.1f} s (limit {POLL_LIMIT_S} s)"
        for side, gap_ns in longest_ns.items()
        if gap_ns > limit_ns
    ]
    near_ns = client_ns[(client_ns > client_began_ns - limit_ns) & (client_ns < client_ended_ns + limit_ns)]
    is_covered = len(client_ns) and client_ns[0] - client_began_ns <= limit_ns >= client_ended_ns - client_ns[-1]
    if not is_covered:
        covered_s, drive_s = (int(np.ptp(near_ns)) if len(near_ns) else 0) / NS_PER_S, (ended_ns - began_ns) / NS_PER_S
        reasons.append(f"the clock samples of the client cover {covered_s:.1f} s of a drive of {drive_s:.1f} s")
    return reasons


def _longest_gap_ns(sampled_ns: IntArray, began_ns: int, ended_ns: int) -> int:
    """Return the longest time between two samples that overlaps the drive."""
    in_drive = (sampled_ns[1:] > began_ns) & (sampled_ns[:-1] < ended_ns)
    return int(np.max(np.diff(sampled_ns)[in_drive], initial=0))


def _sampled_ns(record: Record) -> IntArray:
    """Return the times at which a side's clocks were sampled, on its monotonic clock."""
    mono_ns = record.table("clock").ints("mono_ns")
    return np.sort(mono_ns[mono_ns != MISSING])


def offset_reasons(server: Record, client: Record, clocks: RunClocks) -> list[str]:
    """Return the reasons against Delta: an unfit time source, or else a disagreement, bound or probe that is unfit."""
    if clocks.source == SAME_KERNEL:
        return []
    of_server, of_client = server.table("clock"), client.table("clock")
    if clocks.source is None:
        sides = (("server", of_server), ("client", of_client))
        statuses = ", ".join(f"{side}: {_last_status(samples)}" for side, samples in sides)
        return [f"the offset between the clocks is not known ({statuses}), and the probe had no answer"]
    unfit = [] if clocks.source == PROBE else _source_reasons(of_server, of_client, clocks)
    return unfit or _agreement_reasons(clocks) or _bound_reasons(clocks) or _unchecked_reasons(clocks)


def _last_status(samples: Table) -> str:
    statuses = [status for status in samples.texts("status") if status]
    return statuses[-1] if statuses else "no usable sample"


def _source_reasons(of_server: Table, of_client: Table, clocks: RunClocks) -> list[str]:
    sides: Sides = (
        ("client", of_client, of_server, clocks.client_wall_ns),
        ("server", of_server, of_client, clocks.server_wall_ns),
    )
    reasons = [*_path_reasons(sides, clocks), *_still_reasons(sides)]
    masters = {name for samples in (of_server, of_client) for name in _grandmasters(samples)}
    if len(masters) > 1:
        reasons.append(f"the hosts follow different PTP grandmasters: {' and '.join(sorted(masters))}")
    return reasons


def _grandmasters(samples: Table) -> set[str]:
    names = zip(samples.texts("source"), samples.texts("follows"), strict=True)
    return {name for source, name in names if source == "ptp" and name}


def _path_reasons(sides: Sides, clocks: RunClocks) -> list[str]:
    """Return a reason where NTP's shortest round trip between the hosts during the drive is longer than the probe's.

    A busy machine delays some exchanges, an injected delay all of them.
    """
    reasons = []
    for side, samples, other, drive_ns in sides:
        followed = _during(samples.where(follows_peer(samples, other)), drive_ns)
        delays_ms = followed.floats("peer_delay_s") * 1e3
        delays_ms = delays_ms[np.isfinite(delays_ms)]
        if len(delays_ms) == 0 or len(clocks.probed) == 0:
            continue
        found_ms, shortest_ms = float(delays_ms.min()), float(clocks.probed.round_trip_ns.min()) / NS_PER_MS
        if found_ms > shortest_ms + PATH_LIMIT_MS:
            reasons.append(
                f"the NTP of the {side} goes through injected delay: its round trip is {found_ms:.2f} ms, the probe's "
                f"{shortest_ms:.2f} ms (limit {PATH_LIMIT_MS} ms more)"
            )
    return reasons


def _still_reasons(sides: Sides) -> list[str]:
    """Return a reason for each side where NTP accepted no sample for too long, in a time that overlaps the drive."""
    reasons = []
    for side, samples, _, drive_ns in sides:
        still = _longest_still_s(samples, drive_ns)
        if still is not None:
            still_s, limit_s = still
            reasons.append(
                f"the NTP of the {side} accepted no sample for {still_s:.1f} s (limit {STILL_LIMIT_POLLS} polls, "
                f"{limit_s:.1f} s): its path is lost or goes through injected delay, or the machine is too busy"
            )
    return reasons


def _longest_still_s(samples: Table, drive_ns: IntArray) -> tuple[float, float] | None:
    """Return the longest time without a good sample and its limit; None where the limit is met."""
    good = samples.ints("good_samples")
    counted = (good != MISSING) & np.isfinite(samples.floats("poll_s")) & (samples.ints("wall_ns") != MISSING)
    samples, good = samples.where(counted), good[counted]
    if len(good) == 0:
        return None
    begins = np.flatnonzero(np.diff(good, prepend=-1) != 0)
    ends = np.append(begins[1:], len(good)) - 1
    mono_ns, wall_ns = samples.ints("mono_ns"), samples.ints("wall_ns")
    touches = (wall_ns[ends] >= drive_ns[0]) & (wall_ns[begins] <= drive_ns[1])
    still_s = np.where(touches, (mono_ns[ends] - mono_ns[begins]) / NS_PER_S, 0.0)
    limits_s = np.maximum(STILL_LIMIT_POLLS * samples.floats("poll_s")[begins], STILL_LEAST_S)
    worst = int(np.argmax(still_s - limits_s))
    return (float(still_s[worst]), float(limits_s[worst])) if still_s[worst] > limits_s[worst] else None


def _during(samples: Table, drive_ns: IntArray) -> Table:
    wall_ns = samples.ints("wall_ns")
    return samples.where((wall_ns >= drive_ns[0]) & (wall_ns <= drive_ns[1]))


def _bound_reasons(clocks: RunClocks) -> list[str]:
    bound_ms = clocks.bound_ms
    if bound_ms is None:
        return ["the offset between the clocks has no bound"]
    if bound_ms > CLOCK_BOUND_LIMIT_MS:
        return [
            f"the offset between the clocks is only known to {bound_ms:.2f} ms (limit {CLOCK_BOUND_LIMIT_MS} ms), "
            f"by {clocks.source}"
        ]
    return []


def _unchecked_reasons(clocks: RunClocks) -> list[str]:
    if clocks.probe is not None:
        return []
    return [
        "the probe had no answer during the drive, so the offset between the clocks was not checked: open the server's "
        "UDP port clock.probe_port"
    ]


def _agreement_reasons(clocks: RunClocks) -> list[str]:
    disagreement_ms = clocks.disagreement_ms()
    if disagreement_ms is None:
        return []
    source_ms, probe_ms, allowed_ms = disagreement_ms
    return [
        f"{clocks.source} and the probe disagree about the offset between the clocks: {source_ms:.2f} and "
        f"{probe_ms:.2f} ms, although both bounds together are {allowed_ms:.2f} ms"
    ]
