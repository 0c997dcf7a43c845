"""A UDP flow to a vehicle behind a NAT that forwards nothing, through a machine that both ends reach.

The vehicle's socket registers with the rendezvous every second, which also keeps its NAT open. Clients send to the
rendezvous what they would send to the vehicle. Between these two each datagram is wrapped with the client's address:

    vehicle -> rendezvous   registration  b"LAVR", version, 1, wall time, vehicle, flow, signature or nothing
    rendezvous <-> vehicle  wrapped       b"LAVR", version, 2, client's IPv4 address, client's port, datagram

The proof of the video's path and its encryption stay between the ends: the rendezvous has no token and no key, and the
address in the wrapping is what the vehicle seals in its challenge. What it could do, any router on the way could do.

* Stand in for the vehicle: a registration counts only with the vehicle's signature, and newer than the last taken. A
  rendezvous that was started again, or has not heard the vehicle for 10 s, may take an old one, until the vehicle's
  next (at most 1 s; longer only where the vehicle's clock was set back). Without a key any of its name counts.
* Have it send to a third party: it sends to the registered vehicle, and from there to clients that were heard in the
  last 30 s, one datagram for one, longer by the wrapping or shorter. A registration gets no reply.
* Flood the vehicle: it gets only what looks like the flow's own, so many a second; those that it has answered have a
  share of their own, so that strangers cannot keep them out.
* Not covered: who reads on the way to the rendezvous can send a registration on first, from elsewhere, and so swallow
  the flow for a second, as it can swallow the datagrams themselves.

No input, output or clock here: `rendezvous_link.py` has the sockets. One flow is one `Forwarder`, of one vehicle.
"""

from __future__ import annotations

import socket
import struct
from collections import Counter
from collections.abc import Callable, Mapping
from typing import Final, Literal

from lavt.domain import NS_PER_S
from lavt.errors import BadMessage
from lavt.transport.clock_sync.probe import decode_request
from lavt.transport.rtp.rtcp import is_rtcp
from lavt.transport.security.flood_filter import RateLimiter
from lavt.transport.security.keys import SIGNATURE_BYTES, PrivateKey, PublicKey
from lavt.transport.video.path_validation import is_path_datagram

FlowName = Literal["video", "probe"]
Address = tuple[str, int]

REGISTER_EVERY_NS: Final = NS_PER_S
"""Linux as a NAT forgets a UDP flow after 30 s; and so long at most a vehicle with a new address is not found."""
VEHICLE_SILENCE_NS: Final = 10 * NS_PER_S
"""A vehicle that has not registered for so long is not there."""
CLIENT_SILENCE_NS: Final = 30 * NS_PER_S
"""A client that sent nothing for so long gets nothing."""
MOST_CLIENTS: Final = 64
"""That the vehicle has answered, and as many that it has not."""
REGISTRATIONS_PER_S: Final = 50
"""So many signatures are looked at of those from the vehicle's address, and as many from elsewhere."""
UPSTREAM_PER_S: Final = 200
"""Of those the vehicle has answered, and as many of all others. A client reports 2.5 times a second, as measured."""
LONGEST_UPSTREAM_BYTES: Final = 1400

_MAGIC: Final = b"LAVR"
_VERSION: Final = 1
_REGISTRATION: Final = _MAGIC + bytes([_VERSION, 1])
_WRAPPED: Final = _MAGIC + bytes([_VERSION, 2])
_LAYOUT: Final = struct.Struct(">6sq32s8s")
_ADDRESS: Final = struct.Struct(">4sH")
WRAPPING_BYTES: Final = len(_WRAPPED) + _ADDRESS.size


def encode_registration(vehicle: str, flow: FlowName, wall_ns: int, key: PrivateKey | None) -> bytes:
    """Say where the flow of a vehicle is, by sending this from there: 54 bytes, 118 where it is signed."""
    said = _LAYOUT.pack(_REGISTRATION, wall_ns, vehicle.encode(), flow.encode())
    return said if key is None else said + key.sign(_context(vehicle) + said)


def wrap(client: Address, datagram: bytes) -> bytes:
    """Wrap a datagram from or to a client, whose address is an IPv4 one in numbers."""
    return _WRAPPED + _ADDRESS.pack(socket.inet_aton(client[0]), client[1]) + datagram


def unwrap(data: bytes) -> tuple[Address, bytes] | None:
    """Give the client's address and the datagram; None for what is not wrapped."""
    if not data.startswith(_WRAPPED) or len(data) < WRAPPING_BYTES:
        return None
    host, port = _ADDRESS.unpack_from(data, len(_WRAPPED))
    return (socket.inet_ntoa(host), port), data[WRAPPING_BYTES:]


def _context(vehicle: str) -> bytes:
    """Begin what is signed, as in `sealing.py`: no signature serves for anything else."""
    return f"LAVT 1 registration {vehicle}\0".encode()


def _may_be_video(datagram: bytes) -> bool:
    return is_path_datagram(datagram) or is_rtcp(datagram)


def _is_probe(datagram: bytes) -> bool:
    try:
        decode_request(datagram)
    except BadMessage:
        return False
    return True


LOOKS_RIGHT: Final[Mapping[FlowName, Callable[[bytes], bool]]] = {"video": _may_be_video, "probe": _is_probe}
"""What a client may send in each flow."""


class Forwarder:
    """One flow of one vehicle: where the vehicle is, which clients there are, and where each datagram goes.

    `key` is the vehicle's; None: whoever knows its name can stand in for it. All times are of one monotonic clock.
    `counts` has what became of the datagrams.
    """

    def __init__(self, vehicle: str, flow: FlowName, key: PublicKey | None) -> None:
        self.counts: Counter[str] = Counter()
        self._vehicle = vehicle
        self._flow: FlowName = flow
        self._key = key
        self._at: Address | None = None
        self._registered_ns = 0
        self._told_ns = 0
        self._clients = _Clients()
        self._signatures = {True: RateLimiter(REGISTRATIONS_PER_S), False: RateLimiter(REGISTRATIONS_PER_S)}
        """Apart, by whether they come from where the vehicle is."""
        self._upstream = {True: RateLimiter(UPSTREAM_PER_S), False: RateLimiter(UPSTREAM_PER_S)}
        """Apart, by whether the vehicle has answered the client."""

    def vehicle_at(self, now_ns: int) -> Address | None:
        """Tell from where the vehicle has registered; None: it is not there."""
        return self._at if now_ns - self._registered_ns <= VEHICLE_SILENCE_NS else None

    def receive(self, datagram: bytes, sender: Address, now_ns: int) -> tuple[bytes, Address] | None:
        """Take a datagram, and give what is to be sent and where to; None: nothing."""
        if datagram.startswith(_REGISTRATION):
            self.counts[self._register(datagram, sender, now_ns)] += 1
            return None
        if datagram.startswith(_MAGIC):
            return self._from_vehicle(datagram, sender, now_ns)
        return self._from_client(datagram, sender, now_ns)

    def _register(self, datagram: bytes, sender: Address, now_ns: int) -> str:
        """Take a registration if it is the vehicle's and new; say what became of it."""
        said, signature = datagram[: _LAYOUT.size], datagram[_LAYOUT.size :]
        if len(said) != _LAYOUT.size or len(signature) not in {0, SIGNATURE_BYTES}:
            return "registrations_malformed"
        told_ns = _LAYOUT.unpack(said)[1]
        if said != encode_registration(self._vehicle, self._flow, told_ns, None):
            return "registrations_of_others"
        at = self.vehicle_at(now_ns)
        if at is not None and told_ns <= self._told_ns:
            return "registrations_stale"
        if self._key is not None:
            if not self._signatures[sender == at].take(now_ns):
                return "registrations_too_many"
            if not self._key.verify(signature, _context(self._vehicle) + said):
                return "registrations_forged"
        self._at, self._registered_ns, self._told_ns = sender, now_ns, told_ns
        return "registrations"

    def _from_vehicle(self, datagram: bytes, sender: Address, now_ns: int) -> tuple[bytes, Address] | None:
        unwrapped = unwrap(datagram)
        if unwrapped is None:
            self.counts["malformed"] += 1
        elif sender != self.vehicle_at(now_ns):
            self.counts["not_from_vehicle"] += 1
        elif not self._clients.answered(unwrapped[0], now_ns):
            self.counts["to_nobody"] += 1
        else:
            self.counts["to_clients"] += 1
            return unwrapped[1], unwrapped[0]
        return None

    def _from_client(self, datagram: bytes, sender: Address, now_ns: int) -> tuple[bytes, Address] | None:
        at = self.vehicle_at(now_ns)
        if sender == at or len(datagram) > LONGEST_UPSTREAM_BYTES or not LOOKS_RIGHT[self._flow](datagram):
            self.counts["malformed"] += 1
        elif at is None:
            self.counts["without_vehicle"] += 1
        elif not self._upstream[self._clients.heard(sender, now_ns)].take(now_ns):
            self.counts["too_many"] += 1
        else:
            self.counts["to_vehicle"] += 1
            return wrap(sender, datagram), at
        return None


class _Clients:
    """Those heard lately, the longest silent first; a crowd of strangers drives nobody out whom the vehicle answers."""

    def __init__(self) -> None:
        self._answered: dict[Address, int] = {}
        self._unanswered: dict[Address, int] = {}

    def heard(self, client: Address, now_ns: int) -> bool:
        """Note that a client sent something; tell whether the vehicle has answered it before."""
        known = client in self._answered
        _put(self._answered if known else self._unanswered, client, now_ns)
        return known

    def answered(self, client: Address, now_ns: int) -> bool:
        """Tell whether a client was heard lately, to whom the vehicle sends something."""
        heard_ns = self._answered.get(client)
        if heard_ns is None:
            heard_ns = self._unanswered.pop(client, None)
            if heard_ns is None:
                return False
            _put(self._answered, client, heard_ns)
        if now_ns - heard_ns <= CLIENT_SILENCE_NS:
            return True
        del self._answered[client]
        return False


def _put(table: dict[Address, int], client: Address, heard_ns: int) -> None:
    """Put a client at the end; where there are too many, the first goes."""
    table.pop(client, None)
    table[client] = heard_ns
    if len(table) > MOST_CLIENTS:
        del table[next(iter(table))]
