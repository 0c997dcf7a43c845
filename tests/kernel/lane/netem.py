"""Delay the packets that a machine sends, by `tc netem` and without LAVT."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from tests.kernel.lane import processes
from tests.kernel.lane.machine import Machine


@contextmanager
def netem_on_all(machine: Machine, *arguments: str) -> Iterator[None]:
    """Apply `tc netem` with these arguments to all egress of the machine, also NTP and ARP, inside the context."""
    target = ["dev", machine.interface, "root"]
    machine.run(["tc", "qdisc", "add", *target, "netem", *arguments, "limit", "10000"])
    try:
        yield
    finally:
        machine.run(["tc", "qdisc", "del", *target])


@contextmanager
def netem_on_ntp(machine: Machine, delay: str = "75ms") -> Iterator[None]:
    """Delay only the machine's packets to NTP servers, inside the context."""
    target = ["dev", machine.interface]
    machine.run(["tc", "qdisc", "add", *target, "root", "handle", "1:", "prio", "bands", "4"])
    machine.run(["tc", "qdisc", "add", *target, "parent", "1:4", "handle", "40:", "netem", "delay", delay])
    match = ["match", "ip", "protocol", "17", "0xff", "match", "ip", "dport", "123", "0xffff"]
    machine.run(["tc", "filter", "add", *target, "parent", "1:", "protocol", "ip", "u32", *match, "classid", "1:4"])
    try:
        yield
    finally:
        machine.run(["tc", "qdisc", "del", *target, "root"])


def clear(machine: Machine) -> None:
    """Delete all qdiscs and filters of the machine's interface on the network under test, if there are any."""
    for queue in ("root", "clsact"):
        machine.call(processes.run, ["tc", "qdisc", "del", "dev", machine.interface, queue], 10)
