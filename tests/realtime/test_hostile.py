"""A drive in real time under attack: random datagrams at all UDP ports, and garbage and replays at the router."""

from __future__ import annotations

import socket
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import zenoh
from tests.support.stalls import BUSY_SHARE, LONG_STALL_MS, SharedResult, Stalls

from lavt.clock import MachineClock, pause
from lavt.config_file import shipped
from lavt.domain import NS_PER_MS, NS_PER_S, PATH_POINTS, Command, SessionRequest
from lavt.experiment.runs.plan import PlannedRun
from lavt.experiment.runs.processes import Process, Processes
from lavt.experiment.runs.real_run import start_loop
from lavt.recording.record import Record, read_record
from lavt.recording.table import MISSING
from lavt.streams import stream
from lavt.transport.messages import encode

DATAGRAMS = 6_000
"""Number of datagrams per UDP port; each side has one port for the video and one for the clock probe."""
DATAGRAMS_PER_ROUND = 30
ROUNDS = DATAGRAMS // DATAGRAMS_PER_ROUND
ROUND_NS = 25 * NS_PER_MS
GARBAGE_PER_ROUND = 5
"""Number of messages per round on each of the three keys, which is 200 Hz."""
END_LIMIT_S = 5.0

COMMAND = Command(1, 2**40, 0, 0, 0, 0.1, 1.0, 0.0, (0.0,) * PATH_POINTS, "drive", 0)
PREFIXES = (b"", b"\x80\x60", b"\x80\xc9\x00\x01", b"\x81\xce\x00\x02", b"LAVT\x01\x03")
"""First bytes of datagrams: none, or those of RTP, a receiver report, a picture-loss indication or a hello."""
REQUEST = SessionRequest("acquire", "stranger", 7, 0)


def udp_ports(process: Process) -> set[int]:
    """Return the UDP ports of a process (proc(5)), which are those of the video, of the probe and of its router."""
    files = Path(f"/proc/{process.popen.pid}/fd").iterdir()
    sockets = {str(file.readlink()).removeprefix("socket:[").rstrip("]") for file in files}
    lines = (line.split() for line in Path("/proc/net/udp").read_text().splitlines()[1:])
    ports = {int(fields[1].rpartition(":")[2], 16) for fields in lines if fields[9] in sockets}
    assert len(ports) >= 3
    return ports


class Attacker:
    """An attacker that reaches all UDP ports and the server's router, and records commands to replay them."""

    def __init__(self, router: str, ports: set[int], router_port: int) -> None:
        self._chance = stream(1, "hostile")
        self._ports = ports
        self._router_port = router_port
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.setblocking(False)
        self.received = 0
        config = zenoh.Config.from_file(str(shipped("zenoh-configs/session.json5")))
        config.insert_json5("connect/endpoints", f'["{router}"]')
        self._session = zenoh.open(config)
        self._recorded: list[bytes] = []
        listener: Any = zenoh.handlers.Callback(
            lambda sample: self._recorded.append(sample.payload.to_bytes()), indirect=False
        )
        self._subscriber = self._session.declare_subscriber("lavt/vehicle-1/control", listener)

    def attack(self) -> None:
        """Send one round of datagrams, commands and queries."""
        for port in self._ports:
            for _ in range(DATAGRAMS_PER_ROUND):
                self.socket.sendto(self._datagram(), ("127.0.0.1", port))
        for _ in range(GARBAGE_PER_ROUND):
            self._session.put("lavt/vehicle-1/control", self._garbage(COMMAND))
            ignore: Any = zenoh.handlers.Callback(lambda _reply: None, indirect=False)
            for query in ("session", "netem"):
                self._session.get(f"lavt/vehicle-1/{query}", ignore, payload=self._garbage(REQUEST), timeout=1.0)
        self._count_received()

    def close(self) -> None:
        """Count the last replies and close the sockets."""
        pause(NS_PER_S // 2)
        self._count_received()
        self.socket.close()
        self._session.close()

    def _datagram(self) -> bytes:
        """Return random bytes, most of which begin like RTP, RTCP or a hello."""
        prefix = PREFIXES[self._chance.integers(len(PREFIXES))]
        return prefix + self._chance.bytes(int(self._chance.choice([0, 8, 32, 200, 1200])))

    def _garbage(self, message: Command | SessionRequest) -> bytes:
        """Return random bytes, a truncated message, one with a flipped bit, or a replayed command.

        No bit of the last byte is flipped, because that would make a valid emergency stop.
        """
        data = bytearray(encode(message))
        at = int(self._chance.integers(1, len(data) - 1))
        kind = self._chance.choice(["random", "truncated", "flipped", "replayed"])
        if kind == "random":
            return self._chance.bytes(at)
        if kind == "truncated":
            return bytes(data[:at])
        if kind == "replayed" and isinstance(message, Command) and self._recorded:
            return self._recorded[-1 - int(self._chance.integers(min(100, len(self._recorded))))]
        data[at] ^= 1 << int(self._chance.integers(8))
        return bytes(data)

    def _count_received(self) -> None:
        """Count the replies, except those of QUIC at the port of the server's router, to which anybody may connect."""
        while True:
            try:
                _, (_, port) = self.socket.recvfrom(65_535)
            except BlockingIOError:
                return
            self.received += port != self._router_port


@pytest.fixture(scope="module")
def drives(
    tmp_path_factory: pytest.TempPathFactory,
    wait_until: Callable[[str, Callable[[], bool], float], None],
    planned: Callable[..., PlannedRun],
    stalls: Stalls,
) -> SharedResult[SimpleNamespace]:
    clock = MachineClock()

    def drive() -> SimpleNamespace:
        work = tmp_path_factory.mktemp("attacked")
        with Processes(work) as processes:
            loop = start_loop(processes, planned("vehicle.scenery=none"), work, work, once=False)
            wait_until(
                "the vehicle is driven", lambda: loop.server.latest.get("status", {}).get("safety") == "driving", 60.0
            )
            udp = next(locator for locator in loop.server_ready["locators"] if locator.startswith("udp/"))
            router_port = int(udp.partition("?")[0].rpartition(":")[2])
            attacker = Attacker(loop.router, udp_ports(loop.server) | udp_ports(loop.client), router_port)
            began_ns = clock.now().mono_ns
            for number in range(ROUNDS):
                attacker.attack()
                pause(began_ns + (number + 1) * ROUND_NS - clock.now().mono_ns)
            ended_ns = clock.now().mono_ns
            attacker.close()
            status = loop.server.latest["status"]
            ending_took_s = {}
            for process in (loop.client, loop.server):
                interrupted_ns = clock.now().mono_ns
                process.end()
                ending_took_s[process.name] = (clock.now().mono_ns - interrupted_ns) / NS_PER_S
            return SimpleNamespace(
                began_ns=began_ns,
                ended_ns=ended_ns,
                received=attacker.received,
                status=status,
                ending_took_s=ending_took_s,
                codes=[process.popen.returncode for process in (loop.client, loop.server)],
                server=read_record(work / "server" / "server.mcap"),
                client=read_record(work / "client" / "client.mcap"),
            )

    return SharedResult(stalls, drive)


@pytest.fixture
def attacked(drives: SharedResult[SimpleNamespace]) -> SimpleNamespace:
    """Return a drive that was attacked for some seconds and then ended by Ctrl-C on both sides."""
    return drives.get()


def total_count(record: Record, name: str) -> int:
    values = record.table("counts").ints(name)
    return int(np.sum(values[values != MISSING]))


def test_a_drive_continues_under_attack(attacked: SimpleNamespace, stalls: Stalls) -> None:
    """The drive continues under 6000 random datagrams per port, and garbage at 200 Hz on all keys.

    Only half of the pictures must lead to a command, which leaves room for other load on the machine.
    """
    admissions = attacked.server.table("admission")
    accepted = admissions.where(np.array(admissions.texts("verdict")) == "accepted")
    at_ns = accepted.ints("received_mono_ns")
    during_attack = accepted.where((at_ns > attacked.began_ns) & (at_ns < attacked.ended_ns))
    age_ms = (during_attack.ints("received_wall_ns") - during_attack.ints("stamp_ns")) / NS_PER_MS

    with stalls.excusing_failures(attacked.began_ns, attacked.ended_ns, stall_ms=LONG_STALL_MS):
        assert attacked.status["safety"] == "driving"
    with stalls.excusing_failures(attacked.began_ns, attacked.ended_ns, share=BUSY_SHARE):
        assert np.median(age_ms) < 60
        sent_frames = 30 * (attacked.ended_ns - attacked.began_ns) / NS_PER_S
        assert len(np.unique(during_attack.ints("stamp_ns"))) > 0.5 * sent_frames


def test_no_message_of_a_stranger_is_accepted(attacked: SimpleNamespace) -> None:
    """No command of another epoch and no replayed command is accepted, and no stranger gets control."""
    admissions = attacked.server.table("admission")
    accepted = admissions.where(np.array(admissions.texts("verdict")) == "accepted")
    events, states = attacked.server.table("event"), attacked.server.table("state")
    requests = events.where(np.array(["stranger" in detail for detail in events.texts("detail")]))
    granted = requests.where(np.array(["rejected" not in detail for detail in requests.texts("detail")]))

    assert len(set(accepted.objects("epoch"))) == 1
    assert np.all(np.diff(accepted.ints("sequence")) > 0)
    assert len(requests) > 0
    # Anybody may acquire a vehicle that has stopped, for example because the host stalled its client.
    latest = np.searchsorted(states.ints("state_mono_ns"), granted.ints("mono_ns")) - 1
    assert {states.texts("safety")[index] for index in latest} <= {"disarmed", "safe_stop"}
    assert all(abs(states.floats("speed_mps")[index]) < 0.1 for index in latest)


def test_strangers_do_not_damage_pictures(attacked: SimpleNamespace, stalls: Stalls) -> None:
    """Under attack more than 99 % of the pictures are readable, and fewer than 5 % are in doubt."""
    pictures = attacked.client.table("picture")
    at_ns = pictures.ints("read_mono_ns")
    during_attack = pictures.where((at_ns > attacked.began_ns) & (at_ns < attacked.ended_ns))

    with stalls.excusing_failures(attacked.began_ns, attacked.ended_ns):  # the sockets of a stalled side overflow
        assert np.mean(during_attack.flags("readable")) > 0.99
        assert np.mean(during_attack.flags("in_doubt")) < 0.05


def test_rejected_messages_are_counted_in_the_record(attacked: SimpleNamespace, stalls: Stalls) -> None:
    """The records of both sides have the numbers of rejected datagrams and messages."""
    server, client = attacked.server, attacked.client
    node_counters = ("feedback_from_strangers", "path_malformed", "path_wrong_token", "probes_rejected")
    at_server = sum(total_count(server, name) for name in (*node_counters, "datagrams_screened_out"))
    rejected_netem_requests = total_count(server, "netem_requests_unreadable") + total_count(
        server, "netem_requests_screened_out"
    )
    with stalls.excusing_failures(attacked.began_ns, attacked.ended_ns):  # the sockets of a stalled side overflow
        assert at_server > 0.9 * 2 * DATAGRAMS
        assert total_count(client, "datagrams_from_strangers") > 0.9 * 2 * DATAGRAMS
        assert total_count(server, "commands_unreadable") > 0.3 * ROUNDS * GARBAGE_PER_ROUND
        assert total_count(server, "session_requests_unreadable") > 0.3 * ROUNDS * GARBAGE_PER_ROUND
        assert rejected_netem_requests > 0.9 * ROUNDS * GARBAGE_PER_ROUND


def test_no_stranger_gets_video(attacked: SimpleNamespace) -> None:
    """An attacker without a token gets no datagram back."""
    assert attacked.received == 0


def test_ctrl_c_ends_both_sides(attacked: SimpleNamespace, stalls: Stalls) -> None:
    """SIGINT during a drive ends `lavt server` and `lavt client` within 5 s, with exit code 0 and complete records."""
    assert attacked.codes == [0, 0]
    with stalls.excusing_failures(attacked.ended_ns, stall_ms=LONG_STALL_MS):
        assert max(attacked.ending_took_s.values()) < END_LIMIT_S
    assert attacked.server.complete
    assert attacked.client.complete
    assert total_count(attacked.server, "record_overflow") == 0
    assert total_count(attacked.client, "record_overflow") == 0
