from __future__ import annotations

import json
import os
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from tests.support.command_line import Run

from lavt.clock import MachineClock
from lavt.domain import Now
from lavt.node import Message
from lavt.nodes.clock_sync import ClockSyncNode
from lavt.transport.clock_sync.clock_report import ClockReport
from lavt.transport.udp_link import UdpLink


@pytest.fixture
def port() -> Iterator[int]:
    """Run a server that answers probes with a clock correction of 0; return its port."""
    clock = MachineClock()
    node = ClockSyncNode(0)
    ((_, note_report),) = node.pipelines["clock_report"]
    ((_, answer_request),) = node.pipelines["probe_request"]
    report = ClockReport(0, 0, "here", "chrony", 0.0, 0.0001)
    note_report(Message("clock_report", report, clock.now()), clock.now())

    def answer(_channel: str, payload: Any, arrived: Now, peer: Any) -> None:
        for send in answer_request(Message("probe_request", payload, arrived, peer), clock.now()):
            link.send(send)

    link = UdpLink(clock, "probe_request", bind=("127.0.0.1", 0), name="probe")
    with closing(link):
        link.start(answer)
        yield link.port


def test_a_server_is_probed(port: int, run: Run) -> None:
    """For a server on this machine, Delta is at most the bound, which is half of the shortest round trip."""
    code, out, _ = run("clock", "--server", "localhost", "--port", str(port), "--seconds", "0.5", "--json")
    result = json.loads(out)
    assert abs(result["probe"]["ms"]) <= result["probe"]["bound_ms"] == result["round_trip_ms"] / 2
    assert code == (0 if result["good"] else 1)


def test_the_source_is_read_before_and_after_the_probing(
    port: int, run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The estimate uses the correction after the probing; the bound includes its change during the probing."""
    (tmp_path / "chronyc").write_text(
        "#!/bin/sh\n"
        "correction=0.0\n"
        "while read -r command; do\n"
        '  case "$command" in\n'
        "    tracking) echo 0A090001,10.9.0.1,9,1795292431.9,$correction,0,0,0,0,4.0,0.0002,0.00005,1.1,Normal;;\n"
        "    ntpdata) echo 501 Not authorised;;\n"
        "    *) echo Unrecognized command; correction=0.001;;\n"
        "  esac\n"
        "done\n"
    )
    (tmp_path / "chronyc").chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}{os.pathsep}{os.environ['PATH']}")
    result = json.loads(run("clock", "--server", "localhost", "--port", str(port), "--seconds", "0.1", "--json").out)
    assert result["clock"]["correction_s"] == 0.001
    half_delay_ms, dispersion_ms, server_bound_ms, change_ms = 0.1, 0.05, 0.1, 1.0
    bound_ms = half_delay_ms + dispersion_ms + server_bound_ms + change_ms
    assert result["sources"] == pytest.approx({"ms": 1.0, "bound_ms": bound_ms})


def test_options_set_an_external_source(port: int, run: Run) -> None:
    """With --source external, correction and bound are those of the options, and the server's bound is added."""
    external = ("--source", "external", "--correction-ms", "0.05", "--bound-ms", "0.1")
    probing = ("--server", "localhost", "--port", str(port), "--seconds", "0.1", "--json")
    code, out, _ = run("clock", *probing, *external)
    result = json.loads(out)
    assert result["clock"]["source"] == "external"
    own_bound_ms, server_bound_ms = 0.1, 0.1
    assert result["sources"] == pytest.approx({"ms": 0.05, "bound_ms": own_bound_ms + server_bound_ms})
    assert (code, result["good"]) == (0, True)


def test_no_server_answers(run: Run) -> None:
    """If no server answers, the command prints what to check and exits with 1."""
    result = run("clock", "--server", "127.0.0.1", "--port", "1", "--seconds", "0.1")
    assert (result.code, result.out) == (1, "")
    assert "127.0.0.1:1" in result.sentence()
    assert "`lavt server`" in result.err


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (("--server", "a" * 64), "--server"),
        (("--server", "localhost", "--port", "0"), "--port"),
        (("--server", "localhost", "--port", "70000"), "--port"),
        (("--seconds", "-1"), "--seconds"),
        (("--source", "sundial"), "--source"),
        (("--source", "external"), "correction_ms and bound_ms"),
        (("--source", "external", "--correction-ms", "nan", "--bound-ms", "1"), "'correction_ms'"),
        (("--source", "external", "--correction-ms", "1", "--bound-ms", "-1"), "'bound_ms'"),
        (("--bound-ms", "1"), "correction_ms and bound_ms"),
    ],
)
def test_bad_input(arguments: tuple[str, ...], reason: str, run: Run) -> None:
    """Unknown hosts, numbers out of range and contradictory options are rejected with exit code 2."""
    code, out, err = run("clock", *arguments)
    assert (code, out) == (2, "")
    assert reason in err


def test_a_machine_without_chrony(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without chronyc, the command prints what to install and exits with 1."""
    monkeypatch.setenv("PATH", "")
    code, out, err = run("clock")
    assert (code, err) == (1, "")
    assert "install chrony" in out
