"""The checks of a run's clocks, which return the reasons why the run is invalid.

Each cause gives one reason; its consequences give no further reasons.
"""

from __future__ import annotations

import numpy as np

from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.experiment.analysis.clock_offset import follows_peer
from lavt.experiment.analysis.clocks import MARGIN_NS, PROBE, SAME_KERNEL, RunClocks, drive_on_client
from lavt.experiment.analysis.invalid_reason import InvalidCode, InvalidReason
from lavt.recording.record import Record
from lavt.recording.table import MISSING, IntArray, Table

STEP_LIMIT_MS = 5.0
"""If the wall clock changes by more than this relative to the monotonic clock between two samples, it was set.
Slewing is not a step, however fast, because it changes both clocks (clock_gettime(2))."""
SAMPLE_GAP_LIMIT_S = 2.5
"""The longest time between two samples of a clock. Clocks are sampled every second, so one missing sample is
allowed."""
CLOCK_BOUND_LIMIT_MS = 2.0
"""With a larger bound, the split of the loop latency into tau_v and tau_c is too uncertain."""
PATH_LIMIT_MS = 1.0
"""If NTP's round trip is longer than the probe's by more than this, NTP does not take the probe's path."""
NO_SAMPLE_LIMIT_POLLS = 5
"""The longest time without a good sample, in poll intervals; after it, chrony only extrapolates."""
NO_SAMPLE_ALLOWED_S = 5.0
"""The limit is at least this time, however short the poll interval is, because a busy machine loses some samples."""

Sides = tuple[tuple[str, Table, Table, IntArray], ...]
"""For each side: its name, its clock samples, the other side's samples, and the drive's start and end on the wall clock
of the side."""


def step_reasons(
    server: Record, client: Record, clocks: RunClocks, began_ns: int, ended_ns: int
) -> list[InvalidReason]:
    """Return a reason for each wall clock that was set near the drive; two sides on one kernel share one clock."""
    reasons = [
        InvalidReason(InvalidCode.CLOCK_STEP, f"the wall clock of the {side} stepped by {ms:+.1f} ms")
        for side, ms in steps_ms(server, client, began_ns, ended_ns).items()
        if abs(ms) > STEP_LIMIT_MS
    ]
    return reasons[:1] if clocks.source == SAME_KERNEL else reasons


def steps_ms(server: Record, client: Record, began_ns: int, ended_ns: int) -> dict[str, float]:
    """Return the largest change of each side's wall clock, relative to its monotonic clock, between two samples."""
    return {
        "server": _step_ms(server.table("clock"), (began_ns, ended_ns)),
        "client": _step_ms(client.table("clock"), drive_on_client(server, client, began_ns, ended_ns)),
    }


def _step_ms(samples: Table, drive_ns: tuple[int, int]) -> float:
    """Return the largest step of a side's wall clock near the drive; 0 without samples."""
    began_ns, ended_ns = drive_ns
    mono_ns, wall_ns = samples.ints("mono_ns"), samples.ints("wall_ns")
    known = (mono_ns != MISSING) & (wall_ns != MISSING)
    mono_ns, wall_ns = mono_ns[known], wall_ns[known]
    near_drive = (mono_ns[1:] > began_ns - MARGIN_NS) & (mono_ns[:-1] < ended_ns + MARGIN_NS)
    jumps_ms = np.diff(wall_ns - mono_ns)[near_drive] / NS_PER_MS
    return float(jumps_ms[np.argmax(np.abs(jumps_ms))]) if len(jumps_ms) else 0.0


def sampling_reasons(server: Record, client: Record, began_ns: int, ended_ns: int) -> list[InvalidReason]:
    """Return a reason for each side without enough clock samples between the start and the end of the drive.

    Without samples the clock offset is only a guess.
    """
    if began_ns > ended_ns:
        return []
    client_ns = _sampled_ns(client)
    client_began_ns, client_ended_ns = drive_on_client(server, client, began_ns, ended_ns)
    limit_ns = SAMPLE_GAP_LIMIT_S * NS_PER_S
    reasons = [
        InvalidReason(
            InvalidCode.CLOCK_NOT_SAMPLED,
            f"the clock of the {side} was not sampled for {gap_ns / NS_PER_S:.1f} s (limit {SAMPLE_GAP_LIMIT_S} s)",
        )
        for side, gap_ns in _longest_gaps_ns(server, client, began_ns, ended_ns).items()
        if gap_ns > limit_ns
    ]
    near_drive_ns = client_ns[(client_ns > client_began_ns - limit_ns) & (client_ns < client_ended_ns + limit_ns)]
    if len(client_ns) == 0 or _uncovered_ns(server, client, began_ns, ended_ns) > limit_ns:
        covered_s = (int(np.ptp(near_drive_ns)) if len(near_drive_ns) else 0) / NS_PER_S
        drive_s = (ended_ns - began_ns) / NS_PER_S
        text = f"the clock samples of the client cover {covered_s:.1f} s of a drive of {drive_s:.1f} s"
        reasons.append(InvalidReason(InvalidCode.CLOCK_NOT_SAMPLED, text))
    return reasons


def longest_unsampled_s(server: Record, client: Record, began_ns: int, ended_ns: int) -> float:
    """Return the longest time of the drive without a sample of a clock; 0 without a drive."""
    if began_ns > ended_ns:
        return 0.0
    gaps_ns = _longest_gaps_ns(server, client, began_ns, ended_ns)
    return max(*gaps_ns.values(), _uncovered_ns(server, client, began_ns, ended_ns)) / NS_PER_S


def _longest_gaps_ns(server: Record, client: Record, began_ns: int, ended_ns: int) -> dict[str, int]:
    """Return the longest time between two samples of each side; the server also has samples near both ends."""
    server_ns = _sampled_ns(server)
    return {
        "server": max(
            _nearest_sample_ns(server_ns, began_ns, if_none=ended_ns - began_ns),
            _nearest_sample_ns(server_ns, ended_ns, if_none=ended_ns - began_ns),
            _longest_gap_ns(server_ns, began_ns, ended_ns),
        ),
        "client": _longest_gap_ns(_sampled_ns(client), *drive_on_client(server, client, began_ns, ended_ns)),
    }


def _uncovered_ns(server: Record, client: Record, began_ns: int, ended_ns: int) -> int:
    """Return the longer of the times before the client's first sample and after its last one, within the drive."""
    client_ns = _sampled_ns(client)
    client_began_ns, client_ended_ns = drive_on_client(server, client, began_ns, ended_ns)
    if len(client_ns) == 0:
        return ended_ns - began_ns
    return max(int(client_ns[0]) - client_began_ns, client_ended_ns - int(client_ns[-1]), 0)


def _nearest_sample_ns(sampled_ns: IntArray, at_ns: int, *, if_none: int) -> int:
    """Return the time between `at_ns` and the nearest sample; `if_none` without samples."""
    return int(np.min(np.abs(sampled_ns - at_ns))) if len(sampled_ns) else if_none


def _longest_gap_ns(sampled_ns: IntArray, began_ns: int, ended_ns: int) -> int:
    """Return the longest of the gaps between two successive samples that overlap the drive."""
    in_drive = (sampled_ns[1:] > began_ns) & (sampled_ns[:-1] < ended_ns)
    return int(np.max(np.diff(sampled_ns)[in_drive], initial=0))


def _sampled_ns(record: Record) -> IntArray:
    """Return the times at which a side's clocks were sampled, on its monotonic clock."""
    mono_ns = record.table("clock").ints("mono_ns")
    return np.sort(mono_ns[mono_ns != MISSING])


def offset_reasons(server: Record, client: Record, clocks: RunClocks) -> list[InvalidReason]:
    """Check Delta, and return the reasons of the first check that fails.

    The checks are, in order: the time sources are usable, they agree with the probe, the bound of Delta is small
    enough, and the probe had an answer.
    """
    if clocks.source == SAME_KERNEL:
        return []
    server_samples, client_samples = server.table("clock"), client.table("clock")
    if clocks.source is None:
        sides = (("server", server_samples), ("client", client_samples))
        statuses = ", ".join(f"{side}: {_last_status(samples)}" for side, samples in sides)
        text = f"the offset between the clocks is not known ({statuses}), and the probe had no answer"
        return [InvalidReason(InvalidCode.CLOCK_UNKNOWN, text)]
    source_reasons = [] if clocks.source == PROBE else _source_reasons(server_samples, client_samples, clocks)
    return source_reasons or _agreement_reasons(clocks) or _bound_reasons(clocks) or _unchecked_reasons(clocks)


def _last_status(samples: Table) -> str:
    statuses = [status for status in samples.texts("status") if status]
    return statuses[-1] if statuses else "no usable sample"


def _source_reasons(server_samples: Table, client_samples: Table, clocks: RunClocks) -> list[InvalidReason]:
    sides: Sides = (
        ("client", client_samples, server_samples, clocks.client_wall_ns),
        ("server", server_samples, client_samples, clocks.server_wall_ns),
    )
    reasons = [*_path_reasons(sides, clocks), *_no_sample_reasons(sides)]
    masters = {name for samples in (server_samples, client_samples) for name in _grandmasters(samples)}
    if len(masters) > 1:
        text = f"the hosts follow different PTP grandmasters: {' and '.join(sorted(masters))}"
        reasons.append(InvalidReason(InvalidCode.PTP_GRANDMASTERS, text))
    return reasons


def _grandmasters(samples: Table) -> set[str]:
    names = zip(samples.texts("source"), samples.texts("follows"), strict=True)
    return {name for source, name in names if source == "ptp" and name}


def _path_reasons(sides: Sides, clocks: RunClocks) -> list[InvalidReason]:
    """Return a reason for each side whose NTP had a longer round trip to the other side than the probe.

    The check compares the shortest round trips of the drive: a busy machine delays only some exchanges, whereas
    injected delay affects all exchanges.
    """
    reasons = []
    for side, samples, other_samples, drive_ns in sides:
        follower_samples = _samples_in_drive(samples.where(follows_peer(samples, other_samples)), drive_ns)
        delays_ms = follower_samples.floats("peer_delay_s") * 1e3
        delays_ms = delays_ms[np.isfinite(delays_ms)]
        if len(delays_ms) == 0 or len(clocks.drive_exchanges) == 0:
            continue
        ntp_ms, probe_ms = float(delays_ms.min()), float(clocks.drive_exchanges.round_trip_ns.min()) / NS_PER_MS
        if ntp_ms > probe_ms + PATH_LIMIT_MS:
            text = (
                f"the NTP of the {side} goes through injected delay: its round trip is {ntp_ms:.2f} ms, the probe's "
                f"is {probe_ms:.2f} ms (limit: {PATH_LIMIT_MS} ms longer)"
            )
            reasons.append(InvalidReason(InvalidCode.NTP_THROUGH_DELAY, text))
    return reasons


def _no_sample_reasons(sides: Sides) -> list[InvalidReason]:
    """Return a reason for each side whose NTP accepted no sample for too long; the time must overlap the drive."""
    reasons = []
    for side, samples, _, drive_ns in sides:
        time_and_limit = _longest_without_sample_s(samples, drive_ns)
        if time_and_limit is not None:
            longest_s, limit_s = time_and_limit
            text = (
                f"the NTP of the {side} accepted no sample for {longest_s:.1f} s (limit {NO_SAMPLE_LIMIT_POLLS} polls, "
                f"{limit_s:.1f} s): its path is lost or goes through injected delay, or the machine is too busy"
            )
            reasons.append(InvalidReason(InvalidCode.NTP_NO_SAMPLE, text))
    return reasons


def _longest_without_sample_s(samples: Table, drive_ns: IntArray) -> tuple[float, float] | None:
    """Return the time without a good sample and its limit, where it exceeds this limit most; None if it never does."""
    began_ns, ended_ns = drive_ns
    good_counts = samples.ints("good_samples")
    is_known = (good_counts != MISSING) & np.isfinite(samples.floats("poll_s")) & (samples.ints("wall_ns") != MISSING)
    samples, good_counts = samples.where(is_known), good_counts[is_known]
    if len(good_counts) == 0:
        return None
    # Each phase without a further good sample is from the row `first` to the row `last`.
    first = np.flatnonzero(np.diff(good_counts, prepend=-1) != 0)
    last = np.append(first[1:], len(good_counts)) - 1
    mono_ns, wall_ns = samples.ints("mono_ns"), samples.ints("wall_ns")
    overlaps_drive = (wall_ns[last] >= began_ns) & (wall_ns[first] <= ended_ns)
    times_s = np.where(overlaps_drive, (mono_ns[last] - mono_ns[first]) / NS_PER_S, 0.0)
    limits_s = np.maximum(NO_SAMPLE_LIMIT_POLLS * samples.floats("poll_s")[first], NO_SAMPLE_ALLOWED_S)
    worst = int(np.argmax(times_s - limits_s))
    return (float(times_s[worst]), float(limits_s[worst])) if times_s[worst] > limits_s[worst] else None


def _samples_in_drive(samples: Table, drive_ns: IntArray) -> Table:
    began_ns, ended_ns = drive_ns
    wall_ns = samples.ints("wall_ns")
    return samples.where((wall_ns >= began_ns) & (wall_ns <= ended_ns))


def _bound_reasons(clocks: RunClocks) -> list[InvalidReason]:
    bound_ms = clocks.bound_ms
    if bound_ms is None:
        return [InvalidReason(InvalidCode.CLOCK_BOUND, "the offset between the clocks has no bound")]
    if bound_ms > CLOCK_BOUND_LIMIT_MS:
        text = (
            f"the offset between the clocks is only known to {bound_ms:.2f} ms (limit {CLOCK_BOUND_LIMIT_MS} ms); "
            f"its source is {clocks.source}"
        )
        return [InvalidReason(InvalidCode.CLOCK_BOUND, text)]
    return []


def _unchecked_reasons(clocks: RunClocks) -> list[InvalidReason]:
    if clocks.probe is not None:
        return []
    text = (
        "the probe had no answer during the drive, so the offset between the clocks was not checked: open the server's "
        "UDP port clock.probe_port"
    )
    return [InvalidReason(InvalidCode.CLOCK_UNCHECKED, text)]


def _agreement_reasons(clocks: RunClocks) -> list[InvalidReason]:
    disagreement_ms = clocks.disagreement_ms()
    if disagreement_ms is None:
        return []
    source_ms, probe_ms, allowed_ms = disagreement_ms
    if abs(source_ms - probe_ms) <= allowed_ms:
        return []
    text = (
        f"{clocks.source} and the probe disagree about the offset between the clocks: {source_ms:.2f} and "
        f"{probe_ms:.2f} ms, although the sum of their error bounds is {allowed_ms:.2f} ms"
    )
    return [InvalidReason(InvalidCode.CLOCK_DISAGREEMENT, text)]
