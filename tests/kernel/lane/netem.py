"""netem by hand: a delay on everything that a machine sends to the other one."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from tests.kernel.lane import processes
from tests.kernel.lane.machine import Machine


@contextmanager
def netem_on_all(machine: Machine, *arguments: str) -> Iterator[None]:
    """Apply `tc netem` with these arguments to all of the machine's egress, NTP and ARP included, and undo it."""
    where = ["dev", machine.interface, "root"]
    machine.run(["tc", "qdisc", "add", *where, "netem", *arguments, "limit", "10000"])
    try:
        yield
    finally:
        machine.run(["tc", "qdisc", "del", *where])


@contextmanager
def netem_on_ntp(machine: Machine, delay: str = "75ms") -> Iterator[None]:
    """Delay what the machine sends to NTP servers, and nothing else, and undo it."""
    where = ["dev", machine.interface]
    machine.run(["tc", "qdisc", "add", *where, "root", "handle", "1:", "prio", "bands", "4"])
    machine.run(["tc", "qdisc", "add", *where, "parent", "1:4", "handle", "40:", "netem", "delay", delay])
    match = ["match", "ip", "protocol", "17", "0xff", "match", "ip", "dport", "123", "0xffff"]
    machine.run(["tc", "filter", "add", *where, "parent", "1:", "protocol", "ip", "u32", *match, "classid", "1:4"])
    try:
        yield
    finally:
        machine.run(["tc", "qdisc", "del", *where, "root"])


def clear(machine: Machine) -> None:
    """Take every queue and filter from the machine's end of the network under test, if there are any."""
    for queue in ("root", "clsact"):
        machine.call(processes.run, ["tc", "qdisc", "del", "dev", machine.interface, queue], 10)
