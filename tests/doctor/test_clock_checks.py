from __future__ import annotations

from typing import Any

import msgspec
import pytest

from lavt.doctor.clock_checks import HINTS, ClockComparison, check_host, compare
from lavt.domain import NS_PER_MS
from lavt.transport.clock_sync.clock_report import ClockReport
from lavt.transport.clock_sync.probe import ClockProbe, ProbeReply

SERVER = "10.9.0.1"
GOOD = ClockReport(
    0,
    0,
    "desk",
    "chrony",
    0.25,
    0.0005,
    follows=SERVER,
    skew_ppm=4.0,
    age_s=1.0,
    peer_delay_s=0.0002,
    peer_dispersion_s=0.00003,
)
PATH_BOUND_MS = 0.2 / 2 + 0.03 + 0.004
"""The bound of `GOOD`: half of the peer delay, the peer dispersion, and skew x age."""
REPLY = ProbeReply(1, 0, 0, 0, 0.0, 0.0001)


def probes(delta_ms: float, *round_trips_ms: float) -> list[ClockProbe]:
    """Return probes with symmetric paths."""
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


def compare_clocks(
    delta_ms: float = 250.0, *, reply: ProbeReply = REPLY, round_trip_ms: float = 0.3, **changes: Any
) -> ClockComparison:
    """Compare the clocks with `GOOD`, changed, as the report both before and after the probing."""
    report = msgspec.structs.replace(GOOD, **changes)
    return compare(report, report, probes(delta_ms, 5.0, round_trip_ms, 9.0), reply, SERVER)


def test_a_good_clock() -> None:
    """A clock with a bound of 2 ms or better is good; the result names its reference, correction and bound."""
    finding = check_host(GOOD)
    assert finding.good
    (sentence,) = finding.says
    assert all(part in sentence for part in ("chrony", "10.9.0.1", "+250.000 ms", "0.500 ms"))


def test_a_clock_with_a_wide_bound() -> None:
    """A clock with a bound of 3 ms is not good enough."""
    finding = check_host(msgspec.structs.replace(GOOD, bound_s=0.003))
    assert not finding.good
    assert "3.00 ms" in finding.says[1]


@pytest.mark.parametrize("status", HINTS)
def test_a_source_without_an_estimate(status: str) -> None:
    """For a time source without an estimate, the result is the source's status and a suggested fix."""
    finding = check_host(ClockReport(0, 0, "desk", "chrony", status=status))
    assert (finding.good, finding.says) == (False, (f"{status}: {HINTS[status]}",))


def test_two_estimates_that_agree() -> None:
    """The probe's bound comes from the shortest round trip, the sources' bound from NTP's path to the server."""
    finding = compare_clocks(250.02)
    assert finding.good
    assert finding.sources is not None
    assert finding.probe is not None
    assert [finding.sources.ms, finding.sources.bound_ms] == pytest.approx([250.0, PATH_BOUND_MS])
    assert [finding.probe.ms, finding.probe.bound_ms] == pytest.approx([250.02, 0.15])
    (agreement,) = (sentence for sentence in finding.says if " agree" in sentence)
    assert all(part in agreement for part in ("0.020 ms", f"{PATH_BOUND_MS + 0.15:.3f} ms"))


def test_a_client_that_follows_another_host() -> None:
    """If the client follows a third host, the bound is the sum of the client's and the server's bounds."""
    finding = compare_clocks(follows="10.9.0.9")
    assert finding.sources is not None
    assert finding.sources.bound_ms == pytest.approx(0.5 + 0.1)


def test_a_clock_that_is_corrected_during_the_probing() -> None:
    """The estimate uses the correction after the probing; the bound includes its change during the probing."""
    before = msgspec.structs.replace(GOOD, correction_s=0.251)
    finding = compare(before, GOOD, probes(250.0, 0.3), REPLY, SERVER)
    assert finding.sources is not None
    assert [finding.sources.ms, finding.sources.bound_ms] == pytest.approx([250.0, 1.0 + PATH_BOUND_MS])


def test_a_source_without_an_estimate_before_the_probing() -> None:
    """If the time source has no estimate before the probing, Delta is from the probe alone, and a fix is suggested."""
    before = ClockReport(0, 0, "desk", "chrony", status="chrony is not synchronised")
    finding = compare(before, GOOD, probes(250.0, 0.3), REPLY, SERVER)
    assert (finding.good, finding.sources) == (True, None)
    assert "`lavt clock` again" in finding.says[1]


def test_two_estimates_that_disagree() -> None:
    """If two estimates differ by more than the sum of their bounds, the result is not good and names the difference."""
    finding = compare_clocks(251.0)
    assert not finding.good
    assert "disagree" in finding.says[-1]
    assert "1.000 ms" in finding.says[-1]


def test_ntp_through_delay() -> None:
    """If NTP's round trip is more than a millisecond longer than the probe's, this is the only complaint."""
    finding = compare_clocks(212.5, peer_delay_s=0.0752)
    assert not finding.good
    assert all(part in finding.says[-1] for part in ("NTP", "75.20 ms", "0.30"))
    assert not any("agree" in sentence or "too wide" in sentence for sentence in finding.says)


@pytest.mark.parametrize("lacking", ["client", "server"])
def test_the_probe_alone(lacking: str) -> None:
    """If one side's time source has no estimate, Delta is from the probe alone, and the result explains its bound."""
    unknown: dict[str, Any] = {"correction_s": None, "bound_s": None, "status": "chrony is not installed"}
    reply = REPLY if lacking == "client" else msgspec.structs.replace(REPLY, correction_s=None, bound_s=None)
    finding = compare_clocks(reply=reply, **(unknown if lacking == "client" else {}))
    assert finding.good
    assert finding.sources is None
    assert any("+250.000 ms ± 0.150 ms" in sentence for sentence in finding.says)
    assert any("asymmetry" in sentence for sentence in finding.says)


def test_a_probe_with_a_long_round_trip() -> None:
    """Without time sources, a shortest round trip of 5 ms gives a bound of 2.5 ms, which is not good enough."""
    finding = compare_clocks(round_trip_ms=5.0, correction_s=None, bound_s=None)
    assert not finding.good
    assert "2.50 ms" in finding.says[-1]


def test_a_probe_with_a_clock_step_is_ignored() -> None:
    """A probe with a negative round trip is ignored; without other probes the result is not good."""
    stepped = ClockProbe(9, 0, 250 * NS_PER_MS, 250 * NS_PER_MS, -999 * NS_PER_MS)
    finding = compare(GOOD, GOOD, [*probes(250.0, 0.3), stepped], REPLY, SERVER)
    assert finding.good
    assert finding == compare(GOOD, GOOD, probes(250.0, 0.3), REPLY, SERVER)
    alone = compare(GOOD, GOOD, [stepped], REPLY, SERVER)
    assert (alone.good, alone.probe) == (False, None)
    assert len(alone.says) == 1
