"""The networks of the field tests: a vehicle's, an operator's, and an internet that routes between them, in one kernel.

Without NAT both ends have public addresses:

    vehicle 203.0.113.2 ── internet ── 198.51.100.2 operator

With NAT there is a home router at each end. The internet has no route to the networks behind the home routers. These
let through only connections from inside and the ports that a test forwards:

    vehicle 192.168.1.2 ── vehicle-nat 203.0.113.2 ── internet ── 198.51.100.2 operator-nat ── 192.168.2.2 operator

All are network namespaces of one kernel, and so have one clock. Their names contain the process id of the test. If a
test was killed, the next test finds the namespaces that it left by this id and removes them.
"""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, TypeVar

from tests.kernel.namespaces import command, inside

Direction = Literal["uplink", "downlink"]
"""uplink: client to server; downlink: server to client."""

PACKAGES = ("iproute2", "nftables")
"""Debian packages, which .ci/run installs."""
PREFIX = "lavt-field-"
VEHICLE, OPERATOR, INTERNET = "203.0.113.2", "198.51.100.2", "198.51.100.1"
VEHICLE_AT_HOME = "192.168.1.2"
NEXT_VEHICLE, NEXT_OPERATOR = "203.0.113.7", "198.51.100.7"
"""The public addresses of the home routers after a change of address."""
INPUT_DEVICES: dict[Direction, str] = {"uplink": "operator", "downlink": "vehicle"}
"""The device through which packets of a direction enter the internet."""
INTERNET_RULES = (
    "add table inet outage",
    "add chain inet outage counting { type filter hook postrouting priority mangle; }",
    "add chain inet outage forward { type filter hook forward priority filter; }",
)
NAT_RULES = (
    "add table ip nat",
    "add chain ip nat out { type nat hook postrouting priority srcnat; }",
    "add rule ip nat out oifname internet masquerade",
    "add chain ip nat in { type nat hook prerouting priority dstnat; }",
    "add chain ip nat through { type filter hook forward priority filter; policy drop; }",
    "add rule ip nat through ct state established,related accept",
    "add rule ip nat through iifname home accept",
    "add rule ip nat through ct status dnat accept",
)
Result = TypeVar("Result")


def programs_missing() -> bool:
    """Return whether the programs of the Debian packages are missing."""
    return shutil.which("ip") is None or shutil.which("nft") is None


def kernel_lacks_namespaces() -> bool:
    """Return whether network namespaces cannot be made here, or have no NAT (not checked if nft is missing)."""
    if os.geteuid() != 0 or not _works("unshare", "--net", "true"):
        return True
    return shutil.which("nft") is not None and not _works("unshare", "--net", "nft", "; ".join(NAT_RULES[:3]))


def _works(*words: str) -> bool:
    return subprocess.run(words, check=False, capture_output=True).returncode == 0


@dataclass(frozen=True)
class End:
    """One end of a link: a device in a namespace, and its address."""

    part: str
    device: str
    address: str


@dataclass(frozen=True)
class FieldNetworks:
    """The network namespaces of a test process; `part` is a name in the drawing above."""

    owner_pid: int

    def name(self, part: str) -> str:
        """Return the system's name of a namespace."""
        return f"{PREFIX}{self.owner_pid}-{part}"

    def run(self, part: str, *words: str) -> str:
        """Run a command in a namespace and return its output; the command must succeed."""
        completed = subprocess.run(
            ["ip", "netns", "exec", self.name(part), *words], capture_output=True, text=True, check=False
        )
        assert completed.returncode == 0, f"{words}: {completed.stderr}"
        return completed.stdout

    def inside(self, part: str, function: Callable[[], Result]) -> Result:
        """Call a function in a namespace, in which it may also start processes."""
        return inside(self.name(part), function)

    def block(self, directions: Sequence[Direction]) -> None:
        """Silently drop all packets in these directions."""
        rules = (f"add rule inet outage forward iifname {INPUT_DEVICES[direction]} drop" for direction in directions)
        self.run("internet", "nft", "; ".join(rules))

    def unblock(self) -> None:
        """Forward all packets again."""
        self.run("internet", "nft", "flush chain inet outage forward")

    def count_packets(self, name: str, packets: str) -> None:
        """Start to count the internet's outgoing packets that match nft's expression `packets`."""
        rules = f"add counter inet outage {name}; add rule inet outage counting {packets} counter name {name}"
        self.run("internet", "nft", rules)

    def packet_count(self, name: str) -> int:
        """Return how many packets the named counter has counted."""
        match = re.search(r"packets (\d+)", self.run("internet", "nft", f"list counter inet outage {name}"))
        assert match is not None
        return int(match[1])

    def forward_ports(self, ports: Sequence[int]) -> None:
        """Forward these UDP ports from the vehicle's home router to the vehicle."""
        numbers = ", ".join(map(str, ports))
        rule = f"add rule ip nat in iifname internet udp dport {{ {numbers} }} dnat to {VEHICLE_AT_HOME}"
        self.run("vehicle-nat", "nft", rule)

    def change_operator_address(self) -> None:
        """Change the address of the operator's home router, which loses all its connections."""
        self._change_address("operator-nat", OPERATOR, NEXT_OPERATOR, INTERNET)

    def change_vehicle_address(self) -> None:
        """Change the address of the vehicle's home router."""
        self._change_address("vehicle-nat", VEHICLE, NEXT_VEHICLE, VEHICLE_UPLINK_ROUTER.address)

    def _change_address(self, part: str, old: str, new: str, router: str) -> None:
        self.run(part, "ip", "addr", "del", f"{old}/24", "dev", "internet")
        self.run(part, "ip", "addr", "add", f"{new}/24", "dev", "internet")
        self.run(part, "ip", "route", "add", "default", "via", router)

    def _join(self, end: End, router: End) -> None:
        """Link two namespaces; `router` is the default route of `end`."""
        devices = [f"{link_end.device} netns {self.name(link_end.part)}" for link_end in (end, router)]
        command(f"ip link add {devices[0]} type veth peer name {devices[1]}")
        for link_end in (end, router):
            command(f"ip -n {self.name(link_end.part)} addr add {link_end.address}/24 dev {link_end.device}")
            command(f"ip -n {self.name(link_end.part)} link set {link_end.device} up")
        command(f"ip -n {self.name(end.part)} route add default via {router.address}")

    def _make(self, *parts: str) -> None:
        for part in parts:
            command(f"ip netns add {self.name(part)}")
            command(f"ip -n {self.name(part)} link set lo up")
            self.run(part, "sysctl", "-qw", f"net.ipv4.ip_forward={int(part not in ('vehicle', 'operator'))}")

    def remove(self) -> None:
        """Kill the processes in the namespaces and delete the namespaces."""
        for name in _list_namespaces():
            if name.startswith(self.name("")):
                _remove(name)


VEHICLE_UPLINK_ROUTER = End("internet", "vehicle", "203.0.113.1")
OPERATOR_UPLINK_ROUTER = End("internet", "operator", INTERNET)


@contextmanager
def plain_field() -> Iterator[FieldNetworks]:
    """Make the networks without NAT."""
    with _field("vehicle", "internet", "operator") as field:
        field._join(End("vehicle", "internet", VEHICLE), VEHICLE_UPLINK_ROUTER)
        field._join(End("operator", "internet", OPERATOR), OPERATOR_UPLINK_ROUTER)
        yield field


@contextmanager
def nat_field() -> Iterator[FieldNetworks]:
    """Make the networks with NAT at both ends."""
    with _field("vehicle", "vehicle-nat", "internet", "operator-nat", "operator") as field:
        field._join(End("vehicle-nat", "internet", VEHICLE), VEHICLE_UPLINK_ROUTER)
        field._join(End("operator-nat", "internet", OPERATOR), OPERATOR_UPLINK_ROUTER)
        field._join(End("vehicle", "internet", VEHICLE_AT_HOME), End("vehicle-nat", "home", "192.168.1.1"))
        field._join(End("operator", "internet", "192.168.2.2"), End("operator-nat", "home", "192.168.2.1"))
        for part in ("vehicle-nat", "operator-nat"):
            field.run(part, "nft", "; ".join(NAT_RULES))
        yield field


@contextmanager
def _field(*parts: str) -> Iterator[FieldNetworks]:
    remove_stale_namespaces()
    field = FieldNetworks(os.getpid())
    try:
        field._make(*parts)
        field.run("internet", "nft", "; ".join(INTERNET_RULES))
        yield field
    finally:
        field.remove()


def remove_stale_namespaces() -> None:
    """Remove the namespaces of tests whose process has ended."""
    for name in _list_namespaces():
        match = re.match(rf"{PREFIX}(\d+)-", name)
        if match and not Path(f"/proc/{match[1]}").exists():
            _remove(name)


def _list_namespaces() -> list[str]:
    return [line.split()[0] for line in command("ip netns list").splitlines()]


def _remove(name: str) -> None:
    for process in command(f"ip netns pids {name}").split():
        with suppress(ProcessLookupError):
            os.kill(int(process), signal.SIGKILL)
    command(f"ip netns del {name}")
