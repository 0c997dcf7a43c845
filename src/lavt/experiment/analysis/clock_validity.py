"""What the clocks have against a run: one reason for one cause, so that what follows from it is not told beside it."""

from __future__ import annotations

import numpy as np

from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.experiment.analysis.clock_offset import follows
from lavt.experiment.analysis.clocks import MARGIN_NS, PROBE, SAME_KERNEL, RunClocks, drive_on_client
from lavt.recording.record import Record
from lavt.recording.table import MISSING, IntArray, Table

STEP_LIMIT_MS = 5.0
"""A wall clock that moves this much against the monotonic clock between two samples was set. Steering, however fast,
moves both (clock_gettime(2)), and is no step."""
POLL_LIMIT_S = 2.5
"""Clocks are sampled every second: one sample may be late or missing, and no more."""
CLOCK_BOUND_LIMIT_MS = 2.0
"""Beyond this the split of the loop into tau_v and tau_c says too little."""
PATH_LIMIT_MS = 1.0
"""How much longer than the probe's NTP's round trip may be before its path is not the probe's."""
STILL_LIMIT_POLLS = 5
"""So many polls without a good sample, and chrony only extrapolates."""
STILL_LEAST_S = 5.0
"""Shorter than this it may, however often it polls: a busy machine loses some samples of many."""

Sides = tuple[tuple[str, Table, Table, IntArray], ...]
"""Name of a side, its samples, the other side's, and beginning and end of the drive on its wall clock."""


def step_reasons(server: Record, client: Record, clocks: RunClocks, began_ns: int, ended_ns: int) -> list[str]:
    """Tell of wall clocks that were set near the drive; two sides on one kernel have one clock."""
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
    """Look for samples of the clocks that are missing: without them the offset is only guessed.

    On both sides they must follow each other from the drive's beginning to its end.
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
    whole = len(client_ns) and client_ns[0] - client_began_ns <= limit_ns >= client_ended_ns - client_ns[-1]
    if not whole:
        covered_s, drive_s = (int(np.ptp(near_ns)) if len(near_ns) else 0) / NS_PER_S, (ended_ns - began_ns) / NS_PER_S
        reasons.append(f"the clock samples of the client reach over {covered_s:.1f} s of a drive of {drive_s:.1f} s")
    return reasons


def _longest_gap_ns(sampled_ns: IntArray, began_ns: int, ended_ns: int) -> int:
    """For how long, between two samples, there was none while it was driven."""
    in_drive = (sampled_ns[1:] > began_ns) & (sampled_ns[:-1] < ended_ns)
    return int(np.max(np.diff(sampled_ns)[in_drive], initial=0))


def _sampled_ns(record: Record) -> IntArray:
    """When a side's clocks were sampled, on its monotonic clock."""
    mono_ns = record.table("clock").ints("mono_ns")
    return np.sort(mono_ns[mono_ns != MISSING])


def offset_reasons(server: Record, client: Record, clocks: RunClocks) -> list[str]:
    """Tell what is wrong with Delta: an unfit source of time first, and only where there is none what it leads to."""
    if clocks.source == SAME_KERNEL:
        return []
    of_server, of_client = server.table("clock"), client.table("clock")
    if clocks.source is None:
        said = {side: _status(samples) for side, samples in (("server", of_server), ("client", of_client))}
        words = ", ".join(f"{side}: {status}" for side, status in said.items())
        return [f"the offset between the clocks is not known ({words}), and the probe had no answer"]
    unfit = [] if clocks.source == PROBE else _source_reasons(of_server, of_client, clocks)
    return unfit or _agreement_reasons(clocks) or _bound_reasons(clocks) or _unchecked_reasons(clocks)


def _status(samples: Table) -> str:
    said = [status for status in samples.texts("status") if status]
    return said[-1] if said else "no sample that can be used"


def _source_reasons(of_server: Table, of_client: Table, clocks: RunClocks) -> list[str]:
    sides: Sides = (
        ("client", of_client, of_server, clocks.client_wall_ns),
        ("server", of_server, of_client, clocks.server_wall_ns),
    )
    reasons = [reason for look in (_path_reasons, _still_reasons) for reason in look(sides, clocks)]
    masters = {name for samples in (of_server, of_client) for name in _grandmasters(samples)}
    if len(masters) > 1:
        reasons.append(f"the hosts follow different PTP grandmasters: {' and '.join(sorted(masters))}")
    return reasons


def _grandmasters(samples: Table) -> set[str]:
    names = zip(samples.texts("source"), samples.texts("follows"), strict=True)
    return {name for source, name in names if source == "ptp" and name}


def _path_reasons(sides: Sides, clocks: RunClocks) -> list[str]:
    """Compare the shortest round trips of NTP and of the probe during the drive, where one host follows the other.

    A busy machine makes some of them longer, injected delay all of them.
    """
    reasons = []
    for side, samples, other, drive_ns in sides:
        followed = _during(samples.where(follows(samples, other)), drive_ns)
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


def _still_reasons(sides: Sides, _clocks: RunClocks) -> list[str]:
    """Look for a time that touches the drive in which NTP's samples came to nothing, or came no more."""
    reasons = []
    for side, samples, _, drive_ns in sides:
        still = _longest_still_s(samples, drive_ns)
        if still is not None:
            still_s, limit_s = still
            reasons.append(
                f"the NTP of the {side} accepted no sample for {still_s:.1f} s (limit {STILL_LIMIT_POLLS} polls, "
                f"{limit_s:.1f} s): its path is lost or was put through injected delay, or the machine is too busy"
            )
    return reasons


def _longest_still_s(samples: Table, drive_ns: IntArray) -> tuple[float, float] | None:
    """For how long the count of good samples stood still, and for how long it may; None: nowhere too long."""
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
        "the probe had no answer during the drive, so that nobody has checked the offset between the clocks: open "
        "the server's UDP port clock.probe_port"
    ]


def _agreement_reasons(clocks: RunClocks) -> list[str]:
    apart_ms = clocks.disagreement_ms()
    if apart_ms is None:
        return []
    source_ms, probe_ms, allowed_ms = apart_ms
    return [
        f"{clocks.source} and the probe disagree about the offset between the clocks: {source_ms:.2f} and "
        f"{probe_ms:.2f} ms, where both bounds together are {allowed_ms:.2f} ms"
    ]
