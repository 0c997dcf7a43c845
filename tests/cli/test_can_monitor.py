"""Test that `lavt can monitor` decodes a bus or a log, and prints text or JSON."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import can
import pytest
from tests.support.command_line import Run

from lavt.assembly.dbw import find_dbw
from lavt.config.dbw import DbwConfig
from lavt.errors import UserError

LOG = """(1000.000000) can0 065#640000007D000001
(1000.500000) can0 067#0480
(1001.000000) can0 065#C80000007D000001
(1001.250000) can0 555#00
"""
"""Steering wheel at 10 and then 20 degrees at 1.25 km/h, gear DRIVE, and an unknown message."""


@pytest.fixture
def run(run: Run) -> Run:
    """Return a function that runs `lavt can`."""
    return lambda *arguments: run("can", *arguments)


@pytest.fixture
def log(tmp_path: Path) -> Path:
    path = tmp_path / "drive.log"
    path.write_text(LOG)
    return path


@contextmanager
def sending(message: can.Message) -> Iterator[None]:
    """Send a message every 10 ms on the virtual bus `monitored` until the context ends."""
    is_over = threading.Event()

    def send() -> None:
        with can.Bus(interface="virtual", channel="monitored", ignore_config=True) as bus:
            while not is_over.wait(0.01):
                bus.send(message)

    sender = threading.Thread(target=send)
    sender.start()
    try:
        yield
    finally:
        is_over.set()
        sender.join()


def test_log_as_text(run: Run, log: Path) -> None:
    """A log is printed second by second and as a summary: values, changes, errors and unknown messages."""
    code, out, _ = run("monitor", "dataspeed_gen1", "--log", str(log))
    assert code == 0
    lines = out.splitlines()
    for part in ("SteeringReport 0x065  2 times", "ANGLE 20 deg", "VEH_VEL 1.25 km/h", "changed: ANGLE", "1000 ms"):
        assert part in lines[2]
    (gear,) = (line for line in lines if line.startswith("  GearReport 0x067  1 times, "))
    assert "STATE DRIVE" in gear
    assert "0x555 1 times" in lines[-1]


def test_log_as_json(run: Run, log: Path) -> None:
    """As JSON, a log has one line per second and a summary, with the unit and name of each signal."""
    code, out, _ = run("monitor", "dataspeed_gen1", "--log", str(log), "--json")
    second, summary = map(json.loads, out.splitlines())
    assert code == 0
    assert (list(second), list(summary)) == (["second"], ["summary"])
    assert summary["summary"]["unknown"] == {"0x555": 1}
    gear = next(message for message in summary["summary"]["messages"] if message["message"] == "GearReport")
    assert (gear["identifier"], gear["frames"]) == (0x067, 1)
    assert gear["signals"]["STATE"] == {"value": 4, "unit": "", "name": "DRIVE", "unverified": False}


def test_bus(run: Run, tmp_path: Path) -> None:
    """Frames on a bus are printed, and written to a log that can be read again."""
    log_file = tmp_path / "received.log"
    with sending(can.Message(arbitration_id=0x067, data=b"\x01\x80", is_extended_id=False)):
        bus = ("--interface", "virtual", "--channel", "monitored")
        code, out, _ = run("monitor", "dataspeed_gen1", *bus, "--seconds", "1", "--json", "--write", str(log_file))
    assert code == 0
    (gear,) = (message for message in json.loads(out.splitlines()[-1])["summary"]["messages"] if message["frames"])
    assert gear["signals"]["STATE"]["name"] == "PARK"
    assert len(log_file.read_text().splitlines()) == gear["frames"] > 10
    code, out, _ = run("monitor", "dataspeed_gen1", "--log", str(log_file))
    assert f"GearReport 0x067  {gear['frames']} times" in out


def test_silent_bus(run: Run) -> None:
    """On a silent bus the missing reports are named, and the exit code is 1."""
    result = run("monitor", "--interface", "virtual", "--channel", "silent", "--seconds", "1")
    assert result.code == 1
    assert "SteerReport1 0x100  0 times, 0.0 of 100 per s  WRONG: " in result.out
    assert "virtual silent" in result.sentence()


def test_any_dbc(run: Run, log: Path, tmp_path: Path) -> None:
    """A DBC file without a profile is enough to decode a bus."""
    dbc = tmp_path / "mine.dbc"
    dbc.write_text('VERSION ""\nBS_:\nBU_: A\nBO_ 1365 Stranger: 1 A\n SG_ FLAG : 0|8@1+ (2,0) [0|0] "m" A\n')
    code, out, _ = run("monitor", str(dbc), "--log", str(log))
    assert code == 0
    assert "Stranger 0x555  1 times, 0.8 per s  FLAG 0 m" in out


REJECTED = [
    (["nosuch"], "'nosuch'"),
    (["nosuch.yaml"], "nosuch.yaml"),
    (["--interface", "nosuch"], "nosuch"),
    (["--interface", "inside"], "inside"),
    (["--option", "port"], "--option 'port'"),
    (["--log", "nosuch.log"], "nosuch.log"),
    (["--dbc", "nosuch.dbc"], "nosuch.dbc"),
    (["--interface", "virtual", "--write", "/nosuch/file"], "/nosuch/file"),
]


@pytest.mark.parametrize(("arguments", "reason"), REJECTED)
def test_rejected(run: Run, arguments: list[str], reason: str) -> None:
    """Invalid input is rejected in one sentence."""
    assert reason in run("monitor", *arguments).rejection()


def test_find_dbw(tmp_path: Path) -> None:
    """A target is a server config with a by-wire vehicle, or the name or file of a profile."""
    config = tmp_path / "server.yaml"
    config.write_text("vehicle:\n  kind: dbw\n  dbw: {profile: dataspeed_gen1, channel: vcan3}\n")
    assert find_dbw(str(config)) == DbwConfig(profile="dataspeed_gen1", channel="vcan3")
    profile = tmp_path / "mine.yaml"
    profile.write_text("kit: dataspeed_1\n")
    assert find_dbw(str(profile)) == DbwConfig(profile=str(profile))
    assert find_dbw("dataspeed_gen2:user") == DbwConfig(profile="dataspeed_gen2:user")
    for text in ("vehicle: {kind: simulator}\n", "vehicle: 3\n", "vehicle: {kind: simulator, dbw: {}}\n"):
        config.write_text(text)
        with pytest.raises(UserError, match="has no vehicle of kind dbw"):
            find_dbw(str(config))
