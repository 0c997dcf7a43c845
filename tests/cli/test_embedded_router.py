"""Server and client with embedded routers, as processes: they find each other, and what happens when they cannot."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from tests.support.command_line import Run
from tests.support.ports import free_port

from lavt.clock import MachineClock, pause
from lavt.config_file import shipped
from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.experiment.runs.processes import Process, Processes

SERVER, CLIENT = str(shipped("configs/server.yaml")), str(shipped("configs/client.yaml"))
SERVER_SECURE, CLIENT_SECURE = str(shipped("configs/server-secure.yaml")), str(shipped("configs/client-secure.yaml"))
LOOPBACK = "127.0.0.1"
LIMIT_S = 120.0
"""The time limit for everything that a pair of processes does, on a busy machine."""
SMALL = ("camera.width_px=128", "camera.height_px=128", "clock.source=probe")
PLAIN, ENCRYPTED = "udp/127.0.0.1:{}?rel=1;mixed_rel=1", "quic/127.0.0.1:{}?mixed_rel=1"


def options(*changes: str) -> list[str]:
    return [word for change in changes for word in ("--set", change)]


def embedded(**settings: Any) -> str:
    """Return the change of a config for an embedded router with these settings."""
    return "zenoh=" + json.dumps({"router": "embedded", "router_settings": settings})


def wait_until(expectation: str, condition: Callable[[], bool]) -> None:
    clock = MachineClock()
    end_ns = clock.now().mono_ns + round(LIMIT_S * NS_PER_S)
    while not condition():
        assert clock.now().mono_ns < end_ns, f"not within {LIMIT_S:g} s: {expectation}"
        pause(50 * NS_PER_MS)


class Pair:
    """The arguments of a server and a client with embedded routers on the loopback, plain or secure."""

    def __init__(self, keys: Path | None = None) -> None:
        self.port, self.probe_port = free_port(), free_port()
        self.local_port = 0
        """The TCP port of the client's router for programs on its machine; 0: none."""
        self._keys = keys

    @property
    def is_plain(self) -> bool:
        """Whether both sides are without keys."""
        return self._keys is None

    def server(self) -> list[str]:
        """Return the server's arguments."""
        listen = {"endpoints": [(PLAIN if self._keys is None else ENCRYPTED).format(self.port)]}
        changes = [
            embedded(listen=listen, **self._tls("vehicle-1", "listen")),
            *(f"video.bind={LOOPBACK}", "video.port=0", f"clock.probe_port={self.probe_port}", "vehicle.scenery=none"),
        ]
        if self._keys is None:
            return ["server", SERVER, *options(*SMALL, *changes)]
        operators = json.dumps({"operator-1": str(self._keys / "operator-1.sign.pub")})
        changes += [f"security.key={self._keys}/vehicle-1.sign.key", f"security.operators={operators}"]
        return ["server", SERVER_SECURE, *options(*SMALL, *changes)]

    def client(self, command: str = "client") -> list[str]:
        """Return the arguments of a command with the client's config."""
        connect = {"endpoints": [(PLAIN if self._keys is None else ENCRYPTED).format(self.port)]}
        listen = {"endpoints": [f"tcp/{LOOPBACK}:{self.local_port}"] if self.local_port else []}
        changes = [
            embedded(connect=connect, listen=listen, **self._tls("operator-1", "connect")),
            *(f"video.server={LOOPBACK}", f"clock.probe_port={self.probe_port}"),
        ]
        if self._keys is None:
            return [command, CLIENT, *options(*SMALL, *changes)]
        changes += [
            f"security.key={self._keys}/operator-1.sign.key",
            f"security.vehicle={self._keys}/vehicle-1.sign.pub",
        ]
        return [command, CLIENT_SECURE, *options(*SMALL, *changes)]

    def _tls(self, name: str, action: str) -> dict[str, Any]:
        """Return the settings of a router with the certificate of `name`."""
        if self._keys is None:
            return {}
        tls = {
            "root_ca_certificate": f"{self._keys}/authority.pem",
            f"{action}_certificate": f"{self._keys}/{name}.pem",
            f"{action}_private_key": f"{self._keys}/{name}.key",
        }
        return {"transport": {"link": {"tls": tls}}}


@pytest.fixture(params=["plain", pytest.param("secure", marks=pytest.mark.full)])
def pair(request: pytest.FixtureRequest, tmp_path: Path) -> Pair:
    if request.param == "plain":
        return Pair()
    keys = tmp_path / "keys"
    arguments = ["keys", str(keys), "--vehicle", "vehicle-1", "--operator", "operator-1", "--host", LOOPBACK]
    subprocess.run([sys.executable, "-m", "lavt", *arguments], check=True, capture_output=True)
    return Pair(keys)


def has_control(client: Process) -> bool:
    """Return whether the client has control, and so has exchanged a query, a reply and states with the server."""
    return client.latest.get("status", {}).get("phase") in ("arming", "driving", "stopped")


def listening_tcp_ports(pid: int) -> list[int]:
    """Return the TCP ports at which a process listens."""
    links = {str(link.readlink()) for link in Path(f"/proc/{pid}/fd").iterdir() if link.is_symlink()}
    rows = [
        line.split()
        for table in ("tcp", "tcp6")
        for line in Path(f"/proc/{pid}/net/{table}").read_text().splitlines()[1:]
    ]
    return [int(row[1].rpartition(":")[2], 16) for row in rows if row[3] == "0A" and f"socket:[{row[9]}]" in links]


def test_two_commands_are_enough(pair: Pair, tmp_path: Path) -> None:
    """Two processes are enough for a client to get control of a server, to list and to stop it, plain and secure.

    Here the client starts first. Its machine accepts no connections, and `lavt vehicles` and `lavt stop` reach the
    vehicle directly. A plain side says once that it is plain.
    """
    with Processes(tmp_path) as processes:
        client = processes.start("client", *pair.client())
        client.wait_ready()
        server = processes.start("server", *pair.server())
        (locator,) = server.wait_ready()["ready"]["locators"]
        assert f":{pair.port}" in locator
        wait_until("the client has control", lambda: has_control(client))
        assert listening_tcp_ports(client.popen.pid) == []
        listed = subprocess.run(
            [sys.executable, "-m", "lavt", *pair.client("vehicles"), "--json"],
            capture_output=True,
            text=True,
            check=True,
        )
        (vehicle,) = json.loads(listed.stdout)["vehicles"]
        assert (vehicle["vehicle"], vehicle["active_operator"]) == ("vehicle-1", "operator-1")
        assert vehicle["is_authentic"] != pair.is_plain
        stopped = subprocess.run(
            [sys.executable, "-m", "lavt", *pair.client("stop")], capture_output=True, text=True, check=False
        )
        assert (stopped.returncode, stopped.stdout) == (0, "vehicle-1 accepted the emergency stop\n"), stopped.stderr
        wait_until("the server reports the stop", lambda: "emergency_stop" in str(server.latest))
    assert (client.popen.returncode, server.popen.returncode) == (0, 0)
    for side in ("client", "server"):
        assert (tmp_path / f"{side}.log").read_text().count("this side is plain") == pair.is_plain


def messages(process: Process) -> str:
    """Return the session's log that a process has printed."""
    lines = list(process._first.queue)
    return "\n".join(message for line in lines if line for message in line.get("said", []))


@pytest.mark.full
def test_a_client_outlives_a_killed_server(pair: Pair, tmp_path: Path) -> None:
    """If a server is killed with its router, the client continues without states, and gets control of the next one."""
    with Processes(tmp_path) as processes:
        server = processes.start("server", *pair.server())
        server.wait_ready()
        client = processes.start("client", *pair.client(), *options("controller.rearm=true"))
        wait_until("the client has control", lambda: has_control(client))
        server.popen.kill()
        wait_until("the client misses the states", lambda: "no state from the vehicle for" in messages(client))
        assert client.running
        next_server = processes.start("next-server", *pair.server())
        next_server.wait_ready()
        wait_until("the client receives states again", lambda: "state received again" in messages(client))
        wait_until("the client has control of the next server", lambda: "operator-1" in str(next_server.latest))
    assert (client.popen.returncode, next_server.popen.returncode) == (0, 0)


def test_standard_output_has_lines_of_json_only() -> None:
    """With RUST_LOG set, Zenoh's log goes to standard error, and standard output has lines of JSON only."""
    process = subprocess.Popen(
        [sys.executable, "-m", "lavt", *Pair().server(), "--json"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "RUST_LOG": "zenoh=debug"},
    )
    assert process.stdout is not None
    assert "ready" in json.loads(process.stdout.readline())
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=LIMIT_S)
    assert process.returncode == 0
    assert all(isinstance(json.loads(line), dict) for line in out.splitlines())
    assert "DEBUG" in err


@pytest.mark.parametrize("side", ["server", "client"])
def test_a_router_that_cannot_listen(side: str, run: Run, tmp_path: Path) -> None:
    """If the embedded router's port is in use, the side ends with one sentence and exit code 2; nothing is created."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as occupant:
        occupant.bind((LOOPBACK, 0))
        port = occupant.getsockname()[1]
        changes = [embedded(listen={"endpoints": [PLAIN.format(port)]})]
        changes += ["video.port=0", "clock.probe_port=0", f"video.bind={LOOPBACK}"] if side == "server" else []
        config = SERVER if side == "server" else CLIENT
        sentence = run(side, config, "--out", "mine", *options(*changes)).rejection()
    assert f"{LOOPBACK}:{port}" in sentence
    assert "in use" in sentence
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ("zenoh={router: embedded, session: zenoh-configs/session.json5}", "zenoh.session"),
        ("zenoh={router: embedded, router_file: no.json5}", "no.json5"),
        ("zenoh={router: embedded, router_settings: {lisen: {endpoints: []}}}", "lisen.endpoints"),
        ("zenoh={router: embedded, router_settings: {connect: {endpoints: [foo/h:1]}}}", "'foo/h:1'"),
        ("zenoh={router: embedded, router_settings: {mode: peer}}", 'mode: "router"'),
        ("zenoh={router: embedded, router_file: zenoh-configs/session.json5}", 'mode: "router"'),
    ],
)
def test_a_wrong_setting(change: str, reason: str, run: Run, tmp_path: Path) -> None:
    """A wrong setting of an embedded router is rejected in one sentence, and nothing is created."""
    for side, config in (("server", SERVER), ("client", CLIENT)):
        ports = ["video.port=0", "clock.probe_port=0"] if side == "server" else []
        assert reason in run(side, config, "--out", "mine", *options(*ports, change)).rejection()
    assert list(tmp_path.iterdir()) == []


def test_a_stop_without_a_vehicle_says_what_to_check(run: Run) -> None:
    """If nothing answers at the vehicle's address until the timeout, `lavt stop` says that the stop was not sent."""
    endpoint = f"tcp/{LOOPBACK}:{free_port(socket.SOCK_STREAM)}"
    router = embedded(connect={"endpoints": [endpoint]}, listen={"endpoints": []})
    sentence = run("stop", CLIENT, "--timeout", "0.2", *options(router)).rejection()
    assert "NOT sent" in sentence
    assert endpoint in sentence
    assert "`lavt server`" in sentence


def test_a_stop_uses_the_link_of_the_running_client(tmp_path: Path) -> None:
    """`lavt stop` needs no link of its own to the vehicle if the client's router has one."""
    pair = Pair()
    pair.local_port = free_port(socket.SOCK_STREAM)
    with Processes(tmp_path) as processes:
        processes.start("server", *pair.server()).wait_ready()
        client = processes.start("client", *pair.client())
        wait_until("the client has control", lambda: has_control(client))
        pair.port = free_port()  # nothing answers there
        stopped = subprocess.run(
            [sys.executable, "-m", "lavt", *pair.client("stop")], capture_output=True, text=True, check=False
        )
    assert (stopped.returncode, stopped.stdout) == (0, "vehicle-1 accepted the emergency stop\n"), stopped.stderr


HARMFUL_PEER = """
import sys, zenoh
config = zenoh.Config()
for key, value in (("mode", '"client"'), ("connect/endpoints", f'["{sys.argv[1]}"]'), ("connect/timeout_ms", "2000"),
                   ("scouting/multicast/enabled", "false"), ("transport/link/tx/batch_size", "0")):
    config.insert_json5(key, value)
zenoh.open(config)
"""
"""A program whose handshake makes a task of the other router panic."""


@pytest.mark.full
def test_a_peer_that_makes_zenoh_panic_harms_only_its_own_connection(tmp_path: Path) -> None:
    """A panic in the handshake with a peer ends neither the drive nor the server, and new connections are accepted."""
    pair = Pair()
    with Processes(tmp_path) as processes:
        server = processes.start("server", *pair.server())
        server.wait_ready()
        client = processes.start("client", *pair.client())
        wait_until("the client has control", lambda: has_control(client))
        for _ in range(2):
            attack = [sys.executable, "-c", HARMFUL_PEER, PLAIN.format(pair.port)]
            subprocess.run(attack, capture_output=True, timeout=60, check=False)
        wait_until("a task panics", lambda: "panicked at" in (tmp_path / "server.log").read_text())
        stopped = subprocess.run(
            [sys.executable, "-m", "lavt", *pair.client("stop")], capture_output=True, text=True, check=False
        )
        assert (stopped.returncode, stopped.stdout) == (0, "vehicle-1 accepted the emergency stop\n"), stopped.stderr
    assert (client.popen.returncode, server.popen.returncode) == (0, 0)


CLOSED_SESSION = """
import lavt.assembly.side
from lavt.cli.main import main
from lavt.transport import zenoh_link

class ClosedLater(zenoh_link.ZenohLink):
    def start(self, *arguments, **options):
        super().start(*arguments, **options)
        self._session.close()

lavt.assembly.side.ZenohLink = ClosedLater
main()
"""
"""A program that runs `lavt` and closes the session of its embedded router without the link's knowledge."""


def test_a_side_whose_router_has_failed_ends() -> None:
    """If the embedded router no longer works, the side ends with one sentence and exit code 1."""
    command = [sys.executable, "-c", CLOSED_SESSION, *Pair().server()]
    process = subprocess.run(command, capture_output=True, text=True, timeout=LIMIT_S, check=False)
    assert process.returncode == 1
    assert process.stderr.splitlines()[-1].startswith("lavt: ")
