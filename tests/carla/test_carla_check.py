"""`lavt carla` against a stand-in server."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from tests.carla.stand_in import StandIn, stand_in

from lavt.cli.main import main

pytestmark = pytest.mark.full


@pytest.fixture(scope="module")
def server() -> Iterator[StandIn]:
    """Start a stand-in server that both commands share."""
    with stand_in("--scenery", "none", "--camera", "640", "480") as started:
        yield started


def run(monkeypatch: pytest.MonkeyPatch, *words: str) -> int:
    monkeypatch.setattr(sys, "argv", ["lavt", "carla", *words])
    with pytest.raises(SystemExit) as raised:
        main()
    return raised.value.code if isinstance(raised.value.code, int) else 0


def test_the_check_writes_a_log(
    server: StandIn, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The check drives, steers, brakes and takes pictures, passes with LAVT's own car, and removes everything."""
    monkeypatch.chdir(tmp_path)
    code = run(monkeypatch, "check", "127.0.0.1", "--port", str(server.port), "--set", "vehicle.carla.timeout_s=30.0")
    output = capsys.readouterr()
    assert code == 0, output
    log = json.loads((tmp_path / "carla-check.json").read_text())
    assert {check["name"] for check in log["checks"]} == {
        "stationary",
        "throttle",
        "brake",
        "steering side",
        "steering angle",
        "pictures",
    }
    assert log["wheelbase_m"] == pytest.approx(2.8448, abs=0.001)
    assert log["ticks"]["tick_p50_ms"] <= log["ticks"]["tick_p95_ms"]
    assert server.ask("actors") == ""


def test_calibration_finds_the_steering_ratio(
    server: StandIn, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """With a largest angle that is twice the true one, the calibration prints about the true one, 29.4 degrees."""
    changes = ("--set", "vehicle.carla.max_steering_deg=58.8", "--set", "vehicle.carla.timeout_s=30.0")
    options = ("--port", str(server.port), *changes)
    assert run(monkeypatch, "calibrate", "127.0.0.1", *options) == 0
    last = capsys.readouterr().out.splitlines()[-1]
    name, value = last.split(": ")
    assert name == "vehicle.carla.max_steering_deg"
    assert float(value) == pytest.approx(29.4, rel=0.05)
