"""A port on the kernel's own CAN: vcan, which goes and comes back as a real interface does."""

from __future__ import annotations

import subprocess
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing

import pytest

from lavt.clock import MachineClock, pause
from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.errors import UserError
from lavt.vehicle.can_frame import BusGone, CanFrame
from lavt.vehicle.dbw.bus import CanPort, is_virtual

DEADLINE_S = 20
STEERING = CanFrame(0x064, bytes(range(8)))
FAR = CanFrame(0x1F01, b"\x01", is_extended=True)


def ip(*arguments: str) -> None:
    subprocess.run(["ip", *arguments], check=True)


@pytest.fixture
def channel() -> Iterator[str]:
    """A virtual CAN interface that is up."""
    ip("link", "add", "vcan7", "type", "vcan")
    ip("link", "set", "vcan7", "up")
    yield "vcan7"
    subprocess.run(["ip", "link", "delete", "vcan7"], check=False)


@pytest.fixture
def ports(channel: str) -> Iterator[tuple[CanPort, CanPort]]:
    """Two ports on it."""
    with ExitStack() as ends:
        one, other = (
            ends.enter_context(closing(CanPort("socketcan", channel, {}, clock=MachineClock()))) for _ in range(2)
        )
        yield one, other


def now_ns() -> int:
    return MachineClock().now().mono_ns


def until(done: Callable[[], bool]) -> None:
    end_ns = now_ns() + DEADLINE_S * NS_PER_S
    while not done():
        assert now_ns() < end_ns, "it did not happen"
        pause(NS_PER_MS)


def is_heard(sender: CanPort, hearer: CanPort) -> bool:
    """Send and see whether anything comes; a bus that is gone carries nothing."""
    try:
        sender.take(now_ns())
        sender.send([STEERING], now_ns())
        pause(NS_PER_MS)
        return any(each.frame == STEERING for each in hearer.take(now_ns()))
    except BusGone:
        return False


def why_gone(port: CanPort) -> str:
    """Why a port can neither be read from nor written to."""
    whys: list[str] = []

    def is_gone() -> bool:
        try:
            port.take(0)
        except BusGone as gone:
            whys.append(str(gone))
        return bool(whys)

    until(is_gone)
    with pytest.raises(BusGone):
        port.send([STEERING], now_ns())
    return whys[0]


def test_frames(ports: tuple[CanPort, CanPort]) -> None:
    """Frames come to the other port as they were, soon by the kernel's own time, and not back to the one that sent."""
    one, other = ports
    before_ns = now_ns()
    one.send([STEERING, FAR], before_ns)
    heard = []

    def is_all() -> bool:
        heard.extend(other.take(now_ns()))
        return len(heard) >= 2

    until(is_all)
    assert [each.frame for each in heard] == [STEERING, FAR]
    assert all(before_ns - NS_PER_MS < each.arrived_ns < now_ns() for each in heard)
    assert one.take(now_ns()) == []


@pytest.mark.parametrize(
    ("go", "come"),
    [
        ([("link", "set", "vcan7", "down")], [("link", "set", "vcan7", "up")]),
        (
            [("link", "delete", "vcan7")],
            [("link", "add", "vcan7", "type", "vcan"), ("link", "set", "vcan7", "up")],
        ),
    ],
    ids=["down and up", "gone and back"],
)
def test_gone_and_back(ports: tuple[CanPort, CanPort], go: list[tuple[str, ...]], come: list[tuple[str, ...]]) -> None:
    """An interface that goes down, or away, is told by reading and writing, and heard again once it is back."""
    one, other = ports
    until(lambda: is_heard(one, other))
    for command in go:
        ip(*command)
    assert "socketcan vcan7" in why_gone(one)
    why_gone(other)
    for command in come:
        ip(*command)
    until(lambda: is_heard(one, other))
    until(lambda: is_heard(other, one))


def test_kind(channel: str) -> None:
    """The kernel says which channel is virtual; one that it does not have, or of another kind, is not."""
    assert is_virtual("socketcan", channel)
    assert not is_virtual("socketcan", "lo")
    assert not is_virtual("socketcan", "can7")


def test_no_such_channel() -> None:
    """A channel that is not there is refused with what to do."""
    with pytest.raises(UserError, match=r"socketcan nosuch0 cannot be opened .*: name a channel that `ip link` shows"):
        CanPort("socketcan", "nosuch0", {}, clock=MachineClock())
