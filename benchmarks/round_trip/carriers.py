"""The carriers of messages to another process and back: raw UDP, Zenoh through routers, pyzmq, CycloneDDS.

Each carrier has two ends: the asking end, which sends commands, and the echoing end, which sends them back. The echoing
end is created first, with an empty address. The asking end is then created with the echoing end's `address`. pyzmq and
CycloneDDS are imported only when they are used, because LAVT does not need them.
"""

from __future__ import annotations

import importlib
import json
import os
import queue
import socket
import threading
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, make_dataclass
from importlib.util import find_spec
from typing import Any, Final, Protocol

import zenoh

from lavt.config_file import shipped
from lavt.transport.zenoh_link import CONTROL, RECEIVE_RING_LENGTH

MAX_DATAGRAM_BYTES: Final = 65_507
LOOPBACK: Final = "127.0.0.1"
Routers = tuple[str, str]
"""Endpoints of the vehicle's router, to which the echoing end connects, and of the operator's, for the asking end."""

DDS_CONFIG: Final = (
    "<CycloneDDS><Domain><General><Interfaces><NetworkInterface name='lo' multicast='false'/></Interfaces>"
    "<AllowMulticast>false</AllowMulticast></General><Discovery><ParticipantIndex>auto</ParticipantIndex>"
    f"<Peers><Peer address='{LOOPBACK}'/></Peers></Discovery></Domain></CycloneDDS>"
)
"""Restricts CycloneDDS to this machine: to the loopback, without multicast."""


class CarrierEnd(Protocol):
    """One end of a carrier."""

    address: str
    """The address of this end, which the other end needs. It is not empty, even if the carrier has no addresses."""

    def send(self, data: bytes) -> None:
        """Send a message."""
        ...

    def receive(self, timeout_s: float) -> bytes | None:
        """Wait for the next message; return None if none arrives in time."""
        ...

    def close(self) -> None:
        """Close the end."""
        ...


class UdpCarrier:
    """A UDP socket, which sends to the address from which it received last."""

    def __init__(self, address: str, _routers: Routers) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind((LOOPBACK, 0))
        self.address = str(self._socket.getsockname()[1])
        self._peer = (LOOPBACK, int(address)) if address else None

    def send(self, data: bytes) -> None:
        """Send to the peer."""
        if self._peer is not None:
            self._socket.sendto(data, self._peer)

    def receive(self, timeout_s: float) -> bytes | None:
        """Wait for a datagram."""
        self._socket.settimeout(timeout_s)
        try:
            data, self._peer = self._socket.recvfrom(MAX_DATAGRAM_BYTES)
        except TimeoutError:
            return None
        return data

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


class ZenohCarrier:
    """A session at the router of its own side, as in LAVT, with the quality of service of commands."""

    def __init__(self, address: str, routers: Routers) -> None:
        is_asking = address != ""
        vehicle_router, operator_router = routers
        config = zenoh.Config.from_file(str(shipped("zenoh-configs/session.json5")))
        config.insert_json5("connect/endpoints", json.dumps([operator_router if is_asking else vehicle_router]))
        self.address = "zenoh"  # any text but the empty one: the ends find each other by their keys
        self._session = zenoh.open(config)
        self._received: queue.SimpleQueue[bytes] = queue.SimpleQueue()
        sent_key, received_key = ("ask", "echo") if is_asking else ("echo", "ask")
        qos: dict[str, Any] = CONTROL
        self._publisher = self._session.declare_publisher(f"lavt/round-trip/{sent_key}", **qos)
        ring: Any = zenoh.handlers.RingChannel(RECEIVE_RING_LENGTH)
        self._subscriber = self._session.declare_subscriber(f"lavt/round-trip/{received_key}", ring)
        self._listener = threading.Thread(target=self._listen, daemon=True)
        self._listener.start()

    def _listen(self) -> None:
        samples = self._subscriber.handler
        with suppress(zenoh.ZError):  # raised when the subscriber is undeclared
            while True:
                self._received.put(samples.recv().payload.to_bytes())

    def send(self, data: bytes) -> None:
        """Publish a message."""
        self._publisher.put(data)

    def receive(self, timeout_s: float) -> bytes | None:
        """Wait for a message from the listening thread, as a node does."""
        with suppress(queue.Empty):
            return self._received.get(timeout=timeout_s)
        return None

    def close(self) -> None:
        """Undeclare the subscriber, which ends the listening thread, and close the session."""
        self._subscriber.undeclare()
        self._listener.join()
        self._session.close()


class PyzmqCarrier:
    """A PUB and a SUB socket in each process, over TCP, without a broker."""

    def __init__(self, address: str, _routers: Routers) -> None:
        zmq: Any = importlib.import_module("zmq")
        self._context = zmq.Context()
        self._publisher, self._subscriber = self._context.socket(zmq.PUB), self._context.socket(zmq.SUB)
        self._subscriber.setsockopt(zmq.SUBSCRIBE, b"")
        for zmq_socket in (self._publisher, self._subscriber):
            zmq_socket.setsockopt(zmq.LINGER, 0)
        self.address = address
        if address:
            echo_subscriber_port, echo_publisher_port = json.loads(address)
            self._publisher.connect(f"tcp://{LOOPBACK}:{echo_subscriber_port}")
            self._subscriber.connect(f"tcp://{LOOPBACK}:{echo_publisher_port}")
        else:
            zmq_sockets = (self._subscriber, self._publisher)
            self.address = json.dumps(
                [zmq_socket.bind_to_random_port(f"tcp://{LOOPBACK}") for zmq_socket in zmq_sockets]
            )

    def send(self, data: bytes) -> None:
        """Publish a message."""
        self._publisher.send(data)

    def receive(self, timeout_s: float) -> bytes | None:
        """Wait for a message."""
        if not self._subscriber.poll(round(timeout_s * 1000)):
            return None
        data: bytes = self._subscriber.recv()
        return data

    def close(self) -> None:
        """Close both sockets."""
        self._context.destroy()


class DdsCarrier:
    """A writer and a reader of CycloneDDS, with best effort and a history of one sample."""

    def __init__(self, address: str, _routers: Routers) -> None:
        os.environ["CYCLONEDDS_URI"] = DDS_CONFIG  # read when the first participant is created
        core, domain, idl, publish, subscribe, topics, types = (
            importlib.import_module(f"cyclonedds.{name}")
            for name in ("core", "domain", "idl", "pub", "sub", "topic", "idl.types")
        )
        self._sample: Any = make_dataclass(
            "LavtRoundTrip", [("data", types.sequence[types.uint8])], bases=(idl.IdlStruct,)
        )
        qos = core.Qos(core.Policy.Reliability.BestEffort, core.Policy.History.KeepLast(1))
        self.address = "dds"  # any text but the empty one: the ends find each other by their topics
        participant = domain.DomainParticipant()
        names = ("ask", "echo") if address else ("echo", "ask")
        sent, received = (topics.Topic(participant, f"lavt_round_trip_{name}", self._sample) for name in names)
        self._writer = publish.DataWriter(participant, sent, qos=qos)
        self._reader = subscribe.DataReader(participant, received, qos=qos)
        self._wait_set = core.WaitSet(participant)
        anything = core.SampleState.Any | core.ViewState.Any | core.InstanceState.Alive
        self._wait_set.attach(core.ReadCondition(self._reader, anything))
        self._keep_alive = (participant, sent, received)

    def send(self, data: bytes) -> None:
        """Write a sample."""
        self._writer.write(self._sample(data=data))

    def receive(self, timeout_s: float) -> bytes | None:
        """Wait for a sample."""
        if not self._wait_set.wait(round(timeout_s * 1e9)):
            return None
        for sample in self._reader.take(1):
            if hasattr(sample, "data"):
                return bytes(sample.data)
        return None

    def close(self) -> None:
        """Do nothing, because the participant ends with the process."""


@dataclass(frozen=True)
class Carrier:
    """A carrier that can be measured."""

    label: str
    """The carrier's name in the printed table."""
    end: Callable[[str, Routers], CarrierEnd]
    """Creates an end from the address of the other end (empty for the echoing end) and the routers."""
    module: str = ""
    """The Python module that the carrier needs besides LAVT's dependencies; empty if none."""
    package: str = ""
    """The package that has the module."""

    @property
    def missing(self) -> bool:
        """Whether the module is not installed."""
        return self.module != "" and find_spec(self.module) is None


CARRIERS: Final[dict[str, Carrier]] = {
    "udp": Carrier("raw UDP sockets", UdpCarrier),
    "zenoh": Carrier("Zenoh through two routers, as in LAVT", ZenohCarrier),
    "pyzmq": Carrier("pyzmq, PUB and SUB, no broker", PyzmqCarrier, "zmq", "pyzmq"),
    "cyclonedds": Carrier("CycloneDDS, best effort, no broker", DdsCarrier, "cyclonedds", "cyclonedds"),
}
