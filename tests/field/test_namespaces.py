"""Tests of the networks that the field tests use."""

from __future__ import annotations

import signal
import socket
import subprocess
from pathlib import Path

import pytest
from tests.field.namespaces import OPERATOR, VEHICLE, Field, Way, plain_field, remove_stale_namespaces

pytestmark = pytest.mark.usefixtures("namespaces")

PORT = 7000


def test_an_outage_has_a_direction() -> None:
    """Packets are dropped in a blocked direction only, and pass again after unblocking."""
    with plain_field() as field:
        ends = {"uplink": "operator", "downlink": "vehicle"}
        to: dict[Way, str] = {"uplink": VEHICLE, "downlink": OPERATOR}
        opened = {
            part: field.inside(part, lambda: socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) for part in ends.values()
        }
        for each in opened.values():
            each.bind(("", PORT))
            each.settimeout(0.3)

        def passes(way: Way) -> bool:
            sender = opened.pop(ends[way])
            (receiver,) = opened.values()
            opened[ends[way]] = sender
            sender.sendto(b"x", (to[way], PORT))
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
        for each in opened.values():
            each.close()


def test_namespaces_of_a_killed_test_are_removed() -> None:
    """The namespaces of a test whose process has died are removed with their processes, and no others."""
    died = subprocess.Popen(["true"])
    died.wait()
    theirs = Field(died.pid)
    theirs._make("vehicle")
    left = theirs.inside("vehicle", lambda: subprocess.Popen(["sleep", "600"]))
    with plain_field() as ours:
        assert left.wait(timeout=5) == -signal.SIGKILL
        assert not Path("/run/netns", theirs.name("vehicle")).exists()
        remove_stale_namespaces()
        assert Path("/run/netns", ours.name("vehicle")).exists()
