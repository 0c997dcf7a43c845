"""An attacker at a router between vehicle and operator, who overhears one hello and sends with any source address."""

from __future__ import annotations

import socket
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from tests.field.driving import SIGNED_ONLY, running_loop, signed, wait_until
from tests.field.namespaces import OPERATOR, VEHICLE, VEHICLE_UPLINK_ROUTER, plain_field
from tests.field.secured_routers import make_keys

from lavt.clock import MachineClock, pause
from lavt.domain import NS_PER_S
from lavt.recording.record import Record
from lavt.recording.table import MISSING

pytestmark = [pytest.mark.usefixtures("namespaces")]

VIDEO_PORT = 5600
"""As in configs/server.yaml."""
ATTACK_NS = 4 * NS_PER_S
RATE_HZ = 1000
"""Replays a second: twice the 480 that made all video unreadable before hellos were numbered."""
ETH_P_IP = 0x0800
PROTOCOL_AT, SOURCE_AT, SOURCE_PORT_AT = 9, 12, 20
"""Offsets of fields in the IP header (20 bytes) and the UDP header after it."""
HEADERS_BYTES = 20 + 8
"""Size of the IP and the UDP header."""
HELLO = b"LAVT\x01"


def spoofed(source: tuple[str, int], target: tuple[str, int], payload: bytes) -> bytes:
    """Return an IPv4 packet with a UDP datagram; the kernel fills in the length and checksum of the IP header."""
    udp = struct.pack(">HHHH", source[1], target[1], 8 + len(payload), 0)
    addresses = (socket.inet_aton(address) for address, _ in (source, target))
    return struct.pack(">BBHHHBBH4s4s", 0x45, 0, 0, 0, 0, 64, socket.IPPROTO_UDP, 0, *addresses) + udp + payload


def overhear(listener: socket.socket) -> tuple[tuple[str, int], bytes]:
    """Return the source (address, port) and the payload of the next hello."""
    while True:
        packet = listener.recv(2048)
        if packet[PROTOCOL_AT] == socket.IPPROTO_UDP and packet[HEADERS_BYTES:].startswith(HELLO):
            (port,) = struct.unpack_from(">H", packet, SOURCE_PORT_AT)
            return (socket.inet_ntoa(packet[SOURCE_AT : SOURCE_AT + 4]), port), packet[HEADERS_BYTES:]


def total_count(record: Record, name: str) -> int:
    values = record.table("counts").ints(name)
    return int(np.sum(values[values != MISSING]))


def test_a_replayed_hello_leaves_encrypted_video_readable(tmp_path: Path, print_report: Callable[[str], None]) -> None:
    """A hello, replayed from the client's and from the attacker's address, makes no packet of the video unreadable.

    The server sends challenges to the attacker. The attacker forwards these to the client, with the vehicle's address.
    """
    keys = tmp_path / "keys"
    make_keys(keys, "--vehicle", "vehicle-1", "--operator", "operator-1", "--host", VEHICLE)
    links = signed(SIGNED_ONLY, keys)
    clock = MachineClock()
    with plain_field() as field:
        listener = field.inside(
            "internet", lambda: socket.socket(socket.AF_PACKET, socket.SOCK_DGRAM, socket.htons(ETH_P_IP))
        )
        listener.bind(("operator", ETH_P_IP))
        raw_socket = field.inside(
            "internet", lambda: socket.socket(socket.AF_INET, socket.SOCK_RAW, socket.IPPROTO_RAW)
        )
        own_socket = field.inside("internet", lambda: socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
        with listener, raw_socket, own_socket, running_loop(field, tmp_path, links) as drive:
            client_address, hello = overhear(listener)
            wait_until("video arrives", lambda: "raw_tau_v_ms" in drive.running["client"].latest.get("status", {}))
            own_socket.bind((VEHICLE_UPLINK_ROUTER.address, 0))
            own_socket.setblocking(False)
            begin_ns, sent, forwarded = clock.now().mono_ns, 0, 0
            while (elapsed_ns := clock.now().mono_ns - begin_ns) < ATTACK_NS:
                while sent < elapsed_ns * RATE_HZ // NS_PER_S:
                    sent += 1
                    raw_socket.sendto(spoofed(client_address, (VEHICLE, VIDEO_PORT), hello), (VEHICLE, 0))
                    own_socket.sendto(hello, (VEHICLE, VIDEO_PORT))
                    try:
                        challenge = own_socket.recv(2048)
                    except BlockingIOError:
                        continue
                    forwarded += 1
                    raw_socket.sendto(spoofed((VEHICLE, VIDEO_PORT), client_address, challenge), (OPERATOR, 0))
                pause(NS_PER_S // RATE_HZ)
            end_ns = clock.now().mono_ns
            pause(NS_PER_S)
        (server_record,), (client_record,) = drive.records("server"), drive.records("client")
    packets, unreadable = total_count(client_record, "packets"), total_count(client_record, "packets_forged")
    stale_hellos = total_count(server_record, "path_stale")
    screened_out = total_count(server_record, "datagrams_screened_out")
    pictures_ns = client_record.table("picture").mono_ns
    pictures_during_attack = int(((pictures_ns > begin_ns) & (pictures_ns < end_ns)).sum())
    print_report(
        f"{2 * sent} replays, {forwarded} challenges to the attacker: {unreadable} packets unreadable, {packets} "
        f"readable, {pictures_during_attack} pictures in {(end_ns - begin_ns) / NS_PER_S:.1f} s; "
        f"at the server {stale_hellos} stale hellos, {screened_out} datagrams screened out"
    )

    assert sent > 0.5 * RATE_HZ * ATTACK_NS / NS_PER_S
    assert unreadable == 0
    assert pictures_during_attack > 0
