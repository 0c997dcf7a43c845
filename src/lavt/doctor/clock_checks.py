"""The checks of `lavt clock`: the accuracy of this machine's clock, and its offset to another machine's clock."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from lavt.domain import NS_PER_MS
from lavt.experiment.analysis.clock_validity import CLOCK_BOUND_LIMIT_MS, PATH_LIMIT_MS
from lavt.transport.clock_sync import chrony, ptp
from lavt.transport.clock_sync.clock_report import ClockReport
from lavt.transport.clock_sync.probe import ClockProbe, ProbeReply

HINTS = {
    chrony.ABSENT: "install chrony on both machines, or use the probe alone",
    chrony.NOT_RUNNING: "start chronyd, or use the probe alone",
    chrony.NOT_SYNCHRONISED: "wait for its first samples, or name a server in chrony.conf (see chronyc sources)",
    ptp.ABSENT: "install linuxptp on both machines, or set clock.source to another source",
    ptp.NOT_RUNNING: "start ptp4l, and run as a user who may write to its socket (root)",
    ptp.NO_MASTER: "check that one machine is master and the other receives its messages (pmc 'GET PORT_DATA_SET')",
}
"""How to fix a time source, by its status."""


@dataclass(frozen=True, slots=True)
class ClockEstimate:
    """An estimate of Delta, the server's clock minus the client's, with its largest error."""

    ms: float
    bound_ms: float


@dataclass(frozen=True, slots=True)
class ClockComparison:
    """The result of a check of this machine's clock, alone or compared with the server's."""

    good: bool
    """Whether the clocks are accurate enough for a run on two machines."""
    says: tuple[str, ...]
    """The result in sentences."""
    sources: ClockEstimate | None = None
    """Delta from the time sources of both machines; None if either has no estimate."""
    probe: ClockEstimate | None = None
    """Delta from the probe; None if no usable probe was answered."""
    round_trip_ms: float | None = None


def check_host(report: ClockReport) -> ClockComparison:
    """Check the accuracy of this machine's clock."""
    if report.correction_s is None or report.bound_s is None:
        hint = HINTS.get(report.status)
        return ClockComparison(False, (f"{report.status}: {hint}" if hint else report.status,))
    bound_ms = report.bound_s * 1e3
    reference = (
        f"follows {report.follows}" if report.follows else report.status or "follows a source without an address"
    )
    sentence = (
        f"{report.source}: this machine's clock {reference}; its correction is "
        f"{report.correction_s * 1e3:+.3f} ms ± {bound_ms:.3f} ms"
    )
    good = bound_ms <= CLOCK_BOUND_LIMIT_MS
    return ClockComparison(good, (sentence,) if good else (sentence, _bound_complaint(bound_ms)))


def compare_with_server(
    before: ClockReport, after: ClockReport, probes: Sequence[ClockProbe], last_reply: ProbeReply, server: str
) -> ClockComparison:
    """Compare this machine's clock with the clock of the server at the address `server`, which answered these probes.

    `before` and `after` are the reports of this machine's time source before and after the probing. The estimate uses
    `after`. The server reported its correction between the two, so the change from `before` to `after` is added to the
    bound.
    """
    usable = [probe for probe in probes if probe.round_trip_ns >= 0]
    if not usable:
        return ClockComparison(False, ("no answer is usable: a clock was set during each probe, so try again later",))
    best = min(usable, key=lambda probe: probe.round_trip_ns)
    probe = ClockEstimate(best.offset_ns / NS_PER_MS, best.round_trip_ns / 2 / NS_PER_MS)
    sources = _estimate_from_sources(before, after, last_reply, server)
    round_trip_ms = best.round_trip_ns / NS_PER_MS
    sentences = [check_host(after).says[0]]
    complaints: list[str] = []
    if sources is None:
        if after.correction_s is not None and before.correction_s is None:
            sentences.append("this machine's time source had no estimate before the probing: run `lavt clock` again")
        elif after.correction_s is not None:
            sentences.append("the server's time source has no estimate: run `lavt clock` there")
        sentences.append(
            f"Delta (server minus client) from the probe alone: {probe.ms:+.3f} ms ± {probe.bound_ms:.3f} ms. The "
            "bound is half the round trip and includes any asymmetry of the path"
        )
    else:
        sentences.append(
            f"Delta (server minus client) from {after.source}: {sources.ms:+.3f} ms ± {sources.bound_ms:.3f} ms"
        )
        sentences.append(f"Delta from the probe: {probe.ms:+.3f} ms ± {probe.bound_ms:.3f} ms")
        complaints += _path_complaints(after, round_trip_ms, server)
        difference_ms, allowed_ms = abs(sources.ms - probe.ms), sources.bound_ms + probe.bound_ms
        if complaints:
            sentences.append(f"the two estimates differ by {difference_ms:.3f} ms")
        elif difference_ms > allowed_ms:
            complaints.append(
                f"the two estimates disagree: they differ by {difference_ms:.3f} ms, allowed are {allowed_ms:.3f} ms"
            )
        else:
            sentences.append(
                f"the two estimates agree: they differ by {difference_ms:.3f} ms, allowed are {allowed_ms:.3f} ms"
            )
    sentences.append(f"the shortest of {len(usable)} round trips took {round_trip_ms:.3f} ms")
    estimate = sources or probe
    if not complaints and estimate.bound_ms > CLOCK_BOUND_LIMIT_MS:
        complaints.append(_bound_complaint(estimate.bound_ms))
    return ClockComparison(not complaints, (*sentences, *complaints), sources, probe, round_trip_ms)


def _estimate_from_sources(
    before: ClockReport, after: ClockReport, last_reply: ProbeReply, server: str
) -> ClockEstimate | None:
    """Return Delta from the time sources of both machines; None if either has no estimate."""
    correction_s, bound_s = after.correction_s, after.bound_s
    server_correction_s, server_bound_s = last_reply.correction_s, last_reply.bound_s
    if before.correction_s is None or correction_s is None or bound_s is None:
        return None
    if server_correction_s is None or server_bound_s is None:
        return None
    path = (after.peer_delay_s, after.peer_dispersion_s, after.skew_ppm, after.age_s)
    delay_s, dispersion_s, skew_ppm, age_s = (math.inf if value is None else value for value in path)
    # If this machine follows the server, an error of the server's own clock does not change Delta.
    path_bound_s = delay_s / 2 + dispersion_s + (skew_ppm / 1e6 * age_s if age_s else 0.0)
    total_bound_s = min(bound_s, path_bound_s) if after.follows == server else bound_s + server_bound_s
    change_s = abs(correction_s - before.correction_s)
    return ClockEstimate((correction_s - server_correction_s) * 1e3, (total_bound_s + change_s) * 1e3)


def _path_complaints(report: ClockReport, round_trip_ms: float, server: str) -> list[str]:
    """Return a complaint if NTP's round trip is clearly longer than the probe's; otherwise no complaint."""
    delay_ms = None if report.peer_delay_s is None else report.peer_delay_s * 1e3
    if report.follows != server or delay_ms is None or delay_ms <= round_trip_ms + PATH_LIMIT_MS:
        return []
    return [
        f"the injected delay seems to affect NTP: its round trip is {delay_ms:.2f} ms, the probe's is "
        f"{round_trip_ms:.2f} ms; exempt UDP port 123 from the delay"
    ]


def _bound_complaint(bound_ms: float) -> str:
    return f"the bound of {bound_ms:.2f} ms is too wide: one-way latencies need {CLOCK_BOUND_LIMIT_MS} ms or better"
