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

from lavt.cli.main import build_app
from lavt.runtime import process_priority

DEPLOY = Path(__file__).resolve().parents[2] / "deploy"
UNITS = sorted((DEPLOY / "systemd").glob("*.service"))
PROGRAM = "/opt/lavt/.venv/bin/lavt"


def read_unit(path: Path) -> configparser.ConfigParser:
    parsed = configparser.ConfigParser(interpolation=None)
    parsed.optionxform = str  # type: ignore[assignment,method-assign]  # keeps the capitals in systemd's names
    parsed.read(path)
    return parsed


def config_lines(path: Path) -> list[str]:
    return [line for line in path.read_text().splitlines() if line and not line.startswith("#")]


def test_the_servers_unit_allows_can() -> None:
    """The server may open a CAN socket, for a vehicle by wire; no other unit may."""
    allowed = {path.name: read_unit(path)["Service"]["RestrictAddressFamilies"].split() for path in UNITS}
    assert [name for name, families in allowed.items() if "AF_CAN" in families] == ["lavt-server.service"]


@pytest.mark.parametrize("path", UNITS, ids=lambda path: path.name)
def test_units_start_existing_commands(path: Path) -> None:
    """Each unit starts an existing command of lavt with existing options and a file in /etc/lavt."""
    program, command, *arguments = read_unit(path)["Service"]["ExecStart"].split()
    assert program == PROGRAM
    help_result = CliRunner().invoke(build_app(), [command, "--help"])
    assert help_result.exit_code == 0
    options = [word for word in arguments if word.startswith("-")]
    assert all(option in help_result.output for option in options)
    (file,) = [word for word in arguments if word not in options]
    assert re.fullmatch(r"/etc/lavt/\w+\.(yaml|json5)", file)


@pytest.mark.parametrize("path", UNITS, ids=lambda path: path.name)
def test_units_are_valid_for_systemd(path: Path, tmp_path: Path) -> None:
    """systemd-analyze accepts each unit, with an existing program in place of the documented path."""
    if shutil.which("systemd-analyze") is None:
        need("systemd", "needs systemd-analyze: apt-get install systemd")
    for unit in UNITS:  # the units refer to each other
        (tmp_path / unit.name).write_text(unit.read_text().replace(PROGRAM, shutil.which("true") or "/bin/true"))
    command = ["systemd-analyze", "verify", "--man=no", str(tmp_path / path.name)]
    result = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert (result.returncode, result.stdout, result.stderr) == (0, "", "")


@pytest.mark.parametrize("path", UNITS, ids=lambda path: path.name)
def test_units_run_without_root(path: Path) -> None:
    """Each unit runs as an unprivileged user and allows the process priority that LAVT requests."""
    service = read_unit(path)["Service"]
    assert (service["User"], service["Group"]) == ("lavt", "lavt")
    assert (service["CapabilityBoundingSet"], service["NoNewPrivileges"]) == ("", "yes")
    requested = process_priority.VEHICLE_NICENESS if path.name == "lavt-server.service" else process_priority.NICENESS
    assert service["LimitNICE"] == str(requested)


def test_only_the_server_may_lock_its_memory() -> None:
    """The server's unit allows the actuator's process to lock all its memory; the other units need no permission."""
    limits = {path.name: read_unit(path)["Service"].get("LimitMEMLOCK") for path in UNITS}
    assert {name: limit for name, limit in limits.items() if limit} == {"lavt-server.service": "infinity"}


def test_the_directory_of_the_socket() -> None:
    """The units of server, client and router create /run/lavt, which outlives them; their socket is for one user."""
    services = {path.name: read_unit(path)["Service"] for path in UNITS}
    creators = {name for name, service in services.items() if "RuntimeDirectory" in service}
    assert creators == {"lavt-client.service", "lavt-router.service", "lavt-server.service"}
    for service in (services[name] for name in creators):
        assert (service["RuntimeDirectory"], service["RuntimeDirectoryMode"]) == ("lavt", "0750")
        assert service["RuntimeDirectoryPreserve"] == "yes"
        assert int(service["UMask"], 8) & 0o022 == 0o022  # who may not write to the socket cannot connect


def test_the_client_is_started_by_a_person() -> None:
    """Router, rendezvous and server restart after a failure; a client does not, and does not start at boot either."""
    restarts = {path.name: read_unit(path)["Service"]["Restart"] for path in UNITS}
    assert restarts == {
        "lavt-client.service": "no",
        "lavt-rendezvous.service": "on-failure",
        "lavt-router.service": "on-failure",
        "lavt-server.service": "on-failure",
    }
    assert "Install" not in read_unit(DEPLOY / "systemd/lavt-client.service")


def test_chrony_config_is_the_measured_one() -> None:
    """The lines for chrony are those of the tests on a real kernel, except for the addresses."""
    serve, allow = SERVE_OWN_CLOCK
    assert config_lines(DEPLOY / "chrony/vehicle.conf") == [serve, f"{allow} 192.0.2.0/24"]
    assert config_lines(DEPLOY / "chrony/operator.conf") == [follow_server("192.0.2.7").replace(" port 123", "")]


def test_the_documentation_names_existing_commands_and_files() -> None:
    """Every command, file and page that docs/deployment.md names exists."""
    text = (DEPLOY.parent / "docs/deployment.md").read_text()
    commands = set(re.findall(r"(?:^ {4}|`|/|&& )lavt ([a-z]+)\b", text, re.MULTILINE))
    assert commands >= {"doctor", "keys", "router", "server", "client", "stop", "clock", "join", "report"}
    assert commands <= {command.name for command in build_app().registered_commands}
    files = set(re.findall(r"(?<![\w/])(?:configs|zenoh-configs|deploy)/[\w./-]*\w", text))
    assert len(files) > 12
    assert {file for file in files if not (DEPLOY.parent / file).exists()} == set()
    links = set(re.findall(r"\]\(([\w.]+\.md)", text))
    assert {link for link in links if not (DEPLOY.parent / "docs" / link).exists()} == set()
