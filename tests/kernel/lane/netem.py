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


def clear(machine: Machine) -> None:
    """Take every queue and filter from the machine's end of the network under test, if there are any."""
    for queue in ("root", "clsact"):
        machine.call(processes.run, ["tc", "qdisc", "del", "dev", machine.interface, queue], 10)
