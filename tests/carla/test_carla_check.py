"""`lavt carla` against a stand-in server."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from tests.carla.stand_in import StandIn, stand_in

from lavt.cli import carla as carla_command
from lavt.cli.main import main
from lavt.vehicle.carla import session
from lavt.vehicle.carla.check import CarlaCheck
from lavt.vehicle.contract import CHECKS

pytestmark = pytest.mark.full


PICTURE = ("320", "240")
SIZE = ("--set", f"camera.width_px={PICTURE[0]}", "--set", f"camera.height_px={PICTURE[1]}")
TIMEOUT = ("--set", "vehicle.carla.timeout_s=30.0")
ITEMS = [
    "connection",
    *(f"contract: {name}" for name in CHECKS),
    "stationary",
    "throttle",
    "brake",
    "steering side",
    "steering angle",
    "pictures and latency",
    "drive of the lane keeper",
]


@pytest.fixture(scope="module")
def server() -> Iterator[StandIn]:
    """Start a stand-in server that the commands share."""
    with stand_in("--scenery", "none", "--camera", *PICTURE) as started:
        yield started


def run(monkeypatch: pytest.MonkeyPatch, *words: str) -> int:
    monkeypatch.setattr(sys, "argv", ["lavt", "carla", *words])
    with pytest.raises(SystemExit) as raised:
        main()
    return raised.value.code if isinstance(raised.value.code, int) else 0


def kill(server: StandIn) -> list[CarlaCheck]:
    server.kill()
    return []


def outcomes(log: dict[str, Any]) -> dict[str, bool | None]:
    return {item["name"]: item["passed"] for item in log["checks"]}


def test_the_check_writes_a_log(
    server: StandIn, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """With LAVT's own car all items pass, among them the contract and a drive of the lane keeper; nothing is left."""
    monkeypatch.chdir(tmp_path)
    options = ("--port", str(server.port), *SIZE, *TIMEOUT, "--set", "vehicle.time_limit_s=6")
    code = run(monkeypatch, "check", "127.0.0.1", *options)
    output = capfd.readouterr()
    assert code == 0, output
    log = json.loads((tmp_path / "carla-check" / "log.json").read_text())
    assert outcomes(log) == dict.fromkeys(ITEMS, True)
    assert [line[:7] for line in output.out.splitlines()[:-1]] == ["passed "] * len(ITEMS)
    assert log["wheelbase_m"] == pytest.approx(2.8448, abs=0.001)
    assert log["ticks"]["tick_p50_ms"] <= log["ticks"]["tick_p95_ms"]
    assert 0 < log["ticks"]["request_p50_ms"] <= log["ticks"]["request_p95_ms"]
    assert log["drive"]["ending"] == "timeout"
    assert (tmp_path / "carla-check" / "drive" / "server.mcap").is_file()
    assert server.ask("actors") == ""


def test_failed_items_and_items_that_were_not_run_are_named(
    server: StandIn, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """A wrong steering ratio fails its items, and a route that is not in the town is not run; the log has all of it."""
    changes = ("--set", "vehicle.carla.max_steering_deg=58.8", "--set", "vehicle.route=c")
    out = tmp_path / "out"
    options = ("--port", str(server.port), *SIZE, *TIMEOUT, *changes, "--out", str(out))
    assert run(monkeypatch, "check", "127.0.0.1", *options) == 1
    printed = capfd.readouterr().out
    found = outcomes(json.loads((out / "log.json").read_text()))
    assert {name for name, passed in found.items() if passed is False} == {
        "contract: follows commands",
        "steering angle",
    }
    assert {name for name, passed in found.items() if passed is None} == {"drive of the lane keeper"}
    assert re.search(r"FAILED   steering angle: the driven angle is 0\.(49|50)", printed), printed
    assert "not run  drive of the lane keeper: the start, x " in printed
    assert server.ask("actors") == ""


def test_a_server_that_dies_during_the_check_still_gives_a_log(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """If the server is killed, the items after that fail or are not run, with reasons, and the log is written."""
    with stand_in("--scenery", "none", "--camera", *PICTURE) as server:
        monkeypatch.setattr(session, "CLOSE_TIMEOUT_S", 0.2)  # it cannot answer
        monkeypatch.setitem(carla_command.STAGES, "contract", lambda *_: kill(server))
        options = ("--port", str(server.port), *SIZE, "--set", "vehicle.carla.tick_timeout_s=1.0")
        out = tmp_path / "out"
        assert run(monkeypatch, "check", "127.0.0.1", *options, *TIMEOUT, "--out", str(out)) == 1
    assert "FAILED   driving: the CARLA server at 127.0.0.1" in capfd.readouterr().out
    found = outcomes(json.loads((out / "log.json").read_text()))
    failed = {"driving": False, "steering": False, "pictures and latency": None, "drive of the lane keeper": None}
    assert found == {"connection": True, **failed}


def test_calibration_finds_the_steering_ratio(
    server: StandIn, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """With a largest angle that is twice the true one, the calibration prints about the true one, 29.4 degrees."""
    options = ("--port", str(server.port), "--set", "vehicle.carla.max_steering_deg=58.8", *TIMEOUT)
    assert run(monkeypatch, "calibrate", "127.0.0.1", *options) == 0
    last = capfd.readouterr().out.splitlines()[-1]
    name, value = last.split(": ")
    assert name == "vehicle.carla.max_steering_deg"
    assert float(value) == pytest.approx(29.4, rel=0.05)
