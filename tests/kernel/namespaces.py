"""Two network namespaces joined by a veth pair, and one-way delays between them from the kernel's receive times."""

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
from typing import Any, Literal, NamedTuple, TypeVar

from lavt.clock import MachineClock, pause
from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.transport.arrival import SO_TIMESTAMPNS

DEVICES = {"server": "va", "client": "vb"}
ADDRESSES = {"server": ("10.9.0.1", "fd09::1"), "client": ("10.9.0.2", "fd09::2")}
PACKET_HEADER = struct.Struct(">8sIq")
"""Mark of the flow, packet number, and send time (wall clock, ns)."""
DRAIN_S = 0.35
"""Time to wait for packets after the last one was sent."""
LONGEST_POLL_NS = 20 * NS_PER_MS
"""A longer poll shows a stall of the machine, in which packets are delayed like the poll; the rest does not count."""
_CLONE_NEWNET = 0x40000000
_ALL_PROTOCOLS = 3
_SO_RCVBUFFORCE = 33
Result = TypeVar("Result")
_numbers = itertools.count()


def command(command_line: str) -> str:
    """Run a command that must succeed, and return its output."""
    completed = subprocess.run(command_line.split(), capture_output=True, text=True, check=False)
    assert completed.returncode == 0, f"{command_line}: {completed.stderr}"
    return completed.stdout


def create_namespaces() -> None:
    """Create both namespaces and the link between them."""
    socket.socket(socket.AF_INET6, socket.SOCK_DGRAM).close()  # loads IPv6
    command("ip netns add server")
    command("ip netns add client")
    command("ip link add va netns server type veth peer name vb netns client")
    for name, device in DEVICES.items():
        command(f"ip -n {name} link set lo up")
        command(f"ip -n {name} link set {device} up")
        command(f"ip -n {name} addr add {ADDRESSES[name][0]}/24 dev {device}")
        command(f"ip -n {name} addr add {ADDRESSES[name][1]}/64 dev {device} nodad")


def delete_namespaces() -> None:
    """Delete both namespaces."""
    command("ip netns del server")
    command("ip netns del client")


def inside(name: str, function: Callable[[], Result]) -> Result:
    """Call a function in a thread inside a namespace; processes that it starts are in the namespace, too."""
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
class ProbeFlow:
    """A test flow from one namespace to the other, between two ports; `first_byte` begins each packet."""

    name: str
    sender: Literal["server", "client"]
    protocol: Literal["udp", "tcp"]
    source_port: int
    destination_port: int
    first_byte: int = 0x80
    version: Literal[4, 6] = 4
    packet_bytes: int = 200

    @property
    def receiver(self) -> Literal["server", "client"]:
        """The namespace that receives the flow."""
        return "client" if self.sender == "server" else "server"


class ArrivedPacket(NamedTuple):
    """A packet that arrived."""

    number: int
    delay_ms: float
    """One-way delay."""
    received_ns: int
    """Wall clock of the kernel."""


@dataclass
class Arrivals:
    """The packets of a flow that arrived, in order of arrival."""

    sent: int
    arrived: list[ArrivedPacket] = field(default_factory=list)

    @property
    def numbers(self) -> list[int]:
        """Numbers in the order of arrival."""
        return [packet.number for packet in self.arrived]

    @property
    def delays_ms(self) -> list[float]:
        """Delays in the order of arrival."""
        return [packet.delay_ms for packet in self.arrived]

    @property
    def delays_in_sending_order_ms(self) -> list[float]:
        """Delays in the order of sending."""
        return [packet.delay_ms for packet in sorted(self.arrived)]

    @property
    def inversions(self) -> int:
        """The number of packets that arrived directly after a packet that was sent later."""
        return sum(later < earlier for earlier, later in zip(self.numbers, self.numbers[1:], strict=False))


def send_flows(
    flows: Sequence[ProbeFlow], count: int, period_ms: float, *, at: dict[int, Callable[[], None]] | None = None
) -> dict[str, Arrivals]:
    """Send `count` packets of each flow, one per `period_ms`, and return the arrivals by the flow's name.

    `at` maps packet numbers to functions. A thread calls the function when that packet is due; sending continues until
    all functions have returned.
    """
    clock = MachineClock()
    captures = {name: inside(name, lambda name=name: _open_capture(DEVICES[name])) for name in DEVICES}  # type: ignore[misc]
    sockets = [_FlowSockets(flow) for flow in flows]
    arrivals = {flow.name: Arrivals(count) for flow in flows}
    names = {flow_sockets.mark: flow_sockets.flow.name for flow_sockets in sockets}
    try:
        begin_ns = clock.now().mono_ns
        threads: list[threading.Thread] = []
        for number in itertools.takewhile(
            lambda number: number < count or any(thread.is_alive() for thread in threads), itertools.count()
        ):
            if at and number in at:
                threads.append(threading.Thread(target=at[number]))
                threads[-1].start()
            for flow_sockets in sockets:
                flow_sockets.send(number, clock.now().wall_ns)
                arrivals[flow_sockets.flow.name].sent = number + 1
            _receive(captures, names, arrivals)
            while clock.now().mono_ns < begin_ns + round((number + 1) * period_ms * NS_PER_MS):
                pause(NS_PER_MS // 2)
                _receive(captures, names, arrivals)
        for thread in threads:
            thread.join()
        _drain(captures, names, arrivals)
    finally:
        for flow_sockets in sockets:
            flow_sockets.close()
        for capture in captures.values():
            capture.close()
    return arrivals


class _FlowSockets:
    """The sockets of one test flow."""

    def __init__(self, flow: ProbeFlow) -> None:
        self.flow = flow
        self.mark = b"FLY%05d" % next(_numbers)
        family = socket.AF_INET if flow.version == 4 else socket.AF_INET6
        kind = socket.SOCK_DGRAM if flow.protocol == "udp" else socket.SOCK_STREAM
        receiver_address = ADDRESSES[flow.receiver][flow.version == 6]
        self._receiver = inside(flow.receiver, lambda: _bound(family, kind, receiver_address, flow.destination_port))
        sender_address = ADDRESSES[flow.sender][flow.version == 6]
        self._sender = inside(flow.sender, lambda: _bound(family, kind, sender_address, flow.source_port))
        self._accepted: list[socket.socket] = []
        if flow.protocol == "tcp":
            self._receiver.listen()
        self._sender.connect((receiver_address, flow.destination_port))
        if flow.protocol == "tcp":
            self._accepted.append(self._receiver.accept()[0])
            self._sender.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def send(self, number: int, now_ns: int) -> None:
        data = bytes([self.flow.first_byte]) + PACKET_HEADER.pack(self.mark, number, now_ns)
        self._sender.send(data.ljust(self.flow.packet_bytes, b"."))

    def close(self) -> None:
        for sock in (*self._accepted, self._sender, self._receiver):
            sock.close()


def _bound(family: int, kind: int, address: str, port: int) -> socket.socket:
    sock = socket.socket(family, kind)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    if kind == socket.SOCK_STREAM:  # close without TIME_WAIT, because the next flow may use the same port
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    sock.bind((address, port))
    return sock


def _open_capture(device: str) -> socket.socket:
    """Open a socket that captures all incoming packets with the kernel's receive times."""
    capture = socket.socket(socket.AF_PACKET, socket.SOCK_DGRAM, socket.htons(_ALL_PROTOCOLS))
    capture.bind((device, _ALL_PROTOCOLS))
    capture.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
    capture.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, 4 << 20)
    capture.setblocking(False)
    return capture


def _drain(captures: dict[str, socket.socket], names: dict[bytes, str], arrivals: dict[str, Arrivals]) -> None:
    """Receive the packets that are still on their way; a stall of the machine does not shorten the wait."""
    clock, remaining_ns = MachineClock(), round(DRAIN_S * NS_PER_S)
    while remaining_ns > 0:
        began_ns = clock.now().mono_ns
        pause(NS_PER_MS)
        _receive(captures, names, arrivals)
        remaining_ns -= min(clock.now().mono_ns - began_ns, LONGEST_POLL_NS)


def _receive(captures: dict[str, socket.socket], names: dict[bytes, str], arrivals: dict[str, Arrivals]) -> None:
    for capture in captures.values():
        while True:
            try:
                frame, ancillary, _flags, address = capture.recvmsg(2048, 64)
            except BlockingIOError:
                break
            _device, _protocol, packet_type, *_ = address
            if packet_type == socket.PACKET_OUTGOING:
                continue
            match = next(((mark, frame.index(mark)) for mark in names if mark in frame), None)
            if match is None:
                continue
            mark, header_at = match
            _, number, sent_ns = PACKET_HEADER.unpack_from(frame, header_at)
            seconds, nanoseconds = struct.unpack_from("qq", ancillary[0][2])
            received_ns = seconds * NS_PER_S + nanoseconds
            arrivals[names[mark]].arrived.append(
                ArrivedPacket(number, (received_ns - sent_ns) / NS_PER_MS, received_ns)
            )
