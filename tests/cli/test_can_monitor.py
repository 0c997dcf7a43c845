"""`lavt can monitor`: a bus, or its log, in words or as JSON."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import can
import pytest

from lavt.build.dbw_bus import find_dbw
from lavt.cli import console
from lavt.cli.main import app
from lavt.config.dbw import DbwConfig
from lavt.errors import UserError

Run = Callable[..., tuple[int, str, str]]

LOG = """(1000.000000) can0 065#640000007D000001
(1000.500000) can0 067#0480
(1001.000000) can0 065#C80000007D000001
(1001.250000) can0 555#00
"""
"""Steering wheel at 10 and 20 degrees, 1.25 km/h; gear DRIVE; and a stranger."""


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Run:
    """Give a function that runs `lavt can` in this process: exit code, standard output, standard error."""

    def run_here(*arguments: str) -> tuple[int, str, str]:
        code = 0
        try:
            console.run_command(lambda: app(["can", *arguments], standalone_mode=False))
        except SystemExit as ended:
            code = int(ended.code or 0)
        said = capsys.readouterr()
        return code, said.out, said.err

    return run_here


@pytest.fixture
def log(tmp_path: Path) -> Path:
    path = tmp_path / "drive.log"
    path.write_text(LOG)
    return path


@contextmanager
def sending(message: can.Message) -> Iterator[None]:
    """Somebody who sends a message again and again on the virtual bus `monitored`."""
    ended = threading.Event()

    def send() -> None:
        with can.Bus(interface="virtual", channel="monitored", ignore_config=True) as bus:
            while not ended.wait(0.01):
                bus.send(message)

    sender = threading.Thread(target=send)
    sender.start()
    try:
        yield
    finally:
        ended.set()
        sender.join()


def test_log_in_words(run: Run, log: Path) -> None:
    """A log is told second by second and in all: what was said, what changed, what is wrong, who is unknown."""
    code, out, _ = run("monitor", "dataspeed_gen1", "--log", str(log))
    assert code == 0
    lines = out.splitlines()
    assert lines[2] == (
        "1 s  SteeringReport 0x065  2 times, 2.0 per s  ANGLE 20 deg, CMD 0, VEH_VEL 1.25 km/h, TORQUE 0 Nm, ENABLED"
        "  changed: ANGLE  WRONG: silent for 1000 ms, longer than 200 ms"
    )
    assert "in all, in 1.2 s:" in lines
    assert "  GearReport 0x067  1 times, 0.8 per s  STATE DRIVE, CMD NONE, REJECT 0, READY" in out
    assert lines[-1] == "  in no message of the DBC: 0x555 1 times"


def test_log_as_json(run: Run, log: Path) -> None:
    """Programs get a line of JSON for each second and one for the whole, every signal with unit and name."""
    code, out, _ = run("monitor", "dataspeed_gen1", "--log", str(log), "--json")
    second, summary = map(json.loads, out.splitlines())
    assert code == 0
    assert (list(second), list(summary)) == (["second"], ["summary"])
    assert summary["summary"]["unknown"] == {"0x555": 1}
    gear = next(each for each in summary["summary"]["messages"] if each["message"] == "GearReport")
    assert (gear["identifier"], gear["frames"]) == (0x067, 1)
    assert gear["signals"]["STATE"] == {"value": 4, "unit": "", "name": "DRIVE", "unverified": False}


def test_bus(run: Run, tmp_path: Path) -> None:
    """What is on a bus is told, and written as `candump -L` would, so that it can be told again."""
    written = tmp_path / "heard.log"
    with sending(can.Message(arbitration_id=0x067, data=b"\x01\x80", is_extended_id=False)):
        bus = ("--interface", "virtual", "--channel", "monitored")
        code, out, _ = run("monitor", "dataspeed_gen1", *bus, "--seconds", "1", "--json", "--write", str(written))
    assert code == 0
    (gear,) = (each for each in json.loads(out.splitlines()[-1])["summary"]["messages"] if each["frames"])
    assert gear["signals"]["STATE"]["name"] == "PARK"
    assert len(written.read_text().splitlines()) == gear["frames"] > 10
    code, out, _ = run("monitor", "dataspeed_gen1", "--log", str(written))
    assert f"GearReport 0x067  {gear['frames']} times" in out


def test_silent_bus(run: Run) -> None:
    """On a bus that nothing comes from, the reports that are missing are named, and the work has failed."""
    code, out, err = run("monitor", "--interface", "virtual", "--channel", "silent", "--seconds", "1")
    assert code == 1
    assert "SteerReport1 0x100  0 times, 0.0 of 100 per s  WRONG: never came" in out
    assert err == "lavt: no frame came on virtual silent\n"


def test_any_dbc(run: Run, log: Path, tmp_path: Path) -> None:
    """A DBC file alone will do."""
    dbc = tmp_path / "mine.dbc"
    dbc.write_text('VERSION ""\nBS_:\nBU_: A\nBO_ 1365 Stranger: 1 A\n SG_ FLAG : 0|8@1+ (2,0) [0|0] "m" A\n')
    code, out, _ = run("monitor", str(dbc), "--log", str(log))
    assert code == 0
    assert "Stranger 0x555  1 times, 0.8 per s  FLAG 0 m" in out


REFUSED = [
    (["nosuch"], "there is no profile 'nosuch'"),
    (["nosuch.yaml"], r"nosuch.yaml cannot be read"),
    (["--interface", "nosuch"], "there is no CAN interface nosuch"),
    (["--interface", "inside"], "can be heard by nobody else"),
    (["--option", "port"], "--option 'port' is not of the form name=value"),
    (["--log", "nosuch.log"], "nosuch.log cannot be read after 0 frames"),
    (["--dbc", "nosuch.dbc"], "nosuch.dbc cannot be read"),
    (["--interface", "virtual", "--write", "/nosuch/file"], "/nosuch/file cannot be written"),
]


@pytest.mark.parametrize(("arguments", "because"), REFUSED)
def test_refused(run: Run, arguments: list[str], because: str) -> None:
    """What was asked wrongly is said in one sentence."""
    code, out, err = run("monitor", *arguments)
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert because in err


def test_find_dbw(tmp_path: Path) -> None:
    """A server's config names the bus of its vehicle by wire; a profile's name or file names itself."""
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
