"""What carries a message to another process and back: raw UDP, Zenoh through routers, pyzmq, CycloneDDS.

Each carrier has two ends. The echo's end tells an address, with which the asker's end is made. pyzmq and CycloneDDS are
imported only where they are asked for: LAVT does not need them.
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

LONGEST_BYTES: Final = 65_507
LOOPBACK: Final = "127.0.0.1"
Routers = tuple[str, str]
"""Endpoints of the vehicle's and of the operator's: the echo is at the first one, the asker at the second."""
DDS_CONFIG: Final = (
    "<CycloneDDS><Domain><General><Interfaces><NetworkInterface name='lo' multicast='false'/></Interfaces>"
    "<AllowMulticast>false</AllowMulticast></General><Discovery><ParticipantIndex>auto</ParticipantIndex>"
    f"<Peers><Peer address='{LOOPBACK}'/></Peers></Discovery></Domain></CycloneDDS>"
)
"""The loopback, and nobody else."""


class End(Protocol):
    """One end of a carrier."""

    address: str
    """What the other end needs to know."""

    def send(self, data: bytes) -> None:
        """Send a message."""
        ...

    def receive(self, timeout_s: float) -> bytes | None:
        """Wait for the next message; None where none comes."""
        ...

    def close(self) -> None:
        """Leave."""
        ...


class Udp:
    """A UDP socket; it answers whoever sent last."""

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
            data, self._peer = self._socket.recvfrom(LONGEST_BYTES)
        except TimeoutError:
            return None
        return data

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


class Zenoh:
    """A session at a router of its own, as each side of LAVT has it, with the quality of service of commands."""

    def __init__(self, address: str, routers: Routers) -> None:
        asks = address != ""
        config = zenoh.Config.from_file(str(shipped("zenoh-configs/session.json5")))
        config.insert_json5("connect/endpoints", json.dumps([routers[asks]]))
        self.address = "zenoh"
        self._session = zenoh.open(config)
        self._heard: queue.SimpleQueue[bytes] = queue.SimpleQueue()
        said, heard = ("ask", "echo") if asks else ("echo", "ask")
        qos: dict[str, Any] = CONTROL
        self._publisher = self._session.declare_publisher(f"lavt/round-trip/{said}", **qos)
        ring: Any = zenoh.handlers.RingChannel(RECEIVE_RING_LENGTH)
        self._subscriber = self._session.declare_subscriber(f"lavt/round-trip/{heard}", ring)
        self._listener = threading.Thread(target=self._listen, daemon=True)
        self._listener.start()

    def _listen(self) -> None:
        arriving = self._subscriber.handler
        with suppress(zenoh.ZError):  # undeclared
            while True:
                self._heard.put(arriving.recv().payload.to_bytes())

    def send(self, data: bytes) -> None:
        """Publish."""
        self._publisher.put(data)

    def receive(self, timeout_s: float) -> bytes | None:
        """Wait for what the thread that listens has put here, as a node does."""
        with suppress(queue.Empty):
            return self._heard.get(timeout=timeout_s)
        return None

    def close(self) -> None:
        """Undeclare and close: without it the process would not end."""
        self._subscriber.undeclare()
        self._listener.join()
        self._session.close()


class Pyzmq:
    """Two pairs of PUB and SUB over TCP, without a broker."""

    def __init__(self, address: str, _routers: Routers) -> None:
        zmq: Any = importlib.import_module("zmq")
        self._context = zmq.Context()
        self._out, self._in = self._context.socket(zmq.PUB), self._context.socket(zmq.SUB)
        self._in.setsockopt(zmq.SUBSCRIBE, b"")
        for each in (self._out, self._in):
            each.setsockopt(zmq.LINGER, 0)
        self.address = address
        if address:
            to_port, from_port = json.loads(address)
            self._out.connect(f"tcp://{LOOPBACK}:{to_port}")
            self._in.connect(f"tcp://{LOOPBACK}:{from_port}")
        else:
            ports = [each.bind_to_random_port(f"tcp://{LOOPBACK}") for each in (self._in, self._out)]
            self.address = json.dumps(ports)

    def send(self, data: bytes) -> None:
        """Publish."""
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


class Dds:
    """A writer and a reader of CycloneDDS, best effort, that keep the last sample."""

    def __init__(self, address: str, _routers: Routers) -> None:
        os.environ["CYCLONEDDS_URI"] = DDS_CONFIG  # it is read when the first participant is made
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
        said, heard = ("ask", "echo") if address else ("echo", "ask")
        out, into = (topics.Topic(participant, f"lavt_round_trip_{each}", self._sample) for each in (said, heard))
        self._writer = publish.DataWriter(participant, out, qos=qos)
        self._reader = subscribe.DataReader(participant, into, qos=qos)
        self._waits = core.WaitSet(participant)
        anything = core.SampleState.Any | core.ViewState.Any | core.InstanceState.Alive
        self._waits.attach(core.ReadCondition(self._reader, anything))
        self._kept = (participant, out, into)

    def send(self, data: bytes) -> None:
        """Write a sample."""
        self._writer.write(self._sample(data=data))

    def receive(self, timeout_s: float) -> bytes | None:
        """Wait for a sample."""
        if not self._waits.wait(round(timeout_s * 1e9)):
            return None
        for sample in self._reader.take(1):
            if hasattr(sample, "data"):
                return bytes(sample.data)
        return None

    def close(self) -> None:
        """Nothing to do: it ends with the process."""


@dataclass(frozen=True)
class Carrier:
    """A carrier in the table of results."""

    words: str
    end: Callable[[str, Routers], End]
    module: str = ""
    """What has to be installed for it."""
    package: str = ""

    @property
    def missing(self) -> bool:
        """Whether it cannot be measured here."""
        return self.module != "" and find_spec(self.module) is None


CARRIERS: Final[dict[str, Carrier]] = {
    "udp": Carrier("raw UDP sockets", Udp),
    "zenoh": Carrier("Zenoh through two routers, as LAVT has it", Zenoh),
    "pyzmq": Carrier("pyzmq, PUB and SUB, no broker", Pyzmq, "zmq", "pyzmq"),
    "cyclonedds": Carrier("CycloneDDS, best effort, no broker", Dds, "cyclonedds", "cyclonedds"),
}
