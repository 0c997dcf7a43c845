"""Datagrams of a multicast bus: the form of a CAN message, and the check of a waiting datagram."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from typing import Any

import can
import msgpack
import pytest
from can.interfaces.udp_multicast.utils import pack_message

from lavt.vehicle.dbw.multicast_datagram import MAX_DATAGRAM_BYTES, DatagramCheck, is_well_formed

MESSAGES = [
    can.Message(arbitration_id=0x64, is_extended_id=False, data=bytes(8), channel="0123456789abcdef"),
    can.Message(arbitration_id=0x1FFFFFFF, data=b"", channel=None, timestamp=1.5e9),
    can.Message(arbitration_id=1, channel=0),
    can.Message(arbitration_id=1, is_fd=True, data=bytes(64), channel="ff15:7079:7468:6f6e:6465:6d6f:6d63:6173"),
    can.Message(arbitration_id=1, is_remote_frame=True, dlc=8),
    can.Message(arbitration_id=4, is_error_frame=True, data=bytes(8)),
]
GOOD: dict[str, Any] = msgpack.unpackb(pack_message(MESSAGES[0]))
CHANGES: dict[str, tuple[Any, ...]] = {
    "data": (1 << 32, None, "12345678", [1, 2, 3], bytes(65)),
    "dlc": (-1, 65, 1.0, None),
    "arbitration_id": (-1, 1 << 29, 1.5, "1"),
    "is_extended_id": (1, None),
    "is_error_frame": (0, "no"),
    "channel": ([1], {"a": 1}, 1.5),
    "timestamp": ("now", [1]),
    "check": (False,),
    "is_rx": (True,),
}


@pytest.mark.parametrize("message", MESSAGES)
def test_messages_of_python_can_are_well_formed(message: can.Message) -> None:
    """Whatever message python-can sends has a well-formed datagram."""
    assert is_well_formed(pack_message(message))


@pytest.mark.parametrize(("key", "value"), [(key, value) for key, values in CHANGES.items() for value in values])
def test_a_value_of_another_type_is_malformed(key: str, value: object) -> None:
    """A datagram with a wrong type, a number outside its range or an unknown key is malformed."""
    assert not is_well_formed(msgpack.packb({**GOOD, key: value}))


@pytest.mark.parametrize("key", GOOD)
def test_a_missing_key_is_malformed(key: str) -> None:
    """A datagram without one of the keys is malformed."""
    assert not is_well_formed(msgpack.packb({name: value for name, value in GOOD.items() if name != key}))


def test_other_datagrams_are_malformed() -> None:
    """Nested, truncated, extended and long datagrams, and datagrams with a length beyond their end, are malformed."""
    whole = pack_message(MESSAGES[0])
    others = [whole[:length] for length in range(len(whole))]
    others += [code + b"\xff\xff\xff\xff" for code in (b"\xc6", b"\xc9", b"\xdb", b"\xdd", b"\xdf")]
    others += [
        whole + b"\xc0",
        b"\x91" * 500,
        b"\xa1\xff",
        msgpack.packb({**GOOD, "channel": "x" * MAX_DATAGRAM_BYTES}),
    ]
    assert not any(map(is_well_formed, others))


@pytest.fixture
def ends() -> Iterator[tuple[socket.socket, socket.socket]]:
    """Return a pair of connected sockets."""
    pair = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    yield pair
    for end in pair:
        end.close()


def test_only_a_malformed_datagram_is_dropped(ends: tuple[socket.socket, socket.socket]) -> None:
    """A malformed datagram is dropped as a whole, and a well-formed datagram remains in the socket unchanged."""
    receiver, sender = ends
    check = DatagramCheck(receiver.fileno())
    good = pack_message(MESSAGES[0])
    for datagram in (bytes(3000), good):
        sender.send(datagram)
    assert [check.drop_malformed() for _ in range(3)] == [True, False, False]
    assert receiver.recv(4096) == good
    with pytest.raises(BlockingIOError):
        check.drop_malformed()
    check.close()
    sender.send(good)
    assert receiver.recv(4096) == good
