"""Delay without netem: a process with one thread that carries two UDP flows and holds back what the design names.

Video, server to client: RTP and sender reports wait; the rest of that flow (challenges) does not. Control: what the
client's router sends to the server's waits; what comes back waits only where the state is to be delayed too. Nothing
upstream of the video (hellos, RTCP) ever waits.
"""

from __future__ import annotations

import heapq
import selectors
import socket
import struct
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from statistics import median

from lavt.clock import Clock
from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.errors import UserError
from lavt.transport.arrival import ANCILLARY_BYTES, Ancillary, arrival, want_arrival_times
from lavt.transport.emulation.delay_line import DelayLine, DelayModel
from lavt.transport.emulation.link import EmulatedLink, LinkInjection
from lavt.transport.rtp.rtcp import is_rtcp

LONGEST_DATAGRAM = 65_535
BUFFER_BYTES = 4 * 1024 * 1024
LONGEST_PAUSE_S = 0.05
MOST_CLIENTS = 64
"""Of a flow; each has a socket."""
CLIENT_SILENCE_NS = 30 * NS_PER_S
"""A client that sent nothing for so long loses its socket."""

REMEMBERED = 20_000
"""So many datagrams count for what the relay says it did."""

Address = tuple[str, int]
NONE = DelayModel(0.0)


def is_delayed_video(datagram: bytes) -> bool:
    """Whether a datagram from the server is RTP or RTCP (version 2) and not part of proving the path."""
    return len(datagram) >= 2 and datagram[0] >> 6 == 2


def video_index(datagram: bytes) -> int:
    """Index of a video packet's delay: its RTP timestamp, so that the packets of a frame share one delay.

    A sender report says the timestamp of the frame that it was sent with, and shares its delay.
    """
    at = 16 if is_rtcp(datagram) else 4
    return int(struct.unpack_from(">I", datagram, at)[0]) if len(datagram) >= at + 4 else 0


@dataclass(frozen=True, slots=True)
class RelayedFlow:
    """One UDP flow through the relay: where clients reach it, where the server is, and what waits in each direction."""

    name: str
    listen: Address
    server: Address
    upstream: DelayModel
    downstream: DelayModel
    delays_downstream: Callable[[bytes], bool] = lambda _datagram: True
    index_downstream: Callable[[bytes], int] | None = None
    """From a datagram to the index of its delay; None: datagrams are counted."""
    upstream_injected: LinkInjection | None = None
    downstream_injected: LinkInjection | None = None
    """More than a delay; each client has a link of its own."""


@dataclass
class _Way:
    """One direction of a client's flow: its delay line, and how what comes out of it is sent."""

    line: DelayLine
    send: Callable[[bytes], object]
    index: Callable[[bytes], int] | None
    held: Callable[[bytes], bool]
    count: int = 0
    looked_at_ns: int | None = None
    held_ns: deque[int] = field(default_factory=lambda: deque(maxlen=REMEMBERED))
    """For how long the last datagrams were held, from their arrival to their leaving."""
    late_ns: deque[int] = field(default_factory=lambda: deque(maxlen=REMEMBERED))
    """How much later they left than they were due."""


@dataclass
class _Client:
    """A client of a flow: the socket that stands for it towards the server."""

    upstream_socket: socket.socket
    up: _Way
    down: _Way
    heard_ns: int


class Relay:
    """Carries flows, one upstream socket for each client, in one thread."""

    def __init__(self, clock: Clock, flows: list[RelayedFlow]) -> None:
        self._clock = clock
        self._selector = selectors.SelectSelector()  # epoll's timeouts are whole milliseconds, rounded up
        self._heap: list[tuple[int, int, _Way]] = []
        self._number = 0
        self.start_ns = clock.now().mono_ns
        """When traces begin."""
        self.not_sent = 0
        self._flows: list[_OpenFlow] = []
        try:
            for flow in flows:
                self._flows.append(_OpenFlow(self, flow))
        except UserError:
            self.close()
            raise

    def ports(self) -> dict[str, int]:
        """Tell the port that was opened for each flow."""
        return {each.flow.name: each.port for each in self._flows}

    def held_ms(self) -> dict[str, float | None]:
        """Tell for each flow and direction the median of how long its datagrams were held; None where none came.

        Of the clients that it has now, and their last datagrams.
        """
        return {name: _median_ms([each for way in ways for each in way.held_ns]) for name, ways in self._ways()}

    def late_ms(self) -> dict[str, float | None]:
        """Tell the same of how much later they left than they were due."""
        return {name: _median_ms([each for way in ways for each in way.late_ns]) for name, ways in self._ways()}

    def counts(self) -> dict[str, dict[str, int]]:
        """Tell what became of the packets of each flow and direction that are not only delayed; of all clients ever."""
        counts = {name: _counted(ways) for name, ways in self._ways()}
        for each in self._flows:
            for direction, gone in each.gone.items():
                counts[f"{each.flow.name} {direction}"].update(gone)
        return {name: dict(each) for name, each in counts.items() if each}

    def _ways(self) -> Iterator[tuple[str, list[_Way]]]:
        for each in self._flows:
            for direction, ways in each.ways().items():
                yield f"{each.flow.name} {direction}", ways

    def step(self, longest_pause_s: float = LONGEST_PAUSE_S) -> None:
        """Wait for what comes first, a datagram, one that is due or the longest pause, and deal with it."""
        self._release()
        pause_s = longest_pause_s
        if self._heap:
            pause_s = max(0.0, min(pause_s, (self._heap[0][0] - self._clock.now().mono_ns) / NS_PER_S))
        for key, _events in self._selector.select(pause_s):
            key.data()
        self._release()

    def close(self) -> None:
        """Close all sockets; what waits is lost."""
        for each in self._flows:
            each.close()
        self._selector.close()

    def watch(self, opened: socket.socket, ready: Callable[[], None]) -> None:
        """Call `ready` when a socket has something."""
        opened.setblocking(False)
        self._selector.register(opened, selectors.EVENT_READ, ready)

    def unwatch(self, opened: socket.socket) -> None:
        """Forget a socket and close it."""
        self._selector.unregister(opened)
        opened.close()

    def now_ns(self) -> int:
        """Read the monotonic clock."""
        return self._clock.now().mono_ns

    def arrived_ns(self, ancillary: Ancillary) -> int:
        """Tell when a datagram arrived, on the monotonic clock."""
        return arrival(ancillary, self._clock.now()).mono_ns

    def pass_on(self, way: _Way, datagram: bytes, arrived_ns: int) -> None:
        """Send a datagram its way, at once or when it is due: its delay counts from its arrival."""
        if not way.held(datagram):
            self._send(way, datagram)
            return
        way.count += 1
        index = way.count if way.index is None else way.index(datagram)
        way.line.push((datagram, arrived_ns), arrived_ns, index, len(datagram))
        self._schedule(way)

    def _schedule(self, way: _Way) -> None:
        """Look at a way when its first is due, unless that is asked for already."""
        due_ns = way.line.next_due_ns()
        if due_ns is not None and (way.looked_at_ns is None or due_ns < way.looked_at_ns):
            self._number += 1
            way.looked_at_ns = due_ns
            heapq.heappush(self._heap, (due_ns, self._number, way))

    def _release(self) -> None:
        while self._heap and self._heap[0][0] <= (now_ns := self.now_ns()):
            look_ns, _, way = heapq.heappop(self._heap)
            if look_ns != way.looked_at_ns:
                continue  # one that overtook had it looked at earlier
            way.looked_at_ns = None
            while (due_ns := way.line.next_due_ns()) is not None and due_ns <= now_ns:
                for datagram, arrived_ns in way.line.pop_due(due_ns):
                    self._send(way, datagram)
                    sent_ns = self.now_ns()
                    way.held_ns.append(sent_ns - arrived_ns)
                    way.late_ns.append(sent_ns - due_ns)
            self._schedule(way)

    def _send(self, way: _Way, datagram: bytes) -> None:
        try:
            way.send(datagram)
        except OSError:  # the other end is not there, or its buffer is full: as on any network, it is lost
            self.not_sent += 1


class _OpenFlow:
    """A flow at work: the socket that clients reach, and what is known of each of them."""

    def __init__(self, relay: Relay, flow: RelayedFlow) -> None:
        self.flow = flow
        self._relay = relay
        self._clients: dict[Address, _Client] = {}
        self.gone: dict[str, Counter[str]] = {"upstream": Counter(), "downstream": Counter()}
        """What became of the packets of clients that it has no more."""
        self._socket = _bound_socket(flow.listen, flow.name)
        self.port = int(self._socket.getsockname()[1])
        relay.watch(self._socket, self._from_clients)

    def ways(self) -> dict[str, list[_Way]]:
        clients = self._clients.values()
        return {"upstream": [client.up for client in clients], "downstream": [client.down for client in clients]}

    def close(self) -> None:
        for client in self._clients.values():
            self._relay.unwatch(client.upstream_socket)
        self._relay.unwatch(self._socket)

    def _from_clients(self) -> None:
        for datagram, ancillary, address in _drain(self._socket):
            client = self._clients.get(address) or self._new_client(address)
            client.heard_ns = self._relay.now_ns()
            self._relay.pass_on(client.up, datagram, self._relay.arrived_ns(ancillary))

    def _new_client(self, address: Address) -> _Client:
        self._forget_silent()
        towards_server = _bound_socket(("", 0), self.flow.name)
        flow = self.flow
        upstream = self._line(flow.upstream, flow.upstream_injected)
        downstream = self._line(flow.downstream, flow.downstream_injected)
        client = _Client(
            towards_server,
            _Way(upstream, lambda data: towards_server.sendto(data, flow.server), None, _always),
            _Way(
                downstream, lambda data: self._socket.sendto(data, address), flow.index_downstream,
                flow.delays_downstream,
            ),
            self._relay.now_ns(),
        )  # fmt: skip
        self._clients[address] = client
        self._relay.watch(towards_server, lambda: self._from_server(client))
        return client

    def _line(self, delay: DelayModel, injected: LinkInjection | None) -> DelayLine:
        return DelayLine(delay, None if injected is None else EmulatedLink(injected, self._relay.start_ns))

    def _from_server(self, client: _Client) -> None:
        for datagram, ancillary, address in _drain(client.upstream_socket):
            if address == self.flow.server:
                self._relay.pass_on(client.down, datagram, self._relay.arrived_ns(ancillary))

    def _forget_silent(self) -> None:
        """Let clients go that are silent and, where there are too many, the one that has been silent for longest."""
        now_ns = self._relay.now_ns()
        if len(self._clients) >= MOST_CLIENTS:
            self._release(min(self._clients, key=lambda address: self._clients[address].heard_ns))
        for address, client in list(self._clients.items()):
            if now_ns - client.heard_ns > CLIENT_SILENCE_NS:
                self._release(address)

    def _release(self, address: Address) -> None:
        client = self._clients.pop(address)
        self.gone["upstream"].update(_counted([client.up]))
        self.gone["downstream"].update(_counted([client.down]))
        self._relay.unwatch(client.upstream_socket)


def _counted(ways: Sequence[_Way]) -> Counter[str]:
    """Add up what the links of some ways counted; nothing where there is no link."""
    counts: Counter[str] = Counter()
    for way in ways:
        if way.line.link is not None:
            counts.update(way.line.link.counts)
    return counts


def _median_ms(values_ns: Sequence[int]) -> float | None:
    return median(values_ns) / NS_PER_MS if values_ns else None


def _always(_datagram: bytes) -> bool:
    return True


def _bound_socket(address: Address, name: str) -> socket.socket:
    opened = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    want_arrival_times(opened)
    for option in (socket.SO_RCVBUF, socket.SO_SNDBUF):
        opened.setsockopt(socket.SOL_SOCKET, option, BUFFER_BYTES)
    try:
        opened.bind(address)
    except OSError as error:
        opened.close()
        raise UserError(
            f"the relay's {name} port {address[0]}:{address[1]} cannot be opened ({error.strerror}): name another, or 0"
        ) from error
    return opened


def _drain(opened: socket.socket) -> list[tuple[bytes, Ancillary, Address]]:
    """Take all datagrams that wait, up to a number that lets the other sockets have their turn."""
    datagrams = []
    for _ in range(64):
        try:
            datagram, ancillary, _flags, address = opened.recvmsg(LONGEST_DATAGRAM, ANCILLARY_BYTES)
        except BlockingIOError:
            break
        except OSError:  # an ICMP error of an earlier datagram
            continue
        datagrams.append((datagram, ancillary, address))
    return datagrams
