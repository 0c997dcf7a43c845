"""A CAN bus by python-can, of any of its interfaces: frames leave at once or not at all, and what comes is queued.

The only module that knows python-can, of the extra `can`. Nothing here sends by itself: neither python-can's periodic
sending nor the kernel's (CAN_BCM) may be used anywhere, or a frozen program's last command would stand
(`tests/test_no_periodic_sending.py`).
"""

from __future__ import annotations

import errno
import json
import logging
import secrets
import socket
import subprocess
import threading
from collections import Counter, deque
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from lavt.clock import Clock
from lavt.domain import NS_PER_MS, NS_PER_S, Now
from lavt.errors import UserError
from lavt.vehicle.can_frame import BusGone, CanFrame, ReceivedCanFrame

if TYPE_CHECKING:
    from can import BusABC, Message

TICK_LIMIT_NS: Final = 60 * NS_PER_MS
"""A frame made longer ago is not written: whoever made it may have been frozen since."""
REOPEN_NS: Final = NS_PER_S
"""A bus that went away is tried again after so long."""
QUEUE_FRAMES: Final = 8192
"""What nobody took in the meantime: two seconds of a full bus of 500 kbit/s. Then the oldest go."""
POLL_S: Final = 0.1
"""The reader looks so often whether the port was closed."""
LATEST_READ_NS: Final = NS_PER_S
"""A frame that has waited longer is dropped: whoever read it was frozen, or the wall clock was stepped in between."""
IP_TIMEOUT_S: Final = 2

logging.getLogger("can").addHandler(logging.NullHandler())  # what it says of errors is in the errors

VIRTUAL_INTERFACES: Final = frozenset({"inside", "virtual", "udp_multicast"})
STAMPED_BY_KERNEL: Final = frozenset({"socketcan", "udp_multicast"})
"""Their frames carry the kernel's wall time of arrival; others' times are of devices' own clocks."""
HEARS_ITSELF: Final = "udp_multicast"
"""Its socket is a member of the group it sends to. So own frames carry a mark."""
BUS_OFF_BIT: Final = 0x40
"""In the identifier of an error frame of SocketCAN (linux/can/error.h, CAN_ERR_BUSOFF)."""
PASSING: Final = frozenset({None, errno.ENOBUFS, errno.EAGAIN})
"""Errors of a write that say that there is no room now; a new socket would have no more."""


class CanPort:
    """A `Port` on a bus; `send` and `take` are for one thread, and one of its own reads.

    `counts`: `frames_too_old` were not sent; `error_frames`, `remote_frames`, `fd_frames`, `unreadable`,
    `read_too_late` and `own_frames` were heard and dropped; `overflowed` is what had to go because nobody took it.

    Raises `UserError` where python-can is missing or the bus cannot be opened.
    """

    def __init__(self, interface: str, channel: str, options: Mapping[str, Any], *, clock: Clock) -> None:
        self._interface, self._channel, self._options = interface, channel, dict(options)
        self._clock = clock
        self._mark = secrets.token_hex(8) if interface == HEARS_ITSELF else None
        self._heard: deque[ReceivedCanFrame] = deque(maxlen=QUEUE_FRAMES)
        self._why = ""
        self._tried_ns = clock.now().mono_ns
        self.counts: Counter[str] = Counter()
        self._open()

    def send(self, frames: Sequence[CanFrame], made_ns: int) -> None:
        """Write frames that were made at a time, in order and without waiting, but none older than `TICK_LIMIT_NS`.

        The age is looked at just before each write. Raises `BusGone`; then the rest is not written.
        """
        for frame in frames:
            if self._bus is None:
                raise BusGone(self._why)
            message = self._message(frame)
            if self._clock.now().mono_ns - made_ns > TICK_LIMIT_NS:
                self.counts["frames_too_old"] += 1
                continue
            try:
                self._bus.send(message, timeout=0)
            except Exception as error:  # of any driver
                why = f"{self._interface} {self._channel} cannot be written to ({_text(error)})"
                if _number(error) not in PASSING:
                    self._lose(why)
                raise BusGone(why) from error

    def take(self, now_ns: int) -> list[ReceivedCanFrame]:
        """Take what has come since the last call, in order; own frames are not among it.

        A bus that has gone is opened again, at most each `REOPEN_NS`. Raises `BusGone` until that is done.
        """
        taken = [self._heard.popleft() for _ in range(len(self._heard))]
        if self._bus is None and not taken:
            self._reopen(now_ns)
        return taken

    def next_wake_ns(self) -> int | None:
        """Nobody knows when the next frame comes."""
        return None

    def close(self) -> None:
        """Let go of the bus."""
        self._lose("the port is closed")
        self._reader.join()

    def _open(self) -> None:
        bus = _opened(self._interface, self._channel, self._options)
        self._bus: BusABC | None = bus
        self._reader = threading.Thread(target=self._read, args=(bus,), name="can", daemon=True)
        self._reader.start()

    def _reopen(self, now_ns: int) -> None:
        if now_ns - self._tried_ns < REOPEN_NS or self._reader.is_alive():
            raise BusGone(self._why)
        self._tried_ns = now_ns
        try:
            self._open()
        except UserError as error:
            self._why = str(error)
            raise BusGone(self._why) from error

    def _lose(self, why: str) -> None:
        self._why = why
        self._bus = None  # the reader ends, and shuts it down

    def _read(self, bus: BusABC) -> None:
        """Hear frames until the bus has gone or the port is closed; the bus is this thread's to shut down."""
        try:
            while self._bus is bus:
                self._read_once(bus)
        except Exception as error:  # of any driver
            if self._bus is bus:
                self._lose(f"{self._interface} {self._channel} cannot be read ({_text(error)})")
        finally:
            with suppress(Exception):  # of a bus that is broken already
                bus.shutdown()

    def _read_once(self, bus: BusABC) -> None:
        try:
            message = bus.recv(POLL_S)
        except BlockingIOError:  # another datagram than was announced: its checksum was wrong
            return
        except Exception as error:
            if self._interface != HEARS_ITSELF or isinstance(error.__cause__, OSError):
                raise
            self.counts["unreadable"] += 1  # a datagram that is no frame: anybody can send one
            return
        if message is not None:
            self._hear(message, self._clock.now())

    def _hear(self, message: Message, now: Now) -> None:
        if self._mark is not None and message.channel == self._mark:
            self.counts["own_frames"] += 1
            return
        if message.is_error_frame and message.arbitration_id & BUS_OFF_BIT:
            raise BusGone("the controller is bus-off")
        frame = _frame(message, self.counts)
        if frame is None:
            return
        arrived_ns = now.mono_ns
        if self._interface in STAMPED_BY_KERNEL:
            waited_ns = now.wall_ns - round(message.timestamp * NS_PER_S)
            if waited_ns > LATEST_READ_NS:
                self.counts["read_too_late"] += 1
                return
            arrived_ns -= max(waited_ns, 0)
        self.counts["overflowed"] += len(self._heard) == QUEUE_FRAMES
        self._heard.append(ReceivedCanFrame(frame, arrived_ns))

    def _message(self, frame: CanFrame) -> Message:
        message: Message = _library().Message(
            arbitration_id=frame.identifier,
            is_extended_id=frame.is_extended,
            data=frame.data,
            channel=self._mark,
        )
        return message


def is_virtual(interface: str, channel: str) -> bool:
    """Whether a bus exists in computers only, so that no real kit can be on it; what cannot be found out is none."""
    if interface in VIRTUAL_INTERFACES:
        return True
    if interface != "socketcan":
        return False
    return _link_kind(channel) == "vcan"


def read_log(path: Path) -> Iterator[ReceivedCanFrame]:
    """Read the frames of a log (candump's `.log`, or another that python-can knows), with the log's own times.

    Raises `UserError` where it cannot be read.
    """
    counts: Counter[str] = Counter()
    heard = 0
    try:
        with _library().LogReader(path) as messages:
            for message in messages:
                frame = _frame(message, counts)
                if frame is not None:
                    heard += 1
                    yield ReceivedCanFrame(frame, round(message.timestamp * NS_PER_S))
    except Exception as error:  # of any of the readers
        raise UserError(
            f"{path} cannot be read after {heard} frames ({_text(error)}): name a log, as `candump -L` writes it"
        ) from error


def log_line(heard_ns: int, channel: str, frame: CanFrame) -> str:
    """Write a frame as a line of `candump -L`."""
    digits = 8 if frame.is_extended else 3
    seconds, nanoseconds = divmod(heard_ns, NS_PER_S)
    return f"({seconds}.{nanoseconds // 1000:06d}) {channel} {frame.identifier:0{digits}X}#{frame.data.hex().upper()}\n"


def _library() -> Any:
    try:
        return import_module("can")  # an extra
    except ImportError as error:
        raise UserError(f"a CAN bus needs python-can ({error}): pip install 'lavt[can]'") from error


def _opened(interface: str, channel: str, options: Mapping[str, Any]) -> BusABC:
    """A bus of python-can; settings of the user's account (`~/.canrc`) are left out of it."""
    library = _library()
    known = library.interfaces.BACKENDS
    if interface not in known:
        raise UserError(f"there is no CAN interface {interface}: name one of {', '.join(sorted(known))}")
    if not channel:
        raise UserError(f"a bus of {interface} needs a channel: name one, like can0")
    if options.get("receive_own_messages"):
        raise UserError("a port does not hear what it sends: leave out receive_own_messages")
    if interface == "socketcan" and channel not in (name for _, name in socket.if_nameindex()):
        # python-can would say so as well, and leave a socket behind
        raise UserError(f"socketcan {channel} cannot be opened (no such device): {REMEDIES[errno.ENODEV]}")
    # It counts as virtual: no gateway on another machine is to hear it.
    own = {"hop_limit": 0} if interface == HEARS_ITSELF else {}
    try:
        bus: BusABC = library.Bus(channel=channel, interface=interface, ignore_config=True, **{**own, **options})
    except Exception as error:  # of any driver
        remedy = REMEDIES.get(_number(error), "see python-can's page on this interface")
        raise UserError(f"{interface} {channel} cannot be opened ({_text(error)}): {remedy}") from error
    return bus


REMEDIES: Final[Mapping[int | None, str]] = {
    errno.ENODEV: "name a channel that `ip link` shows",
    errno.EPERM: "run it as a user who may",
    errno.EACCES: "run it as a user who may",
    errno.EAFNOSUPPORT: "this kernel has no SocketCAN; `modprobe can_raw` loads it where it is installed",
}


def _frame(message: Message, counts: Counter[str]) -> CanFrame | None:
    """The data frame that a message is; None for anything else, counted."""
    if message.is_error_frame:
        counts["error_frames"] += 1
    elif message.is_remote_frame:
        counts["remote_frames"] += 1
    elif message.is_fd:
        counts["fd_frames"] += 1
    elif type(message.arbitration_id) is not int or len(message.data) > 8:  # by udp_multicast anything comes
        counts["unreadable"] += 1
    else:
        return CanFrame(message.arbitration_id, bytes(message.data), bool(message.is_extended_id))
    return None


def _number(error: Exception) -> int | None:
    """The system's number of an error, where it has one."""
    for candidate in (error, error.__cause__):
        if isinstance(candidate, OSError):
            return candidate.errno
        code = getattr(candidate, "error_code", None)
        if isinstance(code, int):
            return code
    return None


def _text(error: Exception) -> str:
    """What an error says, in one line, and what is behind it."""
    said = [str(candidate).partition("\n")[0] for candidate in (error, error.__cause__) if candidate is not None]
    return ": ".join(dict.fromkeys(text for text in said if text)) or type(error).__name__


def _link_kind(channel: str) -> str:
    """What kind of network interface a channel is, by the kernel; empty: nobody says."""
    try:
        told = subprocess.run(  # noqa: S603 (its arguments go through no shell)
            ["ip", "-details", "-json", "link", "show", "dev", channel],  # noqa: S607 (wherever the system has it)
            capture_output=True, check=True, timeout=IP_TIMEOUT_S,
        ).stdout  # fmt: skip
        (link,) = json.loads(told)
        return str(link["linkinfo"]["info_kind"])
    except (OSError, subprocess.SubprocessError, ValueError, LookupError, TypeError):
        return ""
