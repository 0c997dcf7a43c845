"""A CAN bus through python-can, on any of its interfaces. Writes never block; received frames are queued.

This is the only module that uses python-can, which comes with the extra `can`. Periodic sending, by python-can or by
the kernel (CAN_BCM), must not be used anywhere: it would repeat the last command of a frozen program
(`tests/test_no_periodic_sending.py`).
"""

from __future__ import annotations

import errno
import logging
import secrets
import select
import socket
import threading
from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from lavt.clock import Clock, suspended_ns
from lavt.domain import NS_PER_S, Now
from lavt.errors import UserError
from lavt.vehicle.can_frame import BusGone, CanFrame, ReceivedCanFrame
from lavt.vehicle.dbw.kernel_arrival import ArrivalTimes
from lavt.vehicle.dbw.multicast_datagram import DatagramCheck
from lavt.vehicle.dbw.profile import COMMAND_TIMEOUT_NS, TICK_LIMIT_NS
from lavt.vehicle.dbw.virtual_bus import SELF_RECEIVING_INTERFACE, VIRTUAL_INTERFACES

if TYPE_CHECKING:
    from can import BusABC, Message

REOPEN_NS: Final = NS_PER_S
"""Pause before each attempt to reopen a lost bus. After the pause, reports from before the loss are too old."""
QUEUE_FRAMES: Final = 8192
"""Capacity of the receive queue: two seconds of a full 500 kbit/s bus. If it is full, the oldest frames are dropped."""
POLL_S: Final = 0.1
"""Period at which the port's thread checks whether the port was closed."""
CLOSE_TIMEOUT_S: Final = 1.0
"""`close` waits at most this long for the port's thread. A thread that a driver blocks for longer keeps running."""
READ_PERIOD_S: Final = 0.05
"""Period at which the port's thread reads frames of `STAMPED_BY_KERNEL` interfaces, even if `take` is not called. In
between, the kernel queues them."""
MAX_READS: Final = 256
"""The most frames that are read at a time, so that a flood does not delay the caller of `take`."""
READ_AGE_LIMIT_NS: Final = NS_PER_S
"""A frame that arrived longer ago than this when it is read is dropped, because this process was frozen."""

logging.getLogger("can").addHandler(logging.NullHandler())  # errors raised here contain what python-can would log

STAMPED_BY_KERNEL: Final = frozenset({"socketcan", "udp_multicast"})
"""Interfaces whose frames have the kernel's wall time of arrival, and whose descriptor is readable if and only if a
frame is waiting. Frames of other interfaces have times of their devices' clocks."""
BUS_OFF_BIT: Final = 0x40
"""Bit in the identifier of an error frame of SocketCAN (linux/can/error.h, CAN_ERR_BUSOFF)."""
FULL_BUFFER_TEXT: Final = "Transmit buffer full"
"""Text of an error of python-can's SocketCAN interface that has no error number."""


class OpenBus(NamedTuple):
    """An open bus. If the bus is lost, the frames received from it are dropped, because their age can be unknown."""

    driver: BusABC
    received: deque[ReceivedCanFrame]
    arrivals: ArrivalTimes
    datagram_check: DatagramCheck | None
    read_lock: threading.Lock
    """Held by the thread that reads a frame."""

    def shut_down(self) -> None:
        """Close the driver's bus, which may be broken already."""
        if self.datagram_check is not None:
            self.datagram_check.close()
        with suppress(Exception):
            self.driver.shutdown()


class CanPort:
    """A `BusPort` on a CAN bus. Only one thread may call `send` and `take`, which never block.

    The port has a thread, which reads frames and reopens a lost bus; reopening takes some drivers a second.

    `counts` has numbers of frames: `frames_too_old` and `buffer_full` were not sent; `error_frames`, `remote_frames`,
    `fd_frames`, `unreadable`, `read_too_late` and `own_frames` were received and dropped; `overflowed` were dropped
    from a full queue. The argument `read_suspended_ns` returns for how long the machine was suspended since its start.

    Raises `UserError` if python-can is missing or the bus cannot be opened.
    """

    def __init__(
        self,
        interface: str,
        channel: str,
        options: Mapping[str, Any],
        *,
        clock: Clock,
        read_suspended_ns: Callable[[], int] = suspended_ns,
    ) -> None:
        self._interface, self._channel, self._options = interface, channel, dict(options)
        self._clock, self._read_suspended_ns = clock, read_suspended_ns
        self._own_mark = secrets.token_hex(8) if interface == SELF_RECEIVING_INTERFACE else None
        """Marks the frames that this port sends, so that it can drop them; None if it does not receive them."""
        self._gone_reason = ""
        self._suspended_ns = read_suspended_ns()
        self._closing = threading.Event()
        self.counts: Counter[str] = Counter()
        bus = self._open()
        self._bus: OpenBus | None = bus
        """The open bus; None if it is lost. The port's thread shuts a lost bus down."""
        self._thread = threading.Thread(target=self._run, args=(bus,), name="can", daemon=True)
        self._thread.start()

    def send(self, frames: Sequence[CanFrame], made_ns: int) -> int:
        """Write frames made at `made_ns`, in order and without blocking; return how many were written.

        The remaining frames are not written if their age exceeds `TICK_LIMIT_NS` (checked before each write), or if the
        transmit buffer is full, which is no loss of the bus. If the bus is lost, they are not written, and `BusGone` is
        raised.
        """
        for written, frame in enumerate(frames):
            message = self._message(frame)
            self._check_suspension()
            bus = self._bus
            if bus is None:
                raise BusGone(self._gone_reason, written)
            if self._clock.now().mono_ns - made_ns > TICK_LIMIT_NS:
                self.counts["frames_too_old"] += len(frames) - written
                return written
            try:
                bus.driver.send(message, timeout=0)
            except Exception as error:  # of any driver
                if _is_buffer_full(error):
                    self.counts["buffer_full"] += len(frames) - written
                    return written
                self._declare_lost(f"{self._interface} {self._channel} cannot be written to ({_error_text(error)})")
                raise BusGone(self._gone_reason, written) from error
        return len(frames)

    def take(self, now_ns: int) -> list[ReceivedCanFrame]:  # noqa: ARG002 (other ports need it)
        """Return the frames received since the last call, in order. Raises `BusGone` if the bus is lost.

        The frames that this port sent are not among them.
        """
        self._check_suspension()
        bus = self._bus
        if bus is not None and self._interface in STAMPED_BY_KERNEL and bus.read_lock.acquire(blocking=False):
            try:
                self._read_waiting(bus)
            except Exception as error:  # of any driver
                self._declare_unreadable(bus, error)
            finally:
                bus.read_lock.release()
        bus = self._bus
        if bus is None:
            raise BusGone(self._gone_reason)
        return [bus.received.popleft() for _ in range(len(bus.received))]

    def next_wake_ns(self) -> int | None:
        """Return None, because the arrival of frames cannot be predicted."""
        return None

    def close(self) -> None:
        """Close the bus, and wait for the port's thread for at most `CLOSE_TIMEOUT_S`."""
        self._closing.set()
        self._declare_lost("the port is closed")
        self._thread.join(CLOSE_TIMEOUT_S)

    def _check_suspension(self) -> None:
        """Declare the bus lost if the machine was suspended: the monotonic clock stood still, so ages are too small."""
        before_ns, self._suspended_ns = self._suspended_ns, max(self._read_suspended_ns(), self._suspended_ns)
        if self._suspended_ns - before_ns >= COMMAND_TIMEOUT_NS:
            self._declare_lost("the machine was suspended")

    def _declare_lost(self, reason: str) -> None:
        self._gone_reason = reason
        self._bus = None

    def _run(self, bus: OpenBus | None) -> None:
        """Read frames and reopen the bus after each loss, until the port is closed."""
        while bus is not None:
            self._read(bus)
            bus = self._reopen()

    def _open(self) -> OpenBus:
        opened = self._clock.now()  # before the first frame can arrive
        driver = _open_bus(self._interface, self._channel, self._options)
        datagram_check = DatagramCheck(driver.fileno()) if self._interface == SELF_RECEIVING_INTERFACE else None
        return OpenBus(driver, deque(maxlen=QUEUE_FRAMES), ArrivalTimes(opened), datagram_check, threading.Lock())

    def _reopen(self) -> OpenBus | None:
        """Try to open the bus until it is open; return None if the port is closed first."""
        while not self._closing.wait(REOPEN_NS / NS_PER_S):
            suspended_ns = self._read_suspended_ns()
            try:
                bus = self._open()
            except Exception as error:  # of the driver or of the system, which can be out of descriptors
                self._gone_reason = _error_text(error)
            else:
                if self._read_suspended_ns() - suspended_ns < COMMAND_TIMEOUT_NS:
                    self._bus = bus
                    return bus
                bus.shut_down()
        return None

    def _read(self, bus: OpenBus) -> None:
        """Read frames until the bus is lost or the port closed, then shut the bus down."""
        try:
            while self._bus is bus and not self._closing.is_set():
                if self._interface not in STAMPED_BY_KERNEL:
                    self._read_frame(bus, POLL_S)
                    continue
                with bus.read_lock:
                    self._read_waiting(bus)
                self._closing.wait(READ_PERIOD_S)
        except Exception as error:  # of any driver
            self._declare_unreadable(bus, error)
        finally:
            if self._bus is bus:
                self._declare_lost("the port is closed")
            bus.shut_down()

    def _read_waiting(self, bus: OpenBus) -> None:
        """Read the frames that wait; the caller holds `bus.read_lock`.

        Only `select` tells whether the queue is empty: python-can also returns None for a message that it filters out,
        and on an empty queue it can wait longer than the timeout if the wall clock is set back.
        """
        for _ in range(MAX_READS):
            now = self._clock.now()
            if not select.select([bus.driver.fileno()], [], [], 0)[0]:
                bus.arrivals.note_empty(now)
                return
            self._read_frame(bus, 0)

    def _declare_unreadable(self, bus: OpenBus, error: Exception) -> None:
        """Declare a bus lost whose driver raised `error`, unless it is lost already."""
        if self._bus is bus:
            self._declare_lost(f"{self._interface} {self._channel} cannot be read ({_error_text(error)})")

    def _read_frame(self, bus: OpenBus, timeout_s: float) -> None:
        """Wait for a frame for at most `timeout_s`, and read it."""
        try:
            if bus.datagram_check is not None and bus.datagram_check.drop_malformed():
                self.counts["unreadable"] += 1
                return
            message = bus.driver.recv(timeout_s)
        except BlockingIOError:  # `select` reported a datagram, but the kernel then dropped it for a wrong checksum
            return
        except Exception as error:
            is_unpacking_error = error.__cause__ is not None and not isinstance(error.__cause__, OSError)
            if bus.datagram_check is None or not is_unpacking_error:
                raise
            self.counts["unreadable"] += 1  # the values of the datagram contradict each other
            return
        if message is not None:
            self._receive(message, self._clock.now(), bus)

    def _receive(self, message: Message, now: Now, bus: OpenBus) -> None:
        if self._own_mark is not None and message.channel == self._own_mark:
            self.counts["own_frames"] += 1
            return
        is_controller_error = message.is_error_frame and self._interface not in VIRTUAL_INTERFACES
        if is_controller_error and message.arbitration_id & BUS_OFF_BIT:
            raise BusGone("the controller is bus-off")
        frame = _data_frame(message, self.counts)
        if frame is None:
            return
        arrived_ns = now.mono_ns
        if self._interface in STAMPED_BY_KERNEL:
            arrived_ns = bus.arrivals.arrived_ns(round(message.timestamp * NS_PER_S), now)
            if now.mono_ns - arrived_ns > READ_AGE_LIMIT_NS:
                self.counts["read_too_late"] += 1
                return
        self.counts["overflowed"] += len(bus.received) == QUEUE_FRAMES
        bus.received.append(ReceivedCanFrame(frame, arrived_ns))

    def _message(self, frame: CanFrame) -> Message:
        message: Message = _library().Message(
            arbitration_id=frame.identifier, is_extended_id=frame.is_extended, data=frame.data, channel=self._own_mark
        )
        return message


def read_log(path: Path) -> Iterator[ReceivedCanFrame]:
    """Yield the frames of a log (candump's `.log`, or another format of python-can), with the times in the log.

    Raises `UserError` if the log cannot be read.
    """
    counts: Counter[str] = Counter()
    count = 0
    try:
        with _library().LogReader(path) as messages:
            for message in messages:
                frame = _data_frame(message, counts)
                if frame is not None:
                    count += 1
                    yield ReceivedCanFrame(frame, round(message.timestamp * NS_PER_S))
    except Exception as error:  # of any reader
        raise UserError(
            f"{path} cannot be read after {count} frames ({_error_text(error)}): name a log, as `candump -L` writes it"
        ) from error


def log_line(received_ns: int, channel: str, frame: CanFrame) -> str:
    """Format a frame as a line of `candump -L`."""
    digits = 8 if frame.is_extended else 3
    seconds, nanoseconds = divmod(received_ns, NS_PER_S)
    return f"({seconds}.{nanoseconds // 1000:06d}) {channel} {frame.identifier:0{digits}X}#{frame.data.hex().upper()}\n"


def _library() -> Any:
    try:
        return import_module("can")  # an extra
    except ImportError as error:
        raise UserError(f"a CAN bus needs python-can ({error}): pip install -e '.[can]' in the clone") from error


def _open_bus(interface: str, channel: str, options: Mapping[str, Any]) -> BusABC:
    """Open a bus of python-can, without the settings of the user's account (`~/.canrc`)."""
    library = _library()
    known = library.interfaces.BACKENDS
    if interface not in known:
        raise UserError(f"there is no CAN interface {interface}: name one of {', '.join(sorted(known))}")
    if not channel:
        raise UserError(f"a bus of {interface} needs a channel: name one, like can0")
    if options.get("receive_own_messages"):
        raise UserError("a port does not receive its own frames: leave out receive_own_messages")
    if interface == "socketcan" and channel not in (name for _, name in socket.if_nameindex()):
        # python-can would report this error, too, but leave a socket open
        raise UserError(f"socketcan {channel} cannot be opened (no such device): {REMEDIES[errno.ENODEV]}")
    # LAVT treats a multicast bus as virtual (`is_virtual`) unless the config has a hop limit.
    defaults = {"hop_limit": 0} if interface == SELF_RECEIVING_INTERFACE else {}
    try:
        bus: BusABC = library.Bus(channel=channel, interface=interface, ignore_config=True, **{**defaults, **options})
    except Exception as error:  # of any driver
        remedy = REMEDIES.get(_error_number(error), "see python-can's page on this interface")
        raise UserError(f"{interface} {channel} cannot be opened ({_error_text(error)}): {remedy}") from error
    return bus


REMEDIES: Final[Mapping[int | None, str]] = {
    errno.ENODEV: "name a channel that `ip link` shows",
    errno.EPERM: "run it as a user with the permission",
    errno.EACCES: "run it as a user with the permission",
    errno.EAFNOSUPPORT: "this kernel has no SocketCAN; load it with `modprobe can_raw` where it is installed",
}


def _data_frame(message: Message, counts: Counter[str]) -> CanFrame | None:
    """Return the data frame of a message; count anything else and return None."""
    if message.is_error_frame:
        counts["error_frames"] += 1
    elif message.is_remote_frame:
        counts["remote_frames"] += 1
    elif message.is_fd:
        counts["fd_frames"] += 1
    elif type(message.arbitration_id) is not int or len(message.data) > 8:  # a driver's fault
        counts["unreadable"] += 1
    else:
        return CanFrame(message.arbitration_id, bytes(message.data), bool(message.is_extended_id))
    return None


def _error_number(error: Exception) -> int | None:
    """Return the system's error number, or None."""
    for candidate in (error, error.__cause__):
        if isinstance(candidate, OSError):
            return candidate.errno
        code = getattr(candidate, "error_code", None)
        if isinstance(code, int):
            return code
    return None


def _is_buffer_full(error: Exception) -> bool:
    """Return whether a write failed because the transmit buffer is full, which is no loss of the bus."""
    has_no_room = isinstance(error, _library().CanTimeoutError) or str(error) == FULL_BUFFER_TEXT
    return has_no_room or _error_number(error) in {errno.ENOBUFS, errno.EAGAIN}


def _error_text(error: Exception) -> str:
    """Return the first line of an error's message, and that of its cause."""
    lines = [str(candidate).partition("\n")[0] for candidate in (error, error.__cause__) if candidate is not None]
    return ": ".join(dict.fromkeys(line for line in lines if line)) or type(error).__name__
