"""Access at the routers of the encrypted configs: by certificate, and by the permissions of a socket file."""

from __future__ import annotations

import json
import os
import socket
import stat
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, closing
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest
import zenoh
from tests.field import attacks
from tests.field.secured_routers import (
    QUIC,
    ClientStandIn,
    Intruder,
    Site,
    VehicleStandIn,
    make_keys,
    open_embedded_router,
    open_session,
    quic_endpoint,
    start_router,
    tls_changes,
    udp_port,
)
from tests.require import need
from tests.support.ports import free_port
from tests.support.stalls import BUSY_SHARE, LONG_STALL_MS, SharedResult, Stalls

from lavt.control.client_limits import CLIENT_LIMITS
from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.experiment.runs.processes import Processes
from lavt.recording.record import Record
from lavt.recording.table import MISSING, IntArray, Table
from lavt.streams import stream
from lavt.transport.zenoh_session import quiet_logs

pytest.importorskip("cryptography")

OPERATOR_EFFECTS = {"commands", "queries", "session", "netem", "info", "run", "state", "alive"}
ALL_EFFECTS = OPERATOR_EFFECTS | {
    "wildcard commands",
    "deletes",
    "long commands",
    "the routers' own state",
    "forged state",
    "forged replies",
    "others' commands",
}
MONITOR_EFFECTS = {"info", "state", "alive"}
EFFECTS_BY_NAME = [("operator-1", OPERATOR_EFFECTS), ("operator-2", set()), ("monitor-1", MONITOR_EFFECTS)]
"""The effects that a session can achieve, by the name in its certificate. operator-2 has a certificate, but is in no
access list."""
MAX_OPEN_SITES = 3
"""The maximum number of attacked sites without access lists."""
NOBODY = 65534
CONNECT_AS_NOBODY = f"import os, socket, sys; os.setgroups([]); os.setgid({NOBODY}); os.setuid({NOBODY}); " + (
    "socket.socket(socket.AF_UNIX).connect(sys.argv[1])"
)


@pytest.fixture(scope="module")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make the keys of a site with `lavt keys`."""
    directory = tmp_path_factory.mktemp("authority") / "keys"
    names = ("--vehicle=vehicle-1", "--operator=operator-1", "--operator=operator-2", "--monitor=monitor-1")
    make_keys(directory, *names, "--cloud=cloud-1")
    return directory


@pytest.fixture(scope="module")
def others_keys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make keys with the same names, signed by another authority of the same name."""
    directory = tmp_path_factory.mktemp("other") / "keys"
    make_keys(directory, "--vehicle=vehicle-1", "--operator=operator-1")
    return directory


def start_site(stack: ExitStack, keys: Path, *changes: str, cloud: bool, embedded: bool = True) -> Site:
    """Start the routers, the vehicle and the operator, and wait until they exchange messages.

    `changes` apply to the router that others dial.
    """
    quiet_logs()
    work = Path(stack.enter_context(TemporaryDirectory()))
    work.chmod(0o755)  # so that only the permissions of the sockets restrict access
    processes = stack.enter_context(Processes(work))
    sockets = {name: work / f"{name}.sock" for name in ("vehicle", "operator")}
    local = {name: f"unixsock-stream/{path}" for name, path in sockets.items()}
    endpoint = f"quic/127.0.0.1:{free_port()}?mixed_rel=1"
    listens = [local["vehicle"]] if cloud else [local["vehicle"], endpoint]
    vehicle_changes = [f"listen.endpoints={json.dumps(listens)}"]
    if cloud:
        start_router(
            processes,
            "cloud",
            "router-cloud-tls.json5",
            f'listen.endpoints=["{endpoint}"]',
            *tls_changes(keys, "cloud-1", "listen"),
            *changes,
        ).wait_ready()
        vehicle_file = "router-server-to-cloud-tls.json5"
        vehicle_changes += [f'connect.endpoints=["{endpoint}"]', *tls_changes(keys, "vehicle-1", "connect")]
    else:
        vehicle_file = "router-server-tls.json5"
        vehicle_changes += [*tls_changes(keys, "vehicle-1", "listen"), *changes]
    operator_changes = (
        f'listen.endpoints=["{local["operator"]}"]',
        f'connect.endpoints=["{endpoint}"]',
        *tls_changes(keys, "operator-1", "connect"),
    )

    def open_own_session(name: str, file: str, *own_changes: str) -> Any:
        if embedded:
            session = open_embedded_router(file, *own_changes)
        else:
            start_router(processes, name, file, *own_changes).wait_ready()
            session = open_session(local[name])
        stack.callback(session.close)
        return session

    car = VehicleStandIn(open_own_session("vehicle", vehicle_file, *vehicle_changes))
    operator = ClientStandIn(open_own_session("operator", "router-client-tls.json5", *operator_changes), b"operator")
    site = Site(keys, endpoint, sockets["operator"], car, operator, processes)
    site.exchange_messages()
    return site


@pytest.fixture(scope="module")
def direct_site(keys: Path) -> Iterator[Site]:
    """Start a site whose operator's router dials the vehicle's."""
    with ExitStack() as stack:
        yield start_site(stack, keys, cloud=False)


@pytest.fixture(scope="module")
def cloud_site(keys: Path) -> Iterator[Site]:
    """Start a site whose routers both dial a router in the cloud."""
    with ExitStack() as stack:
        yield start_site(stack, keys, cloud=True)


@pytest.fixture(scope="module")
def separate_site(keys: Path) -> Iterator[Site]:
    """Start a site like the first, with routers in processes of their own."""
    with ExitStack() as stack:
        yield start_site(stack, keys, cloud=False, embedded=False)


def forget_messages(site: Site) -> Site:
    """Return a site that has forgotten the messages of earlier tests."""
    for messages in (
        site.vehicle.commands,
        site.vehicle.queries,
        site.operator.replies,
        *site.operator.received.values(),
    ):
        messages.clear()
    site.vehicle.deleted = 0
    return site


@pytest.fixture(params=["direct_site", "cloud_site"])
def site(request: pytest.FixtureRequest) -> Site:
    """Return each kind of site with embedded routers in turn."""
    return forget_messages(request.getfixturevalue(request.param))


@pytest.fixture(params=["direct_site", "cloud_site", "separate_site"])
def any_site(request: pytest.FixtureRequest) -> Site:
    """Return each kind of site in turn, also the one with separate routers."""
    return forget_messages(request.getfixturevalue(request.param))


@pytest.mark.parametrize("mode", ["client", "router"])
@pytest.mark.parametrize(("name", "effects"), EFFECTS_BY_NAME)
def test_access_depends_on_the_certificates_name(any_site: Site, name: str, effects: set[str], mode: str) -> None:
    """The listed operator may send commands and queries, a monitor may only see the state and query the vehicle's info.

    An unlisted name may nothing. None of them succeeds with wildcards, deletes, long messages, forged states or forged
    replies.
    """
    with closing(any_site.intruder(name, mode)) as intruder:
        any_site.attack(intruder, effects)  # on a busy machine, the routers take a while to route to a new link
        any_site.exchange_messages(intruder.attempt)
        assert intruder.achieved(any_site) == effects


def test_without_access_lists_every_attack_succeeds(keys: Path) -> None:
    """Without access lists and a size limit all attacks succeed, so the other tests would detect success.

    Without the lists an attack can stop all traffic for good (docs/security.md, "What is not protected"). Then the
    attacks that have not succeeded yet are tried at a new site.
    """
    achieved: set[str] = set()
    for _ in range(MAX_OPEN_SITES):
        with ExitStack() as stack:
            site = start_site(stack, keys, "access_control.enabled=false", "low_pass_filter=[]", cloud=False)
            intruder = stack.enter_context(closing(site.intruder("monitor-1", "router")))
            achieved |= site.attack(intruder, ALL_EFFECTS - achieved)
        if achieved == ALL_EFFECTS:
            return
    assert achieved == ALL_EFFECTS


def test_messages_pass_the_operators_own_router(any_site: Site) -> None:
    """Commands, queries, replies and states pass through the operator's own router."""
    any_site.exchange_messages()
    assert set(any_site.vehicle.commands) == {b"operator"}
    assert set(any_site.vehicle.queries) == {b"operator"}


def test_certificate_of_another_authority_gets_no_link(site: Site, keys: Path, others_keys: Path) -> None:
    """A certificate with the same name from another authority gets no link, and the drive continues."""
    with pytest.raises(zenoh.ZError):
        open_session(site.endpoint, authority=keys / "authority.pem", own=others_keys / "operator-1.pem")
    site.exchange_messages()


def test_session_without_certificate_gets_no_link(site: Site, keys: Path) -> None:
    """A session without a certificate gets no link, and the drive continues."""
    with pytest.raises(zenoh.ZError):
        open_session(site.endpoint, authority=keys / "authority.pem")
    site.exchange_messages()


@pytest.mark.parametrize(("keys_fixture", "name"), [("others_keys", "vehicle-1"), ("keys", "operator-1")])
def test_operator_rejects_a_false_vehicle(
    keys: Path, keys_fixture: str, name: str, request: pytest.FixtureRequest, tmp_path: Path
) -> None:
    """An operator does not link to a router with another authority's keys, nor to one with an operator's key."""
    false_keys = request.getfixturevalue(keys_fixture)
    with Processes(tmp_path) as processes:
        false_vehicle = start_router(
            processes,
            "false",
            "router-cloud-tls.json5",
            f'listen.endpoints=["{QUIC}"]',
            *tls_changes(false_keys, name, "listen"),
        )
        with pytest.raises(zenoh.ZError):
            open_session(quic_endpoint(false_vehicle), authority=keys / "authority.pem", own=keys / "operator-1.pem")


def test_garbage_at_the_port_does_not_stop_messages(site: Site) -> None:
    """Random datagrams at the open port, some of which begin like QUIC, do not stop commands, states or replies."""
    chance = stream(1, "garbage")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:

        def garbage() -> None:
            for prefix in (b"", b"\xc0\x00\x00\x00\x01\x08", b"\x40"):
                for length in (0, 20, 1200, 1400):
                    stranger.sendto(prefix + chance.bytes(length), ("127.0.0.1", udp_port(site.endpoint)))

        site.exchange_messages(garbage)
    assert set(site.vehicle.commands) == {b"operator"}
    with closing(site.intruder("operator-1", "client")):  # new links are still accepted
        pass


def test_local_process_without_permission_cannot_connect(direct_site: Site) -> None:
    """Another user of the operator's machine, without write permission on the socket file, cannot connect."""
    if os.geteuid() != 0:
        need("root", "needs root, to become another user")
    path = direct_site.operator_socket
    assert stat.S_IMODE(path.stat().st_mode) & 0o002 == 0

    def as_nobody() -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, "-c", CONNECT_AS_NOBODY, str(path)],
            capture_output=True,
            text=True,
            check=False,
        )

    assert "PermissionError" in as_nobody().stderr
    former_mode = path.stat().st_mode
    path.chmod(0o777)
    assert as_nobody().returncode == 0
    path.chmod(former_mode)


def test_local_process_with_permission_can_publish_commands(direct_site: Site) -> None:
    """A process with write permission on the operator's socket can publish commands, which is why they are signed."""
    with closing(Intruder(open_session(f"unixsock-stream/{direct_site.operator_socket}"))) as intruder:
        assert "commands" in direct_site.attack(intruder, {"commands"})


# The tests below judge a drive with an attacker at the operator's router, whose socket file should keep attackers out.


@pytest.fixture(scope="module")
def attacked_drives(
    keys: Path, tmp_path_factory: pytest.TempPathFactory, stalls: Stalls
) -> SharedResult[attacks.AttackedDrive]:
    """Drive with the secure configs, without an attack at first and then under one attack after the other."""
    pytest.importorskip("pylibsrtp")
    return SharedResult(stalls, lambda: attacks.drive(tmp_path_factory.mktemp("attacked"), keys))


@pytest.fixture
def attacked_drive(attacked_drives: SharedResult[attacks.AttackedDrive]) -> attacks.AttackedDrive:
    return attacked_drives.get()


def attack_interval_ns(drive: attacks.AttackedDrive) -> tuple[int, int]:
    """Return when the quiet phase began and the last attack ended."""
    return drive.phases["quiet"][0], drive.phases["flood"][1]


def total_count(record: Record, name: str) -> int:
    values = record.table("counts").ints(name)
    return int(np.sum(values[values != MISSING]))


def is_during(drive: attacks.AttackedDrive, name: str, mono_ns: IntArray) -> Any:
    began_ns, ended_ns = drive.phases[name]
    return (mono_ns > began_ns) & (mono_ns < ended_ns)


def accepted_commands(drive: attacks.AttackedDrive) -> Table:
    admissions = drive.server.table("admission")
    return admissions.where(np.array(admissions.texts("verdict")) == "accepted")


COMMAND_PERIOD_MS = CLIENT_LIMITS.command_period_ns / NS_PER_MS
COMMAND_FIELDS = ("sequence", "steering_rad", "throttle", "brake", "mode", "stamp_ns", "sent_wall_ns")


def command_rows(table: Table, *names: str) -> list[tuple[Any, ...]]:
    """Return the epoch and the named columns of each row."""
    return list(zip(*(table.objects(name) for name in ("epoch", *names)), strict=True))


def test_only_the_operators_commands_are_accepted(attacked_drive: attacks.AttackedDrive, stalls: Stalls) -> None:
    """Under every attack each accepted command is one that the client sent, unchanged, and none is accepted twice."""
    commands = accepted_commands(attacked_drive)
    sent_by_client = set(command_rows(attacked_drive.client.table("control"), *COMMAND_FIELDS))

    assert set(command_rows(commands, *COMMAND_FIELDS)) <= sent_by_client
    assert len(set(command_rows(commands, "sequence"))) == len(commands)
    for name, phase in attacked_drive.phases.items():
        with stalls.excusing_failures(*phase, stall_ms=LONG_STALL_MS):
            assert np.sum(is_during(attacked_drive, name, commands.ints("received_mono_ns"))) > 150


def test_forged_messages_are_counted(attacked_drive: attacks.AttackedDrive, stalls: Stalls) -> None:
    """Thousands of replayed, altered and forged commands and requests are rejected and counted."""
    server = attacked_drive.server
    with stalls.excusing_failures(*attack_interval_ns(attacked_drive), stall_ms=LONG_STALL_MS):
        assert attacked_drive.sent_counts["replayed"] > 1000
        assert attacked_drive.sent_counts["flood"] > 0.5 * attacks.FLOOD_PER_S * attacks.PHASE_NS / NS_PER_S
        assert total_count(server, "commands_forged") > 500
        assert total_count(server, "commands_screened_out") > 0.3 * attacked_drive.sent_counts["flood"]
        assert total_count(server, "session_requests_with_wrong_counter") > 10
        assert total_count(server, "rejected: not newer than the last command") > 100


def test_only_the_vehicles_states_are_accepted(attacked_drive: attacks.AttackedDrive, stalls: Stalls) -> None:
    """Every state that reached the client's driver is one that the server sent; all other states are counted."""
    names = ("sent_wall_ns", "state_mono_ns", "speed_mps", "safety", "applied_sequence")
    sent_states, received_states = (
        list(zip(*(record.table("state").objects(name) for name in names), strict=True))
        for record in (attacked_drive.server, attacked_drive.client)
    )

    assert set(received_states) <= set(sent_states)
    assert len(set(received_states)) == len(received_states)
    with stalls.excusing_failures(*attack_interval_ns(attacked_drive), share=BUSY_SHARE):
        assert len(received_states) > 0.9 * len(sent_states) - 100
    with stalls.excusing_failures(*attack_interval_ns(attacked_drive), stall_ms=LONG_STALL_MS):
        assert total_count(attacked_drive.client, "states_replayed") > 100
        assert total_count(attacked_drive.client, "states_forged") > 100


def test_the_drive_continues_under_every_attack(attacked_drive: attacks.AttackedDrive, stalls: Stalls) -> None:
    """During all attacks the vehicle is driven and never stops."""
    events = attacked_drive.server.table("event")
    began_ns, ended_ns = attack_interval_ns(attacked_drive)
    events_of_attacks = events.where((events.ints("mono_ns") > began_ns) & (events.ints("mono_ns") < ended_ns))

    with stalls.excusing_failures(began_ns, ended_ns, stall_ms=LONG_STALL_MS):
        assert attacked_drive.last_status["safety"] == "driving"
        assert not [detail for detail in events_of_attacks.texts("detail") if "stop" in detail]


def test_a_flood_does_not_delay_the_operator(attacked_drive: attacks.AttackedDrive, stalls: Stalls) -> None:
    """Ten thousand forged commands a second delay the operator's commands by less than 20 ms in the median."""
    sent_ns = dict(
        zip(
            command_rows(attacked_drive.client.table("control"), "sequence"),
            attacked_drive.client.table("control").mono_ns,
            strict=True,
        )
    )
    commands = accepted_commands(attacked_drive)
    received_ns = commands.ints("received_mono_ns")
    delays_ms = np.array(
        [
            (at_ns - sent_ns[key]) / NS_PER_MS
            for key, at_ns in zip(command_rows(commands, "sequence"), received_ns, strict=True)
        ]
    )
    quiet, flood = (np.median(delays_ms[is_during(attacked_drive, name, received_ns)]) for name in ("quiet", "flood"))

    with stalls.excusing_failures(*attacked_drive.phases["flood"], share=BUSY_SHARE):
        assert flood - quiet < COMMAND_PERIOD_MS, f"{quiet:.2f} ms, and under the flood {flood:.2f} ms"
