"""An end that sends commands as LAVT does: with its link, its gateway and, if keys are given, its signatures.

The asking end is the client's side and publishes commands; the echoing end is the server's side and publishes what it
receives on the channel of states. The session of an end is an embedded router, or a session with a separate router.
"""

from __future__ import annotations

import threading
import time  # noqa: TID251 (a benchmark reads the clock)
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final, NamedTuple

import zenoh
from benchmarks.round_trip.ends import LOOPBACK, CarrierEnd, Receipt
from msgspec import Struct

from lavt.clock import MachineClock
from lavt.config_file import shipped
from lavt.domain import Now, SessionReply, SessionRequest
from lavt.node import Send
from lavt.transport.messages import decode, encode
from lavt.transport.security.envelope import NullVehicleAuthenticator, OperatorAuthenticator, VehicleAuthenticator
from lavt.transport.security.gateway import ClientGateway, OpenClientGateway, ServerGateway
from lavt.transport.security.keys import load_private, load_public
from lavt.transport.zenoh_config import SessionSettings
from lavt.transport.zenoh_link import ZenohLink

VEHICLE: Final = "vehicle-1"
OPERATOR: Final = "operator-1"
EPOCH: Final = 2**63 + 5
"""The epoch of the commands, as long on the wire as in a drive."""
TOKEN: Final = bytes(range(16))
SESSION_TRIES: Final = 20
PLAIN_LINK: Final = "udp/{}?rel=1;mixed_rel=1"
TLS_LINK: Final = "quic/{}?mixed_rel=1"


class ZenohVariant(Struct, frozen=True):
    """How the two ends use Zenoh."""

    is_embedded: bool = True
    is_tls: bool = False
    """Whether the link of the routers is QUIC with certificates."""
    is_signed: bool = False
    link: str = PLAIN_LINK
    """The endpoint of the link of embedded routers without TLS; {} is replaced by address and port."""
    is_callback: bool = False
    """Whether Zenoh's own thread delivers, instead of a listening thread of Python: one wake-up less."""
    has_stamps: bool = False
    """Whether Zenoh stamps each message on its way."""
    is_busy: bool = False
    """Whether another Python thread computes in each process, and competes for Python's lock."""


class Places(Struct, frozen=True):
    """Where separate routers and keys are; empty: there are none."""

    server_router: str = ""
    client_router: str = ""
    keys: str = ""


class ZenohStamps(NamedTuple):
    """Wall clock times at which Zenoh's library sent and received a message."""

    sent_wall_ns: int
    received_wall_ns: int


class BenchmarkLink(ZenohLink):
    """A link that can let Zenoh stamp messages, and receive in Zenoh's thread."""

    variant = ZenohVariant()
    stamps: ZenohStamps | None = None
    """Of the message that is being delivered."""

    def prepare(self, variant: ZenohVariant) -> None:
        """Set what `start` needs."""
        self.variant = variant
        builder = zenoh.TimestampInstrumentationBuilder()
        self._instrumentation = builder.set_send(True).set_receive(True).build()

    def _declare(self, session: zenoh.Session) -> None:
        super()._declare(session)
        if self.variant.is_callback:
            received = "control" if self._side == "server" else "state"
            self._closing.set()  # lets the listening thread end without an error
            self._declared[0].undeclare()  # the subscriber with a ring
            assert self._listener is not None
            self._listener.join()
            callback: Any = zenoh.handlers.Callback(self._on_sample(received), indirect=False)
            self._declared[0] = session.declare_subscriber(f"{self._base}/{received}", callback)

    def _on_sample(self, channel: str) -> Callable[[Any], None]:
        return lambda sample: self._deliver(channel, sample.payload.to_bytes(), self._clock.now(), None)

    def _send(self, send: Send) -> None:
        if self.variant.has_stamps and send.channel in {"control", "state"}:
            self._publisher.put(send.payload, timestamp_instrumentation=self._instrumentation)
        else:
            super()._send(send)

    def _listen(self, channel: str, ring: Any) -> None:
        if not self.variant.has_stamps:
            super()._listen(channel, ring)
            return
        while True:
            try:
                sample = ring.recv()
            except zenoh.ZError:
                return
            now = self._clock.now()
            stack = sample.timestamp_stack
            times = [] if stack is None else [_wall_ns(record) for record in stack.records]
            self.stamps = ZenohStamps(times[0], times[-1]) if len(times) > 1 else None
            self._deliver(channel, sample.payload.to_bytes(), now, None)


def _wall_ns(record: Any) -> int:
    """Return Unix time of one of Zenoh's stamps, in nanoseconds."""
    return int(record.timestamp().get_time_as_ntp64().as_nanos())


class ZenohEnd(CarrierEnd):
    """An end with LAVT's link and gateway."""

    def __init__(self, address: str, variant: ZenohVariant, places: Places) -> None:
        super().__init__()
        self._is_asking = address != ""
        self._replied = threading.Event()
        self._link = BenchmarkLink(
            MachineClock(),
            side="client" if self._is_asking else "server",
            settings=_session_settings(address, variant, places),
            vehicle=VEHICLE,
            who=OPERATOR if self._is_asking else VEHICLE,
        )
        self._link.prepare(variant)
        self._gateway = self._build_gateway(Path(places.keys) if variant.is_signed else None)
        self._link.start(self._gateway.receive)
        if variant.is_busy:
            threading.Thread(target=_compute, name="busy", daemon=True).start()
        if not self._is_asking and variant.is_embedded:
            self.address = self._link.locators()[0].partition("/")[2].partition("?")[0]
        if self._is_asking and variant.is_signed:
            self._acquire()

    def _build_gateway(self, keys: Path | None) -> ServerGateway | ClientGateway | OpenClientGateway:
        """Build the gateway of this side, as `lavt.assembly.security` does."""
        if self._is_asking:
            if keys is None:
                return OpenClientGateway(self._deliver, self._carry)
            own, vehicle = load_private(keys / f"{OPERATOR}.sign.key"), load_public(keys / f"{VEHICLE}.sign.pub")
            return ClientGateway(self._deliver, self._carry, OperatorAuthenticator(VEHICLE, OPERATOR, own, vehicle))
        authenticator = NullVehicleAuthenticator()
        if keys is not None:
            operators = {OPERATOR: load_public(keys / f"{OPERATOR}.sign.pub")}
            authenticator = VehicleAuthenticator(VEHICLE, load_private(keys / f"{VEHICLE}.sign.key"), operators)
        return ServerGateway(self._deliver, self._carry, lambda: (EPOCH, -1), authenticator)

    def _acquire(self) -> None:
        """Request control, so that both ends share a session's MACs; raise `SystemExit` if no reply arrives."""
        for number in range(SESSION_TRIES):
            request = encode(SessionRequest("acquire", OPERATOR, 1, number))
            self._gateway.send(Send("session", request))
            if self._replied.wait(1.0):
                return
        raise SystemExit(f"no reply to a session request within {SESSION_TRIES} s")

    def _deliver(self, channel: str, payload: Any, arrived: Now, peer: Any) -> None:
        """Pass on a verified message; answer a session request."""
        if channel == "session":
            reply = encode(SessionReply(True, "", EPOCH, TOKEN, 0, "", 0))
            answer = Send("session_reply", reply, peer)
            threading.Thread(target=self._gateway.send, args=(answer,), daemon=True).start()
        elif channel == "session_reply":
            if decode(SessionReply, payload).granted:
                self._replied.set()
        else:
            in_zenoh_ns = woken_ns = 0
            if self._link.stamps is not None:
                sent_ns, received_ns = self._link.stamps
                in_zenoh_ns, woken_ns = received_ns - sent_ns, arrived.wall_ns - received_ns
            now_ns = time.monotonic_ns()
            self._received.put(Receipt(payload, arrived.mono_ns, now_ns, in_zenoh_ns, woken_ns))

    def _carry(self, *sends: Send) -> None:
        self.signed_ns = time.monotonic_ns()
        self.wire_bytes = len(sends[0].payload)
        self._link.send(*sends)

    def send(self, data: bytes) -> None:
        """Sign a message, if keys are given, and publish it."""
        self._gateway.send(Send("control" if self._is_asking else "state", data))

    def close(self) -> None:
        """Close the session."""
        self._link.close()


def _session_settings(address: str, variant: ZenohVariant, places: Places) -> SessionSettings:
    """Return the settings of an end's session; `address` is that of the echoing end, or empty for this end itself."""
    if not variant.is_embedded:
        router = places.client_router if address else places.server_router
        return SessionSettings(shipped("zenoh-configs/session.json5"), {"connect/endpoints": [router]})
    side = "client" if address else "server"
    file = shipped(f"zenoh-configs/router-{side}{'-tls' if variant.is_tls else ''}.json5")
    link = TLS_LINK if variant.is_tls else variant.link
    changes: dict[str, Any] = {
        "listen/endpoints": [] if address else [link.format(f"{LOOPBACK}:0")],
        "connect/endpoints": [link.format(address)] if address else [],
    }
    if variant.is_tls:
        changes |= tls_changes(places.keys, OPERATOR if address else VEHICLE, "connect" if address else "listen")
    return SessionSettings(file, changes, is_router=True)


def tls_changes(keys: str, name: str, action: str) -> dict[str, str]:
    """Return the changes of a router's config for the certificate of `name`; `action` is listen or connect."""
    tls = "transport/link/tls"
    return {
        f"{tls}/root_ca_certificate": f"{keys}/authority.pem",
        f"{tls}/{action}_certificate": f"{keys}/{name}.pem",
        f"{tls}/{action}_private_key": f"{keys}/{name}.key",
    }


def _compute() -> None:
    """Compute without end, and without releasing Python's lock voluntarily."""
    number = 0
    while True:
        number = (number * 5 + 1) % 65_537
