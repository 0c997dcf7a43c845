"""A CAN port on the kernel's own CAN: a vcan interface that is lost and recovers like a real one."""

from __future__ import annotations

import subprocess
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing

import pytest

from lavt.clock import MachineClock, pause
from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.errors import UserError
from lavt.vehicle.can_frame import BusGone, CanFrame
from lavt.vehicle.dbw.bus import CanPort
from lavt.vehicle.dbw.virtual_bus import is_virtual

DEADLINE_S = 20
STEERING = CanFrame(0x064, bytes(range(8)))
EXTENDED_FRAME = CanFrame(0x1F01, b"\x01", is_extended=True)


def ip(*arguments: str) -> None:
    subprocess.run(["ip", *arguments], check=True)


@pytest.fixture
def channel() -> Iterator[str]:
    """Create a virtual CAN interface that is up, and delete it afterwards."""
    ip("link", "add", "vcan7", "type", "vcan")
    ip("link", "set", "vcan7", "up")
    yield "vcan7"
    subprocess.run(["ip", "link", "delete", "vcan7"], check=False)


@pytest.fixture
def ports(channel: str) -> Iterator[tuple[CanPort, CanPort]]:
    """Open two ports on the interface."""
    with ExitStack() as ends:
        one, other = (
            ends.enter_context(closing(CanPort("socketcan", channel, {}, clock=MachineClock()))) for _ in range(2)
        )
        yield one, other


def now_ns() -> int:
    return MachineClock().now().mono_ns


def wait_until(condition: Callable[[], bool]) -> None:
    end_ns = now_ns() + DEADLINE_S * NS_PER_S
    while not condition():
        assert now_ns() < end_ns, f"the condition is not true within {DEADLINE_S} s"
        pause(NS_PER_MS)


def is_received(sender: CanPort, receiver: CanPort) -> bool:
    """Send a frame and return whether it arrives; return False if the bus is lost."""
    try:
        sender.take(now_ns())
        sender.send([STEERING], now_ns())
        pause(NS_PER_MS)
        return any(received_frame.frame == STEERING for received_frame in receiver.take(now_ns()))
    except BusGone:
        return False


def wait_for_lost_bus(port: CanPort) -> str:
    """Wait until reading from a port reports the lost bus, require the same of writing, and return the reason."""
    reasons: list[str] = []

    def is_gone() -> bool:
        try:
            port.take(0)
        except BusGone as gone:
            reasons.append(str(gone))
        return bool(reasons)

    wait_until(is_gone)
    with pytest.raises(BusGone):
        port.send([STEERING], now_ns())
    return reasons[0]


def test_frames_pass_unchanged(ports: tuple[CanPort, CanPort]) -> None:
    """Frames reach the other port unchanged with the kernel's receive time, and do not return to the sender."""
    one, other = ports
    before_ns = now_ns()
    one.send([STEERING, EXTENDED_FRAME], before_ns)
    received = []

    def has_all() -> bool:
        received.extend(other.take(now_ns()))
        return len(received) >= 2

    wait_until(has_all)
    assert [received_frame.frame for received_frame in received] == [STEERING, EXTENDED_FRAME]
    assert all(before_ns - NS_PER_MS < received_frame.arrived_ns < now_ns() for received_frame in received)
    assert one.take(now_ns()) == []


@pytest.mark.parametrize(
    ("disable", "enable"),
    [
        ([("link", "set", "vcan7", "down")], [("link", "set", "vcan7", "up")]),
        (
            [("link", "delete", "vcan7")],
            [("link", "add", "vcan7", "type", "vcan"), ("link", "set", "vcan7", "up")],
        ),
    ],
    ids=["down and up", "gone and back"],
)
def test_lost_interface_is_reported_and_recovers(
    ports: tuple[CanPort, CanPort], disable: list[tuple[str, ...]], enable: list[tuple[str, ...]]
) -> None:
    """An interface that goes down or is deleted is reported on reading and writing, and works again afterwards."""
    one, other = ports
    wait_until(lambda: is_received(one, other))
    for command in disable:
        ip(*command)
    assert "socketcan vcan7" in wait_for_lost_bus(one)
    wait_for_lost_bus(other)
    for command in enable:
        ip(*command)
    wait_until(lambda: is_received(one, other))
    wait_until(lambda: is_received(other, one))


def test_virtual_channels_are_recognised(channel: str) -> None:
    """A vcan channel is virtual; a missing channel, or an interface of another kind, is not."""
    assert is_virtual("socketcan", channel, {})
    assert not is_virtual("socketcan", "lo", {})
    assert not is_virtual("socketcan", "can7", {})


def test_missing_channel_is_rejected() -> None:
    """A missing channel is rejected with a hint."""
    with pytest.raises(UserError, match=r"socketcan nosuch0 cannot be opened .*: name a channel that `ip link` shows"):
        CanPort("socketcan", "nosuch0", {}, clock=MachineClock())
