from __future__ import annotations

import dataclasses
from typing import Any

import pytest

from lavt.doctor.clock_checks import WHAT_TO_DO, ClockComparison, check_host, compare
from lavt.domain import NS_PER_MS
from lavt.transport.clock_sync.clock_report import ClockReport
from lavt.transport.clock_sync.probe import ClockProbe, ProbeReply

SERVER = "10.9.0.1"
GOOD = ClockReport(
    0, 0, "desk", "chrony", 0.25, 0.0005, follows=SERVER, skew_ppm=4.0, age_s=1.0, peer_delay_s=0.0002,
    peer_dispersion_s=0.00003,
)  # fmt: skip
REPLY = ProbeReply(1, 0, 0, 0, 0.0, 0.0001)


def probes(delta_ms: float, *round_trips_ms: float) -> list[ClockProbe]:
    """Make exchanges whose both ways take the same time."""
    return [
        ClockProbe(
            number,
            0,
            round((delta_ms + round_trip_ms / 2) * NS_PER_MS),
            round((delta_ms + round_trip_ms / 2) * NS_PER_MS),
            round(round_trip_ms * NS_PER_MS),
        )
        for number, round_trip_ms in enumerate(round_trips_ms)
    ]


def compared(
    delta_ms: float = 250.0, *, reply: ProbeReply = REPLY, round_trip_ms: float = 0.3, **changes: Any
) -> ClockComparison:
    report = dataclasses.replace(GOOD, **changes)
    return compare(report, report, probes(delta_ms, 5.0, round_trip_ms, 9.0), reply, SERVER)


def test_a_good_clock() -> None:
    """A clock that is known to 2 ms or better is good; whom it follows, correction and bound are told."""
    finding = check_host(GOOD)
    assert finding.good
    (said,) = finding.says
    assert all(part in said for part in ("chrony", "10.9.0.1", "+250.000 ms", "0.500 ms"))


def test_a_clock_known_too_badly() -> None:
    """A clock that is known to 3 ms is not good enough, and a sentence says so."""
    finding = check_host(dataclasses.replace(GOOD, bound_s=0.003))
    assert not finding.good
    assert finding.says[1].startswith("3.00 ms are too wide")


@pytest.mark.parametrize("status", WHAT_TO_DO)
def test_a_clock_that_nobody_knows(status: str) -> None:
    """Where the source cannot tell, why not and what to do about it is told."""
    finding = check_host(ClockReport(0, 0, "desk", "chrony", status=status))
    assert (finding.good, finding.says) == (False, (f"{status}: {WHAT_TO_DO[status]}",))


def test_two_opinions_that_agree() -> None:
    """Delta by both, by the shortest round trip of all; with the path's bound as the client follows this server."""
    finding = compared(250.02)
    assert finding.good
    assert finding.sources is not None
    assert finding.probe is not None
    assert [finding.sources.ms, finding.sources.bound_ms] == pytest.approx([250.0, 0.1 + 0.03 + 0.004])
    assert [finding.probe.ms, finding.probe.bound_ms] == pytest.approx([250.02, 0.15])
    assert "these two agree: they are 0.020 ms apart, 0.284 ms are allowed" in finding.says


def test_who_follows_another_host_is_known_by_both_bounds() -> None:
    """Where the client follows a third host the bound is the sum of the client's and the server's own."""
    finding = compared(follows="10.9.0.9")
    assert finding.sources is not None
    assert finding.sources.bound_ms == pytest.approx(0.6)


def test_a_clock_that_is_steered_meanwhile() -> None:
    """What the host said last counts, and by how much that differs from what it said first is added to the bound."""
    before = dataclasses.replace(GOOD, correction_s=0.251)
    finding = compare(before, GOOD, probes(250.0, 0.3), REPLY, SERVER)
    assert finding.sources is not None
    assert [finding.sources.ms, finding.sources.bound_ms] == pytest.approx([250.0, 1.0 + 0.1 + 0.03 + 0.004])


def test_a_source_that_could_not_tell_before() -> None:
    """Where the host's source could tell only after the probing, Delta is the probe's, and what to do is told."""
    before = ClockReport(0, 0, "desk", "chrony", status="chrony is not synchronised")
    finding = compare(before, GOOD, probes(250.0, 0.3), REPLY, SERVER)
    assert (finding.good, finding.sources) == (True, None)
    assert finding.says[1] == (
        "this machine's source of time could not tell before the probing: run `lavt clock` again"
    )


def test_two_opinions_that_disagree() -> None:
    """Opinions further apart than both bounds are not good, and how far they are is told."""
    finding = compared(251.0)
    assert not finding.good
    assert "disagree: 1.000 ms" in finding.says[-1]


def test_ntp_through_delay() -> None:
    """An NTP round trip over a millisecond longer than the probe's is told as the one complaint."""
    finding = compared(212.5, peer_delay_s=0.0752)
    assert not finding.good
    assert all(part in finding.says[-1] for part in ("NTP", "75.20 ms", "0.30"))
    assert not any("agree" in sentence or "too wide" in sentence for sentence in finding.says)


@pytest.mark.parametrize("lacking", ["client", "server"])
def test_the_probe_alone(lacking: str) -> None:
    """Where one side's source cannot tell, Delta is the probe's alone, and what that means is told."""
    unknown: dict[str, Any] = {"correction_s": None, "bound_s": None, "status": "chrony is not installed"}
    reply = REPLY if lacking == "client" else dataclasses.replace(REPLY, correction_s=None, bound_s=None)
    finding = compared(reply=reply, **(unknown if lacking == "client" else {}))
    assert finding.good
    assert finding.sources is None
    assert any("by the probe alone: +250.000 ms ± 0.150 ms" in sentence for sentence in finding.says)
    assert any("hidden inside it" in sentence for sentence in finding.says)


def test_a_probe_over_too_long_a_way() -> None:
    """By the probe alone a round trip of 5 ms bounds Delta to 2.5 ms: not good enough."""
    finding = compared(round_trip_ms=5.0, correction_s=None, bound_s=None)
    assert not finding.good
    assert finding.says[-1].startswith("2.50 ms are too wide")


def test_an_exchange_during_which_a_clock_was_set_is_not_used() -> None:
    """An answer that came before it was asked for says nothing: it is left out, and alone it is not good."""
    spoilt = ClockProbe(9, 0, 250 * NS_PER_MS, 250 * NS_PER_MS, -999 * NS_PER_MS)
    finding = compare(GOOD, GOOD, [*probes(250.0, 0.3), spoilt], REPLY, SERVER)
    assert finding.good
    assert finding == compare(GOOD, GOOD, probes(250.0, 0.3), REPLY, SERVER)
    alone = compare(GOOD, GOOD, [spoilt], REPLY, SERVER)
    assert (alone.good, alone.probe) == (False, None)
    assert len(alone.says) == 1
