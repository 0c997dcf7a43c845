from __future__ import annotations

import configparser
import re
import shutil
import subprocess
from pathlib import Path

import pytest
from tests.kernel.lane.chrony import SERVE_OWN_CLOCK, follow_server
from tests.require import need
from typer.testing import CliRunner

from lavt.cli.main import app
from lavt.runtime import process_priority

DEPLOY = Path(__file__).resolve().parents[2] / "deploy"
UNITS = sorted((DEPLOY / "systemd").glob("*.service"))
PROGRAM = "/opt/lavt/.venv/bin/lavt"


def unit(path: Path) -> configparser.ConfigParser:
    parsed = configparser.ConfigParser(interpolation=None)
    parsed.optionxform = str  # type: ignore[assignment,method-assign]  # systemd's names have capitals
    parsed.read(path)
    return parsed


def lines(path: Path) -> list[str]:
    return [line for line in path.read_text().splitlines() if line and not line.startswith("#")]


@pytest.mark.parametrize("path", UNITS, ids=lambda path: path.name)
def test_units_start_commands_that_exist(path: Path) -> None:
    """Each unit starts a command of lavt, with options that the command has, and a file in /etc/lavt."""
    program, command, *arguments = unit(path)["Service"]["ExecStart"].split()
    assert program == PROGRAM
    helped = CliRunner().invoke(app, [command, "--help"])
    assert helped.exit_code == 0
    options = [each for each in arguments if each.startswith("-")]
    assert all(option in helped.output for option in options)
    (file,) = [each for each in arguments if each not in options]
    assert re.fullmatch(r"/etc/lavt/\w+\.(yaml|json5)", file)


@pytest.mark.parametrize("path", UNITS, ids=lambda path: path.name)
def test_units_are_understood_by_systemd(path: Path, tmp_path: Path) -> None:
    """Systemd finds nothing to say about a unit, whose program is put in place of the one at its documented path."""
    if shutil.which("systemd-analyze") is None:
        need("systemd", "needs systemd-analyze: apt-get install systemd")
    for each in UNITS:  # they name each other
        (tmp_path / each.name).write_text(each.read_text().replace(PROGRAM, shutil.which("true") or "/bin/true"))
    command = ["systemd-analyze", "verify", "--man=no", str(tmp_path / path.name)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


@pytest.mark.parametrize("path", UNITS, ids=lambda path: path.name)
def test_units_run_as_a_user_of_their_own(path: Path) -> None:
    """No unit runs as root or keeps a root's right, and each may take the precedence that LAVT asks for."""
    service = unit(path)["Service"]
    assert (service["User"], service["Group"]) == ("lavt", "lavt")
    assert (service["CapabilityBoundingSet"], service["NoNewPrivileges"]) == ("", "yes")
    requested = process_priority.OF_THE_CAR if path.name == "lavt-server.service" else process_priority.NICENESS
    assert service["LimitNICE"] == str(requested)


def test_the_directory_of_the_socket() -> None:
    """/run/lavt is the router's and stays when it ends: no other unit's end takes away the socket, one user's."""
    assert [path.name for path in UNITS if "RuntimeDirectory" in unit(path)["Service"]] == ["lavt-router.service"]
    service = unit(DEPLOY / "systemd/lavt-router.service")["Service"]
    assert (service["RuntimeDirectory"], service["RuntimeDirectoryMode"]) == ("lavt", "0750")
    assert service["RuntimeDirectoryPreserve"] == "yes"
    assert service["UMask"] == "0077"


def test_who_drives_is_started_by_a_person() -> None:
    """Router, rendezvous and server start again after a failure and at boot; a client does neither."""
    restarts = {path.name: unit(path)["Service"]["Restart"] for path in UNITS}
    assert restarts == {
        "lavt-client.service": "no", "lavt-rendezvous.service": "on-failure", "lavt-router.service": "on-failure",
        "lavt-server.service": "on-failure",
    }  # fmt: skip
    assert "Install" not in unit(DEPLOY / "systemd/lavt-client.service")


def test_chrony_is_told_what_was_measured() -> None:
    """The lines for chrony are those with which the tests on a real kernel measure, but for the addresses."""
    serve, allow = SERVE_OWN_CLOCK
    assert lines(DEPLOY / "chrony/vehicle.conf") == [serve, f"{allow} 192.0.2.0/24"]
    assert lines(DEPLOY / "chrony/operator.conf") == [follow_server("192.0.2.7").replace(" port 123", "")]


def test_the_documentation_names_what_exists() -> None:
    """Every command and every file of the repository that docs/deployment.md names is there."""
    text = (DEPLOY.parent / "docs/deployment.md").read_text()
    commands = set(re.findall(r"(?:^ {4}|`|/|&& )lavt ([a-z]+)\b", text, re.MULTILINE))
    assert commands >= {"doctor", "keys", "router", "server", "client", "stop", "clock", "join", "report"}
    assert commands <= {each.name for each in app.registered_commands}
    files = set(re.findall(r"(?<![\w/])(?:configs|zenoh-configs|deploy)/[\w./-]*\w", text))
    assert len(files) > 12
    assert {file for file in files if not (DEPLOY.parent / file).exists()} == set()
    links = set(re.findall(r"\]\(([\w.]+\.md)", text))
    assert {link for link in links if not (DEPLOY.parent / "docs" / link).exists()} == set()
