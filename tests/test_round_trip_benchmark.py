from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
from benchmarks import control_round_trip
from benchmarks.round_trip import carriers
from benchmarks.round_trip.process import command

from lavt.domain import Command
from lavt.runtime import process_priority
from lavt.transport.messages import decode

PROGRAM = Path(control_round_trip.__file__)


def measurement(p50_us: float) -> control_round_trip.PaceResults:
    times = {"p50_us": p50_us, "p95_us": 2 * p50_us, "p99_us": 4 * p50_us, "lost": 0.0}
    return {"at_50_hz": times, "back_to_back": times}


def test_a_real_command_is_sent() -> None:
    """The message of the benchmark is a valid command of about 200 bytes."""
    assert decode(Command, command(7)).sequence == 7
    assert 150 < len(command(7)) < 250


def test_medians_over_rounds_and_ratios_to_raw_udp() -> None:
    """The summary has medians over the rounds, and their ratios to those of raw UDP."""
    summary = control_round_trip.summary(
        {"udp": [measurement(10), measurement(20), measurement(30)], "zenoh": [measurement(50)]}
    )
    assert summary["udp"]["at_50_hz"]["p50_us"] == 20
    assert summary["udp"]["at_50_hz"]["p50_ratio"] == 1
    assert summary["zenoh"]["back_to_back"]["p99_us"] == 200
    assert summary["zenoh"]["back_to_back"]["p99_ratio"] == 2.5


def test_without_raw_udp_there_are_no_ratios() -> None:
    """A carrier that is measured without raw UDP has times only."""
    assert set(control_round_trip.summary({"zenoh": [measurement(50)]})["zenoh"]["at_50_hz"]) == set(
        measurement(1)["at_50_hz"]
    )


def test_lost_echoes_are_counted() -> None:
    """A lost echo is counted and is not part of the percentiles."""
    times = control_round_trip.percentiles("udp", [1000, None, 3000])
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
def test_the_control_benchmark_runs() -> None:
    """`benchmarks/control_round_trip.py` measures a command's round trip over raw UDP and through two routers."""
    completed = subprocess.run(
        [sys.executable, PROGRAM, "--only", "udp", "--only", "zenoh", "--rounds", "1", "--seconds", "1"],
        capture_output=True,
        text=True,
        check=False,
        timeout=200,
    )
    assert completed.returncode == 0, completed.stderr
    result = json.loads(completed.stdout.splitlines()[-1])
    assert list(result) == ["udp", "zenoh"]
    for pace in ("at_50_hz", "back_to_back"):
        assert result["udp"][pace]["p50_us"] > 0
        assert result["zenoh"][pace]["p50_ratio"] > 0
    assert "| Zenoh " in completed.stdout


def test_an_installed_carrier_returns_the_echo() -> None:
    """Pyzmq and CycloneDDS, if installed, return the echo of every command."""
    names = [name for name, carrier in carriers.CARRIERS.items() if carrier.module and not carrier.missing]
    if not names:
        pytest.skip("needs pyzmq or cyclonedds: pip install pyzmq cyclonedds")
    for name in names:
        measured = control_round_trip.run(name, ("", ""), 0.1, 5)
        assert measured["back_to_back"]["lost"] == 0
