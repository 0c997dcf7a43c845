"""Tests of the networks that the field tests use."""

from __future__ import annotations

import signal
import socket
import subprocess
from pathlib import Path

import pytest
from tests.field.namespaces import OPERATOR, VEHICLE, Direction, FieldNetworks, plain_field, remove_stale_namespaces

pytestmark = pytest.mark.usefixtures("namespaces")

PORT = 7000


def test_an_outage_has_a_direction() -> None:
    """Packets are dropped in a blocked direction only, and pass again after unblocking."""
    with plain_field() as field:
        senders = {"uplink": "operator", "downlink": "vehicle"}
        destinations: dict[Direction, str] = {"uplink": VEHICLE, "downlink": OPERATOR}
        sockets = {
            part: field.inside(part, lambda: socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
            for part in senders.values()
        }
        for udp_socket in sockets.values():
            udp_socket.bind(("", PORT))
            udp_socket.settimeout(0.3)

        def passes(direction: Direction) -> bool:
            sender = sockets.pop(senders[direction])
            (receiver,) = sockets.values()
            sockets[senders[direction]] = sender
            sender.sendto(b"x", (destinations[direction], PORT))
            try:
                return receiver.recv(10) == b"x"
            except TimeoutError:
                return False

        assert passes("uplink")
        assert passes("downlink")
        field.block(["uplink"])
        assert not passes("uplink")
        assert passes("downlink")
        field.unblock()
        field.block(["downlink"])
        assert passes("uplink")
        assert not passes("downlink")
        field.unblock()
        assert passes("downlink")
        for udp_socket in sockets.values():
            udp_socket.close()


def test_namespaces_of_a_killed_test_are_removed() -> None:
    """The namespaces of a test whose process has ended are removed with their processes; other namespaces remain."""
    ended_test = subprocess.Popen(["true"])
    ended_test.wait()
    stale_field = FieldNetworks(ended_test.pid)
    stale_field._make("vehicle")
    left_behind = stale_field.inside("vehicle", lambda: subprocess.Popen(["sleep", "600"]))
    with plain_field() as own_field:
        assert left_behind.wait(timeout=5) == -signal.SIGKILL
        assert not Path("/run/netns", stale_field.name("vehicle")).exists()
        remove_stale_namespaces()
        assert Path("/run/netns", own_field.name("vehicle")).exists()
