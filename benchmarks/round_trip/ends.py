"""The ends of raw UDP, pyzmq and CycloneDDS, and the base of all ends.

A carrier has two ends: the asking end, which sends commands, and the echoing end, which sends them back. The echoing
end is created first, with an empty address; the asking end is created with the echoing end's `address`. Each end
receives in a listening thread, which passes messages to the process's main thread, as a link of LAVT passes them to the
thread of a node. pyzmq and CycloneDDS are imported only when they are used, because LAVT does not need them.
"""

from __future__ import annotations

import importlib
import json
import os
import queue
import socket
import threading
import time  # noqa: TID251 (a benchmark reads the clock)
from dataclasses import make_dataclass
from typing import Any, Final, NamedTuple

MAX_DATAGRAM_BYTES: Final = 65_507
LOOPBACK: Final = "127.0.0.1"
DDS_CONFIG: Final = (
    "<CycloneDDS><Domain><General><Interfaces><NetworkInterface name='lo' multicast='false'/></Interfaces>"
    "<AllowMulticast>false</AllowMulticast></General><Discovery><ParticipantIndex>auto</ParticipantIndex>"
    f"<Peers><Peer address='{LOOPBACK}'/></Peers></Discovery></Domain></CycloneDDS>"
)
"""Restricts CycloneDDS to this machine: to the loopback, without multicast."""
DDS_WAIT_NS: Final = 60_000_000_000


class Receipt(NamedTuple):
    """A received message with times of the monotonic clock."""

    data: bytes
    arrived_ns: int
    """When the listening thread got it from the carrier."""
    verified_ns: int
    """When the listening thread had verified it, and passed it on."""
    in_zenoh_ns: int = 0
    """Time between Zenoh's own stamps for sending and receiving; 0: there are none."""
    woken_ns: int = 0
    """Time between Zenoh's stamp for receiving and `arrived_ns`; 0: there is none."""


class CarrierEnd:
    """One end of a carrier, with a listening thread that runs `_listen`."""

    address: str = "none"
    """The address of this end, which the other end needs. It is not empty, even if the carrier has no addresses."""
    signed_ns = 0
    """When the last message had been signed, if this end signs messages."""
    wire_bytes = 0
    """Size of the last message as it was sent, if this end signs messages."""

    def __init__(self) -> None:
        self._received: queue.SimpleQueue[Receipt | None] = queue.SimpleQueue()

    def _start(self) -> None:
        threading.Thread(target=self._listen, name="listener", daemon=True).start()

    def _listen(self) -> None:
        """Receive messages and call `_pass_on` for each, without end."""
        raise NotImplementedError

    def _pass_on(self, data: bytes) -> None:
        now_ns = time.monotonic_ns()
        self._received.put(Receipt(data, now_ns, now_ns))

    def send(self, data: bytes) -> None:
        """Send a message."""
        raise NotImplementedError

    def receive(self, timeout_s: float) -> Receipt | None:
        """Wait for the next message; return None if none arrives in time, or after `stop`."""
        try:
            return self._received.get(timeout=timeout_s)
        except queue.Empty:
            return None

    def stop(self) -> None:
        """Let the main thread's `receive` return None."""
        self._received.put(None)

    def close(self) -> None:
        """Close the end; the listening thread ends with the process."""


class UdpEnd(CarrierEnd):
    """A UDP socket, which sends to the address from which it received last."""

    def __init__(self, address: str) -> None:
        super().__init__()
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind((LOOPBACK, 0))
        self.address = str(self._socket.getsockname()[1])
        self._peer = (LOOPBACK, int(address)) if address else None
        self._start()

    def _listen(self) -> None:
        while True:
            data, self._peer = self._socket.recvfrom(MAX_DATAGRAM_BYTES)
            self._pass_on(data)

    def send(self, data: bytes) -> None:
        """Send to the peer."""
        if self._peer is not None:
            self._socket.sendto(data, self._peer)


class DirectUdpEnd(UdpEnd):
    """A UDP socket that the main thread reads itself: the least that a round trip takes in Python."""

    def _start(self) -> None:
        """Start no thread."""

    def receive(self, timeout_s: float) -> Receipt | None:
        """Wait for a datagram."""
        self._socket.settimeout(timeout_s)
        try:
            data, self._peer = self._socket.recvfrom(MAX_DATAGRAM_BYTES)
        except TimeoutError:
            return None
        now_ns = time.monotonic_ns()
        return Receipt(data, now_ns, now_ns) if data else None

    def stop(self) -> None:
        """Send an empty datagram to the own socket."""
        self._socket.sendto(b"", self._socket.getsockname())


class PyzmqEnd(CarrierEnd):
    """A PUB and a SUB socket in each process, over TCP, without a broker."""

    def __init__(self, address: str) -> None:
        super().__init__()
        zmq: Any = importlib.import_module("zmq")
        self._context = zmq.Context()
        self._publisher, self._subscriber = self._context.socket(zmq.PUB), self._context.socket(zmq.SUB)
        self._subscriber.setsockopt(zmq.SUBSCRIBE, b"")
        for zmq_socket in (self._publisher, self._subscriber):
            zmq_socket.setsockopt(zmq.LINGER, 0)
        if address:
            self.address = address
            echo_subscriber_port, echo_publisher_port = json.loads(address)
            self._publisher.connect(f"tcp://{LOOPBACK}:{echo_subscriber_port}")
            self._subscriber.connect(f"tcp://{LOOPBACK}:{echo_publisher_port}")
        else:
            zmq_sockets = (self._subscriber, self._publisher)
            ports = [zmq_socket.bind_to_random_port(f"tcp://{LOOPBACK}") for zmq_socket in zmq_sockets]
            self.address = json.dumps(ports)
        self._start()

    def _listen(self) -> None:
        while True:
            self._pass_on(self._subscriber.recv())

    def send(self, data: bytes) -> None:
        """Publish a message."""
        self._publisher.send(data)


class DdsEnd(CarrierEnd):
    """A writer and a reader of CycloneDDS, with best effort and a history of one sample."""

    def __init__(self, address: str) -> None:
        super().__init__()
        os.environ["CYCLONEDDS_URI"] = DDS_CONFIG  # read when the first participant is created
        core, domain, idl, publish, subscribe, topics, types = (
            importlib.import_module(f"cyclonedds.{name}")
            for name in ("core", "domain", "idl", "pub", "sub", "topic", "idl.types")
        )
        self._sample: Any = make_dataclass(
            "LavtRoundTrip", [("data", types.sequence[types.uint8])], bases=(idl.IdlStruct,)
        )
        qos = core.Qos(core.Policy.Reliability.BestEffort, core.Policy.History.KeepLast(1))
        participant = domain.DomainParticipant()
        names = ("ask", "echo") if address else ("echo", "ask")
        sent, received = (topics.Topic(participant, f"lavt_round_trip_{name}", self._sample) for name in names)
        self._writer = publish.DataWriter(participant, sent, qos=qos)
        self._reader = subscribe.DataReader(participant, received, qos=qos)
        self._wait_set = core.WaitSet(participant)
        anything = core.SampleState.Any | core.ViewState.Any | core.InstanceState.Alive
        self._wait_set.attach(core.ReadCondition(self._reader, anything))
        self._keep_alive = (participant, sent, received)
        self._start()

    def _listen(self) -> None:
        while True:
            if not self._wait_set.wait(DDS_WAIT_NS):
                continue
            for sample in self._reader.take(1):
                if hasattr(sample, "data"):
                    self._pass_on(bytes(sample.data))

    def send(self, data: bytes) -> None:
        """Write a sample."""
        self._writer.write(self._sample(data=data))
