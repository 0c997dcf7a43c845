"""`lavt can prove`: a file that says that the kit's watchdog brakes, only where it does; and what the file is worth."""

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
from lavt.assembly.dbw_proof import check_proof, proof_of
from lavt.clock import MachineClock
from lavt.config.dbw import DbwConfig
from lavt.config_file import shipped
from lavt.domain import NS_PER_MS
from lavt.vehicle.dbw.watchdog_test import WatchdogObservation

SERVER = str(shipped("configs/server.yaml"))
GROUP = "239.74.163.2"


@pytest.fixture
def run(run: Run) -> Run:
    """Return a function that runs `lavt can prove`."""
    return lambda *arguments: run("can", "prove", SERVER, *arguments)


def changes(profile: str, port: int = 0, **others: str) -> list[str]:
    """What makes the server's config one of a by-wire car on a bus of its own."""
    dbw = {
        "profile": profile,
        "interface": "udp_multicast",
        "channel": GROUP,
        "options": f"{{port: {port}}}",
        **others,
    }
    all_changes = ["vehicle.kind=dbw", *(f"vehicle.dbw.{key}={value}" for key, value in dbw.items())]
    return [part for change in all_changes for part in ("--set", change)]


@contextmanager
def software_car(arguments: list[str], *words: str) -> Iterator[None]:
    """A software car in a process of its own, to which words were said."""
    with subprocess.Popen(
        [sys.executable, "-m", "lavt", "software-car", SERVER, *arguments, "--json"],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, bufsize=1,
    ) as car:  # fmt: skip
        assert car.stdin is not None
        assert car.stdout is not None
        assert "ready" in car.stdout.readline()
        for word in words:
            car.stdin.write(word + "\n")
            while json.loads(car.stdout.readline())["kind"] != "done":
                pass
        try:
            yield
        finally:
            car.terminate()
            car.communicate()


@pytest.fixture
def port() -> int:
    """A free UDP port."""
    return free_port()


@pytest.mark.realtime
@pytest.mark.judges_times
@pytest.mark.parametrize("profile", ["dataspeed_gen1", "dataspeed_gen2"])
def test_proved(run: Run, tmp_path: Path, port: int, profile: str) -> None:
    """A car that brakes when it is left alone is proved, and its file counts for this bus and profile."""
    arguments = changes(profile, port, steering_sign="1")
    with software_car(arguments):
        code, out, err = run(*arguments, "--yes", "--json", "--out", "proof.json")
    assert (code, err) == (0, "")
    told = json.loads(out)
    assert told.pop("file") == "proof.json"
    written = json.loads((tmp_path / "proof.json").read_text())
    assert told == written
    assert 100 <= written["release_ms"] <= written["braked_ms"] <= 500
    assert written["gear"] == "park"
    config = DbwConfig(profile=profile, interface="udp_multicast", channel=GROUP, options={"port": port})
    assert check_proof("proof.json", load_profile(profile), config) == ""


@pytest.mark.realtime
@pytest.mark.parametrize("profile", ["dataspeed_gen1", "dataspeed_gen2"])
def test_not_proved(run: Run, tmp_path: Path, port: int, profile: str, stalls: Stalls) -> None:
    """A car that does not brake is said, and leaves no file, not even that of another day."""
    (tmp_path / "proof.json").write_text("of another day")
    arguments = changes(profile, port, steering_sign="1")
    since_ns = MachineClock().now().mono_ns
    with software_car(arguments, "no_watchdog"):
        code, out, err = run(*arguments, "--yes", "--out", "proof.json")
    assert (code, out) == (1, "")
    assert not (tmp_path / "proof.json").exists()
    with stalls.judging(since_ns):  # reports that are late end it with another sentence
        assert err.startswith("lavt: ")
        assert "500 ms" in err


def test_nobody_there(run: Run, port: int) -> None:
    """A bus without a kit is said, and nothing is proved."""
    ended = run(*changes("dataspeed_gen2", port), "--yes")
    assert (ended.code, ended.out) == (1, "")
    assert "SteerReport1" in ended.sentence()


class Terminal(io.StringIO):
    """A terminal on which something was typed."""

    def isatty(self) -> bool:
        """It is one."""
        return True


@pytest.mark.parametrize("typed", ["no\n", "", "y\n"])
def test_requested(run: Run, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, port: int, typed: str) -> None:
    """Without a yes nothing is sent, and an older proof is left alone."""
    (tmp_path / "watchdog_proof.json").write_text("of another day")
    monkeypatch.setattr(sys, "stdin", Terminal(typed))
    code, out, err = run(*changes("dataspeed_gen2", port))
    assert (code, out) == (2, "")
    assert "wheels" in err
    assert err.splitlines()[-1].rpartition("lavt: ")[2]
    assert (tmp_path / "watchdog_proof.json").exists()


def test_requested_and_yes(run: Run, monkeypatch: pytest.MonkeyPatch, port: int) -> None:
    """With a yes it begins."""
    monkeypatch.setattr(sys, "stdin", Terminal("yes\n"))
    code, _, err = run(*changes("dataspeed_gen2", port))
    assert code == 1
    assert "reports are missing" in err


REJECTED: list[tuple[list[str], str]] = [
    (["--set", "vehicle.kind=simulator"], "simulator"),
    (changes("dataspeed_gen2", interface="inside"), "inside"),
    (changes("dataspeed_gen2", interface="socketcan", channel="can0"), "socketcan can0"),
    (changes("nosuch"), "'nosuch'"),
    ([*changes("dataspeed_gen2", port=43999), "--yes", "--out", "/nosuch/proof.json"], "/nosuch/proof.json"),
    ([*changes("dataspeed_gen2", port=43999)], "prepared"),
]


@pytest.mark.parametrize(("arguments", "reason"), REJECTED, ids=[each[1][:30] for each in REJECTED])
def test_rejected(run: Run, monkeypatch: pytest.MonkeyPatch, arguments: list[str], reason: str) -> None:
    """What cannot be proved, or must not be tried, is refused in one sentence before anything is sent."""
    monkeypatch.setattr(sys, "stdin", io.StringIO("yes\n"))
    assert reason in run(*arguments).rejected()


CONFIG = DbwConfig(profile="dataspeed_gen2", interface="udp_multicast", channel=GROUP)
PROFILE = load_profile("dataspeed_gen2")


def proof(tmp_path: Path, **others: Any) -> str:
    """A proof of generation 2, with something changed."""
    seen = WatchdogObservation(released_ns=100 * NS_PER_MS, braked_ns=120 * NS_PER_MS, reports=49, kit_messages="")
    made = proof_of(seen, "park", PROFILE, CONFIG, 0).model_dump() | others
    path = tmp_path / "proof.json"
    path.write_text(json.dumps(made))
    return str(path)


WORTHLESS: list[tuple[dict[str, Any], str]] = [
    ({"digest": "0" * 64}, "another profile or DBC"),
    ({"commands": "user"}, "another set of commands"),
    ({"channel": "239.74.163.3"}, "another bus"),
    ({"options": {"port": 4}}, "another bus"),
    ({"is_virtual": False}, "another bus"),
    ({"braked_ms": 501.0}, "501 ms"),
    ({"version": 2}, "is not proved"),
    ({"release_ms": -1}, "is not proved"),
    ({"surprise": 1}, "is not proved"),
]


@pytest.mark.parametrize(("others", "reason"), WORTHLESS, ids=[next(iter(each[0])) for each in WORTHLESS])
def test_worthless(tmp_path: Path, others: dict[str, Any], reason: str) -> None:
    """A proof of something else, or of too little, does not count, and the sentence says why."""
    assert check_proof(proof(tmp_path), PROFILE, CONFIG) == ""
    assert reason in check_proof(proof(tmp_path, **others), PROFILE, CONFIG)


def test_no_file(tmp_path: Path) -> None:
    """Where there is no proof, or a file that is none, the sentence says what makes one."""
    assert check_proof("", PROFILE, CONFIG).endswith("vehicle.dbw.watchdog_proof")
    path = tmp_path / "proof.json"
    for text in (None, "", "[]", "[" * 100_000, "\xff", '{"version": 1}'):
        if text is not None:
            path.write_text(text, "latin-1")
        assert check_proof(str(path), PROFILE, CONFIG).endswith("`lavt can prove`")


def test_changed_since(tmp_path: Path) -> None:
    """A profile or DBC that was changed since the proof was made needs another."""
    source = shipped_profiles()["dataspeed_gen2"]
    mine, dbc = tmp_path / "mine.yaml", tmp_path / "dataspeed_gen2.dbc"
    mine.write_text(source.read_text())
    dbc.write_text(source.with_suffix(".dbc").read_text())
    config = CONFIG.model_copy(update={"profile": str(mine)})
    path = proof(tmp_path)  # of the shipped one: the same bytes
    assert check_proof(path, PROFILE, config) == ""
    dbc.write_text(dbc.read_text() + "\n")
    assert "another profile or DBC" in check_proof(path, PROFILE, config)
