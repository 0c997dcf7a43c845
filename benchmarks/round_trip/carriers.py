"""The carriers of messages to another process and back: raw UDP, Zenoh through routers, pyzmq, CycloneDDS.

Each carrier has two ends: one in the process that echoes and one in the process that asks. The echoing end is created
first, with an empty address; its own `address` is then passed to the asking end. pyzmq and CycloneDDS are imported only
when they are used, because LAVT does not need them.
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
"""Only this machine: without multicast, on the loopback."""


class CarrierEnd(Protocol):
    """One end of a carrier."""

    address: str
    """The address that the other end needs."""

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
    """A UDP socket, which sends to the address that it last received from."""

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
        config = zenoh.Config.from_file(str(shipped("zenoh-configs/session.json5")))
        config.insert_json5("connect/endpoints", json.dumps([routers[is_asking]]))
        self.address = "zenoh"
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
        """Undeclare the subscriber and close the session; otherwise the process would not end."""
        self._subscriber.undeclare()
        self._listener.join()
        self._session.close()


class PyzmqCarrier:
    """Two pairs of PUB and SUB over TCP, without a broker."""

    def __init__(self, address: str, _routers: Routers) -> None:
        zmq: Any = importlib.import_module("zmq")
        self._context = zmq.Context()
        self._out, self._in = self._context.socket(zmq.PUB), self._context.socket(zmq.SUB)
        self._in.setsockopt(zmq.SUBSCRIBE, b"")
        for zmq_socket in (self._out, self._in):
            zmq_socket.setsockopt(zmq.LINGER, 0)
        self.address = address
        if address:
            to_port, from_port = json.loads(address)
            self._out.connect(f"tcp://{LOOPBACK}:{to_port}")
            self._in.connect(f"tcp://{LOOPBACK}:{from_port}")
        else:
            ports = [zmq_socket.bind_to_random_port(f"tcp://{LOOPBACK}") for zmq_socket in (self._in, self._out)]
            self.address = json.dumps(ports)

    def send(self, data: bytes) -> None:
        """Publish a message."""
        self._out.send(data)

    def receive(self, timeout_s: float) -> bytes | None:
        """Wait for a message."""
        if not self._in.poll(round(timeout_s * 1000)):
            return None
        data: bytes = self._in.recv()
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
        self.address = "dds"
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
        """Do nothing: the participant ends with the process."""


@dataclass(frozen=True)
class Carrier:
    """A carrier in the table of results."""

    label: str
    end: Callable[[str, Routers], CarrierEnd]
    """Creates an end from the address of the other end (empty for the echoing end) and the routers."""
    module: str = ""
    """The module that it needs besides LAVT's dependencies; empty if none."""
    package: str = ""
    """The package that has the module."""

    @property
    def missing(self) -> bool:
        """Whether its module is not installed."""
        return self.module != "" and find_spec(self.module) is None


CARRIERS: Final[dict[str, Carrier]] = {
    "udp": Carrier("raw UDP sockets", UdpCarrier),
    "zenoh": Carrier("Zenoh through two routers, as in LAVT", ZenohCarrier),
    "pyzmq": Carrier("pyzmq, PUB and SUB, no broker", PyzmqCarrier, "zmq", "pyzmq"),
    "cyclonedds": Carrier("CycloneDDS, best effort, no broker", DdsCarrier, "cyclonedds", "cyclonedds"),
}
