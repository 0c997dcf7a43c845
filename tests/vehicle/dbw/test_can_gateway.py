"""The kernel's CAN gateway rules as netlink returns them."""

from __future__ import annotations

import errno
import struct

import pytest

from lavt.vehicle.dbw.can_gateway import (
    CAN_FAMILY,
    NLMSG_DONE,
    NLMSG_ERROR,
    RTM_NEWROUTE,
    gateway_interfaces,
    parse_rules,
)


def message(kind: int, body: bytes) -> bytes:
    return struct.pack("=IHHII", 16 + len(body), kind, 2, 1, 0) + body + bytes(-len(body) % 4)


def attribute(kind: int, value: bytes) -> bytes:
    return struct.pack("=HH", 4 + len(value), kind) + value + bytes(-len(value) % 4)


def rule(source: int, destination: int, family: int = CAN_FAMILY) -> bytes:
    """Return a rule as the kernel writes it, with a counter, a modification of odd length and the interfaces."""
    attributes = [
        attribute(7, struct.pack("=I", 12)),
        attribute(1, bytes(17)),
        attribute(9, struct.pack("=I", source)),
        attribute(10, struct.pack("=I", destination)),
    ]
    return message(RTM_NEWROUTE, bytes([family, 1, 0, 0]) + b"".join(attributes))


DONE = message(NLMSG_DONE, bytes(4))


def test_rules() -> None:
    """Source and destination of every CAN rule are returned; routes of other families are not."""
    assert parse_rules(rule(3, 7) + rule(9, 3, family=2) + rule(300, 3) + DONE) == ({3, 7, 300}, True)
    assert parse_rules(rule(3, 7)) == ({3, 7}, False)
    assert parse_rules(DONE) == (set(), True)


def test_an_error() -> None:
    """An error message and a truncated datagram raise an error, because the rules are not known."""
    with pytest.raises(PermissionError):
        parse_rules(message(NLMSG_ERROR, struct.pack("=i", -errno.EPERM)))
    with pytest.raises(OSError, match=f"Errno {errno.EBADMSG}"):
        parse_rules(rule(3, 7)[:-4])


def test_this_kernel_answers() -> None:
    """The kernel's answer can be parsed; this machine has no rule."""
    try:
        assert gateway_interfaces() == frozenset()
    except OSError as error:
        pytest.skip(f"no netlink here: {error}")
