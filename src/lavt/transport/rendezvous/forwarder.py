"""Forward a UDP flow to a vehicle behind NAT, through a machine that both ends can reach.

The vehicle's socket registers with the rendezvous every second, which also keeps its NAT mapping alive. Clients send
to the rendezvous what they would send to the vehicle. Between rendezvous and vehicle each datagram is wrapped with the
client's address:

    vehicle -> rendezvous   registration  b"LAVR", version, 1, wall time, vehicle, flow, signature or nothing
    rendezvous <-> vehicle  wrapped       b"LAVR", version, 2, client's IPv4 address, client's port, datagram

Validation of the video path and its encryption are end to end: the rendezvous has no token and no key, and the wrapped
client address is the one in the vehicle's address-validation cookie. A rendezvous can do no more than any router on the
path. Threats:

* Impersonating the vehicle: a registration is accepted only with the vehicle's signature and a later time than the
  last one. A rendezvous that has just started, or has had no registration for 10 s, may accept an old one. It is in
  force until the vehicle's next registration arrives, after at most 1 s (longer only if the vehicle's clock was set
  back). Without a key, every registration with the vehicle's name is accepted.
* Reflection to a third party: the rendezvous sends datagrams of clients to the registered vehicle, and datagrams of the
  vehicle to clients that sent something in the last 30 s. For each received datagram it sends at most one, whose length
  differs only by the wrapping. A registration gets no reply.
* Flooding the vehicle: only datagrams in a format of the flow pass, at a limited rate. The client that gets the video
  has a rate limit of its own: it has answered a challenge with the session's token, so no other client can use up that
  limit. Other clients that the vehicle has answered have one, too. Hellos and answers also have a rate
  limit of their own, so that replays with a client's address do not crowd out its reports. In each group every host has
  a limit of its own, so that a flood from one host, or with one false address, crowds out no client at another.
* Keeping the vehicle out: registrations whose signature is verified have the same limits, and those from the vehicle's
  last address one of their own. So forged registrations from one host keep the vehicle out only if it shares that
  host's address. Those from 20 hosts or more delay it: `docs/security.md`.
* Keeping new clients out: a dropped datagram displaces no client. A flood from 20 hosts or more, or with that many
  false addresses, still uses up the common limit, and then keeps new clients out while it lasts. So does, for the
  clients at one address, a flood with that address, and, until a client gets the video, copies of its hellos, which
  the vehicle answers: `docs/security.md`.
* Not covered: an attacker on the path to the rendezvous can forward a registration from another address before the
  original arrives, and so divert the flow for a second. It could as well drop the datagrams themselves.

No input, output or clock here: `link.py` has the sockets. A `Forwarder` serves one flow of one vehicle.
"""

from __future__ import annotations

import secrets
import socket
import struct
from collections import Counter
from collections.abc import Callable, Mapping
from functools import partial
from typing import Final, Literal

from lavt.domain import NS_PER_S
from lavt.errors import BadMessage
from lavt.transport.clock_sync.probe import decode_request
from lavt.transport.rtp.rtcp import is_rtcp
from lavt.transport.security.keys import SIGNATURE_BYTES, PrivateKey, PublicKey
from lavt.transport.video.path_validation import client_datagram_number, is_path_datagram

FlowName = Literal["video", "probe"]
Address = tuple[str, int]

REGISTER_EVERY_NS: Final = NS_PER_S
"""A Linux NAT drops a UDP mapping after 30 s. The period is also the longest outage after a change of address."""
VEHICLE_TIMEOUT_NS: Final = 10 * NS_PER_S
"""A registration expires after this time."""
CLIENT_TIMEOUT_NS: Final = 30 * NS_PER_S
"""A client gets nothing if it has sent nothing for this time."""
MAX_CLIENTS: Final = 64
"""Limits the number of clients that the vehicle has answered."""
UPSTREAM_PER_S: Final = 200
"""Limits each of four groups of datagrams: from clients that the vehicle has answered or from other clients, and of the
path validation or not. The client that gets the video is in none of them. Also limits each of the two groups of
registrations. A client sends 2.5 reports a second (measured)."""
HOST_PER_S: Final = 10
"""Limits the datagrams of each host, within each of the two groups from clients that the vehicle has not answered, and
within the registrations from another address than the vehicle's. Such a client sends 2 hellos a second, or 7 if the
video has ended, until the vehicle answers one."""
ANSWERED_HOST_PER_S: Final = 50
"""The same for clients that the vehicle has answered and for registrations from the vehicle's address, and the only
limit of the client that gets the video. Such a client sends at most 7 hellos, 7 answers, 2.5 reports and 2 probes a
second, and `lavt clock` 20 probes."""
MAX_UNANSWERED: Final = 10 * UPSTREAM_PER_S
"""Limits the number of clients that the vehicle has not answered. So many need 5 s to arrive at the rate limit, and an
answer takes less than that."""
MAX_UPSTREAM_BYTES: Final = 1400

_MAGIC: Final = b"LAVR"
_VERSION: Final = 1
_REGISTRATION: Final = _MAGIC + bytes([_VERSION, 1])
_WRAPPED: Final = _MAGIC + bytes([_VERSION, 2])
_LAYOUT: Final = struct.Struct(">6sq32s8s")
_ADDRESS: Final = struct.Struct(">4sH")
WRAPPING_BYTES: Final = len(_WRAPPED) + _ADDRESS.size


def encode_registration(vehicle: str, flow: FlowName, wall_ns: int, key: PrivateKey | None) -> bytes:
    """Return a registration, which the vehicle's socket sends: 54 bytes, or 118 with a signature."""
    registration = _LAYOUT.pack(_REGISTRATION, wall_ns, vehicle.encode(), flow.encode())
    return registration if key is None else registration + key.sign(_signing_context(vehicle) + registration)


def wrap(client: Address, datagram: bytes) -> bytes:
    """Wrap a datagram from or to a client, whose host is a numeric IPv4 address."""
    return _WRAPPED + _ADDRESS.pack(socket.inet_aton(client[0]), client[1]) + datagram


def unwrap(data: bytes) -> tuple[Address, bytes] | None:
    """Return the client's address and the datagram; None if `data` is not wrapped."""
    if not data.startswith(_WRAPPED) or len(data) < WRAPPING_BYTES:
        return None
    host, port = _ADDRESS.unpack_from(data, len(_WRAPPED))
    return (socket.inet_ntoa(host), port), data[WRAPPING_BYTES:]


def _signing_context(vehicle: str) -> bytes:
    """Return the prefix of signed data, as in `envelope.py`: the signature is valid for registrations only."""
    return f"LAVT 1 registration {vehicle}\0".encode()


def _may_be_video(datagram: bytes) -> bool:
    return client_datagram_number(datagram) is not None or is_rtcp(datagram)


def _is_probe(datagram: bytes) -> bool:
    try:
        decode_request(datagram)
    except BadMessage:
        return False
    return True


UPSTREAM_CHECKS: Final[Mapping[FlowName, Callable[[bytes], bool]]] = {"video": _may_be_video, "probe": _is_probe}
"""Checks whether a client may send a datagram, by flow."""


class Forwarder:
    """A forwarder that knows the addresses of one vehicle and its clients, and routes the datagrams of one flow.

    `key` is the vehicle's public key; without it, anyone who knows the vehicle's name can register. All times are of
    one monotonic clock. `random_below` returns a random number from 0 to less than its argument. `counts` has the
    numbers of datagrams by result.
    """

    def __init__(
        self,
        vehicle: str,
        flow: FlowName,
        key: PublicKey | None,
        *,
        random_below: Callable[[int], int] = secrets.randbelow,
    ) -> None:
        self.counts: Counter[str] = Counter()
        self._vehicle = vehicle
        self._flow: FlowName = flow
        self._key = key
        self._vehicle_address: Address | None = None
        self._registered_ns = 0
        self._registration_wall_ns = 0
        self._clients = _Clients()
        self._video_client: Address | None = None
        """The client to which the vehicle last sent anything but a challenge, in the video's flow."""
        few = partial(_HostLimiter, HOST_PER_S, random_below)
        many = partial(_HostLimiter, ANSWERED_HOST_PER_S, random_below)
        self._signature_limiters = {True: many(), False: few()}
        """By whether the registration comes from the vehicle's last address."""
        self._video_limiters = {True: many(), False: many()}
        """For the client that gets the video, by whether the datagram belongs to the path validation."""
        self._answered_limiters = {True: many(), False: many()}
        """The same for other clients that the vehicle has answered."""
        self._unanswered_limiters = {True: few(), False: few()}
        """The same for clients that the vehicle has not answered."""

    def vehicle_address(self, now_ns: int) -> Address | None:
        """Return the address from which the vehicle registered; None if there is none or the registration expired."""
        return self._vehicle_address if now_ns - self._registered_ns <= VEHICLE_TIMEOUT_NS else None

    def receive(self, datagram: bytes, sender: Address, now_ns: int) -> tuple[bytes, Address] | None:
        """Process a datagram; return a datagram to send and its destination, or None."""
        if datagram.startswith(_REGISTRATION):
            self.counts[self._register(datagram, sender, now_ns)] += 1
            return None
        if datagram.startswith(_MAGIC):
            return self._from_vehicle(datagram, sender, now_ns)
        return self._from_client(datagram, sender, now_ns)

    def _register(self, datagram: bytes, sender: Address, now_ns: int) -> str:
        """Accept a registration if it is the vehicle's and new; return the name of the counter of the result."""
        registration, signature = datagram[: _LAYOUT.size], datagram[_LAYOUT.size :]
        if len(registration) != _LAYOUT.size or len(signature) not in {0, SIGNATURE_BYTES}:
            return "registrations_malformed"
        wall_ns = _LAYOUT.unpack(registration)[1]
        if registration != encode_registration(self._vehicle, self._flow, wall_ns, None):
            return "registrations_of_others"
        address = self.vehicle_address(now_ns)
        if address is not None and wall_ns <= self._registration_wall_ns:
            return "registrations_stale"
        if self._key is not None:
            if not self._signature_limiters[sender == self._vehicle_address].take(sender[0], now_ns):
                return "registrations_too_many"
            if not self._key.verify(signature, _signing_context(self._vehicle) + registration):
                return "registrations_forged"
        self._vehicle_address, self._registered_ns, self._registration_wall_ns = sender, now_ns, wall_ns
        return "registrations"

    def _from_vehicle(self, datagram: bytes, sender: Address, now_ns: int) -> tuple[bytes, Address] | None:
        unwrapped = unwrap(datagram)
        if unwrapped is None:
            self.counts["malformed"] += 1
        elif sender != self.vehicle_address(now_ns):
            self.counts["not_from_vehicle"] += 1
        elif not self._clients.note_answer(unwrapped[0], now_ns):
            self.counts["to_nobody"] += 1
        else:
            self.counts["to_clients"] += 1
            client, payload = unwrapped
            if self._flow == "video" and not is_path_datagram(payload):
                self._video_client = client
            return payload, client
        return None

    def _from_client(self, datagram: bytes, sender: Address, now_ns: int) -> tuple[bytes, Address] | None:
        address = self.vehicle_address(now_ns)
        if sender == address or len(datagram) > MAX_UPSTREAM_BYTES or not UPSTREAM_CHECKS[self._flow](datagram):
            self.counts["malformed"] += 1
        elif address is None:
            self.counts["without_vehicle"] += 1
        elif not self._is_within_limit(datagram, sender, now_ns):
            self.counts["too_many"] += 1
        else:
            self.counts["to_vehicle"] += 1
            return wrap(sender, datagram), address
        return None

    def _is_within_limit(self, datagram: bytes, sender: Address, now_ns: int) -> bool:
        """Return whether a client's datagram is within the rate limits; if so, count it and note the client."""
        is_validation = is_path_datagram(datagram)
        is_within_limit = self._limiters(sender)[is_validation].take(sender[0], now_ns)
        if is_within_limit:
            self._clients.note_datagram(sender, now_ns)
        return is_within_limit

    def _limiters(self, client: Address) -> dict[bool, _HostLimiter]:
        """Return the rate limits of a client, by whether a datagram belongs to the path validation."""
        if client == self._video_client:
            return self._video_limiters
        return self._answered_limiters if self._clients.is_answered(client) else self._unanswered_limiters


class _HostLimiter:
    """A limit on the datagrams per second, and a lower one on those of each host.

    They are counted in windows of 1 to 1.5 s. The length of each window is random, so that whoever sends once a second
    does not arrive each time when a flood has used up the limits already.
    """

    def __init__(self, host_per_s: int, random_below: Callable[[int], int]) -> None:
        self._host_per_s = host_per_s
        self._random_below = random_below
        self._until_ns = 0
        self._left = UPSTREAM_PER_S
        self._passed: Counter[str] = Counter()
        """The datagrams that passed in this window, by host: at most `UPSTREAM_PER_S` entries."""

    def take(self, host: str, now_ns: int) -> bool:
        """Return whether one more datagram of `host` is within both limits; if so, count it."""
        if now_ns >= self._until_ns:
            self._until_ns = now_ns + NS_PER_S + self._random_below(NS_PER_S // 2)
            self._left = UPSTREAM_PER_S
            self._passed.clear()
        if self._left == 0 or self._passed[host] >= self._host_per_s:
            return False
        self._left -= 1
        self._passed[host] += 1
        return True


class _Clients:
    """The addresses of clients, each with the time at which the client last sent something; the oldest is first.

    Clients that the vehicle has answered are in a table of their own, so that others cannot displace them.
    """

    def __init__(self) -> None:
        self._answered: dict[Address, int] = {}
        self._unanswered: dict[Address, int] = {}

    def is_answered(self, client: Address) -> bool:
        """Return whether the vehicle has answered a client."""
        return client in self._answered

    def note_datagram(self, client: Address, now_ns: int) -> None:
        """Note that a client sent something."""
        if self.is_answered(client):
            _put(self._answered, client, now_ns, MAX_CLIENTS)
        else:
            _put(self._unanswered, client, now_ns, MAX_UNANSWERED)

    def note_answer(self, client: Address, now_ns: int) -> bool:
        """Note that the vehicle sends to a client; return whether the client has sent something recently."""
        received_ns = self._answered.get(client)
        if received_ns is None:
            received_ns = self._unanswered.pop(client, None)
            if received_ns is None:
                return False
            _put(self._answered, client, received_ns, MAX_CLIENTS)
        if now_ns - received_ns <= CLIENT_TIMEOUT_NS:
            return True
        del self._answered[client]
        return False


def _put(table: dict[Address, int], client: Address, received_ns: int, limit: int) -> None:
    """Put a client at the end of a table; drop the first if there are more than `limit`."""
    table.pop(client, None)
    table[client] = received_ns
    if len(table) > limit:
        del table[next(iter(table))]
