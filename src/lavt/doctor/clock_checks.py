"""How good the clocks of two machines are at this moment, in words: what `lavt clock` says."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from lavt.domain import NS_PER_MS
from lavt.experiment.analysis.clock_validity import CLOCK_BOUND_LIMIT_MS, PATH_LIMIT_MS
from lavt.transport.clock_sync import chrony, ptp
from lavt.transport.clock_sync.clock_report import ClockReport
from lavt.transport.clock_sync.probe import ClockProbe, ProbeReply

WHAT_TO_DO = {
    chrony.ABSENT: "install chrony on both machines, or go by the probe alone",
    chrony.NOT_RUNNING: "start chronyd, or go by the probe alone",
    chrony.NOT_SYNCHRONISED: "wait for its first samples, or name a server in chrony.conf (chronyc sources tells more)",
    ptp.ABSENT: "install linuxptp on both machines, or set clock.source to another source",
    ptp.NOT_RUNNING: "start ptp4l, and run as a user who may write to its socket (root)",
    ptp.NO_MASTER: "see that one machine is master and the other hears it (pmc 'GET PORT_DATA_SET' tells more)",
}


@dataclass(frozen=True, slots=True)
class ClockEstimate:
    """What somebody says of Delta, and how wrong it can be."""

    ms: float
    bound_ms: float


@dataclass(frozen=True, slots=True)
class ClockComparison:
    """What was found, and whether it will do for a run between two machines."""

    good: bool
    says: tuple[str, ...]
    sources: ClockEstimate | None = None
    probe: ClockEstimate | None = None
    round_trip_ms: float | None = None


def check_host(report: ClockReport) -> ClockComparison:
    """Tell how this host's clock is."""
    if report.correction_s is None or report.bound_s is None:
        hint = WHAT_TO_DO.get(report.status)
        return ClockComparison(False, (f"{report.status}: {hint}" if hint else report.status,))
    bound_ms = report.bound_s * 1e3
    reference = (
        f"follows {report.follows}" if report.follows else report.status or "follows a source without an address"
    )
    words = (
        f"by {report.source} this machine's clock {reference}: it must be corrected by "
        f"{report.correction_s * 1e3:+.3f} ms, which is known to {bound_ms:.3f} ms"
    )
    good = bound_ms <= CLOCK_BOUND_LIMIT_MS
    return ClockComparison(good, (words,) if good else (words, _too_wide(bound_ms)))


def compare(
    before: ClockReport, report: ClockReport, probes: Sequence[ClockProbe], latest: ProbeReply, server: str
) -> ClockComparison:
    """Tell how this host's clock is against that of a server at the address `server` that answered these probes.

    `before` and `report` are what this host's source said before and after the probing: the second counts. The
    server's word is of some moment between: what this clock was corrected by meanwhile is added to the bound.
    """
    possible = [probe for probe in probes if probe.round_trip_ns >= 0]
    if not possible:
        return ClockComparison(
            False, ("no answer can be used: a clock was set during each, so ask again when none is set",)
        )
    best = min(possible, key=lambda probe: probe.round_trip_ns)
    probe = ClockEstimate(best.offset_ns / NS_PER_MS, best.round_trip_ns / 2 / NS_PER_MS)
    sources = _by_sources(before, report, latest, server)
    round_trip_ms = best.round_trip_ns / NS_PER_MS
    says = [check_host(report).says[0]]
    complaints: list[str] = []
    if sources is None:
        if report.correction_s is not None and before.correction_s is None:
            says.append("this machine's source of time could not tell before the probing: run `lavt clock` again")
        elif report.correction_s is not None:
            says.append("the server's source of time cannot tell how its clock is: run `lavt clock` there")
        says.append(
            f"Delta (server less client) is by the probe alone: {probe.ms:+.3f} ms ± {probe.bound_ms:.3f} ms. The "
            "bound is half the round trip: if one way is slower than the other, that is hidden inside it"
        )
    else:
        says.append(f"Delta (server less client) by {report.source}: {sources.ms:+.3f} ms ± {sources.bound_ms:.3f} ms")
        says.append(f"Delta by the probe: {probe.ms:+.3f} ms ± {probe.bound_ms:.3f} ms")
        complaints += _path_complaints(report, round_trip_ms, server)
        apart_ms, allowed_ms = abs(sources.ms - probe.ms), sources.bound_ms + probe.bound_ms
        if complaints:
            says.append(f"these two are {apart_ms:.3f} ms apart")
        elif apart_ms > allowed_ms:
            complaints.append(f"these two disagree: {apart_ms:.3f} ms, where {allowed_ms:.3f} ms are allowed")
        else:
            says.append(f"these two agree: they are {apart_ms:.3f} ms apart, {allowed_ms:.3f} ms are allowed")
    says.append(f"the shortest of {len(possible)} round trips took {round_trip_ms:.3f} ms")
    used = sources or probe
    if not complaints and used.bound_ms > CLOCK_BOUND_LIMIT_MS:
        complaints.append(_too_wide(used.bound_ms))
    return ClockComparison(not complaints, (*says, *complaints), sources, probe, round_trip_ms)


def _by_sources(before: ClockReport, report: ClockReport, latest: ProbeReply, server: str) -> ClockEstimate | None:
    known = (report.correction_s, report.bound_s, latest.correction_s, latest.bound_s)
    if before.correction_s is None or known[0] is None or known[1] is None or known[2] is None or known[3] is None:
        return None
    path = (report.peer_delay_s, report.peer_dispersion_s, report.skew_ppm, report.age_s)
    delay_s, dispersion_s, skew_ppm, age_s = (math.inf if each is None else each for each in path)
    path_s = delay_s / 2 + dispersion_s + (skew_ppm / 1e6 * age_s if age_s else 0.0)
    bound_s = min(known[1], path_s) if report.follows == server else known[1] + known[3]
    moved_s = abs(known[0] - before.correction_s)
    return ClockEstimate((known[0] - known[2]) * 1e3, (bound_s + moved_s) * 1e3)


def _path_complaints(report: ClockReport, round_trip_ms: float, server: str) -> list[str]:
    delay_ms = None if report.peer_delay_s is None else report.peer_delay_s * 1e3
    if report.follows != server or delay_ms is None or delay_ms <= round_trip_ms + PATH_LIMIT_MS:
        return []
    return [
        f"NTP seems to go through injected delay: its round trip is {delay_ms:.2f} ms, the probe's "
        f"{round_trip_ms:.2f} ms; keep UDP port 123 out of what is delayed"
    ]


def _too_wide(bound_ms: float) -> str:
    return f"{bound_ms:.2f} ms are too wide: one-way latencies need {CLOCK_BOUND_LIMIT_MS} ms or better"
