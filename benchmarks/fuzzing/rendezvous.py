"""Make the target for the UDP inputs of the rendezvous: registrations, wrapped datagrams, and datagrams of clients."""

from __future__ import annotations

import hmac

from benchmarks.fuzzing.camera import CLIENT_ADDRESS, STRANGERS, old_path_datagrams, rtcp_datagrams
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


class MacKey(PublicKey):
    """A stand-in for the vehicle's key. Its signature is a MAC, about 100 times faster and as hard to forge."""

    def __init__(self) -> None:
        pass

    def sign(self, data: bytes) -> bytes:
        """Return the MAC of `data`."""
        return hmac.digest(b"vehicle", data, "sha512")

    def verify(self, signature: bytes, data: bytes) -> bool:
        """Return whether `signature` is the MAC of `data`."""
        return signature == self.sign(data)


def rendezvous(_seed: int) -> Target:
    """Make a target for the rendezvous.

    Invariants: the rendezvous sends only to the vehicle and to addresses that have sent something, and no stranger can
    register.
    """
    key = MacKey()
    forwarder = Forwarder("vehicle-1", "video", key)
    now_ns, registered_ns = START.mono_ns, 0
    clients_seen = set[tuple[str, int]]()

    def registration(wall_ns: int) -> bytes:
        plain = encode_registration("vehicle-1", "video", wall_ns, None)
        return plain + key.sign(b"LAVT 1 registration vehicle-1\0" + plain)

    registrations = Corpus([registration(1), registration(2)], fields=((4, 1), (5, 1), (6, 8), (14, 32), (46, 8)))
    wrapped = Corpus(
        [wrap(address, b"video") for address in (CLIENT_ADDRESS, VEHICLE)], fields=((4, 1), (5, 1), (6, 4), (10, 2))
    )
    client = Corpus([*old_path_datagrams(), *rtcp_datagrams()], fields=((0, 1), (1, 1), (4, 1), (5, 1), (6, 8)))

    def feed(channel: str, data: bytes, chance: Chance) -> None:
        nonlocal now_ns, registered_ns
        now_ns += NS_PER_MS
        if now_ns - registered_ns >= REGISTER_EVERY_NS:
            registered_ns = now_ns
            newest = registration(now_ns)
            forwarder.receive(newest, VEHICLE, now_ns)
            registrations.replays.append(newest)
        sender = (
            VEHICLE if channel == "wrapped" and chance.below(2) else chance.choice((CLIENT_ADDRESS, *STRANGERS[:3]))
        )
        forwarded = forwarder.receive(data, sender, now_ns)
        if forwarded is not None:
            datagram, receiver = forwarded
            if sender == VEHICLE:
                expect(receiver in clients_seen, "a datagram went to an address that never sent one")
            else:
                expect(receiver == VEHICLE, "a stranger's datagram went to a third party")
                expect(unwrap(datagram) == (sender, data), "the vehicle got another datagram than was sent")
                clients_seen.add(sender)
        expect(forwarder.vehicle_address(now_ns) == VEHICLE, "a stranger has registered as the vehicle")
        clients = forwarder._clients
        expect(max(len(clients._answered), len(clients._unanswered)) <= MAX_CLIENTS, "clients are never forgotten")

    def rejected_count() -> int:
        counts = forwarder.counts
        return total(counts, "") - counts["registrations"] - total(counts, "to_clients", "to_vehicle")

    expect(len(key.sign(b"")) == SIGNATURE_BYTES, "the MAC is not as long as a signature")
    corpora = {"registration": registrations, "wrapped": wrapped, "client": client}
    return Target(corpora, feed, rejected_count, lambda: f"{forwarder.counts['to_clients']} forwarded to clients")
