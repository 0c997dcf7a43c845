"""The field: a vehicle's network, an operator's, and the internet that routes between them, in one kernel.

Plain, the ends have addresses that everybody reaches:

    vehicle 203.0.113.2 ── internet ── 198.51.100.2 operator

With NAT there is a home router at each end. The internet knows no way to what is behind them, and they let through only
what was begun from inside, and what the test has them forward:

    vehicle 192.168.1.2 ── vehicle-nat 203.0.113.2 ── internet ── 198.51.100.2 operator-nat ── 192.168.2.2 operator

All are network namespaces of one kernel, and so have one clock. Their names hold the test's process: what a test left
behind that was killed is taken away by the next.
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

Way = Literal["uplink", "downlink"]
"""uplink: client to server; downlink: server to client."""

PACKAGES = ("iproute2", "nftables")
"""Debian's; .ci/run installs them."""
PREFIX = "lavt-field-"
VEHICLE, OPERATOR, INTERNET = "203.0.113.2", "198.51.100.2", "198.51.100.1"
VEHICLE_AT_HOME = "192.168.1.2"
NEXT_VEHICLE, NEXT_OPERATOR = "203.0.113.7", "198.51.100.7"
"""What the addresses change to."""
FROM: dict[Way, str] = {"uplink": "operator", "downlink": "vehicle"}
"""The device of the internet by which what goes a way comes in."""
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
    """Whether Debian's packages are not here."""
    return shutil.which("ip") is None or shutil.which("nft") is None


def kernel_rejects() -> bool:
    """Whether this process may not make network namespaces, or the kernel has no NAT in them; for want of nft: no."""
    if os.geteuid() != 0 or not _works("unshare", "--net", "true"):
        return True
    return shutil.which("nft") is not None and not _works("unshare", "--net", "nft", "; ".join(NAT_RULES[:3]))


def _works(*words: str) -> bool:
    return subprocess.run(words, check=False, capture_output=True).returncode == 0


@dataclass(frozen=True)
class End:
    """One end of a link: a device of a part, and its address."""

    part: str
    device: str
    address: str


@dataclass(frozen=True)
class Field:
    """Network namespaces of this process, by the names in the drawing above."""

    owner: int

    def name(self, part: str) -> str:
        """Name a part's namespace as the system knows it."""
        return f"{PREFIX}{self.owner}-{part}"

    def run(self, part: str, *words: str) -> str:
        """Run a command in a namespace, which must succeed."""
        ended = subprocess.run(
            ["ip", "netns", "exec", self.name(part), *words], capture_output=True, text=True, check=False
        )
        assert ended.returncode == 0, f"{words}: {ended.stderr}"
        return ended.stdout

    def inside(self, part: str, function: Callable[[], Result]) -> Result:
        """Call a function in a namespace; processes that it starts are there, too."""
        return inside(self.name(part), function)

    def block(self, ways: Sequence[Way]) -> None:
        """Drop all that the internet carries these ways, without a word to anybody."""
        self.run("internet", "nft", "; ".join(f"add rule inet outage forward iifname {FROM[way]} drop" for way in ways))

    def unblock(self) -> None:
        """Carry everything again."""
        self.run("internet", "nft", "flush chain inet outage forward")

    def count(self, name: str, packets: str) -> None:
        """Count packets that the internet carries or sends, and that nft's expression `packets` matches."""
        rules = f"add counter inet outage {name}; add rule inet outage counting {packets} counter name {name}"
        self.run("internet", "nft", rules)

    def counted(self, name: str) -> int:
        """Tell how many packets were counted."""
        found = re.search(r"packets (\d+)", self.run("internet", "nft", f"list counter inet outage {name}"))
        assert found is not None
        return int(found[1])

    def forward_ports(self, ports: Sequence[int]) -> None:
        """Have the vehicle's home router hand on what comes for these UDP ports."""
        numbers = ", ".join(map(str, ports))
        self.run(
            "vehicle-nat",
            "nft", f"add rule ip nat in iifname internet udp dport {{ {numbers} }} dnat to {VEHICLE_AT_HOME}",
        )  # fmt: skip

    def change_the_operators_address(self) -> None:
        """Give the operator's home router another address: with the old one goes every connection it knew."""
        self._change_address("operator-nat", OPERATOR, NEXT_OPERATOR, INTERNET)

    def change_the_vehicles_address(self) -> None:
        """Give the vehicle's home router another address."""
        self._change_address("vehicle-nat", VEHICLE, NEXT_VEHICLE, VEHICLES_WAY.address)

    def _change_address(self, part: str, old: str, new: str, router: str) -> None:
        self.run(part, "ip", "addr", "del", f"{old}/24", "dev", "internet")
        self.run(part, "ip", "addr", "add", f"{new}/24", "dev", "internet")
        self.run(part, "ip", "route", "add", "default", "via", router)

    def _join(self, end: End, router: End) -> None:
        """Join two namespaces: for the first the second is the way to everywhere else."""
        devices = [f"{each.device} netns {self.name(each.part)}" for each in (end, router)]
        command(f"ip link add {devices[0]} type veth peer name {devices[1]}")
        for each in (end, router):
            command(f"ip -n {self.name(each.part)} addr add {each.address}/24 dev {each.device}")
            command(f"ip -n {self.name(each.part)} link set {each.device} up")
        command(f"ip -n {self.name(end.part)} route add default via {router.address}")

    def _make(self, *parts: str) -> None:
        for part in parts:
            command(f"ip netns add {self.name(part)}")
            command(f"ip -n {self.name(part)} link set lo up")
            self.run(part, "sysctl", "-qw", f"net.ipv4.ip_forward={int(part not in ('vehicle', 'operator'))}")

    def take_away(self) -> None:
        """End what runs in the namespaces, and take them away."""
        for name in _listed():
            if name.startswith(self.name("")):
                _take_away(name)


VEHICLES_WAY = End("internet", "vehicle", "203.0.113.1")
OPERATORS_WAY = End("internet", "operator", INTERNET)


@contextmanager
def plain_field() -> Iterator[Field]:
    """Make the field without NAT."""
    with _field("vehicle", "internet", "operator") as field:
        field._join(End("vehicle", "internet", VEHICLE), VEHICLES_WAY)
        field._join(End("operator", "internet", OPERATOR), OPERATORS_WAY)
        yield field


@contextmanager
def nat_field() -> Iterator[Field]:
    """Make the field with NAT on both ends."""
    with _field("vehicle", "vehicle-nat", "internet", "operator-nat", "operator") as field:
        field._join(End("vehicle-nat", "internet", VEHICLE), VEHICLES_WAY)
        field._join(End("operator-nat", "internet", OPERATOR), OPERATORS_WAY)
        field._join(End("vehicle", "internet", VEHICLE_AT_HOME), End("vehicle-nat", "home", "192.168.1.1"))
        field._join(End("operator", "internet", "192.168.2.2"), End("operator-nat", "home", "192.168.2.1"))
        for part in ("vehicle-nat", "operator-nat"):
            field.run(part, "nft", "; ".join(NAT_RULES))
        yield field


@contextmanager
def _field(*parts: str) -> Iterator[Field]:
    clear_what_was_left()
    field = Field(os.getpid())
    try:
        field._make(*parts)
        field.run("internet", "nft", "; ".join(INTERNET_RULES))
        yield field
    finally:
        field.take_away()


def clear_what_was_left() -> None:
    """Take away the namespaces of tests whose process has ended."""
    for name in _listed():
        found = re.match(rf"{PREFIX}(\d+)-", name)
        if found and not Path(f"/proc/{found[1]}").exists():
            _take_away(name)


def _listed() -> list[str]:
    return [line.split()[0] for line in command("ip netns list").splitlines()]


def _take_away(name: str) -> None:
    for process in command(f"ip netns pids {name}").split():
        with suppress(ProcessLookupError):
            os.kill(int(process), signal.SIGKILL)
    command(f"ip netns del {name}")
