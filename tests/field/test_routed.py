"""A vehicle and an operator, each behind a NAT of its own, and a router in the cloud that both ends dial.

Commands, states and session requests go through the cloud. Video and clock probe take one of two paths: directly, with
two UDP ports that the vehicle's NAT forwards (the client sends first, so its own NAT needs no setting); or, without
forwarded ports, through a rendezvous in the cloud, here with everything signed and encrypted. Each test is run for both
paths. See also `docs/outages.md`.
"""

from __future__ import annotations

import socket
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from tests.field.driving import CLOUD, Links, running_loop, through_rendezvous
from tests.field.namespaces import INTERNET, NEXT_OPERATOR, OPERATOR, VEHICLE, FieldNetworks, nat_field
from tests.field.outage_effects import transitions
from tests.field.secured_routers import make_keys
from tests.support.stalls import Stalls

from lavt.clock import pause
from lavt.domain import NS_PER_S, Now
from lavt.recording.record import Record
from lavt.recording.table import Table
from lavt.transport.video.path_validation import HELLO_AGAIN_NS

pytestmark = [pytest.mark.usefixtures("namespaces")]

VIDEO_PORT, PROBE_PORT = 5600, 5602
"""As in configs/server.yaml."""
HELLO_BYTES, CHALLENGE_BYTES, ANSWER_BYTES = 46, 46, 70
"""Sizes of the datagrams that validate the video's path. RTCP datagrams have other sizes: multiples of 4 bytes."""
UNSOLICITED_S = 1.0
"""Time to wait for a datagram that the NAT must drop. Within one kernel, a datagram that passes arrives at once."""
SPEED_MPS = 5.0
WINDOW_S = 3.0
"""Time over which rates are measured: before the change of address, and again at the end of the drive."""
WINDOW_NS = round(WINDOW_S * NS_PER_S)
NEW_PATH_S = 3.0
"""Limit from a change of address to video at the new address. The client sends a hello 0.15 s after the last packet."""
STALL_MS = 100
"""A stall of this length or more excuses a failed assertion on times."""
RECOVERY_S = 10.0
"""Limit from a change of address until a vehicle that has stopped is driven again."""


@pytest.fixture(scope="module", params=["forwarded ports", "rendezvous"])
def video_path(request: pytest.FixtureRequest) -> str:
    """Return the path of video and probe between client and vehicle."""
    return str(request.param)


@pytest.fixture(scope="module")
def field(namespaces: None, video_path: str) -> Iterator[FieldNetworks]:  # noqa: ARG001 (it skips the test if there are no namespaces)
    with nat_field() as field:
        if video_path == "forwarded ports":
            field.forward_ports((VIDEO_PORT, PROBE_PORT))
        yield field


@pytest.fixture(scope="module")
def links(video_path: str, tmp_path_factory: pytest.TempPathFactory) -> Links:
    """Return the links of both ends."""
    if video_path == "forwarded ports":
        return CLOUD
    keys: Path = tmp_path_factory.mktemp("signing") / "keys"
    make_keys(keys, "--vehicle", "vehicle-1", "--operator", "operator-1", "--host", INTERNET)
    return through_rendezvous(keys)


@dataclass(frozen=True)
class AddressChangeDrive:
    """The records of a drive during which the operator's address changed, and counts of video packets."""

    changed: Now
    """When the operator's address changed."""
    ended: Now
    server: Record
    client: Record
    sent_to_old_until_change: int
    """Video packets to the old address until the change."""
    sent_to_old_after_3_s: int
    """Video packets to the old address until 3 s after the change."""
    sent_to_old: int
    """Video packets to the old address until the end."""
    sent_to_new: int
    """Video packets to the new address until the end."""

    def rows_before(self, record: Record, channel: str) -> Table:
        """Return the rows of a channel from the last seconds before the change."""
        table = record.table(channel)
        return table.where((table.mono_ns > self.changed.mono_ns - WINDOW_S * NS_PER_S) & self._until_change(table))

    def rows_after(self, record: Record, channel: str) -> Table:
        """Return the rows of a channel from the change on."""
        table = record.table(channel)
        return table.where(~self._until_change(table) & (table.mono_ns < self.ended.mono_ns))

    def _until_change(self, table: Table) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
        return np.asarray(table.mono_ns < self.changed.mono_ns)


@pytest.fixture(scope="module")
def address_change(
    field: FieldNetworks,
    links: Links,
    video_path: str,
    tmp_path_factory: pytest.TempPathFactory,
    print_report: Callable[[str], None],
) -> AddressChangeDrive:
    """Drive while the operator's address changes."""
    work: Path = tmp_path_factory.mktemp("routed")
    field.count_packets("sent_to_old", f"ip daddr {OPERATOR} udp sport {VIDEO_PORT}")
    field.count_packets("sent_to_new", f"ip daddr {NEXT_OPERATOR} udp sport {VIDEO_PORT}")
    with running_loop(field, work, links) as drive:
        drive.reach_speed(SPEED_MPS)
        pause(round(WINDOW_S * NS_PER_S))
        sent_to_old_until_change = field.packet_count("sent_to_old")
        changed = drive.clock.now()
        field.change_operator_address()
        pause(round(NEW_PATH_S * NS_PER_S))
        sent_to_old_after_3_s = field.packet_count("sent_to_old")
        drive.reach_speed(SPEED_MPS)
        pause(round(WINDOW_S * NS_PER_S))
        ended = drive.clock.now()
        counts = (
            sent_to_old_until_change,
            sent_to_old_after_3_s,
            field.packet_count("sent_to_old"),
            field.packet_count("sent_to_new"),
        )
    (server,), (client,) = drive.records("server"), drive.records("client")
    address_change = AddressChangeDrive(changed, ended, server, client, *counts)
    pictures_s, states_s = (longest_gap_s(address_change, channel) for channel in ("picture", "state"))
    print_report(
        f"{video_path}: an address changed: {pictures_s:.2f} s without pictures, {states_s:.2f} s without state"
    )
    return address_change


def longest_gap_s(address_change: AddressChangeDrive, channel: str) -> float:
    """Return the client's longest time without a message on a channel, from the change on."""
    return gap_s(address_change.client.table(channel), address_change.changed.mono_ns, address_change.ended.mono_ns)


def gap_s(arrivals: Table, begin_ns: int, end_ns: int) -> float:
    """Return the longest time without an arrival between two times."""
    within_ns = arrivals.mono_ns[(arrivals.mono_ns > begin_ns) & (arrivals.mono_ns < end_ns)]
    return float(np.max(np.diff([begin_ns, *within_ns, end_ns]))) / NS_PER_S


def first_ns(datagrams: Table, size_bytes: int) -> int:
    """Return the time of the first datagram of a size."""
    return int(datagrams.where(datagrams.ints("size_bytes") == size_bytes).mono_ns[0])


def had_picture_gap(address_change: AddressChangeDrive, at_ns: int) -> bool:
    """Return whether the client's pictures had a gap, which causes a re-validation, in the second before `at_ns`."""
    return gap_s(address_change.client.table("picture"), at_ns - NS_PER_S, at_ns) * NS_PER_S > HELLO_AGAIN_NS / 2


def per_second(table: Table) -> float:
    """Return the rows per second of a table that covers `WINDOW_S`."""
    return len(table) / WINDOW_S


def test_nat_drops_unsolicited_datagrams(field: FieldNetworks, video_path: str) -> None:
    """The vehicle's NAT drops unsolicited datagrams, except those to a forwarded port; their source address is kept."""
    video_socket, closed_port_socket = (
        field.inside("vehicle", lambda: socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) for _ in range(2)
    )
    operator = field.inside("operator", lambda: socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
    with video_socket, closed_port_socket, operator:
        video_socket.bind(("", VIDEO_PORT))
        closed_port_socket.bind(("", VIDEO_PORT + 1))
        for receiver in (video_socket, closed_port_socket):
            receiver.settimeout(UNSOLICITED_S)
        operator.sendto(b"to a closed port", (VEHICLE, VIDEO_PORT + 1))
        operator.sendto(b"to the video port", (VEHICLE, VIDEO_PORT))

        if video_path == "forwarded ports":
            datagram, (sender_address, _port) = video_socket.recvfrom(100)
            assert (datagram, sender_address) == (b"to the video port", OPERATOR)
        else:
            with pytest.raises(TimeoutError):
                video_socket.recvfrom(100)
        with pytest.raises(TimeoutError):
            closed_port_socket.recvfrom(100)


def test_everything_passes_two_nats_and_a_cloud(address_change: AddressChangeDrive, stalls: Stalls) -> None:
    """Video, commands, states, clock probe and session work at their rates through two NATs and a cloud."""
    admissions = address_change.rows_before(address_change.server, "admission")

    with stalls.excusing_failures(
        address_change.changed.later(-WINDOW_NS).mono_ns, address_change.changed.mono_ns, stall_ms=STALL_MS
    ):
        assert per_second(address_change.rows_before(address_change.client, "picture")) >= 25
        assert admissions.texts("verdict").count("accepted") / WINDOW_S >= 45
        assert per_second(address_change.rows_before(address_change.client, "state")) >= 45
        assert per_second(address_change.rows_before(address_change.client, "clock_probe")) >= 1.5
    assert len(address_change.client.table("session_reply")) > 0
    before = [
        transition
        for transition in transitions(address_change.server)
        if transition.at.mono_ns < address_change.changed.mono_ns
    ]
    assert before[-1].after == "driving"
    with stalls.excusing_failures(before[0].at.mono_ns, address_change.changed.mono_ns, stall_ms=STALL_MS):
        assert {transition.after for transition in before} <= {"disarmed", "arming", "driving"}


def test_a_client_whose_address_changes_keeps_its_video(address_change: AddressChangeDrive, stalls: Stalls) -> None:
    """Within 3 s the video goes to the client's new address at its full rate, and no longer to the old one."""
    pictures = address_change.rows_after(address_change.client, "picture")
    last_pictures = pictures.where(pictures.mono_ns > address_change.ended.mono_ns - WINDOW_S * NS_PER_S)

    with stalls.excusing_failures(address_change.changed.mono_ns, address_change.ended.mono_ns, stall_ms=STALL_MS):
        assert longest_gap_s(address_change, "picture") <= NEW_PATH_S
        assert per_second(last_pictures) >= 25
    assert address_change.sent_to_old_until_change > 0
    assert address_change.sent_to_old == address_change.sent_to_old_after_3_s
    assert address_change.sent_to_new > 100


def test_only_a_new_validation_moves_the_video(address_change: AddressChangeDrive) -> None:
    """Pictures go to the new address only after the client has answered a challenge, and its answer came from there.

    Before the change of address a re-validation occurs only after frame loss.
    """
    received, sent = (
        address_change.rows_after(address_change.server, "feedback"),
        address_change.rows_after(address_change.server, "rtp"),
    )
    hello_ns = first_ns(received, HELLO_BYTES)
    challenge_ns = first_ns(sent, CHALLENGE_BYTES)
    answer_ns = first_ns(received, ANSWER_BYTES)
    pictures_ns = address_change.rows_after(address_change.client, "picture").mono_ns
    before = address_change.rows_before(address_change.server, "feedback")
    validations_before_ns = before.mono_ns[np.isin(before.ints("size_bytes"), [HELLO_BYTES, ANSWER_BYTES])]

    assert all(had_picture_gap(address_change, at_ns) for at_ns in validations_before_ns)
    assert hello_ns < challenge_ns < answer_ns
    assert np.sum((hello_ns < pictures_ns) & (pictures_ns < answer_ns)) == 0
    assert np.sum(pictures_ns > answer_ns) > 100


def test_a_drive_continues_after_a_change_of_address(address_change: AddressChangeDrive, stalls: Stalls) -> None:
    """States, clock probe and commands continue, and a vehicle that has stopped is armed again and driven."""
    changes = [
        transition
        for transition in transitions(address_change.server)
        if address_change.changed.mono_ns < transition.at.mono_ns < address_change.ended.mono_ns
    ]

    with stalls.excusing_failures(address_change.changed.mono_ns, address_change.ended.mono_ns, stall_ms=STALL_MS):
        assert longest_gap_s(address_change, "state") <= RECOVERY_S
        assert longest_gap_s(address_change, "clock_probe") <= RECOVERY_S
        assert not changes or changes[-1].after == "driving"
        assert not changes or changes[-1].at.mono_ns - address_change.changed.mono_ns <= RECOVERY_S * NS_PER_S
    assert "accepted" in address_change.rows_after(address_change.server, "admission").texts("verdict")[-20:]


@pytest.mark.parametrize("video_path", ["rendezvous"], indirect=True)
def test_a_vehicle_whose_address_changes_keeps_its_video(
    field: FieldNetworks, links: Links, tmp_path: Path, print_report: Callable[[str], None], stalls: Stalls
) -> None:
    """After a change of the vehicle's address, pictures arrive again within 3 s at their full rate."""
    with running_loop(field, tmp_path, links) as drive:
        drive.reach_speed(SPEED_MPS)
        changed = drive.clock.now()
        field.change_vehicle_address()
        pause(round((NEW_PATH_S + WINDOW_S) * NS_PER_S))
        ended = drive.clock.now()
    (client,) = drive.records("client")
    pictures = client.table("picture")
    gap = gap_s(pictures, changed.mono_ns, ended.mono_ns)
    print_report(f"the vehicle's address changed: {gap:.2f} s without pictures")

    in_last_window = (pictures.mono_ns > ended.mono_ns - WINDOW_S * NS_PER_S) & (pictures.mono_ns < ended.mono_ns)
    with stalls.excusing_failures(changed.mono_ns, ended.mono_ns, stall_ms=STALL_MS):
        assert gap <= NEW_PATH_S
        assert per_second(pictures.where(in_last_window)) >= 25
