"""Queue probes: measure an interface's queue with test packets, which are captured when they leave the queue.

A packet socket puts test packets that look like those of a flow into the interface's queue. Another packet socket
receives the kernel's copy of each packet after the queue, with the time of departure (packet(7)). The sending time is
read from the same clock, the wall clock. Nobody receives the test packets: they go to 192.0.2.1 of the documentation
range (RFC 5737) at the interface's own hardware address, which no switch forwards, with a time to live of 1. Queue
probes need root.
"""

from __future__ import annotations

import ctypes
import errno
import socket
import struct
from collections.abc import Mapping, Sequence
from statistics import median, quantiles
from typing import Any, Final, Literal

from msgspec import Struct

from lavt.clock import MachineClock, pause
from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.errors import UserError
from lavt.transport.arrival import ANCILLARY_BYTES, SO_TIMESTAMPNS
from lavt.transport.emulation.impairment import (
    ALWAYS_EXEMPT,
    ExemptPort,
    ImpairedFlow,
    Impairment,
    burst_probabilities,
    has_loss_bursts,
)

PERIOD_NS: Final = 20 * NS_PER_MS
"""Period of the test packets of one queue probe."""
DRAIN_MARGIN_NS: Final = 300 * NS_PER_MS
POLL_NS: Final = 10 * NS_PER_MS
"""Polling period for test packets that are still in the queue."""
MEDIAN_TOLERANCE_MS: Final = 1.0
"""Largest accepted difference between a median and the requested delay."""
LEAST_PROBABILITY: Final = 1e-5
"""The requested share is in doubt if a count as low, or as high, as the measured one is less probable than this."""
OTHER_PORT: Final = 9
"""Port of the other end of a test packet: the port of the discard service."""
RTP_FIRST_BYTE: Final = 0x80
PATH_FIRST_BYTE: Final = ord("L")
"""The first byte of a message of the path validation."""

_SOURCE, _DESTINATION = socket.inet_aton("192.0.2.2"), socket.inet_aton("192.0.2.1")
_LOCAL_ADDRESS: Final = b"\x02LAVT\0"
"""Destination hardware address of test packets if the interface has none, like the loopback, which drops them."""
_SO_ATTACH_FILTER: Final = 26
_SO_RCVBUFFORCE: Final = 33
_ALL_PROTOCOLS, _IPV4 = 0x0003, 0x0800
_MARK: Final = struct.Struct(">QIq")
"""Identifier of the measurement, serial number of the test packet, time of sending."""
_HEADER_BYTES: Final = {"udp": 28, "tcp": 40}
_LONGEST_PACKET: Final = 2048
_RECEIVE_BUFFER_BYTES: Final = 1 << 20


class QueueProbe(Struct, frozen=True):
    """Test packets of one kind, and the impairment that they should have."""

    name: str
    protocol: Literal["udp", "tcp"]
    source: int
    destination: int
    impairment: Impairment
    first_byte: int = RTP_FIRST_BYTE


class ProbeResult(Struct, frozen=True):
    """The measurement of a queue probe: counts of its test packets, and percentiles of their delay in milliseconds.

    `reordered` counts packets that left after a later one. netem reorders by sending a share of the packets at once. If
    such a share is requested, `early` counts these packets, and the percentiles are those of the delayed packets. The
    percentiles are None if fewer than two delayed packets left the queue.
    """

    sent: int
    lost: int
    reordered: int
    early: int
    p5_ms: float | None
    median_ms: float | None
    p95_ms: float | None


def queue_probes(flows: Sequence[ImpairedFlow], exempt: Sequence[ExemptPort] = ()) -> list[QueueProbe]:
    """Return the queue probes for flows, and for packets that must not be delayed."""
    impaired, unimpaired = [], []
    impaired_ports = {(flow.protocol, flow.port, flow.end) for flow in flows}
    for flow in flows:
        outward, backward = (flow.port, OTHER_PORT), (OTHER_PORT, flow.port)
        if flow.end == "destination":
            outward, backward = backward, outward
        impaired.append(QueueProbe(flow.name, flow.protocol, *outward, flow.impairment))
        other_end: Literal["source", "destination"] = "source" if flow.end == "destination" else "destination"
        if (flow.protocol, flow.port, other_end) not in impaired_ports:
            unimpaired.append(QueueProbe(f"{flow.name}, other direction", flow.protocol, *backward, Impairment()))
        if flow.name == "video":
            unimpaired.append(
                QueueProbe("challenges of the video's path", flow.protocol, *outward, Impairment(), PATH_FIRST_BYTE)
            )
    unimpaired += [
        QueueProbe(port.service, port.protocol, port.port, port.port, Impairment())
        for port in (*ALWAYS_EXEMPT, *exempt)
    ]
    return impaired + unimpaired


def measure(interface: str, requested: Sequence[QueueProbe], *, count: int = 50) -> dict[str, ProbeResult]:
    """Send `count` test packets for each queue probe, `PERIOD_NS` apart, and return the results by probe name.

    Raise `UserError` without root, and for an interface that does not exist or is down.
    """
    try:
        return _measure(interface, requested, count)
    except OSError as error:
        raise UserError(
            f"cannot measure {interface} ({error.strerror}): name an interface that is up (`ip link`)"
        ) from error


def _measure(interface: str, requested: Sequence[QueueProbe], count: int) -> dict[str, ProbeResult]:
    clock = MachineClock()
    with _open(interface) as receiver, _open_sender() as sender:
        captured = _CapturedPackets(receiver, requested, clock.now().mono_ns)
        link = (interface, _IPV4, 0, 0, _hardware_address(interface))
        begin_ns = clock.now().mono_ns
        for number in range(count):
            for index, probe in enumerate(requested):
                _send(sender, _test_packet(probe, captured.mark(number, index, clock.now().wall_ns)), link)
            pause(begin_ns + (number + 1) * PERIOD_NS - clock.now().mono_ns)
            captured.receive()  # the kernel takes the times, so this need not be prompt
        longest_ns = round(max(probe.impairment.longest_ms for probe in requested) * NS_PER_MS)
        limit_ns = clock.now().mono_ns + longest_ns + DRAIN_MARGIN_NS
        while captured.count < count * len(requested) and clock.now().mono_ns < limit_ns:
            pause(POLL_NS)
            captured.receive()
    return {
        probe.name: summarize(probe.impairment, count, captured.delays[index]) for index, probe in enumerate(requested)
    }


def summarize(impairment: Impairment, sent: int, delays: Sequence[tuple[int, float]]) -> ProbeResult:
    """Summarize the test packets of a queue probe: (number, delay in milliseconds), in the order of departure."""
    newest, reordered = -1, 0
    for number, _ in delays:
        reordered += number < newest
        newest = max(newest, number)
    all_ms = [delay_ms for _, delay_ms in delays]
    delayed_ms = [delay_ms for delay_ms in all_ms if not impairment.reorder or delay_ms > impairment.delay_ms / 2]
    early = len(all_ms) - len(delayed_ms)
    if len(delayed_ms) < 2:
        return ProbeResult(sent, sent - len(delays), reordered, early, None, None, None)
    twentieths = quantiles(delayed_ms, n=20, method="inclusive")
    return ProbeResult(sent, sent - len(delays), reordered, early, twentieths[0], median(delayed_ms), twentieths[-1])


def judge(
    flows: Sequence[ImpairedFlow], exempt: Sequence[ExemptPort], measured: Mapping[str, ProbeResult]
) -> list[str]:
    """Return a message for each measurement that differs from the request."""
    return [
        reason for probe in queue_probes(flows, exempt) for reason in _check_delays(probe, measured.get(probe.name))
    ]


def _check_delays(probe: QueueProbe, result: ProbeResult | None) -> list[str]:
    name, impairment = probe.name, probe.impairment
    if result is None:
        return [f"{name}: no packet came through"]
    if result.median_ms is None or result.p5_ms is None or result.p95_ms is None:
        return (
            _check_counts(probe, result)
            if impairment.loss or impairment.reorder
            else [f"{name}: no packet came through"]
        )
    reasons = []
    if (
        not (impairment.jitter_ms or impairment.rate_bps)
        and abs(result.median_ms - impairment.delay_ms) > MEDIAN_TOLERANCE_MS
    ):
        reasons.append(f"{name} was delayed by {result.median_ms:.2f} ms instead of {impairment.delay_ms:g} ms")
    least_ms = impairment.delay_ms - 4 * impairment.jitter_ms - MEDIAN_TOLERANCE_MS
    if (impairment.jitter_ms or impairment.rate_bps) and result.p5_ms < least_ms:
        reasons.append(f"{name} was delayed by {result.p5_ms:.2f} ms (p5); the least is {least_ms:.2f} ms")
    most_ms = impairment.longest_ms + MEDIAN_TOLERANCE_MS
    if impairment.jitter_ms and not impairment.rate_bps and result.median_ms > most_ms:
        reasons.append(f"{name} was delayed by {result.median_ms:.2f} ms (median); the most is {most_ms:.2f} ms")
    if (
        impairment.jitter_ms
        and not impairment.jitter_correlation
        and result.p95_ms - result.p5_ms < impairment.jitter_ms / 2
    ):
        spread_ms = result.p95_ms - result.p5_ms
        reasons.append(f"{name} has a jitter of {spread_ms:.2f} ms (p5 to p95) instead of {impairment.jitter_ms:g} ms")
    return reasons + _check_counts(probe, result)


def _check_counts(probe: QueueProbe, result: ProbeResult) -> list[str]:
    name, impairment = probe.name, probe.impairment
    reasons = []
    if not _is_plausible_share(result.lost, result.sent, impairment.loss, _loss_correlation(impairment)):
        reasons.append(f"{name}: {result.lost} of {result.sent} packets were lost instead of {impairment.loss:.1%}")
    arrived = result.sent - result.lost
    if not _is_plausible_share(result.early, arrived, impairment.reorder):
        reasons.append(
            f"{name}: {result.early} of {arrived} packets overtook others instead of {impairment.reorder:.1%}"
        )
    if result.reordered and not impairment.reorder:
        reasons.append(f"{name}: {result.reordered} packets were reordered")
    return reasons


def _is_plausible_share(count: int, packets: int, share: float, correlation: float = 0.0) -> bool:
    """Return whether `count` of `packets` is plausible for the requested share of counted packets.

    `correlation` is that of neighbouring packets: 0 if each packet is counted independently of the others.
    """
    if share == 0:
        return count == 0
    probabilities = _count_probabilities(packets, share, correlation)
    return min(sum(probabilities[: count + 1]), sum(probabilities[count:])) >= LEAST_PROBABILITY


def _count_probabilities(packets: int, share: float, correlation: float) -> list[float]:
    """Return the probabilities that 0, 1, ... `packets` are counted, for a stationary Markov chain of two states."""
    begin, end = share * (1 - correlation), (1 - share) * (1 - correlation)
    # The probabilities of each count, if the next packet is passed over, and if it is counted.
    passed, counted = [1 - share], [share]
    for _ in range(packets):
        pairs = list(zip([*passed, 0.0], [0.0, *counted], strict=True))
        passed = [(1 - begin) * p + end * c for p, c in pairs]
        counted = [begin * p + (1 - end) * c for p, c in pairs]
    return [p + c for p, c in zip(passed, counted, strict=True)]


def _loss_correlation(impairment: Impairment) -> float:
    """Return the correlation of the losses of neighbouring packets."""
    return 1 - sum(burst_probabilities(impairment)) if has_loss_bursts(impairment) else 0.0


class _CapturedPackets:
    """The captured test packets of each probe, as (number, delay in milliseconds) in the order of departure."""

    def __init__(self, receiver: socket.socket, requested: Sequence[QueueProbe], run_id: int) -> None:
        self._receiver = receiver
        self._requested = requested
        self._run_id = run_id
        self.count = 0
        self.delays: list[list[tuple[int, float]]] = [[] for _ in requested]

    def mark(self, number: int, index: int, sent_ns: int) -> bytes:
        """Return the bytes that identify test packet `number` of the probe `index` of this measurement."""
        return _MARK.pack(self._run_id, number * len(self._requested) + index, sent_ns)

    def receive(self) -> None:
        """Receive all test packets that have left so far."""
        while True:
            try:
                packet, ancillary, _flags, address = self._receiver.recvmsg(_LONGEST_PACKET, ANCILLARY_BYTES)
            except BlockingIOError:
                return
            if address[2] == socket.PACKET_OUTGOING:
                self._record(packet, ancillary)

    def _record(self, packet: bytes, ancillary: Sequence[Any]) -> None:
        protocol = {17: "udp", 6: "tcp"}.get(packet[9] if len(packet) > 9 else 0, "")
        begin = _HEADER_BYTES.get(protocol, _LONGEST_PACKET) + 1
        if len(packet) < begin + _MARK.size:
            return
        run_id, serial, sent_ns = _MARK.unpack_from(packet, begin)
        kernel_time = next(
            (data for level, kind, data in ancillary if (level, kind) == (socket.SOL_SOCKET, SO_TIMESTAMPNS)), b""
        )
        if run_id != self._run_id or len(kernel_time) < 16:
            return
        seconds, nanoseconds = struct.unpack_from("qq", kernel_time)
        number, index = divmod(serial, len(self._requested))
        self.count += 1
        self.delays[index].append((number, (seconds * NS_PER_S + nanoseconds - sent_ns) / NS_PER_MS))


def _open(interface: str) -> socket.socket:
    """Open the socket that captures departing packets to the test address, without their link-layer header."""
    try:
        receiver = socket.socket(socket.AF_PACKET, socket.SOCK_DGRAM, 0)
    except PermissionError as error:
        raise UserError("only root may measure queues: use sudo") from error
    try:
        receiver.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
        receiver.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, _RECEIVE_BUFFER_BYTES)
        # BPF: load the word at 16 (the destination); if it is the test address, accept the packet, otherwise drop it.
        destination = int.from_bytes(_DESTINATION, "big")
        code = [(0x20, 0, 0, 16), (0x15, 0, 1, destination), (0x06, 0, 0, 0xFFFF), (0x06, 0, 0, 0)]
        program = ctypes.create_string_buffer(b"".join(struct.pack("HBBI", *instruction) for instruction in code))
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


def _send(sender: socket.socket, packet: bytes, link: tuple[str, int, int, int, bytes]) -> None:
    try:
        sender.sendto(packet, link)
    except BlockingIOError:
        return
    except OSError as error:  # netem also reports the packets that it drops
        if error.errno != errno.ENOBUFS:
            raise


def _hardware_address(interface: str) -> bytes:
    with socket.socket(socket.AF_PACKET, socket.SOCK_DGRAM, 0) as sock:
        sock.bind((interface, 0))
        address: bytes = sock.getsockname()[4]
    return address if any(address) else _LOCAL_ADDRESS


def _test_packet(probe: QueueProbe, mark: bytes) -> bytes:
    """Return a test packet (IPv4) of a probe. Nobody receives it, so UDP and TCP checksums are left out."""
    payload = bytes([probe.first_byte]) + mark
    if probe.protocol == "udp":
        protocol_number = 17
        body = struct.pack(">HHHH", probe.source, probe.destination, 8 + len(payload), 0) + payload
    else:
        protocol_number = 6
        body = struct.pack(">HHIIHHHH", probe.source, probe.destination, 0, 0, 5 << 12, 0, 0, 0) + payload
    header = struct.pack(">BBHHHBBH4s4s", 0x45, 0, 20 + len(body), 0, 0, 1, protocol_number, 0, _SOURCE, _DESTINATION)
    checksum = sum(struct.unpack(">10H", header))
    checksum = (checksum & 0xFFFF) + (checksum >> 16)
    return header[:10] + struct.pack(">H", ~checksum & 0xFFFF) + header[12:] + body
