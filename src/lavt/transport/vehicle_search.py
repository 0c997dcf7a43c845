"""The search for vehicles: queries to all vehicles behind a router, and scouting for routers on the local network.

Anybody on the network can answer, and with anything. So the number and the size of answers are limited, an invalid
answer is counted, and addresses of strangers are dialled only if they are numeric.
"""

from __future__ import annotations

import ipaddress
import json
import re
import threading
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Final, NamedTuple

import zenoh
from msgspec import Struct, field

from lavt.clock import Clock, pause
from lavt.domain import NS_PER_MS, NS_PER_S, VehicleInfo
from lavt.errors import BadMessage
from lavt.transport.messages import NAME, VERSION, decode, decode_versions
from lavt.transport.security.keys import SIGNATURE_BYTES
from lavt.transport.zenoh_config import SessionSettings, check_endpoints, check_tls_files, error_text
from lavt.transport.zenoh_session import RouterUnreachable, close_session, load_zenoh_config, open_zenoh

KEY: Final = re.compile(rf"lavt/({NAME.pattern.removeprefix('^').removesuffix(chr(92) + 'Z')})/info\Z")
MAX_ANSWERS: Final = 64
"""The number of answers to one query that are read."""
MAX_VEHICLES: Final = 256
MAX_MESSAGE_BYTES: Final = 65_536
"""The longest message that the session of a search receives; Zenoh's own limit is 1 GB."""
MAX_ROUTERS: Final = 16
"""The number of routers that scouting returns."""
MAX_LOCATORS: Final = 4
"""The number of addresses of one router that are dialled."""
LOCATOR: Final = re.compile(
    r"(?:udp|quic|tcp|tls)/(?:(?P<v4>[0-9.]{7,15})|\[(?P<v6>[0-9a-fA-F:.]{2,45})\]):(?P<port>[0-9]{1,5})"
    r"(?:\?(?:(?:mixed_)?rel=[01];?){1,2})?\Z"
)
SCOUT_STEP_NS: Final = 20 * NS_PER_MS

Verify = Callable[[str, bytes, bytes], bytes | None]
"""Takes a vehicle's name, the nonce of the query and the answer; returns the answer without its signature, or None if
the vehicle has not signed it."""


class Answer(NamedTuple):
    """An answer to a query, by anybody."""

    key: str
    payload: bytes
    nonce: bytes
    """The random bytes in the query."""
    round_trip_ns: int


class FoundVehicle(Struct):
    """A vehicle that has answered."""

    name: str
    router: str
    """The endpoints of the router over which it answered first."""
    message_version: int
    lavt_version: str
    info: VehicleInfo | None
    """Its newest information; None if the version of its messages is another."""
    is_authentic: bool
    """Whether the key of this vehicle is known, and has signed the information."""
    round_trips_ns: list[int] = field(default_factory=list)


class FoundVehicles:
    """The vehicles that have answered, collected over several queries and routers.

    `verify` has the functions that verify the answers of the vehicles whose keys are known, by the vehicle's name.
    """

    def __init__(self, verify: Mapping[str, Verify]) -> None:
        self.counts: Counter[str] = Counter()
        self._verify = verify
        self._vehicles: dict[tuple[str, int | None], FoundVehicle] = {}

    def vehicles(self) -> list[FoundVehicle]:
        """Return the vehicles by name; there are several of one name if they have several servers."""
        return sorted(self._vehicles.values(), key=lambda vehicle: vehicle.name)

    @property
    def known_names(self) -> list[str]:
        """The names of the vehicles whose keys are known."""
        return list(self._verify)

    def add_all(self, answers: Sequence[Answer], router: str) -> None:
        """Add the answers to one query, and count whether there may have been more than were read."""
        if len(answers) >= MAX_ANSWERS:
            self.counts["answers_cut_off"] += 1
        for answer in answers:
            self.add(answer, router)

    def add(self, answer: Answer, router: str) -> None:
        """Add an answer, or count it if it is invalid, not authentic, or one too many."""
        match = KEY.match(answer.key)
        if match is None:
            self.counts["answers_unreadable"] += 1
            return
        name = match[1]
        verify = self._verify.get(name)
        payload = answer.payload if verify is None else verify(name, answer.nonce, answer.payload)
        if payload is None:
            self.counts["answers_forged"] += 1
            return
        try:
            versions, info = _parse(payload)
        except BadMessage:
            self.counts["answers_unreadable"] += 1
            return
        key = (name, None if info is None else info.instance)
        vehicle = self._vehicles.get(key)
        if vehicle is None:
            if len(self._vehicles) >= MAX_VEHICLES:
                self.counts["answers_beyond_limit"] += 1
                return
            vehicle = self._vehicles[key] = FoundVehicle(name, router, *versions, info, verify is not None)
        vehicle.info = info
        if vehicle.router == router:
            vehicle.round_trips_ns.append(answer.round_trip_ns)


def _parse(payload: bytes) -> tuple[tuple[int, str], VehicleInfo | None]:
    """Return the versions in an answer and, if they are known, its information; raise `BadMessage` for anything else.

    The signature of a vehicle whose key is unknown is ignored.
    """
    for body in (payload, payload[:-SIGNATURE_BYTES]):
        try:
            versions = decode_versions(body)
        except BadMessage:
            continue
        return versions, decode(VehicleInfo, body) if versions[0] == VERSION else None
    raise BadMessage("the answer has no versions")


class SearchSession:
    """A session with a router, to query all vehicles behind it. Raises `RouterUnreachable` if no router answers."""

    def __init__(self, clock: Clock, settings: SessionSettings) -> None:
        self._clock = clock
        limits = {"transport/link/rx/max_message_size": MAX_MESSAGE_BYTES, "adminspace/enabled": False}
        config = load_zenoh_config(settings.path, {**settings.changes, **limits})
        endpoints = check_endpoints(config, "the router")
        check_tls_files(config)
        self.router: str = ", ".join(endpoints)
        try:
            self._session: Any = open_zenoh(config)
        except zenoh.ZError as error:
            raise RouterUnreachable(
                f"no router answers at {endpoints}: {settings.advice} ({error_text(error)})"
            ) from error

    def query(self, nonce: bytes, timeout_s: float, vehicle: str = "*") -> list[Answer]:
        """Query all vehicles or one, and return at most `MAX_ANSWERS` answers within `timeout_s`."""
        answers: list[Answer] = []
        is_finished = threading.Event()
        sent_ns = self._clock.now().mono_ns

        def receive(reply: zenoh.Reply) -> None:
            round_trip_ns = self._clock.now().mono_ns - sent_ns
            if reply.ok is not None and len(answers) < MAX_ANSWERS:
                answers.append(Answer(str(reply.ok.key_expr), reply.ok.payload.to_bytes(), nonce, round_trip_ns))
            if len(answers) == MAX_ANSWERS:
                is_finished.set()

        # A channel would lose the answers that are still unread when the last one arrives.
        on_reply: Any = zenoh.handlers.Callback(receive, is_finished.set, indirect=False)
        self._session.get(
            f"lavt/{vehicle}/info",
            on_reply,
            payload=nonce,
            timeout=timeout_s,
            consolidation=zenoh.ConsolidationMode.NONE,
            target=zenoh.QueryTarget.ALL,
        )
        is_finished.wait(timeout_s)
        return list(answers)

    def close(self) -> None:
        """Close the session."""
        close_session(self._session)


def scout(clock: Clock, duration_s: float) -> list[list[str]]:
    """Ask by multicast which routers are on the local network; return the usable endpoints of each."""
    config = zenoh.Config()
    config.insert_json5("scouting/multicast/enabled", json.dumps(True))
    hellos: dict[str, list[str]] = {}
    scouting: Any = zenoh.scout(zenoh.handlers.RingChannel(MAX_ROUTERS), what="router", config=config)
    try:
        end_ns = clock.now().mono_ns + round(duration_s * NS_PER_S)
        while clock.now().mono_ns < end_ns and len(hellos) < MAX_ROUTERS:
            hello = scouting.try_recv()
            if hello is None:
                pause(SCOUT_STEP_NS)
            else:
                known = hellos.setdefault(str(hello.zid), [])
                known += [locator for locator in usable_locators(hello.locators) if locator not in known]
    finally:
        scouting.stop()
    return [locators[:MAX_LOCATORS] for locators in hellos.values() if locators]


def usable_locators(locators: Iterable[Any]) -> list[str]:
    """Return the endpoints that another machine can dial: numeric, and neither on its own machine nor link-local.

    Reserved addresses, which include every IPv6 address that contains an IPv4 address, cannot be dialled, either.
    """
    usable = []
    for locator in locators:
        match = LOCATOR.match(str(locator))
        if match is None or not 0 < int(match["port"]) < 65_536:
            continue
        try:
            address = ipaddress.ip_address(match["v4"] or match["v6"])
        except ValueError:
            continue
        kinds = (address.is_loopback, address.is_link_local, address.is_multicast, address.is_reserved)
        if not any(kinds) and address.packed[0] != 0:
            usable.append(str(locator))
    return usable[:MAX_LOCATORS]
