"""Fuzzes what the machine in the cloud reads from UDP: registrations, what is wrapped, and what clients send."""

from __future__ import annotations

import hmac

from benchmarks.fuzzing.camera import HOME, STRANGERS, old_path, rtcp_reports
from benchmarks.fuzzing.mutation import Chance, Corpus
from benchmarks.fuzzing.target import START, Target, expect, total

from lavt.domain import NS_PER_MS
from lavt.transport.rendezvous.forwarder import (
    MAX_CLIENTS,
    REGISTER_EVERY_NS,
    Forwarder,
    encode_registration,
    unwrap,
    wrap,
)
from lavt.transport.security.keys import SIGNATURE_BYTES, PublicKey

VEHICLE = ("203.0.113.2", 5600)


class Code(PublicKey):
    """Stands in for the vehicle's key: some 100 times faster, and as hard to guess."""

    def __init__(self) -> None:
        pass

    def sign(self, data: bytes) -> bytes:
        """Sign."""
        return hmac.digest(b"vehicle", data, "sha512")

    def verifies(self, signature: bytes, data: bytes) -> bool:
        """Compare."""
        return signature == self.sign(data)


def rendezvous(_seed: int) -> Target:
    """Datagrams at the rendezvous: it sends to the vehicle, and to those who asked; no stranger is the vehicle."""
    key = Code()
    forwarder = Forwarder("vehicle-1", "video", key)
    now_ns, registered_ns = START.mono_ns, 0
    requested = set[tuple[str, int]]()

    def registration(wall_ns: int) -> bytes:
        said = encode_registration("vehicle-1", "video", wall_ns, None)
        return said + key.sign(b"LAVT 1 registration vehicle-1\0" + said)

    registrations = Corpus([registration(1), registration(2)], fields=((4, 1), (5, 1), (6, 8), (14, 32), (46, 8)))
    wrapped = Corpus([wrap(each, b"video") for each in (HOME, VEHICLE)], fields=((4, 1), (5, 1), (6, 4), (10, 2)))
    client = Corpus([*old_path(), *rtcp_reports()], fields=((0, 1), (1, 1), (4, 1), (5, 1), (6, 8)))

    def feed(channel: str, data: bytes, chance: Chance) -> None:
        nonlocal now_ns, registered_ns
        now_ns += NS_PER_MS
        if now_ns - registered_ns >= REGISTER_EVERY_NS:
            registered_ns = now_ns
            newest = registration(now_ns)
            forwarder.receive(newest, VEHICLE, now_ns)
            registrations.heard.append(newest)
        sender = VEHICLE if channel == "wrapped" and chance.below(2) else chance.choice((HOME, *STRANGERS[:3]))
        passed = forwarder.receive(data, sender, now_ns)
        if passed is not None and sender != VEHICLE:
            expect(passed[1] == VEHICLE, "a stranger has something sent to somebody else")
            expect(unwrap(passed[0]) == (sender, data), "the vehicle is told something else than was sent")
            requested.add(sender)
        elif passed is not None:
            expect(passed[1] in requested, "something goes to who has not asked")
        expect(forwarder.vehicle_address(now_ns) == VEHICLE, "the vehicle is somewhere else")
        clients = forwarder._clients
        expect(max(len(clients._answered), len(clients._unanswered)) <= MAX_CLIENTS, "clients are kept for ever")

    def rejected() -> int:
        counts = forwarder.counts
        return total(counts, "") - counts["registrations"] - total(counts, "to_clients", "to_vehicle")

    expect(len(key.sign(b"")) == SIGNATURE_BYTES, "a code is as long as a signature")
    corpora = {"registration": registrations, "wrapped": wrapped, "client": client}
    return Target(corpora, feed, rejected, lambda: f"{forwarder.counts['to_clients']} passed on to clients")
