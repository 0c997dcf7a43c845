"""A relay that delays without netem: one thread carries two UDP flows and delays the packets that netem would delay.

Video, from the server to the client: RTP and sender reports are delayed; path validation in the same flow is not.
Video, from the client to the server (hellos, RTCP): nothing is delayed. Control: packets from the client's router to
the server's router are delayed; packets in the other direction are delayed only if the state has a delay, too.
"""

from __future__ import annotations

import heapq
import selectors
import socket
import struct
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from statistics import median

from lavt.clock import Clock
from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.errors import UserError
from lavt.transport.arrival import ANCILLARY_BYTES, Ancillary, arrival, enable_arrival_times
from lavt.transport.emulation.delay_line import DelayLine, DelayModel
from lavt.transport.emulation.link import EmulatedLink, LinkInjection
from lavt.transport.rtp.rtcp import is_rtcp

LONGEST_DATAGRAM = 65_535
SOCKET_BUFFER_BYTES = 4 * 1024 * 1024
LONGEST_PAUSE_S = 0.05
"""The longest wait of one step of the relay."""
MAX_CLIENTS = 64
"""Limits the clients of each flow, because every client has a socket."""
CLIENT_TIMEOUT_NS = 30 * NS_PER_S
"""A client that sends nothing for this long loses its socket."""

MAX_DRAINED = 64
"""How many datagrams of one socket are received before the other sockets have their turn."""
MAX_SAMPLES = 20_000
"""The relay's medians cover at most this many of the last datagrams in each direction of a client."""

Address = tuple[str, int]
NO_DELAY = DelayModel(0.0)


def must_delay_video_datagram(datagram: bytes) -> bool:
    """Return whether to delay a datagram from the server: RTP and RTCP (version 2), but not path validation."""
    return len(datagram) >= 2 and datagram[0] >> 6 == 2


def video_delay_index(datagram: bytes) -> int:
    """Return the index of a video packet's delay: its RTP timestamp, so that the packets of a frame share one delay.

    A sender report has the timestamp of the frame with which it was sent, and shares that frame's delay.
    """
    offset = 16 if is_rtcp(datagram) else 4
    return int(struct.unpack_from(">I", datagram, offset)[0]) if len(datagram) >= offset + 4 else 0


@dataclass(frozen=True, slots=True)
class RelayedFlow:
    """A UDP flow through the relay: the address for clients, the server's address, and the delay of each direction."""

    name: str
    listen: Address
    server: Address
    upstream: DelayModel
    downstream: DelayModel
    downstream_delay_filter: Callable[[bytes], bool] = lambda _datagram: True
    """Returns whether to delay a datagram from the server; by default all are delayed."""
    downstream_delay_index_function: Callable[[bytes], int] | None = None
    """Maps a datagram from the server to the index of its delay; None: the index is the datagram's number."""
    upstream_injected: LinkInjection | None = None
    downstream_injected: LinkInjection | None = None
    """Impairments beyond a delay; each client has links of its own."""


@dataclass
class _DelayedPath:
    """One direction of a client's flow: its delay line, and how to send the datagrams that leave the line."""

    line: DelayLine
    send: Callable[[bytes], object]
    delay_index_function: Callable[[bytes], int] | None
    """Maps a datagram to the index of its delay; None: the index is `count`."""
    delay_filter: Callable[[bytes], bool]
    count: int = 0
    """How many datagrams were delayed."""
    scheduled_ns: int | None = None
    """When the relay will send the first datagram of the line; None: the line is empty."""
    delays_ns: deque[int] = field(default_factory=lambda: deque(maxlen=MAX_SAMPLES))
    """How long the last datagrams were delayed, from arrival to departure."""
    lateness_ns: deque[int] = field(default_factory=lambda: deque(maxlen=MAX_SAMPLES))
    """How late the last datagrams left, from due to departure."""


@dataclass
class _Client:
    """A client of a flow, with the socket that represents it towards the server."""

    upstream_socket: socket.socket
    up: _DelayedPath
    down: _DelayedPath
    last_received_ns: int


class Relay:
    """A relay for UDP flows in one thread, with one upstream socket for each client."""

    def __init__(self, clock: Clock, flows: list[RelayedFlow]) -> None:
        self._clock = clock
        self._selector = selectors.SelectSelector()  # epoll's timeouts are whole milliseconds, rounded up
        self._heap: list[tuple[int, int, _DelayedPath]] = []
        """Due time, number of the entry, and path that has a datagram due then."""
        self._entries = 0
        """How many entries were put on the heap; the number of the last one."""
        self.start_ns = clock.now().mono_ns
        """The time at which traces begin."""
        self.not_sent = 0
        """How many datagrams the system did not send."""
        self._flows: list[_ActiveFlow] = []
        try:
            for flow in flows:
                self._flows.append(_ActiveFlow(self, flow))
        except UserError:
            self.close()
            raise

    def ports(self) -> dict[str, int]:
        """Return the port that was opened for each flow."""
        return {active.flow.name: active.port for active in self._flows}

    def median_delays_ms(self) -> dict[str, float | None]:
        """Return for each flow and direction the median delay of its datagrams, or None if there were none.

        The medians cover the current clients and their last datagrams.
        """
        return {
            name: _median_ms([delay_ns for path in paths for delay_ns in path.delays_ns])
            for name, paths in self._paths()
        }

    def median_lateness_ms(self) -> dict[str, float | None]:
        """Return for each flow and direction how late its datagrams left, as a median, or None if there were none."""
        return {
            name: _median_ms([late_ns for path in paths for late_ns in path.lateness_ns])
            for name, paths in self._paths()
        }

    def counts(self) -> dict[str, dict[str, int]]:
        """Return the packet counters of each flow and direction that has a link, over all clients so far."""
        counts = {name: _sum_counts(paths) for name, paths in self._paths()}
        for active in self._flows:
            for direction, past_counts in active.past_counts.items():
                counts[f"{active.flow.name} {direction}"].update(past_counts)
        return {name: dict(counter) for name, counter in counts.items() if counter}

    def change_delays(self, name: str, *, upstream: DelayModel, downstream: DelayModel) -> None:
        """Change the delays of a flow for datagrams that arrive from now on; a flow keeps the order of its datagrams.

        Call this between two steps.
        """
        active = next(active for active in self._flows if active.flow.name == name)
        active.change_delays(upstream, downstream)

    def _paths(self) -> Iterator[tuple[str, list[_DelayedPath]]]:
        for active in self._flows:
            for direction, paths in active.paths().items():
                yield f"{active.flow.name} {direction}", paths

    def step(self, longest_pause_s: float = LONGEST_PAUSE_S) -> None:
        """Wait until a datagram arrives or is due, or the longest pause has passed; forward the datagrams."""
        self._send_due()
        pause_s = longest_pause_s
        if self._heap:
            pause_s = max(0.0, min(pause_s, (self._heap[0][0] - self._clock.now().mono_ns) / NS_PER_S))
        for key, _events in self._selector.select(pause_s):
            key.data()
        self._send_due()

    def close(self) -> None:
        """Close all sockets; queued datagrams are lost."""
        for active in self._flows:
            active.close()
        self._selector.close()

    def add_socket(self, sock: socket.socket, ready: Callable[[], None]) -> None:
        """Call `ready` whenever a socket is readable."""
        sock.setblocking(False)
        self._selector.register(sock, selectors.EVENT_READ, ready)

    def remove_socket(self, sock: socket.socket) -> None:
        """Stop watching a socket and close it."""
        self._selector.unregister(sock)
        sock.close()

    def now_ns(self) -> int:
        """Return the time of the monotonic clock."""
        return self._clock.now().mono_ns

    def arrived_ns(self, ancillary: Ancillary) -> int:
        """Return when a datagram arrived, on the monotonic clock."""
        return arrival(ancillary, self._clock.now()).mono_ns

    def forward(self, path: _DelayedPath, datagram: bytes, arrived_ns: int) -> None:
        """Send a datagram inline if it is not delayed, otherwise when its delay since its arrival has passed."""
        if not path.delay_filter(datagram):
            self._send(path, datagram)
            return
        path.count += 1
        index = path.count if path.delay_index_function is None else path.delay_index_function(datagram)
        path.line.push((datagram, arrived_ns), arrived_ns, index, len(datagram))
        self._schedule(path)

    def _schedule(self, path: _DelayedPath) -> None:
        """Schedule a path for when its first datagram is due, unless it is scheduled for that time or before."""
        due_ns = path.line.next_due_ns()
        if due_ns is not None and (path.scheduled_ns is None or due_ns < path.scheduled_ns):
            self._entries += 1
            path.scheduled_ns = due_ns
            heapq.heappush(self._heap, (due_ns, self._entries, path))

    def _send_due(self) -> None:
        while self._heap and self._heap[0][0] <= (now_ns := self.now_ns()):
            scheduled_ns, _, path = heapq.heappop(self._heap)
            if scheduled_ns != path.scheduled_ns:
                continue  # the entry is out of date: a reordered datagram of this path was due earlier
            path.scheduled_ns = None
            while (due_ns := path.line.next_due_ns()) is not None and due_ns <= now_ns:
                for datagram, arrived_ns in path.line.pop_due(due_ns):
                    self._send(path, datagram)
                    sent_ns = self.now_ns()
                    path.delays_ns.append(sent_ns - arrived_ns)
                    path.lateness_ns.append(sent_ns - due_ns)
            self._schedule(path)

    def _send(self, path: _DelayedPath, datagram: bytes) -> None:
        try:
            path.send(datagram)
        except OSError:  # the peer is gone or its buffer is full: the datagram is lost, as on any network
            self.not_sent += 1


class _ActiveFlow:
    """A flow in operation: the socket for clients, and the state of each client."""

    def __init__(self, relay: Relay, flow: RelayedFlow) -> None:
        self.flow = flow
        self._relay = relay
        self._clients: dict[Address, _Client] = {}
        self.past_counts: dict[str, Counter[str]] = {"upstream": Counter(), "downstream": Counter()}
        """Packet counters of removed clients, by direction."""
        self._socket = _bound_socket(flow.listen, flow.name)
        self.port = int(self._socket.getsockname()[1])
        relay.add_socket(self._socket, self._forward_from_clients)

    def paths(self) -> dict[str, list[_DelayedPath]]:
        clients = self._clients.values()
        return {"upstream": [client.up for client in clients], "downstream": [client.down for client in clients]}

    def change_delays(self, upstream: DelayModel, downstream: DelayModel) -> None:
        self.flow = replace(self.flow, upstream=upstream, downstream=downstream)
        for client in self._clients.values():
            client.up.line.delay, client.down.line.delay = upstream, downstream

    def close(self) -> None:
        for client in self._clients.values():
            self._relay.remove_socket(client.upstream_socket)
        self._relay.remove_socket(self._socket)

    def _forward_from_clients(self) -> None:
        for datagram, ancillary, address in _drain(self._socket):
            client = self._clients.get(address) or self._new_client(address)
            client.last_received_ns = self._relay.now_ns()
            self._relay.forward(client.up, datagram, self._relay.arrived_ns(ancillary))

    def _new_client(self, address: Address) -> _Client:
        self._remove_idle_clients()
        towards_server = _bound_socket(("", 0), self.flow.name)
        flow = self.flow
        upstream = self._line(flow.upstream, flow.upstream_injected)
        downstream = self._line(flow.downstream, flow.downstream_injected)
        client = _Client(
            towards_server,
            _DelayedPath(upstream, lambda data: towards_server.sendto(data, flow.server), None, _is_always_delayed),
            _DelayedPath(
                downstream,
                lambda data: self._socket.sendto(data, address),
                flow.downstream_delay_index_function,
                flow.downstream_delay_filter,
            ),
            self._relay.now_ns(),
        )
        self._clients[address] = client
        self._relay.add_socket(towards_server, lambda: self._forward_from_server(client))
        return client

    def _line(self, delay: DelayModel, injected: LinkInjection | None) -> DelayLine:
        return DelayLine(delay, None if injected is None else EmulatedLink(injected, self._relay.start_ns))

    def _forward_from_server(self, client: _Client) -> None:
        for datagram, ancillary, address in _drain(client.upstream_socket):
            if address == self.flow.server:
                self._relay.forward(client.down, datagram, self._relay.arrived_ns(ancillary))

    def _remove_idle_clients(self) -> None:
        """Remove idle clients and, if there are too many clients, also the one that has been idle for longest."""
        now_ns = self._relay.now_ns()
        if len(self._clients) >= MAX_CLIENTS:
            self._remove_client(min(self._clients, key=lambda address: self._clients[address].last_received_ns))
        for address, client in list(self._clients.items()):
            if now_ns - client.last_received_ns > CLIENT_TIMEOUT_NS:
                self._remove_client(address)

    def _remove_client(self, address: Address) -> None:
        client = self._clients.pop(address)
        self.past_counts["upstream"].update(_sum_counts([client.up]))
        self.past_counts["downstream"].update(_sum_counts([client.down]))
        self._relay.remove_socket(client.upstream_socket)


def _sum_counts(paths: Sequence[_DelayedPath]) -> Counter[str]:
    """Return the sums of the counters of the paths' links."""
    counts: Counter[str] = Counter()
    for path in paths:
        if path.line.link is not None:
            counts.update(path.line.link.counts)
    return counts


def _median_ms(values_ns: Sequence[int]) -> float | None:
    return median(values_ns) / NS_PER_MS if values_ns else None


def _is_always_delayed(_datagram: bytes) -> bool:
    return True


def _bound_socket(address: Address, name: str) -> socket.socket:
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    enable_arrival_times(sock)
    for option in (socket.SO_RCVBUF, socket.SO_SNDBUF):
        sock.setsockopt(socket.SOL_SOCKET, option, SOCKET_BUFFER_BYTES)
    try:
        sock.bind(address)
    except OSError as error:
        sock.close()
        raise UserError(
            f"cannot open the relay's {name} port {address[0]}:{address[1]} ({error.strerror}): name another port, or 0"
        ) from error
    return sock


def _drain(sock: socket.socket) -> list[tuple[bytes, Ancillary, Address]]:
    """Return all waiting datagrams, but at most `MAX_DRAINED`."""
    datagrams = []
    for _ in range(MAX_DRAINED):
        try:
            datagram, ancillary, _flags, address = sock.recvmsg(LONGEST_DATAGRAM, ANCILLARY_BYTES)
        except BlockingIOError:
            break
        except OSError:  # an ICMP error caused by an earlier datagram
            continue
        datagrams.append((datagram, ancillary, address))
    return datagrams
