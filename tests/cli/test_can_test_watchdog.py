"""Test that `lavt can test-watchdog` writes a proof only if the kit's watchdog brakes, and what the proof covers."""

from __future__ import annotations

import io
import json
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from tests.support.command_line import Run
from tests.support.ports import free_port
from tests.support.stalls import Stalls

from lavt.assembly.dbw import load_profile, shipped_profiles
from lavt.assembly.watchdog_proof import new_proof, proof_rejection
from lavt.clock import MachineClock
from lavt.config.dbw import DbwConfig
from lavt.config_file import shipped
from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.vehicle.dbw.watchdog_test import WatchdogObservation

SERVER = str(shipped("configs/server.yaml"))
MULTICAST_GROUP = "239.74.163.2"


@pytest.fixture
def run(run: Run) -> Run:
    """Return a function that runs `lavt can test-watchdog`."""
    return lambda *arguments: run("can", "test-watchdog", SERVER, *arguments)


def by_wire_options(profile: str, port: int = 0, **dbw_changes: str) -> list[str]:
    """Return the options that change the server's config to a by-wire car on a bus of its own."""
    dbw = {
        "profile": profile,
        "interface": "udp_multicast",
        "channel": MULTICAST_GROUP,
        "options": f"{{port: {port}}}",
        **dbw_changes,
    }
    changes = ["vehicle.kind=dbw", *(f"vehicle.dbw.{key}={value}" for key, value in dbw.items())]
    return [part for change in changes for part in ("--set", change)]


@contextmanager
def software_car(arguments: list[str], *commands: str) -> Iterator[None]:
    """Run a software car in a process of its own, and have it execute these console commands first."""
    with subprocess.Popen(
        [sys.executable, "-m", "lavt", "software-car", SERVER, *arguments, "--json"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        bufsize=1,
    ) as car:
        assert car.stdin is not None
        assert car.stdout is not None
        assert "ready" in car.stdout.readline()
        for command in commands:
            car.stdin.write(command + "\n")
            while json.loads(car.stdout.readline())["kind"] != "done":
                pass
        try:
            yield
        finally:
            car.terminate()
            car.communicate()


@pytest.fixture
def port() -> int:
    """Return a free UDP port."""
    return free_port()


@pytest.mark.realtime
@pytest.mark.judges_times
@pytest.mark.parametrize("profile", ["dataspeed_gen1", "dataspeed_gen2"])
def test_a_car_that_brakes_passes(run: Run, tmp_path: Path, port: int, profile: str) -> None:
    """A car that brakes without commands passes the test, and its proof applies to this bus and profile."""
    arguments = by_wire_options(profile, port, steering_sign="1")
    with software_car(arguments):
        code, out, err = run(*arguments, "--yes", "--json", "--out", "proof.json")
    assert (code, err) == (0, "")
    printed = json.loads(out)
    assert printed.pop("file") == "proof.json"
    written = json.loads((tmp_path / "proof.json").read_text())
    assert printed == written
    assert 100 <= written["release_ms"] <= written["braked_ms"] <= 500
    assert written["gear"] == "park"
    config = DbwConfig(profile=profile, interface="udp_multicast", channel=MULTICAST_GROUP, options={"port": port})
    assert proof_rejection("proof.json", load_profile(profile), config, MachineClock().now().wall_ns) == ""


@pytest.mark.realtime
@pytest.mark.parametrize("profile", ["dataspeed_gen1", "dataspeed_gen2"])
def test_a_car_that_does_not_brake_fails(run: Run, tmp_path: Path, port: int, profile: str, stalls: Stalls) -> None:
    """A car that does not brake fails the test, and any older proof is removed."""
    (tmp_path / "proof.json").write_text("an older proof")
    arguments = by_wire_options(profile, port, steering_sign="1")
    since_ns = MachineClock().now().mono_ns
    with software_car(arguments, "no_watchdog"):
        code, out, err = run(*arguments, "--yes", "--out", "proof.json")
    assert (code, out) == (1, "")
    assert not (tmp_path / "proof.json").exists()
    # Late reports or commands end the test with another message.
    with stalls.excusing_failures(since_ns):
        assert err.startswith("lavt: ")
        assert "500 ms" in err


def test_no_kit(run: Run, port: int) -> None:
    """Without a kit on the bus the test fails and names the missing report."""
    result = run(*by_wire_options("dataspeed_gen2", port), "--yes")
    assert (result.code, result.out) == (1, "")
    assert "SteerReport1" in result.sentence()


class Terminal(io.StringIO):
    """A terminal with typed input."""

    def isatty(self) -> bool:
        """Return True."""
        return True


@pytest.mark.parametrize("typed", ["no\n", "", "y\n"])
def test_without_confirmation_nothing_is_sent(
    run: Run, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, port: int, typed: str
) -> None:
    """Without a typed yes nothing is sent, and an older proof is kept."""
    (tmp_path / "watchdog_proof.json").write_text("an older proof")
    monkeypatch.setattr(sys, "stdin", Terminal(typed))
    code, out, err = run(*by_wire_options("dataspeed_gen2", port))
    assert (code, out) == (2, "")
    assert "wheels" in err
    assert err.splitlines()[-1].rpartition("lavt: ")[2]
    assert (tmp_path / "watchdog_proof.json").exists()


def test_confirmation_starts_the_test(run: Run, monkeypatch: pytest.MonkeyPatch, port: int) -> None:
    """A typed yes starts the test."""
    monkeypatch.setattr(sys, "stdin", Terminal("yes\n"))
    code, _, err = run(*by_wire_options("dataspeed_gen2", port))
    assert code == 1
    assert "SteerReport1" in err.splitlines()[-1]


REJECTED: list[tuple[list[str], str]] = [
    (["--set", "vehicle.kind=simulator"], "simulator"),
    (by_wire_options("dataspeed_gen2", interface="inside"), "inside"),
    (by_wire_options("dataspeed_gen2", interface="socketcan", channel="can0"), "socketcan can0"),
    (by_wire_options("nosuch"), "'nosuch'"),
    ([*by_wire_options("dataspeed_gen2", port=43999), "--yes", "--out", "/nosuch/proof.json"], "/nosuch/proof.json"),
    ([*by_wire_options("dataspeed_gen2", port=43999)], "prepared"),
]


@pytest.mark.parametrize(("arguments", "reason"), REJECTED, ids=[reason[:30] for _, reason in REJECTED])
def test_rejected(run: Run, monkeypatch: pytest.MonkeyPatch, arguments: list[str], reason: str) -> None:
    """An unsuitable vehicle, bus, profile or file, or no terminal for the confirmation, is rejected in one sentence.

    Nothing has been sent by then.
    """
    monkeypatch.setattr(sys, "stdin", io.StringIO("yes\n"))
    assert reason in run(*arguments).rejection()


CONFIG = DbwConfig(profile="dataspeed_gen2", interface="udp_multicast", channel=MULTICAST_GROUP)
PROFILE = load_profile("dataspeed_gen2")
WALL_NS = 1_790_000_000 * NS_PER_S


def write_proof(tmp_path: Path, **changes: Any) -> str:
    """Write a proof for generation 2 with some changed fields; return its path."""
    observation = WatchdogObservation(
        released_ns=100 * NS_PER_MS, braked_ns=120 * NS_PER_MS, reports=49, kit_messages=""
    )
    fields = new_proof(observation, "park", PROFILE, CONFIG, WALL_NS).model_dump() | changes
    path = tmp_path / "proof.json"
    path.write_text(json.dumps(fields))
    return str(path)


INVALID: list[tuple[dict[str, Any], str]] = [
    ({"digest": "0" * 64}, "another profile or DBC"),
    ({"commands": "user"}, "another set of commands"),
    ({"channel": "239.74.163.3"}, "another bus"),
    ({"options": {"port": 4}}, "another bus"),
    ({"is_virtual": False}, "another bus"),
    ({"braked_ms": 501.0}, "501 ms"),
    ({"car": "another"}, "another car"),
    ({"at": "2001-01-01T00:00:00+00:00"}, "vehicle.dbw.watchdog_proof_days"),
    ({"at": "2201-01-01T00:00:00+00:00"}, "future"),
    ({"at": "2026-09-21T14:13:20"}, "no date"),
    ({"at": "yesterday"}, "no date"),
    ({"reports": 1}, "1 reports"),
    ({"version": 1}, "version"),
    ({"release_ms": -1}, "release_ms"),
    ({"surprise": 1}, "surprise"),
]


@pytest.mark.parametrize(("changes", "reason"), INVALID, ids=[next(iter(changes)) for changes, _ in INVALID])
def test_invalid_proof(tmp_path: Path, changes: dict[str, Any], reason: str) -> None:
    """A proof for another setup, of a car that braked too late, or with an invalid field is rejected with a reason."""
    assert proof_rejection(write_proof(tmp_path), PROFILE, CONFIG, WALL_NS) == ""
    assert reason in proof_rejection(write_proof(tmp_path, **changes), PROFILE, CONFIG, WALL_NS)


def test_a_proof_expires(tmp_path: Path) -> None:
    """A proof applies for the configured number of days."""
    path, day_ns = write_proof(tmp_path), 86_400 * NS_PER_S
    assert proof_rejection(path, PROFILE, CONFIG, WALL_NS + 30 * day_ns) == ""
    assert "30" in proof_rejection(path, PROFILE, CONFIG, WALL_NS + 31 * day_ns)
    longer = CONFIG.model_copy(update={"watchdog_proof_days": 60})
    assert proof_rejection(path, PROFILE, longer, WALL_NS + 31 * day_ns) == ""


def test_no_proof(tmp_path: Path) -> None:
    """Without a readable proof, the rejection names the command that writes one."""
    assert proof_rejection("", PROFILE, CONFIG, WALL_NS).endswith("vehicle.dbw.watchdog_proof")
    path = tmp_path / "proof.json"
    for text in (None, "", "[]", "[" * 100_000, "\xff", '{"version": 1}'):
        if text is not None:
            path.write_text(text, "latin-1")
        assert proof_rejection(str(path), PROFILE, CONFIG, WALL_NS).endswith("`lavt can test-watchdog`")


def test_changed_profile_or_dbc(tmp_path: Path) -> None:
    """A proof does not apply after a change of the profile or its DBC."""
    source = shipped_profiles()["dataspeed_gen2"]
    mine, dbc = tmp_path / "mine.yaml", tmp_path / "dataspeed_gen2.dbc"
    mine.write_text(source.read_text())
    dbc.write_text(source.with_suffix(".dbc").read_text())
    config = CONFIG.model_copy(update={"profile": str(mine)})
    path = write_proof(tmp_path)  # of the shipped profile, whose bytes are equal
    assert proof_rejection(path, PROFILE, config, WALL_NS) == ""
    dbc.write_text(dbc.read_text() + "\n")
    assert "another profile or DBC" in proof_rejection(path, PROFILE, config, WALL_NS)
