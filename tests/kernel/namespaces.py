"""Two network namespaces joined by a veth pair, and one-way delays between them by the kernel's receive stamps."""

from __future__ import annotations

import ctypes
import itertools
import os
import socket
import struct
import subprocess
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, TypeVar

from lavt.clock import MachineClock, pause
from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.transport.arrival import SO_TIMESTAMPNS

DEVICES = {"server": "va", "client": "vb"}
ADDRESSES = {"server": ("10.9.0.1", "fd09::1"), "client": ("10.9.0.2", "fd09::2")}
MARK = struct.Struct(">8sIq")
AFTER_S = 0.35
"""What is under way after the last has been sent gets so much time."""
_CLONE_NEWNET = 0x40000000
_ALL_PROTOCOLS = 3
_SO_RCVBUFFORCE = 33
Result = TypeVar("Result")
_lines = itertools.count()


def command(words: str) -> str:
    """Run a command, which must succeed."""
    ended = subprocess.run(words.split(), capture_output=True, text=True, check=False)
    assert ended.returncode == 0, f"{words}: {ended.stderr}"
    return ended.stdout


def make_pair() -> None:
    """Make both namespaces, with one link between them."""
    socket.socket(socket.AF_INET6, socket.SOCK_DGRAM).close()  # loads IPv6
    command("ip netns add server")
    command("ip netns add client")
    command("ip link add va netns server type veth peer name vb netns client")
    for name, device in DEVICES.items():
        command(f"ip -n {name} link set lo up")
        command(f"ip -n {name} link set {device} up")
        command(f"ip -n {name} addr add {ADDRESSES[name][0]}/24 dev {device}")
        command(f"ip -n {name} addr add {ADDRESSES[name][1]}/64 dev {device} nodad")


def take_pair_away() -> None:
    """Take both namespaces away."""
    command("ip netns del server")
    command("ip netns del client")


def inside(name: str, function: Callable[[], Result]) -> Result:
    """Call a function in a thread that is in a namespace; what it starts is there, too."""
    results: list[Any] = []
    errors: list[BaseException] = []

    def run() -> None:
        try:
            handle = os.open(f"/run/netns/{name}", os.O_RDONLY)
            assert ctypes.CDLL(None, use_errno=True).setns(handle, _CLONE_NEWNET) == 0
            os.close(handle)
            results.append(function())
        except BaseException as error:
            errors.append(error)

    thread = threading.Thread(target=run)
    thread.start()
    thread.join()
    if errors:
        raise errors[0]
    result: Result = results[0]
    return result


@dataclass(frozen=True)
class Flight:
    """What is sent: from one namespace to the other, between two ports, with a first byte."""

    name: str
    sender: Literal["server", "client"]
    protocol: Literal["udp", "tcp"]
    source: int
    destination: int
    first_byte: int = 0x80
    version: Literal[4, 6] = 4
    bytes_each: int = 200

    @property
    def receiver(self) -> Literal["server", "client"]:
        """Where it arrives."""
        return "client" if self.sender == "server" else "server"


@dataclass
class Flown:
    """What arrived, in order: (number, one-way delay in milliseconds, kernel's receive stamp in nanoseconds)."""

    sent: int
    arrived: list[tuple[int, float, int]] = field(default_factory=list)

    @property
    def numbers(self) -> list[int]:
        """Numbers in the order of arrival."""
        return [number for number, _, _ in self.arrived]

    @property
    def delays_ms(self) -> list[float]:
        """Delays in the order of arrival."""
        return [delay_ms for _, delay_ms, _ in self.arrived]

    @property
    def in_order_of_sending_ms(self) -> list[float]:
        """Delays in the order of sending."""
        return [delay_ms for _, delay_ms, _ in sorted(self.arrived)]

    @property
    def inversions(self) -> int:
        """How often a packet arrived right after a later one."""
        return sum(later < earlier for earlier, later in zip(self.numbers, self.numbers[1:], strict=False))


def fly(
    flights: Sequence[Flight], count: int, period_ms: float, *, at: dict[int, Callable[[], None]] | None = None
) -> dict[str, Flown]:
    """Send `count` of each flight and tell what arrived when.

    `at` names what a thread does meanwhile, by number; until that is done, more than `count` are sent.
    """
    clock = MachineClock()
    watchers = {name: inside(name, lambda name=name: _watcher(DEVICES[name])) for name in DEVICES}  # type: ignore[misc]
    lines = [_Line(flight) for flight in flights]
    flown = {flight.name: Flown(count) for flight in flights}
    names = {line.mark: line.flight.name for line in lines}
    try:
        begin_ns = clock.now().mono_ns
        meanwhile: list[threading.Thread] = []
        for number in itertools.takewhile(
            lambda number: number < count or any(thread.is_alive() for thread in meanwhile), itertools.count()
        ):
            if at and number in at:
                meanwhile.append(threading.Thread(target=at[number]))
                meanwhile[-1].start()
            for line in lines:
                line.send(number, clock.now().wall_ns)
                flown[line.flight.name].sent = number + 1
            _take(watchers, names, flown)
            while clock.now().mono_ns < begin_ns + round((number + 1) * period_ms * NS_PER_MS):
                pause(NS_PER_MS // 2)
                _take(watchers, names, flown)
        for thread in meanwhile:
            thread.join()
        end_ns = clock.now().mono_ns + round(AFTER_S * NS_PER_S)
        while clock.now().mono_ns < end_ns:
            _take(watchers, names, flown)
            pause(NS_PER_MS)
    finally:
        for line in lines:
            line.close()
        for watcher in watchers.values():
            watcher.close()
    return flown


class _Line:
    """The sockets of one flight."""

    def __init__(self, flight: Flight) -> None:
        self.flight = flight
        self.mark = b"FLY%05d" % next(_lines)
        family = socket.AF_INET if flight.version == 4 else socket.AF_INET6
        kind = socket.SOCK_DGRAM if flight.protocol == "udp" else socket.SOCK_STREAM
        there = ADDRESSES[flight.receiver][flight.version == 6]
        self._receiver = inside(flight.receiver, lambda: _bound(family, kind, there, flight.destination))
        here = ADDRESSES[flight.sender][flight.version == 6]
        self._sender = inside(flight.sender, lambda: _bound(family, kind, here, flight.source))
        self._accepted: list[socket.socket] = []
        if flight.protocol == "tcp":
            self._receiver.listen()
        self._sender.connect((there, flight.destination))
        if flight.protocol == "tcp":
            self._accepted.append(self._receiver.accept()[0])
            self._sender.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def send(self, number: int, now_ns: int) -> None:
        data = bytes([self.flight.first_byte]) + MARK.pack(self.mark, number, now_ns)
        self._sender.send(data.ljust(self.flight.bytes_each, b"."))

    def close(self) -> None:
        for opened in (*self._accepted, self._sender, self._receiver):
            opened.close()


def _bound(family: int, kind: int, address: str, port: int) -> socket.socket:
    opened = socket.socket(family, kind)
    opened.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    if kind == socket.SOCK_STREAM:  # no waiting for the last packets of a connection: the ports are used again
        opened.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    opened.bind((address, port))
    return opened


def _watcher(device: str) -> socket.socket:
    """See everything that comes in, with the kernel's receive stamp."""
    watcher = socket.socket(socket.AF_PACKET, socket.SOCK_DGRAM, socket.htons(_ALL_PROTOCOLS))
    watcher.bind((device, _ALL_PROTOCOLS))
    watcher.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
    watcher.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, 4 << 20)
    watcher.setblocking(False)
    return watcher


def _take(watchers: dict[str, socket.socket], names: dict[bytes, str], flown: dict[str, Flown]) -> None:
    for watcher in watchers.values():
        while True:
            try:
                frame, ancillary, _flags, address = watcher.recvmsg(2048, 64)
            except BlockingIOError:
                break
            if address[2] == socket.PACKET_OUTGOING:
                continue
            found = next(((mark, frame.index(mark)) for mark in names if mark in frame), None)
            if found is None:
                continue
            _, number, sent_ns = MARK.unpack_from(frame, found[1])
            seconds, nanoseconds = struct.unpack_from("qq", ancillary[0][2])
            stamp_ns = seconds * NS_PER_S + nanoseconds
            flown[names[found[0]]].arrived.append((number, (stamp_ns - sent_ns) / NS_PER_MS, stamp_ns))
