"""A vehicle and an operator, each behind a NAT of its own, and a router in the cloud that both dial.

Commands, state and session go through the cloud. Video and clock probe go one of two ways: straight, where the
vehicle's NAT forwards two UDP ports (the client begins both, so its own NAT needs no setting); or, where nothing is
forwarded, through a rendezvous in the cloud, here with everything signed and encrypted. Each test is of both ways.
`docs/outages.md` says so too.
"""

from __future__ import annotations

import socket
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from tests.field.counting import transitions
from tests.field.driving import CLOUD, Links, driven, through_rendezvous
from tests.field.namespaces import INTERNET, NEXT_OPERATOR, OPERATOR, VEHICLE, Field, nat_field
from tests.field.secured import make_keys
from tests.support.stalls import Stalls

from lavt.clock import pause
from lavt.domain import NS_PER_S, Now
from lavt.recording.record import Record
from lavt.recording.table import Table
from lavt.transport.video.path_validation import HELLO_AGAIN_NS

pytestmark = [pytest.mark.usefixtures("namespaces")]

VIDEO_PORT, PROBE_PORT = 5600, 5602
"""As in configs/server.yaml."""
HELLO_BYTES, CHALLENGE_BYTES, ANSWER_BYTES = 38, 38, 62
"""Of the datagrams by which the video's path is proven; RTCP comes in fours of bytes."""
UNINVITED_S = 1.0
"""Within one kernel a datagram that gets through is there at once."""
SPEED_MPS = 5.0
WHILE_S = 3.0
WHILE_NS = round(WHILE_S * NS_PER_S)
ANEW_S = 3.0
"""From a change of the address to video on the new one: the client asks 0.15 s after its last packet."""
STALL_MS = 100
AGAIN_S = 10.0
"""From there until the vehicle is driven again, where it has stopped meanwhile."""


@pytest.fixture(scope="module", params=["forwarded ports", "rendezvous"])
def way(request: pytest.FixtureRequest) -> str:
    """How video and probe find the vehicle."""
    return str(request.param)


@pytest.fixture(scope="module")
def field(namespaces: None, way: str) -> Iterator[Field]:  # noqa: ARG001 (skips)
    with nat_field() as field:
        if way == "forwarded ports":
            field.forward_ports((VIDEO_PORT, PROBE_PORT))
        yield field


@pytest.fixture(scope="module")
def links(way: str, tmp_path_factory: pytest.TempPathFactory) -> Links:
    """How the ends talk."""
    if way == "forwarded ports":
        return CLOUD
    keys: Path = tmp_path_factory.mktemp("signing") / "keys"
    make_keys(keys, "--vehicle", "vehicle-1", "--operator", "operator-1", "--host", INTERNET)
    return through_rendezvous(keys)


@dataclass(frozen=True)
class Routed:
    """A drive, what it left, and when in the middle of it the operator's address changed."""

    changed: Now
    ended: Now
    server: Record
    client: Record
    to_old_before: int
    """Packets of the video to the first address when it was changed, two seconds later, and to the second."""
    to_old_soon: int
    to_old: int
    to_new: int

    def before(self, record: Record, channel: str) -> Table:
        """Take from a record what was there in the last seconds before the change."""
        table = record.table(channel)
        return table.where((table.mono_ns > self.changed.mono_ns - WHILE_S * NS_PER_S) & self._until_change(table))

    def after(self, record: Record, channel: str) -> Table:
        """Take from a record what was there from the change on."""
        table = record.table(channel)
        return table.where(~self._until_change(table) & (table.mono_ns < self.ended.mono_ns))

    def _until_change(self, table: Table) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
        return np.asarray(table.mono_ns < self.changed.mono_ns)


@pytest.fixture(scope="module")
def routed(
    field: Field, links: Links, way: str, tmp_path_factory: pytest.TempPathFactory, tell: Callable[[str], None]
) -> Routed:
    """Drive, change the operator's address, drive on."""
    work: Path = tmp_path_factory.mktemp("routed")
    field.count("to_old", f"ip daddr {OPERATOR} udp sport {VIDEO_PORT}")
    field.count("to_new", f"ip daddr {NEXT_OPERATOR} udp sport {VIDEO_PORT}")
    with driven(field, work, links) as drive:
        drive.reach(SPEED_MPS)
        pause(round(WHILE_S * NS_PER_S))
        to_old_before = field.counted("to_old")
        changed = drive.clock.now()
        field.change_the_operators_address()
        pause(round(ANEW_S * NS_PER_S))
        to_old_soon = field.counted("to_old")
        drive.reach(SPEED_MPS)
        pause(round(WHILE_S * NS_PER_S))
        ended = drive.clock.now()
        counts = to_old_before, to_old_soon, field.counted("to_old"), field.counted("to_new")
    (server,), (client,) = drive.records("server"), drive.records("client")
    routed = Routed(changed, ended, server, client, *counts)
    tell(f"{way}: an address changed: {longest_gap_s(routed, 'picture'):.2f} s without pictures, "
         f"{longest_gap_s(routed, 'state'):.2f} s without state")  # fmt: skip
    return routed


def longest_gap_s(routed: Routed, channel: str) -> float:
    """How long the client went without, from the change on."""
    return gap_s(routed.client.table(channel), routed.changed.mono_ns, routed.ended.mono_ns)


def gap_s(arrivals: Table, begin_ns: int, end_ns: int) -> float:
    """How long nothing came at most, between these times."""
    within_ns = arrivals.mono_ns[(arrivals.mono_ns > begin_ns) & (arrivals.mono_ns < end_ns)]
    return float(np.max(np.diff([begin_ns, *within_ns, end_ns]))) / NS_PER_S


def first_ns(datagrams: Table, size_bytes: int) -> int:
    """When the first of this size was heard or said."""
    return int(datagrams.where(datagrams.ints("size_bytes") == size_bytes).mono_ns[0])


def pictures_failed(routed: Routed, at_ns: int) -> bool:
    """Whether the client had no picture for a while in the second before, after which it proves its address again."""
    return gap_s(routed.client.table("picture"), at_ns - NS_PER_S, at_ns) * NS_PER_S > HELLO_AGAIN_NS / 2


def per_second(table: Table) -> float:
    return len(table) / WHILE_S


def test_behind_nat_nobody_is_reached_uninvited(field: Field, way: str) -> None:
    """The vehicle's NAT lets in what comes for a forwarded port, from the operator's public address, and no more."""
    forwarded, closed = (
        field.inside("vehicle", lambda: socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) for _ in range(2)
    )
    operator = field.inside("operator", lambda: socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
    with forwarded, closed, operator:
        forwarded.bind(("", VIDEO_PORT))
        closed.bind(("", VIDEO_PORT + 1))
        for each in (forwarded, closed):
            each.settimeout(UNINVITED_S)
        operator.sendto(b"uninvited", (VEHICLE, VIDEO_PORT + 1))
        operator.sendto(b"expected", (VEHICLE, VIDEO_PORT))

        if way == "forwarded ports":
            heard, (came_from, _port) = forwarded.recvfrom(100)
            assert (heard, came_from) == (b"expected", OPERATOR)
        else:
            with pytest.raises(TimeoutError):
                forwarded.recvfrom(100)
        with pytest.raises(TimeoutError):
            closed.recvfrom(100)


def test_everything_passes_two_nats_and_a_cloud(routed: Routed, stalls: Stalls) -> None:
    """Video, commands, state, clock probe and session all work, and at their rates."""
    admissions = routed.before(routed.server, "admission")

    with stalls.judging(routed.changed.later(-WHILE_NS).mono_ns, routed.changed.mono_ns, stall_ms=STALL_MS):
        assert per_second(routed.before(routed.client, "picture")) >= 25
        assert admissions.texts("verdict").count("accepted") / WHILE_S >= 45
        assert per_second(routed.before(routed.client, "state")) >= 45
        assert per_second(routed.before(routed.client, "clock_probe")) >= 1.5
    assert len(routed.client.table("session_reply")) > 0
    states = [each.after for each in transitions(routed.server) if each.at.mono_ns < routed.changed.mono_ns]
    assert states[-2:] == ["arming", "driving"]
    assert set(states[:-2]) <= {"arming", "disarmed"}  # arming begins anew where the host stalled


def test_a_client_whose_address_changes_keeps_its_video(routed: Routed, stalls: Stalls) -> None:
    """Within 3 s the video comes to the new address and no more to the old one, at its full rate."""
    pictures = routed.after(routed.client, "picture")
    last = pictures.where(pictures.mono_ns > routed.ended.mono_ns - WHILE_S * NS_PER_S)

    with stalls.judging(routed.changed.mono_ns, routed.ended.mono_ns, stall_ms=STALL_MS):
        assert longest_gap_s(routed, "picture") <= ANEW_S
        assert per_second(last) >= 25
    assert routed.to_old_before > 0
    assert routed.to_old == routed.to_old_soon
    assert routed.to_new > 100


def test_only_a_new_proof_moves_the_video(routed: Routed) -> None:
    """Pictures come to the new address after the client has said hello and answered a challenge from there.

    Before, it does so only where a stall of the host left it without pictures.
    """
    heard, said = routed.after(routed.server, "feedback"), routed.after(routed.server, "rtp")
    hello_ns = first_ns(heard, HELLO_BYTES)
    challenge_ns = first_ns(said, CHALLENGE_BYTES)
    answer_ns = first_ns(heard, ANSWER_BYTES)
    pictures_ns = routed.after(routed.client, "picture").mono_ns
    heard_before = routed.before(routed.server, "feedback")
    proofs_before_ns = heard_before.mono_ns[np.isin(heard_before.ints("size_bytes"), [HELLO_BYTES, ANSWER_BYTES])]

    assert all(pictures_failed(routed, at_ns) for at_ns in proofs_before_ns)
    assert hello_ns < challenge_ns < answer_ns
    assert np.sum((hello_ns < pictures_ns) & (pictures_ns < answer_ns)) == 0
    assert np.sum(pictures_ns > answer_ns) > 100


def test_a_drive_goes_on_after_a_change_of_address(routed: Routed, stalls: Stalls) -> None:
    """State, clock probe and commands go on too, and a vehicle that has stopped meanwhile is armed again and driven."""
    changes = [
        each for each in transitions(routed.server) if routed.changed.mono_ns < each.at.mono_ns < routed.ended.mono_ns
    ]

    with stalls.judging(routed.changed.mono_ns, routed.ended.mono_ns, stall_ms=STALL_MS):
        assert longest_gap_s(routed, "state") <= AGAIN_S
        assert longest_gap_s(routed, "clock_probe") <= AGAIN_S
        assert not changes or changes[-1].after == "driving"
        assert not changes or changes[-1].at.mono_ns - routed.changed.mono_ns <= AGAIN_S * NS_PER_S
    assert "accepted" in routed.after(routed.server, "admission").texts("verdict")[-20:]


@pytest.mark.parametrize("way", ["rendezvous"], indirect=True)
def test_a_vehicle_whose_address_changes_keeps_its_video(
    field: Field, links: Links, tmp_path: Path, tell: Callable[[str], None], stalls: Stalls
) -> None:
    """The rendezvous finds the vehicle at its new address, and pictures come again within 3 s, at their full rate."""
    with driven(field, tmp_path, links) as drive:
        drive.reach(SPEED_MPS)
        changed = drive.clock.now()
        field.change_the_vehicles_address()
        pause(round((ANEW_S + WHILE_S) * NS_PER_S))
        ended = drive.clock.now()
    (client,) = drive.records("client")
    pictures = client.table("picture")
    gap = gap_s(pictures, changed.mono_ns, ended.mono_ns)
    tell(f"the vehicle's address changed: {gap:.2f} s without pictures")

    last = (pictures.mono_ns > ended.mono_ns - WHILE_S * NS_PER_S) & (pictures.mono_ns < ended.mono_ns)
    with stalls.judging(changed.mono_ns, ended.mono_ns, stall_ms=STALL_MS):
        assert gap <= ANEW_S
        assert per_second(pictures.where(last)) >= 25
