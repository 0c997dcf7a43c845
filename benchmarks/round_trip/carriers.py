"""The carriers of messages to another process and back."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from typing import Final

from benchmarks.round_trip.ends import CarrierEnd, DdsEnd, DirectUdpEnd, PyzmqEnd, UdpEnd
from benchmarks.round_trip.zenoh_end import Places, ZenohEnd, ZenohVariant


@dataclass(frozen=True)
class Carrier:
    """A carrier that can be measured."""

    label: str
    end: Callable[[str], CarrierEnd] | None = None
    """Creates an end from the address of the echoing end; empty: creates the echoing end."""
    zenoh: ZenohVariant | None = None
    """How Zenoh is used, if `end` is None."""
    module: str = ""
    """A module that must be installed; empty: none."""
    package: str = ""
    """The package of this module."""
    is_variant: bool = False
    """Whether the carrier shows a part of the latency of another one, by leaving it out or adding to it."""

    @property
    def is_missing(self) -> bool:
        """Whether the module is not installed."""
        return self.module != "" and find_spec(self.module) is None

    @property
    def needs_keys(self) -> bool:
        """Whether the carrier needs certificates or signing keys."""
        return self.zenoh is not None and (self.zenoh.is_tls or self.zenoh.is_signed)

    def new_end(self, address: str, places: Places) -> CarrierEnd:
        """Create an end; an empty address creates the echoing end."""
        if self.zenoh is not None:
            return ZenohEnd(address, self.zenoh, places)
        assert self.end is not None
        return self.end(address)


_secure = partial(Carrier, module="cryptography", package="'lavt[secure]'")
_part = partial(Carrier, is_variant=True)

CARRIERS: Final[dict[str, Carrier]] = {
    "udp": Carrier("raw UDP sockets", UdpEnd),
    "udp_direct": Carrier("raw UDP sockets, read without a second thread", DirectUdpEnd),
    "pyzmq": Carrier("pyzmq, PUB and SUB, no broker", PyzmqEnd, module="zmq", package="pyzmq"),
    "cyclonedds": Carrier("CycloneDDS, best effort, no broker", DdsEnd, module="cyclonedds", package="cyclonedds"),
    "embedded": Carrier("Zenoh, embedded routers, as in LAVT", zenoh=ZenohVariant()),
    "separate": Carrier("Zenoh, two separate routers", zenoh=ZenohVariant(is_embedded=False)),
    "embedded_secure": _secure(
        "Zenoh, embedded routers, QUIC with TLS, signed", zenoh=ZenohVariant(is_tls=True, is_signed=True)
    ),
    "separate_secure": _secure(
        "Zenoh, two separate routers, QUIC with TLS, signed",
        zenoh=ZenohVariant(is_embedded=False, is_tls=True, is_signed=True),
    ),
    "embedded_signed": _secure("embedded, signed, without TLS", zenoh=ZenohVariant(is_signed=True), is_variant=True),
    "embedded_tls": _secure("embedded, QUIC with TLS, not signed", zenoh=ZenohVariant(is_tls=True), is_variant=True),
    "embedded_tcp": _part("embedded, link over TCP instead of UDP", zenoh=ZenohVariant(link="tcp/{}")),
    "embedded_callback": _part("embedded, received in Zenoh's thread", zenoh=ZenohVariant(is_callback=True)),
    "embedded_busy": _part("embedded, another Python thread computes", zenoh=ZenohVariant(is_busy=True)),
    "embedded_stamps": _part("embedded, stamped by Zenoh", zenoh=ZenohVariant(has_stamps=True)),
}
