from __future__ import annotations

import json
import re
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from lavt.config_file import shipped
from lavt.transport.clock_sync.probe import encode_request
from lavt.transport.rendezvous.forwarder import encode_registration, wrap

LOOPBACK = "127.0.0.1"
EXIT_TIMEOUT_S = 30.0


@contextmanager
def rendezvous(*options: str) -> Iterator[subprocess.Popen[str]]:
    """Run the command on free ports."""
    changes = [word for change in (f"bind={LOOPBACK}", "video_port=0", "probe_port=0") for word in ("--set", change)]
    process = subprocess.Popen(
        [sys.executable, "-m", "lavt", "rendezvous", str(shipped("configs/rendezvous.yaml")), *changes, *options],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


@pytest.fixture
def vehicle() -> Iterator[socket.socket]:
    """Open the vehicle's socket."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as vehicle_socket:
        vehicle_socket.bind((LOOPBACK, 0))
        vehicle_socket.settimeout(EXIT_TIMEOUT_S)
        yield vehicle_socket


def test_output_as_text(vehicle: socket.socket) -> None:
    """The command prints its ports, then the vehicle's address for each flow, and exits with code 0 on Ctrl-C."""
    with rendezvous() as process:
        assert process.stdout is not None
        port = re.search(r"video at port (\d+)", process.stdout.readline())
        assert port is not None
        vehicle.sendto(encode_registration("vehicle-1", "video", 1, None), (LOOPBACK, int(port[1])))
        assert f"{LOOPBACK}:{vehicle.getsockname()[1]}" in process.stdout.readline()
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=EXIT_TIMEOUT_S)
    assert (process.returncode, out, err) == (0, "", "")


def test_output_as_json(vehicle: socket.socket) -> None:
    """As JSON, the command prints its ports, the vehicle's address, and finally the counts of each flow."""
    with rendezvous("--json") as process, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client:
        client.bind((LOOPBACK, 0))
        client.settimeout(EXIT_TIMEOUT_S)
        assert process.stdout is not None
        ports = json.loads(process.stdout.readline())["ready"]
        address = (LOOPBACK, ports["probe_port"])
        vehicle.sendto(encode_registration("vehicle-1", "probe", 1, None), address)
        expected = {"flow": "probe", "vehicle_at": list(vehicle.getsockname())}
        assert json.loads(process.stdout.readline()) == expected
        client.sendto(encode_request(1, 2), address)
        assert vehicle.recv(100) == wrap(client.getsockname(), encode_request(1, 2))
        vehicle.sendto(wrap(client.getsockname(), b"reply"), address)
        assert client.recv(100) == b"reply"
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=EXIT_TIMEOUT_S)
    counts = {"video": {}, "probe": {"registrations": 1, "to_vehicle": 1, "to_clients": 1}}
    assert (process.returncode, json.loads(out), err) == (0, {"counts": counts}, "")
