"""A port on a bus of python-can: sending, receiving, and loss of the bus."""

from __future__ import annotations

import errno
import gc
import select
import socket
import subprocess
import sys
import threading
import tracemalloc
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import can
import msgpack
import pytest
from can.interfaces.udp_multicast.utils import pack_message
from tests.support.clocks import ManualClock
from tests.support.ports import free_port

from lavt.clock import Clock, MachineClock, pause, suspended_ns
from lavt.domain import NS_PER_MS, NS_PER_S, Now
from lavt.errors import UserError
from lavt.vehicle.can_frame import BusGone, CanFrame, ReceivedCanFrame
from lavt.vehicle.dbw import bus as bus_module
from lavt.vehicle.dbw.bus import CanPort, log_line, read_log
from lavt.vehicle.dbw.kernel_arrival import ArrivalTimes
from lavt.vehicle.dbw.virtual_bus import is_virtual

GROUP = "239.74.163.2"
DEADLINE_S = 20
STEERING = CanFrame(0x064, bytes(8))
BRAKE = CanFrame(0x060, bytes(range(8)))
EXTENDED = CanFrame(0x2F01, b"\x01", is_extended=True)


def until(done: Callable[[], bool]) -> None:
    for _ in range(DEADLINE_S * 1000):
        if done():
            return
        pause(NS_PER_MS)
    raise AssertionError(f"the condition was not met within {DEADLINE_S} s")


@pytest.fixture
def emptied(monkeypatch: pytest.MonkeyPatch) -> list[ArrivalTimes]:
    """Let the ports' threads pause for long; return a list that gets an entry when a port is opened or found empty."""
    noted: list[ArrivalTimes] = []
    note_empty = ArrivalTimes.note_empty

    def note(arrivals: ArrivalTimes, now: Now) -> None:
        note_empty(arrivals, now)
        noted.append(arrivals)

    monkeypatch.setattr(bus_module, "READ_PERIOD_S", DEADLINE_S)
    monkeypatch.setattr(ArrivalTimes, "note_empty", note)
    return noted


def until_pausing(emptied: list[ArrivalTimes], *ports: CanPort) -> None:
    """Wait until the threads of all open ports have found them empty, and pause."""
    until(lambda: len(emptied) == 2 * len(ports))
    for port in ports:
        assert port._bus is not None
        with port._bus.read_lock:
            pass


def receive(port: CanPort, count: int) -> list[CanFrame]:
    """Return the next frames that a port receives."""
    received: list[ReceivedCanFrame] = []

    def enough() -> bool:
        received.extend(port.take(0))
        return len(received) >= count

    until(enough)
    return [entry.frame for entry in received]


@pytest.fixture
def open_port() -> Iterator[Callable[..., CanPort]]:
    """Return a function that opens ports, which are closed after the test."""
    ports: list[CanPort] = []

    def open_new_port(
        interface: str = "virtual",
        channel: str = "test",
        clock: Clock | None = None,
        read_suspended_ns: Callable[[], int] = lambda: 0,
        **options: Any,
    ) -> CanPort:
        ports.append(
            CanPort(interface, channel, options, clock=clock or MachineClock(), read_suspended_ns=read_suspended_ns)
        )
        return ports[-1]

    yield open_new_port
    for port in ports:
        port.close()


@pytest.fixture
def raw_bus() -> Iterator[can.BusABC]:
    """Return another participant on the bus `test`."""
    with can.Bus(interface="virtual", channel="test", ignore_config=True) as bus:
        yield bus


def now_ns() -> int:
    return MachineClock().now().mono_ns


def test_virtual(open_port: Callable[..., CanPort]) -> None:
    """Frames arrive unchanged and in order at every other port of the bus, and not at their sender."""
    one, other = open_port(), open_port()
    one.send([STEERING, BRAKE, EXTENDED], now_ns())
    assert receive(other, 3) == [STEERING, BRAKE, EXTENDED]
    other.send([BRAKE], now_ns())
    assert receive(one, 1) == [BRAKE]


OTHER_PROCESS = """
import sys
from lavt.clock import MachineClock, pause
from lavt.vehicle.dbw.bus import CanPort
port = CanPort("udp_multicast", sys.argv[1], {"port": int(sys.argv[2])}, clock=MachineClock())
print("ready", flush=True)
count = 0
while count < 3:
    for received in port.take(0):
        count += 1
        port.send([received.frame], MachineClock().now().mono_ns)
    pause(1_000_000)
port.close()
"""


def test_two_processes(open_port: Callable[..., CanPort]) -> None:
    """Over `udp_multicast` two processes receive each other's frames and not their own, which the group sends back."""
    number = free_port()
    port = open_port("udp_multicast", GROUP, port=number)
    with subprocess.Popen(
        [sys.executable, "-c", OTHER_PROCESS, GROUP, str(number)], stdout=subprocess.PIPE, text=True
    ) as echo:
        assert echo.stdout is not None
        assert echo.stdout.readline() == "ready\n"
        before_ns = now_ns()
        port.send([STEERING, BRAKE, EXTENDED], before_ns)
        assert receive(port, 3) == [STEERING, BRAKE, EXTENDED]
        assert echo.wait(DEADLINE_S) == 0
    until(lambda: port.counts["own_frames"] == 3)
    assert not port.take(0)


def test_udp_multicast_stays_on_this_machine(
    open_port: Callable[..., CanPort], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Frames of `udp_multicast`, which LAVT treats as virtual, stay on the machine unless the user sets `hop_limit`."""
    requested: list[dict[str, Any]] = []
    open_bus = can.Bus

    def record(**keys: Any) -> can.BusABC:
        requested.append(keys)
        return open_bus(**keys)

    monkeypatch.setattr(can, "Bus", record)
    open_port("udp_multicast", GROUP, port=free_port())
    open_port("udp_multicast", GROUP, port=free_port(), hop_limit=1)
    open_port()
    assert [keys.get("hop_limit") for keys in requested] == [0, 1, None]


def test_arrival(open_port: Callable[..., CanPort]) -> None:
    """A frame's arrival time is the kernel's, on the monotonic clock, however late the frame is taken."""
    number = free_port()
    port, other = open_port("udp_multicast", GROUP, port=number), open_port("udp_multicast", GROUP, port=number)
    before_ns = now_ns()
    other.send([STEERING], before_ns)
    taken: list[ReceivedCanFrame] = []

    def is_there() -> bool:
        taken.extend(port.take(0))
        return bool(taken)

    until(is_there)
    assert before_ns - NS_PER_MS < taken[0].arrived_ns < now_ns()


def test_take_reads_the_frames_that_wait(open_port: Callable[..., CanPort], emptied: list[ArrivalTimes]) -> None:
    """`take` returns frames that have arrived even if the port's thread has not run since, which may wait its turn."""
    options = {"interface": "udp_multicast", "channel": GROUP, "port": free_port()}
    one, other = open_port(**options), open_port(**options)
    until_pausing(emptied, one, other)
    one.send([STEERING, BRAKE], now_ns())
    assert [received.frame for received in other.take(0)] == [STEERING, BRAKE]


def test_take_does_not_wait_for_the_ports_thread(open_port: Callable[..., CanPort]) -> None:
    """`take` returns what has been read already while the port's thread reads."""
    port = open_port("udp_multicast", GROUP, port=free_port())
    bus = port._bus
    assert bus is not None
    with bus.read_lock:
        taking = threading.Thread(target=port.take, args=(0,), daemon=True)
        taking.start()
        taking.join(DEADLINE_S)
        assert not taking.is_alive()


def test_a_frame_behind_a_flood_of_garbage_keeps_its_time(
    open_port: Callable[..., CanPort], emptied: list[ArrivalTimes], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A frame that waits behind as many malformed datagrams as are read at a time is no newer than its arrival."""
    monkeypatch.setattr(bus_module, "MAX_READS", 3)
    number = free_port()
    port, other = open_port("udp_multicast", GROUP, port=number), open_port("udp_multicast", GROUP, port=number)
    until_pausing(emptied, port, other)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        for _ in range(3):
            stranger.sendto(b"garbage", (GROUP, number))
    other.send([STEERING], now_ns())
    sent_ns = now_ns()
    pause(50 * NS_PER_MS)
    assert port.take(0) == []
    assert port.counts["unreadable"] == 3
    [received] = port.take(0)
    assert received.arrived_ns < sent_ns + 5 * NS_PER_MS


def test_a_filtered_message_does_not_hide_the_next_frame(
    open_port: Callable[..., CanPort], emptied: list[ArrivalTimes]
) -> None:
    """A message that python-can filters out, for which it returns nothing, is not taken for an empty queue."""
    options = {"interface": "udp_multicast", "channel": GROUP, "port": free_port()}
    filters = [{"can_id": STEERING.identifier, "can_mask": 0x7FF}]
    one, other = open_port(**options), open_port(**options, can_filters=filters)
    until_pausing(emptied, one, other)
    one.send([BRAKE, STEERING], now_ns())
    assert [received.frame for received in other.take(0)] == [STEERING]


def test_the_ports_thread_reads_frames_that_nobody_takes(open_port: Callable[..., CanPort]) -> None:
    """The kernel's buffer is emptied even if `take` is not called, and the frames keep their times of arrival."""
    options = {"interface": "udp_multicast", "channel": GROUP, "port": free_port()}
    one, other = open_port(**options), open_port(**options)
    sent_ns = now_ns()
    one.send([STEERING], sent_ns)
    bus = other._bus
    assert bus is not None
    until(lambda: len(bus.received) == 1)
    read_ns = now_ns()
    pause(200 * NS_PER_MS)
    [received] = other.take(0)
    assert sent_ns - NS_PER_MS < received.arrived_ns < read_ns


def test_garbage_datagrams(open_port: Callable[..., CanPort]) -> None:
    """Datagrams of the group that are not frames are counted, and the next frame is received."""
    number = free_port()
    port, other = open_port("udp_multicast", GROUP, port=number), open_port("udp_multicast", GROUP, port=number)
    garbage = [b"", b"\xff", b"\x80", b"\xc0", bytes(2000), b"\x81\xaearbitration_id\xcb?\xf8\0\0\0\0\0\0"]
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        for datagram in garbage:
            stranger.sendto(datagram, (GROUP, number))
    until(lambda: port.counts["unreadable"] == len(garbage))
    other.send([BRAKE], now_ns())
    assert receive(port, 1) == [BRAKE]


def test_a_datagram_allocates_no_more_than_its_size(open_port: Callable[..., CanPort]) -> None:
    """A datagram with a number as its data, which python-can takes for a number of bytes to allocate, is dropped."""
    number = free_port()
    port = open_port("udp_multicast", GROUP, port=number)
    fields = msgpack.unpackb(pack_message(can.Message(arbitration_id=0x064, is_extended_id=False)))
    tracemalloc.start()
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
            stranger.sendto(msgpack.packb({**fields, "data": 200_000_000}), (GROUP, number))
        until(lambda: port.counts["unreadable"] == 1)
        assert tracemalloc.get_traced_memory()[1] < 50_000_000
    finally:
        tracemalloc.stop()


def test_messages_of_a_stranger_on_a_multicast_bus(open_port: Callable[..., CanPort]) -> None:
    """On a multicast bus, error, remote and CAN FD frames, and messages whose values contradict each other, are counted
    and dropped. No such message is a loss of the bus, not even an error frame with bus-off.
    """
    number = free_port()
    port = open_port("udp_multicast", GROUP, port=number)
    messages = [
        can.Message(arbitration_id=0x040, is_error_frame=True, is_extended_id=False, data=bytes(8)),
        can.Message(arbitration_id=0x065, is_error_frame=True, is_extended_id=False, data=bytes(8)),
        can.Message(arbitration_id=0x065, is_remote_frame=True, is_extended_id=False, dlc=8),
        can.Message(arbitration_id=0x065, is_fd=True, is_extended_id=False, data=bytes(8)),
        can.Message(arbitration_id=0x065, is_error_frame=True, is_remote_frame=True, is_extended_id=False),
        can.Message(arbitration_id=0x800, is_extended_id=False, data=bytes(8)),
        can.Message(arbitration_id=0x065, is_extended_id=False, data=bytes(8), dlc=7),
        can.Message(arbitration_id=0x065, is_extended_id=False, data=bytes(12)),
        can.Message(arbitration_id=BRAKE.identifier, is_extended_id=False, data=BRAKE.data),
    ]
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        for message in messages:
            stranger.sendto(pack_message(message), (GROUP, number))
    assert receive(port, 1) == [BRAKE]
    assert {name: count for name, count in port.counts.items() if count} == {
        "error_frames": 2,
        "remote_frames": 1,
        "fd_frames": 1,
        "unreadable": 4,
    }


def test_a_read_error_loses_a_multicast_bus(
    open_port: Callable[..., CanPort], device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An error of the system, or of the driver, while a multicast bus is read is a loss of the bus."""
    monkeypatch.setitem(can.interfaces.BACKENDS, "udp_multicast", (__name__, "BreakableBus"))
    port = open_port("udp_multicast", "stick", clock=ManualClock(0))
    for error in (OSError(errno.ENETDOWN, "Network is down"), can.CanOperationError("odd")):
        device.put(error)
    until(lambda: device.opened == 3)
    assert not port.counts["unreadable"]


@pytest.mark.parametrize(("age_ns", "is_sent"), [(60 * NS_PER_MS, True), (60 * NS_PER_MS + 1, False)])
def test_too_old(open_port: Callable[..., CanPort], raw_bus: can.BusABC, age_ns: int, is_sent: bool) -> None:
    """A frame made more than 60 ms before its write is counted and not written."""
    port = open_port(clock=ManualClock(5 * NS_PER_S))
    port.send([STEERING], 5 * NS_PER_S - age_ns)
    assert (raw_bus.recv(0) is not None) is is_sent
    assert port.counts["frames_too_old"] == (not is_sent)


def test_too_old_while_writing(open_port: Callable[..., CanPort], raw_bus: can.BusABC) -> None:
    """The age is checked before each frame, so that a writer frozen between two frames does not write the rest."""
    clock = ManualClock(0)
    port = open_port(clock=clock)
    clock.step_ns = 25 * NS_PER_MS
    assert port.send([STEERING, BRAKE, STEERING, BRAKE], 0) == 2
    assert [getattr(raw_bus.recv(0), "arbitration_id", None) for _ in range(3)] == [0x064, 0x060, None]
    assert port.counts["frames_too_old"] == 2


def test_other_frames(open_port: Callable[..., CanPort], raw_bus: can.BusABC) -> None:
    """Error frames, remote frames and CAN FD frames are counted and dropped."""
    port = open_port()
    raw_bus.send(can.Message(is_error_frame=True, arbitration_id=0x04))
    raw_bus.send(can.Message(is_remote_frame=True, arbitration_id=0x60))
    raw_bus.send(can.Message(is_fd=True, arbitration_id=0x60, data=bytes(12), is_extended_id=False))
    raw_bus.send(can.Message(arbitration_id=0x60, data=b"\x07", is_extended_id=False))
    assert receive(port, 1) == [CanFrame(0x60, b"\x07")]
    assert {name: count for name, count in port.counts.items() if count} == {
        "error_frames": 1,
        "remote_frames": 1,
        "fd_frames": 1,
    }


def test_queue_is_bounded(
    open_port: Callable[..., CanPort], raw_bus: can.BusABC, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A full queue keeps the newest frames and counts the dropped frames."""
    monkeypatch.setattr(bus_module, "QUEUE_FRAMES", 4)
    port = open_port()
    for number in range(10):
        raw_bus.send(can.Message(arbitration_id=number, is_extended_id=False))
    until(lambda: port.counts["overflowed"] == 6)
    assert [received.frame.identifier for received in port.take(0)] == [6, 7, 8, 9]


def test_queue_has_room_for_two_seconds_of_a_full_bus() -> None:
    """The queue has room for 8192 frames: two seconds of a full 500 kbit/s bus."""
    assert bus_module.QUEUE_FRAMES == 8192


@dataclass
class Device:
    """A driver's device that can fail."""

    incoming: deque[can.Message | Exception] = field(default_factory=deque)
    """Results of the next reads; errors are raised."""
    open_error: Exception | None = None
    send_error: Exception | None = None
    openings: int = 0
    """How often opening has begun."""
    opened: int = 0
    shut_down: int = 0
    may_open: threading.Event = field(default_factory=threading.Event)
    """Opening waits for it."""
    on_receive: Callable[[], None] = lambda: None
    """Called in each read, before it returns a frame."""
    polls: int = 0
    """How often its descriptor was asked for, to see whether frames wait."""
    ends: tuple[socket.socket, socket.socket] = field(
        default_factory=lambda: socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    )
    """The first end is readable while frames of `put` wait."""

    def put(self, result: can.Message | Exception) -> None:
        """Let the driver receive a message, or raise an error, that its descriptor announces by a datagram."""
        self.incoming.append(result)
        self.ends[1].send(pack_message(can.Message()))


DEVICES: dict[str, Device] = {}


class BreakableBus(can.BusABC):
    """The driver of the device."""

    def __init__(self, channel: str, **_: Any) -> None:
        self.device = DEVICES[channel]
        self.device.openings += 1
        assert self.device.may_open.wait(DEADLINE_S)
        if self.device.open_error:
            raise self.device.open_error
        self.device.opened += 1
        super().__init__(channel)

    def fileno(self) -> int:  # noqa: D102 (python-can's)
        self.device.polls += 1
        return self.device.ends[0].fileno()

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:  # noqa: ARG002 (python-can's)
        if self.device.ends[0] in select.select([self.device.ends[0]], [], [], 0)[0]:
            self.device.ends[0].recv(1)  # the whole datagram
        if not self.device.incoming:
            pause(NS_PER_MS)
            return None, False
        self.device.on_receive()
        result = self.device.incoming.popleft()
        if isinstance(result, Exception):
            raise result
        return result, False

    def send(self, msg: can.Message, timeout: float | None = None) -> None:  # noqa: ARG002, D102 (python-can's)
        if self.device.send_error:
            raise self.device.send_error

    def shutdown(self) -> None:  # noqa: D102 (python-can's)
        self.device.shut_down += 1
        super().shutdown()


@pytest.fixture
def device(monkeypatch: pytest.MonkeyPatch) -> Iterator[Device]:
    monkeypatch.setitem(can.interfaces.BACKENDS, "breakable", (__name__, "BreakableBus"))
    monkeypatch.setattr(bus_module, "REOPEN_NS", 20 * NS_PER_MS)
    DEVICES["stick"] = device = Device()
    device.may_open.set()
    yield device
    device.may_open.set()
    for end in device.ends:
        end.close()


def until_back(port: CanPort) -> None:
    """Wait until a lost bus is open again."""

    def is_back() -> bool:
        with suppress(BusGone):
            return port.take(0) == []
        return False

    until(is_back)


def test_reopening_period() -> None:
    """A lost bus is reopened at most once a second."""
    assert bus_module.REOPEN_NS == NS_PER_S


def test_bus_gone_and_back(open_port: Callable[..., CanPort], device: Device) -> None:
    """A lost bus raises an error in reading and writing until it is reopened, and then receives again."""
    port = open_port("breakable", "stick", clock=ManualClock(0))
    device.may_open.clear()
    device.open_error = OSError(errno.ENODEV, "No such device")
    device.incoming.append(can.CanOperationError("Error receiving: Network is down", errno.ENETDOWN))
    until(lambda: device.shut_down == 1)
    for attempt in (lambda: port.take(0), lambda: port.send([STEERING], 0)):
        with pytest.raises(BusGone, match=r"breakable stick cannot be read .*Network is down"):
            attempt()
    device.may_open.set()
    until(lambda: "cannot be opened" in port._gone_reason)
    with pytest.raises(BusGone, match=r"breakable stick cannot be opened .*No such device"):
        port.take(0)
    device.open_error = None
    until_back(port)
    device.incoming.append(can.Message(arbitration_id=7, is_extended_id=False))
    assert receive(port, 1) == [CanFrame(7, b"")]
    assert port.send([STEERING], 0) == 1
    assert device.opened == 2


def test_a_slow_opening_blocks_nobody(open_port: Callable[..., CanPort], device: Device) -> None:
    """While a lost bus is being opened, reading and writing raise an error immediately, and the port can be closed."""
    port = open_port("breakable", "stick", clock=ManualClock(0))
    device.may_open.clear()
    device.incoming.append(OSError(errno.ENODEV, "gone"))
    until(lambda: (device.shut_down, device.openings) == (1, 2))
    for _ in range(100):
        with pytest.raises(BusGone):
            port.take(10 * NS_PER_S)
        with pytest.raises(BusGone):
            port.send([STEERING], 0)
    port.close()
    device.may_open.set()
    until(lambda: device.shut_down == device.opened == 2)


def test_frames_before_the_loss_are_dropped(open_port: Callable[..., CanPort], device: Device) -> None:
    """Frames received before the bus was lost are never returned, not even after the bus is open again."""
    port = open_port("breakable", "stick", clock=ManualClock(0))
    device.incoming.extend([can.Message(arbitration_id=7, is_extended_id=False), OSError(errno.ENODEV, "gone")])
    until(lambda: device.shut_down == 1)
    with pytest.raises(BusGone):
        port.take(0)
    until_back(port)
    device.incoming.append(can.Message(arbitration_id=8, is_extended_id=False))
    assert receive(port, 1) == [CanFrame(8, b"")]


def test_frames_before_a_suspension_are_dropped(open_port: Callable[..., CanPort], device: Device) -> None:
    """Frames queued before a suspension, or being read when the suspension is noticed, are never returned: the
    monotonic clock stood still, so their age is unknown.
    """
    suspended = [0]
    port = open_port("breakable", "stick", clock=ManualClock(0), read_suspended_ns=lambda: suspended[0])
    is_reading, may_read = threading.Event(), threading.Event()
    device.incoming.append(can.Message(arbitration_id=6, is_extended_id=False))
    until(lambda: not device.incoming)

    def wait() -> None:
        is_reading.set()
        assert may_read.wait(DEADLINE_S)

    device.on_receive = wait
    device.incoming.append(can.Message(arbitration_id=7, is_extended_id=False))
    assert is_reading.wait(DEADLINE_S)
    suspended[0] = NS_PER_S
    with pytest.raises(BusGone, match="suspended"):
        port.take(0)
    may_read.set()
    until_back(port)
    device.on_receive = lambda: None
    device.incoming.append(can.Message(arbitration_id=8, is_extended_id=False))
    assert receive(port, 1) == [CanFrame(8, b"")]


def test_a_bus_opened_during_a_suspension_is_opened_again(open_port: Callable[..., CanPort], device: Device) -> None:
    """A bus that was being reopened when the machine was suspended is not used: it can have frames from before."""
    suspended = [0]
    port = open_port("breakable", "stick", clock=ManualClock(0), read_suspended_ns=lambda: suspended[0])
    device.may_open.clear()
    device.incoming.append(OSError(errno.ENODEV, "gone"))
    until(lambda: (device.shut_down, device.openings) == (1, 2))
    suspended[0] = NS_PER_S
    with pytest.raises(BusGone):
        port.take(0)
    device.may_open.set()
    until_back(port)
    assert (device.opened, device.shut_down) == (3, 2)


def test_the_port_survives_any_error_of_opening(open_port: Callable[..., CanPort], device: Device) -> None:
    """If reopening fails with an error of the system, such as too many open files, reopening is tried again."""
    port = open_port("breakable", "stick", clock=ManualClock(0))
    failures = [OSError(errno.EMFILE, "Too many open files"), OSError(), MemoryError()]

    def no_descriptor(*keys: Any) -> can.BusABC:
        if failures:
            raise failures.pop()
        return open_bus(*keys)

    open_bus = bus_module._open_bus
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(bus_module, "_open_bus", no_descriptor)
        device.incoming.append(OSError(errno.ENODEV, "gone"))
        until(lambda: device.opened == 2)
    until_back(port)


def test_a_frame_that_arrives_while_the_bus_opens_is_not_newer(
    open_port: Callable[..., CanPort], device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A frame that arrived before the port first read the bus has its true time of arrival."""
    monkeypatch.setitem(can.interfaces.BACKENDS, "udp_multicast", (__name__, "BreakableBus"))
    clock = ManualClock(10 * NS_PER_S, wall_ahead_ns=1_790_000_000 * NS_PER_S)
    timestamp_s = clock.now().wall_ns / NS_PER_S
    open_bus = bus_module._open_bus

    def open_slowly(*keys: Any) -> can.BusABC:
        bus = open_bus(*keys)
        clock.advance(500)
        return bus

    monkeypatch.setattr(bus_module, "_open_bus", open_slowly)
    device.put(can.Message(arbitration_id=7, is_extended_id=False, timestamp=timestamp_s))
    port = open_port("udp_multicast", "stick", clock=clock)
    taken: list[ReceivedCanFrame] = []

    def is_there() -> bool:
        taken.extend(port.take(0))
        return bool(taken)

    until(is_there)
    assert abs(taken[0].arrived_ns - 10 * NS_PER_S) < 1000


@pytest.mark.parametrize(
    "error",
    [
        can.CanOperationError("Failed to transmit: No buffer space available", errno.ENOBUFS),
        can.CanOperationError("Transmit buffer full"),
        can.CanTimeoutError(),
    ],
)
def test_a_full_buffer_is_no_loss(open_port: Callable[..., CanPort], device: Device, error: Exception) -> None:
    """Frames that do not fit into the transmit buffer are counted and dropped, and the bus can be used on."""
    port = open_port("breakable", "stick", clock=ManualClock(0))
    device.send_error = error
    assert port.send([STEERING, BRAKE], 0) == 0
    assert port.counts["buffer_full"] == 2
    device.send_error = None
    assert port.send([STEERING], 0) == 1
    assert port.take(0) == []
    assert device.shut_down == 0


@pytest.mark.parametrize(
    "error",
    [
        can.CanOperationError("Failed to transmit: Network is down", errno.ENETDOWN),
        OSError(errno.ENODEV, "No such device"),
        can.CanOperationError("the device does not answer"),
        OSError("no number"),
        RuntimeError(),
    ],
)
def test_a_failed_write_loses_the_bus(open_port: Callable[..., CanPort], device: Device, error: Exception) -> None:
    """A write that fails for another reason raises an error immediately, and the bus is reopened."""
    port = open_port("breakable", "stick", clock=ManualClock(0))
    device.may_open.clear()
    device.send_error = error
    with pytest.raises(BusGone, match=r"breakable stick cannot be written to") as raised:
        port.send([STEERING], 0)
    assert raised.value.written == 0
    device.send_error = None
    with pytest.raises(BusGone):
        port.send([STEERING], 0)
    device.may_open.set()
    until_back(port)
    assert device.shut_down == 1
    assert port.send([STEERING], 0) == 1


def test_a_suspended_machine(open_port: Callable[..., CanPort], device: Device) -> None:
    """A suspension of 100 ms or more is treated as a loss of the bus: nothing is written until the bus is reopened."""
    suspended_ms = [5000]
    port = open_port("breakable", "stick", clock=ManualClock(0), read_suspended_ns=lambda: suspended_ms[0] * NS_PER_MS)
    for step_ms, is_lost in ((99, False), (-80, False), (100, False), (100, True)):
        suspended_ms[0] += step_ms
        device.may_open.clear()
        if is_lost:
            with pytest.raises(BusGone, match="suspended"):
                port.send([STEERING], 0)
            with pytest.raises(BusGone, match="suspended"):
                port.take(0)
        else:
            assert port.send([STEERING], 0) == 1
    device.may_open.set()
    until_back(port)
    suspended_ms[0] += 100
    with pytest.raises(BusGone, match="suspended"):
        port.take(0)


def test_suspended_time_of_this_machine() -> None:
    """The time for which the machine was suspended does not grow while it runs."""
    before_ns = suspended_ns()
    pause(50 * NS_PER_MS)
    assert suspended_ns() - before_ns < 40 * NS_PER_MS


@pytest.fixture
def timestamped(
    open_port: Callable[..., CanPort], device: Device, monkeypatch: pytest.MonkeyPatch
) -> TimestampedFrames:
    monkeypatch.setitem(can.interfaces.BACKENDS, "udp_multicast", (__name__, "BreakableBus"))
    clock = ManualClock(10 * NS_PER_S, wall_ahead_ns=1_790_000_000 * NS_PER_S)
    return TimestampedFrames(open_port("udp_multicast", "stick", clock=clock), device, clock)


@dataclass
class TimestampedFrames:
    """A port whose frames have wall-clock timestamps of a clock that a test sets."""

    port: CanPort
    device: Device
    clock: ManualClock

    def receive(self, *, waits_ms: int, step_ms: int = 0) -> float | None:
        """Let a frame arrive, step the wall clock, and let the port read the frame after a time.

        Return the error of its arrival time in ms, or None if the frame was dropped.
        """
        polls = self.device.polls
        until(lambda: self.device.polls >= polls + 2)  # the port has found the queue empty since the last step
        self.clock.advance(20)
        arrived, clock = self.clock.now(), self.clock

        def wait() -> None:
            clock.advance(waits_ms)
            clock.wall_ahead_ns += step_ms * NS_PER_MS

        self.device.on_receive = wait
        timestamp_s = arrived.wall_ns / NS_PER_S
        self.device.put(can.Message(arbitration_id=7, is_extended_id=False, timestamp=timestamp_s))
        until(lambda: not self.device.incoming)
        taken: list[ReceivedCanFrame] = []

        def is_done() -> bool:
            taken.extend(self.port.take(0))
            return bool(taken) or self.port.counts["read_too_late"] > 0

        until(is_done)
        return (taken[0].arrived_ns - arrived.mono_ns) / NS_PER_MS if taken else None


@pytest.mark.parametrize("step_ms", [-3_600_000, -50, 0, 50, 150, 300, 3_600_000])
def test_a_step_of_the_wall_clock_changes_no_age(timestamped: TimestampedFrames, step_ms: int) -> None:
    """A step of the wall clock between the arrival of a frame and its reading does not change the frame's age."""
    for _ in range(3):
        error_ms = timestamped.receive(waits_ms=5, step_ms=step_ms)
        assert error_ms is not None
        assert abs(error_ms) < 0.001


@pytest.mark.parametrize(("waits_ms", "is_received"), [(1000, True), (1001, False)])
def test_a_frame_that_waited_too_long_is_dropped(
    timestamped: TimestampedFrames, waits_ms: int, is_received: bool
) -> None:
    """A frame that has waited in the kernel for more than a second is counted and dropped."""
    assert (timestamped.receive(waits_ms=waits_ms) is not None) == is_received


@pytest.mark.parametrize("interface", ["virtual", "udp_multicast"])
def test_a_port_closes_whatever_the_wall_clock_does(monkeypatch: pytest.MonkeyPatch, interface: str) -> None:
    """A wall clock that is set back does not delay the closing of a silent bus by more than 5 s."""
    hours_back = [0]
    monkeypatch.setattr(can.bus, "time", lambda: MachineClock().now().wall_ns / NS_PER_S - 3600 * hours_back[0])
    options = {} if interface == "virtual" else {"port": free_port()}
    port = CanPort(interface, GROUP, options, clock=MachineClock())
    pause(50 * NS_PER_MS)
    hours_back[0] = 1
    pause(200 * NS_PER_MS)
    before_ns = now_ns()
    port.close()
    assert now_ns() - before_ns < 5 * NS_PER_S
    with pytest.raises(BusGone):
        port.send([STEERING], now_ns())
    assert port._thread.is_alive() == (interface == "virtual")
    if interface == "virtual":  # its thread waits for a frame
        with can.Bus(interface="virtual", channel=GROUP, ignore_config=True) as other:
            other.send(can.Message(arbitration_id=7))
        port._thread.join(DEADLINE_S)
        assert not port._thread.is_alive()


def test_bus_off(open_port: Callable[..., CanPort], device: Device) -> None:
    """An error frame with bus-off means that the bus is lost."""
    port = open_port("breakable", "stick", clock=ManualClock(0))
    device.may_open.clear()
    device.incoming.append(can.Message(is_error_frame=True, arbitration_id=0x40, is_extended_id=False))
    until(lambda: device.shut_down == 1)
    with pytest.raises(BusGone, match="bus-off"):
        port.take(0)
    device.may_open.set()


def test_closed(device: Device) -> None:
    """A closed port has released the bus, rejects frames, and can be closed again."""
    port = CanPort("breakable", "stick", {}, clock=ManualClock(0))
    port.close()
    port.close()
    assert (device.opened, device.shut_down) == (1, 1)
    with pytest.raises(BusGone):
        port.send([STEERING], 0)


REJECTED = [
    ("nosuch", "can0", {}, "there is no CAN interface nosuch: name one of .*socketcan"),
    ("virtual", "", {}, "a bus of virtual needs a channel"),
    ("virtual", "x", {"receive_own_messages": True}, "leave out receive_own_messages"),
    ("udp_multicast", "1.2.3.4", {}, r"udp_multicast 1\.2\.3\.4 cannot be opened \(.*Invalid argument\)"),
    ("udp_multicast", GROUP, {"port": 99999}, "cannot be opened .*port must be 0-65535"),
    ("socketcan", "nosuch0", {}, "socketcan nosuch0 cannot be opened"),
]


@pytest.mark.filterwarnings(
    "ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning"
)  # python-can's
@pytest.mark.parametrize(("interface", "channel", "options", "reason"), REJECTED)
def test_rejected(interface: str, channel: str, options: dict[str, Any], reason: str) -> None:
    """A bus that cannot be opened is rejected with an error of one line."""
    with pytest.raises(UserError, match=reason) as rejected:
        CanPort(interface, channel, options, clock=MachineClock())
    assert "\n" not in str(rejected.value)
    del rejected
    gc.collect()  # while warnings about python-can's open sockets are ignored


@pytest.mark.parametrize(
    ("number", "remedy"), [(errno.ENODEV, "ip link"), (errno.EPERM, "permission"), (errno.EAFNOSUPPORT, "can_raw")]
)
def test_remedies(device: Device, number: int, remedy: str) -> None:
    """The errors for a missing channel, a missing permission and a kernel without CAN name a remedy."""
    device.open_error = OSError(number, "rejected")
    with pytest.raises(UserError, match=rf"breakable stick cannot be opened \(.*rejected\): .*{remedy}"):
        CanPort("breakable", "stick", {}, clock=MachineClock())


def test_without_python_can(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without python-can the error says how to install it."""

    def missing(name: str) -> None:
        raise ImportError(f"No module named {name!r}")

    monkeypatch.setattr(bus_module, "import_module", missing)
    with pytest.raises(UserError, match=r"pip install -e '\.\[can\]'"):
        CanPort("virtual", "x", {}, clock=MachineClock())


@pytest.mark.parametrize(
    ("bus", "output", "expected"),
    [
        (("virtual", "x", {}), "", True),
        (("udp_multicast", GROUP, {}), "", True),
        (("inside", "", {}), "", True),
        (("udp_multicast", GROUP, {"hop_limit": 0}), "", True),
        (("udp_multicast", GROUP, {"hop_limit": 1}), "", False),
        (("pcan", "PCAN_USBBUS1", {}), "", False),
        (("socketcan", "vcan0", {}), '[{"ifname": "vcan0", "linkinfo": {"info_kind": "vcan"}}]', True),
        (("socketcan", "can0", {}), '[{"ifname": "can0", "linkinfo": {"info_kind": "can"}}]', False),
        (("socketcan", "slcan0", {}), '[{"ifname": "slcan0"}]', False),
        (("socketcan", "vcan0", {}), "[]", False),
        (("socketcan", "vcan0", {}), "nonsense", False),
    ],
)
def test_is_virtual(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, bus: tuple[str, str, dict[str, Any]], output: str, expected: bool
) -> None:
    """A bus is virtual if python-can or the kernel says so, and not otherwise."""
    program = tmp_path / "ip"
    program.write_text(f"#!/bin/sh\nprintf '%s' '{output}'\n")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setattr("lavt.vehicle.dbw.bus.socket.if_nametoindex", lambda _: 3)
    monkeypatch.setattr("lavt.vehicle.dbw.virtual_bus.gateway_interfaces", frozenset)
    assert is_virtual(*bus) is expected


def test_a_forwarded_bus_is_not_virtual(monkeypatch: pytest.MonkeyPatch) -> None:
    """A vcan is not virtual if a gateway rule names it, or if the gateway rules cannot be read."""

    def unreadable() -> frozenset[int]:
        raise OSError

    monkeypatch.setattr("lavt.vehicle.dbw.virtual_bus._link_kind", lambda _: "vcan")
    monkeypatch.setattr("lavt.vehicle.dbw.bus.socket.if_nametoindex", lambda _: 3)
    for read, expected in ((lambda: frozenset({4, 5}), True), (lambda: frozenset({3, 5}), False), (unreadable, False)):
        monkeypatch.setattr("lavt.vehicle.dbw.virtual_bus.gateway_interfaces", read)
        assert is_virtual("socketcan", "vcan0", {}) is expected


def test_is_virtual_unknown(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """A bus is not virtual if the interface does not exist or `ip` is missing."""
    assert not is_virtual("socketcan", "lo", {})
    assert not is_virtual("socketcan", "nosuch0", {})
    monkeypatch.setenv("PATH", str(tmp_path))
    assert not is_virtual("socketcan", "vcan0", {})


def test_log(tmp_path: Path) -> None:
    """A written log is read back unchanged, to the microsecond."""
    written = [
        ReceivedCanFrame(STEERING, 1_700_000_000_000_001_000),
        ReceivedCanFrame(EXTENDED, 1_700_000_000_500_000_000),
    ]
    log = tmp_path / "drive.log"
    log.write_text("".join(log_line(entry.arrived_ns, "vcan0", entry.frame) for entry in written))
    read_back = list(read_log(log))
    assert [entry.frame for entry in read_back] == [entry.frame for entry in written]
    assert [round(entry.arrived_ns / 1000) for entry in read_back] == [entry.arrived_ns // 1000 for entry in written]
    assert log.read_text().splitlines()[1] == "(1700000000.500000) vcan0 00002F01#01"


def test_bad_log(tmp_path: Path) -> None:
    """The error for a missing or damaged log has the number of frames read."""
    with pytest.raises(UserError, match=r"missing\.log cannot be read after 0 frames"):
        list(read_log(tmp_path / "missing.log"))
    bad = tmp_path / "bad.log"
    bad.write_text(log_line(0, "can0", STEERING) + "and then nothing\n")
    with pytest.raises(UserError, match=r"bad\.log cannot be read after 1 frames"):
        list(read_log(bad))


def test_counts_of_a_log(tmp_path: Path) -> None:
    """Error and remote frames in a log are ignored."""
    log = tmp_path / "drive.log"
    log.write_text("(1.0) can0 20000080#0000000000000000\n(2.0) can0 060#R\n(3.0) can0 060#01\n")
    assert [entry.frame for entry in read_log(log)] == [CanFrame(0x60, b"\x01")]
