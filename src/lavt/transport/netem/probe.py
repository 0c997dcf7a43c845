"""Measuring what an interface's queue does, on one machine: frames of our own, seen again when they leave.

A frame that looks like one of a flow is handed to the interface's queue by a packet socket, and another packet socket
gets the kernel's copy of it when it has passed the queue, with the time (packet(7); the kernel copies what leaves after
its queue). Both times are of this machine's wall clock. The frames are for nobody: the destination is 192.0.2.1 of the
documentation range (RFC 5737) at the interface's own hardware address, which no switch forwards, with a time to live of
1. Needs root.
"""

from __future__ import annotations

import ctypes
import errno
import math
import socket
import struct
from collections.abc import Mapping, Sequence
from statistics import median, quantiles
from typing import Any, Final, Literal

from lavt.clock import Clock, MachineClock, pause
from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.errors import UserError
from lavt.transport.arrival import ANCILLARY_BYTES, SO_TIMESTAMPNS
from lavt.transport.emulation.impairment import ALWAYS_EXEMPT, ExemptPort, ImpairedFlow, Impairment, bursts, gilbert
from lavt.value import value

PERIOD_NS: Final = 20 * NS_PER_MS
"""Between two frames of one flow."""
AFTER_LONGEST_NS: Final = 300 * NS_PER_MS
AFTERWARDS_NS: Final = 10 * NS_PER_MS
"""Between two looks for what is still under way."""
LIMIT_MS: Final = 1.0
"""How far a median may be from what was asked."""
SIGMAS: Final = 4.0
"""How far a share may be from what was asked, in its standard deviations; and one packet more."""
OTHER_PORT: Final = 9
"""At the other end of a frame: discard."""
RTP: Final = 0x80
PATH: Final = ord("L")
"""First bytes of RTP and of what opens the video's path."""

_SOURCE, _DESTINATION = socket.inet_aton("192.0.2.2"), socket.inet_aton("192.0.2.1")
_NOBODY: Final = b"\x02LAVT\0"
"""A hardware address of ours where the interface has none (the loopback): what is not addressed to it, it drops."""
_SO_ATTACH_FILTER: Final = 26
_SO_RCVBUFFORCE: Final = 33
_ALL_PROTOCOLS, _IPV4 = 0x0003, 0x0800
_MARK: Final = struct.Struct(">QIq")
"""Who measures, number of the frame, when it was sent."""
_HEADER_BYTES: Final = {"udp": 28, "tcp": 40}
_LONGEST_FRAME: Final = 2048
_RECEIVE_BUFFER_BYTES: Final = 1 << 20


@value
class ProbeSpec:
    """Frames of one kind, and what is expected to happen to them."""

    name: str
    protocol: Literal["udp", "tcp"]
    source: int
    destination: int
    impairment: Impairment
    first_byte: int = RTP


@value
class ProbeResult:
    """What happened to the frames of a probe: how many were sent, lost, passed by later ones; delays in milliseconds.

    Where packets overtake by not being delayed, those are counted in `early` and are not among the delays. None: no
    frame came through.
    """

    sent: int
    lost: int
    reordered: int
    early: int
    p5_ms: float | None
    median_ms: float | None
    p95_ms: float | None


def probes(flows: Sequence[ImpairedFlow], exempt: Sequence[ExemptPort] = ()) -> list[ProbeSpec]:
    """Give the probes for flows, and for what must not be held beside them."""
    held, beside = [], []
    taken = {(flow.protocol, flow.port, flow.end) for flow in flows}
    for flow in flows:
        there, back = (flow.port, OTHER_PORT), (OTHER_PORT, flow.port)
        if flow.end == "destination":
            there, back = back, there
        held.append(ProbeSpec(flow.name, flow.protocol, *there, flow.impairment))
        other_end: Literal["source", "destination"] = "source" if flow.end == "destination" else "destination"
        if (flow.protocol, flow.port, other_end) not in taken:
            beside.append(ProbeSpec(f"{flow.name}, other direction", flow.protocol, *back, Impairment()))
        if flow.name == "video":
            beside.append(ProbeSpec("challenges of the video's path", flow.protocol, *there, Impairment(), PATH))
    beside += [
        ProbeSpec(port.service, port.protocol, port.port, port.port, Impairment()) for port in (*ALWAYS_EXEMPT, *exempt)
    ]
    return held + beside


def measure(
    interface: str,
    requested: Sequence[ProbeSpec],
    *,
    count: int = 50,
    period_ns: int = PERIOD_NS,
    clock: Clock | None = None,
) -> dict[str, ProbeResult]:
    """Send `count` frames for each probe, `period_ns` apart, and tell for each by name what happened to them.

    Raises `UserError` without root, and for an interface that is not there or not up.
    """
    try:
        return _measure(interface, requested, count, period_ns, clock or MachineClock())
    except OSError as error:
        raise UserError(
            f"{interface} cannot be measured ({error.strerror}): name an interface that is up (`ip link`)"
        ) from error


def _measure(
    interface: str, requested: Sequence[ProbeSpec], count: int, period_ns: int, clock: Clock
) -> dict[str, ProbeResult]:
    with _open(interface) as receiver, _open_sender() as sender:
        seen = _Seen(receiver, requested, clock.now().mono_ns)
        link = (interface, _IPV4, 0, 0, _hardware_address(interface))
        begin_ns = clock.now().mono_ns
        for number in range(count):
            for index, probe in enumerate(requested):
                _send(sender, _frame(probe, seen.mark(number, index, clock.now().wall_ns)), link)
            pause(begin_ns + (number + 1) * period_ns - clock.now().mono_ns)
            seen.take()  # when is the kernel's to say: there is no hurry
        longest_ns = round(max(probe.impairment.longest_ms for probe in requested) * NS_PER_MS)
        limit_ns = clock.now().mono_ns + longest_ns + AFTER_LONGEST_NS
        while seen.count < count * len(requested) and clock.now().mono_ns < limit_ns:
            pause(AFTERWARDS_NS)
            seen.take()
    return {probe.name: summary(probe.impairment, count, seen.delays[index]) for index, probe in enumerate(requested)}


def summary(impairment: Impairment, sent: int, delays: Sequence[tuple[int, float]]) -> ProbeResult:
    """Sum up (number, delay in milliseconds) of the frames of a probe, in the order in which they left."""
    newest, reordered = -1, 0
    for number, _ in delays:
        reordered += number < newest
        newest = max(newest, number)
    all_ms = [delay_ms for _, delay_ms in delays]
    held_ms = [delay_ms for delay_ms in all_ms if not impairment.reorder or delay_ms > impairment.delay_ms / 2]
    early = len(all_ms) - len(held_ms)
    if len(held_ms) < 2:
        return ProbeResult(sent, sent - len(delays), reordered, early, None, None, None)
    twentieths = quantiles(held_ms, n=20, method="inclusive")
    return ProbeResult(sent, sent - len(delays), reordered, early, twentieths[0], median(held_ms), twentieths[-1])


def judge(
    flows: Sequence[ImpairedFlow], exempt: Sequence[ExemptPort], measured: Mapping[str, ProbeResult]
) -> list[str]:
    """Say in sentences what was measured to be otherwise than asked; an empty list is as asked."""
    return [reason for probe in probes(flows, exempt) for reason in _judge(probe, measured.get(probe.name))]


def _judge(probe: ProbeSpec, found: ProbeResult | None) -> list[str]:
    name, impairment = probe.name, probe.impairment
    if found is None:
        return [f"{name}: no packet came through"]
    if found.median_ms is None or found.p5_ms is None or found.p95_ms is None:
        return (
            _judge_counts(probe, found)
            if impairment.loss or impairment.reorder
            else [f"{name}: no packet came through"]
        )
    reasons = []
    if not (impairment.jitter_ms or impairment.rate_bps) and abs(found.median_ms - impairment.delay_ms) > LIMIT_MS:
        reasons.append(f"{name} was delayed by {found.median_ms:.2f} ms where {impairment.delay_ms:g} ms was asked")
    least_ms = impairment.delay_ms - 4 * impairment.jitter_ms - LIMIT_MS
    if (impairment.jitter_ms or impairment.rate_bps) and found.p5_ms < least_ms:
        reasons.append(f"{name} was delayed by {found.p5_ms:.2f} ms (p5) where {least_ms:.2f} ms is the least")
    most_ms = impairment.longest_ms + LIMIT_MS
    if impairment.jitter_ms and not impairment.rate_bps and found.median_ms > most_ms:
        reasons.append(f"{name} was delayed by {found.median_ms:.2f} ms (median) where {most_ms:.2f} ms is the most")
    if (
        impairment.jitter_ms
        and not impairment.jitter_correlation
        and found.p95_ms - found.p5_ms < impairment.jitter_ms / 2
    ):
        spread_ms = found.p95_ms - found.p5_ms
        reasons.append(
            f"{name} has a jitter of {spread_ms:.2f} ms (p5 to p95) where {impairment.jitter_ms:g} ms was asked"
        )
    return reasons + _judge_counts(probe, found)


def _judge_counts(probe: ProbeSpec, found: ProbeResult) -> list[str]:
    name, impairment = probe.name, probe.impairment
    reasons = []
    if not _is_share(found.lost, found.sent, impairment.loss, _clumping(impairment)):
        reasons.append(f"{name}: {found.lost} of {found.sent} packets were lost where {impairment.loss:.1%} was asked")
    arrived = found.sent - found.lost
    if not _is_share(found.early, arrived, impairment.reorder, 1.0):
        reasons.append(f"{name}: {found.early} of {arrived} packets overtook where {impairment.reorder:.1%} was asked")
    if found.reordered and not impairment.reorder:
        reasons.append(f"{name}: {found.reordered} packets were overtaken")
    return reasons


def _is_share(count: int, of: int, share: float, clumping: float) -> bool:
    """Whether a count can be the binomial share of a number, `clumping` times as variable as independent ones."""
    if share == 0:
        return count == 0
    return abs(count - of * share) <= SIGMAS * math.sqrt(of * share * (1 - share) * clumping) + 1


def _clumping(impairment: Impairment) -> float:
    """Tell how much more variable a count of losses is in bursts: (1 + r) / (1 - r), r from one packet to the next."""
    if not bursts(impairment):
        return 1.0
    correlation = 1 - sum(gilbert(impairment))
    return (1 + correlation) / (1 - correlation)


class _Seen:
    """Frames of ours that have left, by probe: (number, delay in milliseconds) in order."""

    def __init__(self, receiver: socket.socket, requested: Sequence[ProbeSpec], who: int) -> None:
        self._receiver = receiver
        self._requested = requested
        self._who = who
        self.count = 0
        self.delays: list[list[tuple[int, float]]] = [[] for _ in requested]

    def mark(self, number: int, index: int, sent_ns: int) -> bytes:
        """Give what marks a frame of ours."""
        return _MARK.pack(self._who, number * len(self._requested) + index, sent_ns)

    def take(self) -> None:
        """Take all that has left by now."""
        while True:
            try:
                frame, ancillary, _flags, address = self._receiver.recvmsg(_LONGEST_FRAME, ANCILLARY_BYTES)
            except BlockingIOError:
                return
            if address[2] == socket.PACKET_OUTGOING:
                self._note(frame, ancillary)

    def _note(self, frame: bytes, ancillary: Sequence[Any]) -> None:
        protocol = {17: "udp", 6: "tcp"}.get(frame[9] if len(frame) > 9 else 0, "")
        begin = _HEADER_BYTES.get(protocol, _LONGEST_FRAME) + 1
        if len(frame) < begin + _MARK.size:
            return
        who, serial, sent_ns = _MARK.unpack_from(frame, begin)
        stamp = next(
            (data for level, kind, data in ancillary if (level, kind) == (socket.SOL_SOCKET, SO_TIMESTAMPNS)), b""
        )
        if who != self._who or len(stamp) < 16:
            return
        seconds, nanoseconds = struct.unpack_from("qq", stamp)
        number, index = divmod(serial, len(self._requested))
        self.count += 1
        self.delays[index].append((number, (seconds * NS_PER_S + nanoseconds - sent_ns) / NS_PER_MS))


def _open(interface: str) -> socket.socket:
    """Open the socket that sees what leaves: only frames for our address, without their link's header."""
    try:
        receiver = socket.socket(socket.AF_PACKET, socket.SOCK_DGRAM, 0)
    except PermissionError as error:
        raise UserError("only root may measure what a queue does: run it with sudo") from error
    try:
        receiver.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
        receiver.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, _RECEIVE_BUFFER_BYTES)
        # BPF: load the word at 16 (the destination); equal: take all of it, else nothing.
        ours = int.from_bytes(_DESTINATION, "big")
        code = [(0x20, 0, 0, 16), (0x15, 0, 1, ours), (0x06, 0, 0, 0xFFFF), (0x06, 0, 0, 0)]
        program = ctypes.create_string_buffer(b"".join(struct.pack("HBBI", *each) for each in code))
        filtered = struct.pack("HL", len(code), ctypes.addressof(program))
        receiver.setsockopt(socket.SOL_SOCKET, _SO_ATTACH_FILTER, filtered)
        receiver.bind((interface, _ALL_PROTOCOLS))
        receiver.setblocking(False)
    except OSError:
        receiver.close()
        raise
    return receiver


def _open_sender() -> socket.socket:
    return socket.socket(socket.AF_PACKET, socket.SOCK_DGRAM, 0)


def _send(sender: socket.socket, frame: bytes, link: tuple[str, int, int, int, bytes]) -> None:
    try:
        sender.sendto(frame, link)
    except BlockingIOError:
        return
    except OSError as error:  # netem says so of what it loses, too
        if error.errno != errno.ENOBUFS:
            raise


def _hardware_address(interface: str) -> bytes:
    with socket.socket(socket.AF_PACKET, socket.SOCK_DGRAM, 0) as opened:
        opened.bind((interface, 0))
        address: bytes = opened.getsockname()[4]
    return address if any(address) else _NOBODY


def _frame(probe: ProbeSpec, mark: bytes) -> bytes:
    """Make an IPv4 packet of a probe's kind; checksums of UDP and TCP are left out, as nobody receives it."""
    payload = bytes([probe.first_byte]) + mark
    if probe.protocol == "udp":
        number = 17
        body = struct.pack(">HHHH", probe.source, probe.destination, 8 + len(payload), 0) + payload
    else:
        number = 6
        body = struct.pack(">HHIIHHHH", probe.source, probe.destination, 0, 0, 5 << 12, 0, 0, 0) + payload
    header = struct.pack(">BBHHHBBH4s4s", 0x45, 0, 20 + len(body), 0, 0, 1, number, 0, _SOURCE, _DESTINATION)
    folded = sum(struct.unpack(">10H", header))
    folded = (folded & 0xFFFF) + (folded >> 16)
    return header[:10] + struct.pack(">H", ~folded & 0xFFFF) + header[12:] + body
