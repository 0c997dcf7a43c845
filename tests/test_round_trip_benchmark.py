from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
from benchmarks import control_round_trip
from benchmarks.round_trip import carriers, results
from benchmarks.round_trip.process import command
from benchmarks.round_trip.zenoh_end import Places

from lavt.domain import Command
from lavt.runtime import process_priority
from lavt.transport.messages import decode

PROGRAM = Path(control_round_trip.__file__)


def measurement(p50_us: float) -> results.PaceResults:
    times = {"p50_us": p50_us, "p95_us": 2 * p50_us, "p99_us": 4 * p50_us, "lost": 0.0}
    return {"at_50_hz": times, "back_to_back": times}


def test_a_real_command_is_sent() -> None:
    """The message of the benchmark is a valid command of about 200 bytes."""
    assert decode(Command, command(7)).sequence == 7
    assert 150 < len(command(7)) < 250


def test_medians_over_rounds_and_ratios_to_raw_udp() -> None:
    """The summary has medians over the rounds, and their ratios to those of raw UDP."""
    udp, embedded = [measurement(us) for us in (10, 20, 30)], [measurement(us) for us in (40, 40, 90)]
    summary = results.summary({"udp": udp, "embedded": embedded})
    assert summary["udp"]["at_50_hz"]["p50_us"] == 20
    assert summary["udp"]["at_50_hz"]["p50_range_us"] == [10, 30]
    assert summary["udp"]["at_50_hz"]["p50_ratio"] == 1
    assert summary["embedded"]["back_to_back"]["p99_us"] == 160
    assert summary["embedded"]["back_to_back"]["p99_ratio"] == 3, "the median of the ratios 4, 2 and 3"


def test_without_raw_udp_there_are_no_ratios() -> None:
    """A carrier that is measured without raw UDP has times only."""
    values = results.summary({"embedded": [measurement(50)]})["embedded"]["at_50_hz"]
    assert values["p50_us"] == 50
    assert not [name for name in values if name.endswith("ratio")]


def test_the_goals_are_judged() -> None:
    """The embedded routers meet the goal if they are ahead of CycloneDDS and take at most 3 times as long as UDP."""
    measured = {"udp": [measurement(10)], "embedded": [measurement(31)], "cyclonedds": [measurement(32)]}
    sentences = results.goals(results.summary(measured))
    assert sentences[0] == "goal at 50 Hz, p50: 31 us, CycloneDDS 32 us: met"
    assert sentences[1] == "goal at 50 Hz, p50: 3.10 x raw UDP, at most 3 x: missed"
    assert results.goals({}) == ["goals: embedded routers were not measured"]


def test_the_stages_add_up_to_the_round_trip() -> None:
    """Signing, carrier, verifying and handing over, in both directions, take as long as the round trip."""
    times = ("begin", "encoded", "signed", "sent", "arrived", "verified", "handed")
    asked = dict(zip(times, (0, 5, 8, 9, 70, 77, 90), strict=True)) | {"in_zenoh": 3, "woken": 4}
    echoed = dict(zip(times[2:], (38, 39, 20, 31, 36), strict=True)) | {"decode": 2, "in_zenoh": 5, "woken": 6}
    stages = results.message_stages(asked, echoed)
    assert sum(stages[stage] for stage in ("sign", "carry", "verify", "hand_over")) == 90 - 5
    assert (stages["encode"], stages["sign"], stages["in_zenoh"], stages["woken"]) == (5, 5, 8, 10)


def test_lost_echoes_are_counted() -> None:
    """A lost echo is counted and is not part of the percentiles."""
    times = results.percentiles("udp", [1000, None, 3000])
    assert (times["p50_us"], times["lost"]) == (2.0, 1)


def test_a_missing_carrier_is_reported(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """If pyzmq is missing and no other carrier is requested, the benchmark names the package and exits with 2."""
    monkeypatch.setattr(process_priority, "raise_priority", lambda: None)  # it would change the priority of all tests
    monkeypatch.setattr(carriers, "find_spec", lambda _name: None)
    monkeypatch.setattr(sys, "argv", ["control_round_trip.py", "--only", "pyzmq"])
    assert control_round_trip.main() == 2
    assert "pip install pyzmq" in capsys.readouterr().err


@pytest.mark.parametrize("arguments", [["--rounds", "0"], ["--seconds", "0"], ["--messages", "0"]])
def test_empty_measurements_are_rejected(arguments: list[str]) -> None:
    """A benchmark without rounds, time or messages is rejected with exit status 2."""
    with pytest.raises(SystemExit) as ended:
        control_round_trip.arguments(arguments)
    assert ended.value.code == 2


@pytest.mark.full
@pytest.mark.timeout(1800)
def test_the_control_benchmark_runs() -> None:
    """`benchmarks/control_round_trip.py` measures UDP and Zenoh, plain and secure, and divides the time into stages."""
    names = ["udp", "embedded", "separate", "embedded_secure", "embedded_callback", "embedded_stamps"]
    completed = subprocess.run(
        [sys.executable, PROGRAM, "--short", *(word for name in names for word in ("--only", name))],
        capture_output=True,
        text=True,
        check=False,
        timeout=900,
    )
    assert completed.returncode == 0, completed.stderr
    result = json.loads(completed.stdout.splitlines()[-1])
    assert list(result) == names
    for name in names:
        for pace in ("at_50_hz", "back_to_back"):
            assert result[name][pace]["p50_us"] > 0
            assert result[name][pace]["p50_ratio"] > 0
    stages = {name: result[name]["stages"] for name in names}
    assert stages["udp"]["sign"] == stages["udp"]["verify"] == 0
    assert stages["embedded_secure"]["sign"] > stages["embedded"]["sign"]
    assert stages["embedded_stamps"]["in_zenoh"] > 0
    assert "| Zenoh, embedded routers" in completed.stdout


def test_an_installed_carrier_returns_the_echo() -> None:
    """Pyzmq and CycloneDDS, if installed, return the echo of every command."""
    names = [name for name in ("pyzmq", "cyclonedds") if not carriers.CARRIERS[name].is_missing]
    if not names:
        pytest.skip("needs pyzmq or cyclonedds: pip install pyzmq cyclonedds")
    for name in names:
        measured = control_round_trip.run(name, Places(), 0.1, 5)
        assert measured["back_to_back"]["lost"] == 0
