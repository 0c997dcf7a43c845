"""Test a video path in virtual time, with an attacker who overhears hellos and sends with any source address."""

from __future__ import annotations

import heapq
from collections.abc import Callable
from functools import partial
from itertools import count, pairwise

import pytest

from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.transport.rtp.rtcp import is_rtcp
from lavt.transport.video.cipher import SrtpCipher
from lavt.transport.video.path_validation import PathClient, PathServer, is_path_datagram

Address = tuple[str, int]

TOKEN, OTHER_TOKEN = bytes(range(16)), bytes(16)
HOME: Address = ("192.0.2.1", 5004)
MOVED: Address = ("192.0.2.1", 61000)
ATTACKER: Address = ("198.51.100.7", 5004)
SERVER: Address = ("203.0.113.2", 5600)
RTCP = bytes.fromhex("80c900010000000b")
FRAME_NS, PACKETS_PER_FRAME = NS_PER_S // 30, 5
REPORT_NS = 500 * NS_PER_MS
POLL_NS = 5 * NS_PER_MS
KIND_BYTE = 4
"""Where a datagram of the path validation has its kind: 1 hello, 2 challenge, 3 answer."""
ATTACK_START_NS, ATTACK_END_NS = 2 * NS_PER_S, 8 * NS_PER_S
"""The path is open before the attack."""

pytestmark = pytest.mark.usefixtures("srtp")


@pytest.fixture
def srtp() -> None:
    pytest.importorskip("pylibsrtp", reason="an extra: pip install -e '.[secure]'")


class Path:
    """A server that sends encrypted video, a client that receives it, and the network between them.

    `fate` takes the source and the content of a datagram, and returns the delays with which its copies arrive; a lost
    datagram has none.
    """

    def __init__(self, one_way_ns: int) -> None:
        numbers = count()
        self.server = PathServer(lambda: next(numbers).to_bytes(16, "big"), partial(SrtpCipher, "server"))
        self.server.set_token(TOKEN)
        self.client = PathClient(TOKEN, partial(SrtpCipher, "client"))
        self.address = HOME
        self.now_ns = 0
        self.overheard: list[bytes] = []
        """The datagrams of the client's path validation."""
        self.challenges: list[bytes] = []
        """The challenges that arrived at the client's address."""
        self.receive_at_attacker: Callable[[bytes], None] = lambda _datagram: None
        self.fate: Callable[[Address, bytes], tuple[int, ...]] = lambda _source, _datagram: (one_way_ns,)
        self.arrivals: list[tuple[int, bool]] = []
        """For each video packet at the client, when it arrived, and whether the client could decrypt it."""
        self.sent = 0
        self._packets = count(1)
        self._events: list[tuple[int, int, Callable[[], None]]] = []
        self._order = count()
        for period_ns, action in ((FRAME_NS, self._frame), (POLL_NS, self._poll), (REPORT_NS, self._report)):
            self.schedule_every(period_ns, action)

    def schedule(self, time_ns: int, action: Callable[[], None]) -> None:
        """Call `action` at a time."""
        heapq.heappush(self._events, (time_ns, next(self._order), action))

    def schedule_every(self, period_ns: int, action: Callable[[], None], since_ns: int = 0) -> None:
        """Call `action` once in each period, from `since_ns` on."""

        def repeat() -> None:
            action()
            self.schedule(self.now_ns + period_ns, repeat)

        self.schedule(since_ns, repeat)

    def run(self, until_ns: int = ATTACK_END_NS) -> None:
        """Run until a time."""
        while self._events and self._events[0][0] <= until_ns:
            self.now_ns, _, action = heapq.heappop(self._events)
            action()

    def send(self, source: Address, target: Address, datagram: bytes) -> None:
        """Send a datagram from any source address."""
        for delay_ns in self.fate(source, datagram):
            self.schedule(self.now_ns + delay_ns, lambda: self._arrive(source, target, datagram))

    def were_readable(self, begin_ns: int = ATTACK_START_NS, end_ns: int = ATTACK_END_NS) -> list[bool]:
        """Return for each packet that arrived in this interval whether the client could decrypt it."""
        return [readable for at_ns, readable in self.arrivals if begin_ns <= at_ns < end_ns]

    def longest_gap_ns(self, begin_ns: int = ATTACK_START_NS, end_ns: int = ATTACK_END_NS) -> int:
        """Return the longest time without readable video."""
        times_ns = [at_ns for at_ns, readable in self.arrivals if readable and begin_ns <= at_ns < end_ns]
        edges_ns = [begin_ns, *times_ns, end_ns]
        return max(later - earlier for earlier, later in pairwise(edges_ns))

    def _arrive(self, source: Address, target: Address, datagram: bytes) -> None:
        if target == SERVER:
            self._at_server(source, datagram)
        elif target == ATTACKER:
            self.receive_at_attacker(datagram)
        elif target == self.address:
            self._at_client(datagram)

    def _at_server(self, source: Address, datagram: bytes) -> None:
        if is_path_datagram(datagram):
            challenge = self.server.receive(datagram, source, self.now_ns)
            if challenge is not None:
                self.send(SERVER, source, challenge)
        elif self.server.accepts_rtcp_from(source) and self.server.cipher.unprotect_rtcp(datagram) is not None:
            self.server.note_report(source, self.now_ns)

    def _at_client(self, datagram: bytes) -> None:
        if is_path_datagram(datagram):
            self.challenges.append(datagram)
            answer = self.client.answer(datagram)
            if answer is not None:
                self._from_client(answer)
            return
        assert not is_rtcp(datagram)
        readable = self.client.unprotect(datagram) is not None
        self.arrivals.append((self.now_ns, readable))
        if readable:
            self.client.video_arrived(self.now_ns)

    def _frame(self) -> None:
        address = self.server.open_address(self.now_ns)
        for _ in range(PACKETS_PER_FRAME if address else 0):
            number = next(self._packets).to_bytes(2, "big")
            packet = self.server.cipher.protect(b"\x80\x60" + number + bytes(4) + b"\0\0\0\x0a" + b"a picture")
            self.sent += 1
            self.send(SERVER, address or HOME, packet)

    def _poll(self) -> None:
        if self.now_ns >= self.client.next_hello_ns():
            self._from_client(self.client.hello(self.now_ns))

    def _report(self) -> None:
        if self.arrivals:
            self.send(self.address, SERVER, self.client.protect_rtcp(RTCP))

    def _from_client(self, datagram: bytes) -> None:
        self.overheard.append(datagram)
        self.send(self.address, SERVER, datagram)


def replay_hello(path: Path, source: Address, rate_hz: int) -> None:
    """Replay the first hello from `source` during the attack."""
    path.schedule_every(NS_PER_S // rate_hz, lambda: path.send(source, SERVER, path.overheard[0]), ATTACK_START_NS)


def hellos(path: Path) -> list[bytes]:
    return [datagram for datagram in path.overheard if datagram[KIND_BYTE] == 1]


@pytest.mark.parametrize(("rate_hz", "one_way_ms"), [(100, 100), (400, 25)])
def test_replayed_hellos_from_the_clients_address_leave_the_video_readable(rate_hz: int, one_way_ms: int) -> None:
    """One hello that is replayed with the client's source address makes no packet unreadable."""
    path = Path(one_way_ms * NS_PER_MS)
    replay_hello(path, HOME, rate_hz)
    path.run()
    assert len(path.were_readable()) > 800
    assert all(path.were_readable())
    assert path.longest_gap_ns() < 2 * FRAME_NS


def test_challenges_that_an_attacker_obtained_leave_the_video_readable() -> None:
    """Challenges to replays of a hello, forwarded with the server's source address, make no packet unreadable."""
    path = Path(25 * NS_PER_MS)
    replay_hello(path, ATTACKER, 480)
    path.receive_at_attacker = lambda challenge: path.send(SERVER, HOME, challenge)
    path.run()
    assert len(path.were_readable()) > 800
    assert all(path.were_readable())
    assert path.server.open_address(path.now_ns) == HOME


@pytest.mark.parametrize("source", [HOME, ATTACKER])
def test_a_replayed_hello_neither_moves_nor_stops_the_video(source: Address) -> None:
    """Every packet goes to the client although all the client's datagrams are replayed."""
    path = Path(25 * NS_PER_MS)

    def replay_everything() -> None:
        for datagram in path.overheard:
            path.send(source, SERVER, datagram)
            path.send(SERVER, HOME, datagram)

    path.schedule_every(10 * NS_PER_MS, replay_everything, ATTACK_START_NS)
    path.receive_at_attacker = lambda challenge: path.send(SERVER, HOME, challenge)
    path.run(ATTACK_END_NS + NS_PER_S)
    assert path.server.open_address(path.now_ns) == HOME
    # At most the packets of 3 s are missing; those of the last second arrive after ATTACK_END_NS.
    assert sum(path.were_readable(0)) >= path.sent - 3 * 30 * PACKETS_PER_FRAME
    assert path.longest_gap_ns() < 2 * FRAME_NS


def test_a_client_behind_a_nat_that_changes_keeps_its_video_under_attack() -> None:
    """After a change of the client's address, video arrives there within 0.4 s, although hellos are replayed."""
    path = Path(25 * NS_PER_MS)
    for source in (HOME, ATTACKER):
        replay_hello(path, source, 400)

    def move() -> None:
        path.address = MOVED

    path.schedule(4 * NS_PER_S, move)
    path.run()
    assert path.server.open_address(path.now_ns) == MOVED
    assert path.longest_gap_ns() < 400 * NS_PER_MS
    assert all(path.were_readable())


@pytest.mark.parametrize("kind", [1, 2, 3])
@pytest.mark.parametrize("moves", [False, True])
def test_a_lost_datagram_of_the_validation_delays_the_video_by_one_hello(kind: int, *, moves: bool) -> None:
    """The loss of a hello, a challenge or an answer delays opening or moving the path until the next hello."""
    path = Path(25 * NS_PER_MS)
    change_ns = 4 * NS_PER_S if moves else 0
    lost: list[bytes] = []

    def lose_first(_source: Address, datagram: bytes) -> tuple[int, ...]:
        if is_path_datagram(datagram) and datagram[KIND_BYTE] == kind and path.now_ns >= change_ns and not lost:
            lost.append(datagram)
            return ()
        return (25 * NS_PER_MS,)

    def move() -> None:
        path.address = MOVED

    path.fate = lose_first
    if moves:
        path.schedule(change_ns, move)
    path.run()
    assert len(lost) == 1
    assert all(path.were_readable(0))
    assert path.longest_gap_ns(change_ns) < (600 if moves else 800) * NS_PER_MS
    assert path.server.open_address(path.now_ns) == path.address


def test_duplicated_and_reordered_datagrams_leave_the_video_readable() -> None:
    """With delays from 20 to 200 ms and duplicates, the video is readable before and after a change of address."""
    path = Path(25 * NS_PER_MS)
    delays_ms = [20 + (number * 7919) % 180 for number in range(1000)]
    turns = count()

    def shuffled(_source: Address, datagram: bytes) -> tuple[int, ...]:
        first, second = (delays_ms[next(turns) % 1000] * NS_PER_MS for _ in range(2))
        return (first, second) if is_path_datagram(datagram) else (first,)

    def move() -> None:
        path.address = MOVED

    path.fate = shuffled
    path.schedule(4 * NS_PER_S, move)
    path.run()
    assert all(path.were_readable(0))
    assert path.server.open_address(path.now_ns) == MOVED
    assert path.longest_gap_ns() < NS_PER_S


def test_an_outage_changes_no_key_while_reports_arrive() -> None:
    """Video that is lost for 1 s causes hellos and answers, but no new keys, and is readable afterwards."""
    path = Path(25 * NS_PER_MS)

    def lose_video(source: Address, datagram: bytes) -> tuple[int, ...]:
        lost = source == SERVER and not is_path_datagram(datagram) and 4 * NS_PER_S <= path.now_ns < 5 * NS_PER_S
        return () if lost else (25 * NS_PER_MS,)

    path.fate = lose_video
    path.run(3 * NS_PER_S)
    cipher = path.server.cipher
    path.run()
    assert path.server.cipher is cipher
    assert path.server.unneeded > 3
    assert all(path.were_readable())


@pytest.mark.parametrize("token", [OTHER_TOKEN, None])
def test_a_client_that_restarts_opens_the_path_with_its_own_token(token: bytes | None) -> None:
    """A new client gets the video with its token; hellos and answers of the previous client have no effect."""
    path = Path(25 * NS_PER_MS)

    def restart() -> None:
        path.server.set_token(token)
        path.client = PathClient(token or TOKEN, partial(SrtpCipher, "client"))
        path.arrivals.clear()

    def replay_the_previous_client() -> None:
        for datagram in previous_datagrams:
            path.send(HOME, SERVER, datagram)
            path.send(ATTACKER, SERVER, datagram)

    path.schedule(ATTACK_START_NS, restart)
    path.run(ATTACK_START_NS)
    previous_datagrams = list(path.overheard)
    path.schedule_every(20 * NS_PER_MS, replay_the_previous_client, ATTACK_START_NS)
    path.run()
    late_ns = ATTACK_START_NS + NS_PER_S
    assert path.server.open_address(path.now_ns) == (HOME if token else None)
    assert all(path.were_readable(late_ns))
    assert (len(path.were_readable(late_ns)) > 700) == (token is not None)


def test_a_second_client_with_another_token_has_no_effect() -> None:
    """The hellos of a client without control, from any address, leave the first client's video as it is."""
    path = Path(25 * NS_PER_MS)
    second = PathClient(OTHER_TOKEN, partial(SrtpCipher, "client"))

    def send_second_hello(source: Address) -> None:
        path.send(source, SERVER, second.hello(0))

    for source in (ATTACKER, MOVED, HOME):
        path.schedule_every(20 * NS_PER_MS, partial(send_second_hello, source), ATTACK_START_NS)
    path.run()
    assert path.server.wrong_token > 800
    assert all(path.were_readable())
    assert path.longest_gap_ns() < 2 * FRAME_NS


@pytest.mark.parametrize("one_way_ms", [1, 60])
def test_a_copied_hello_that_arrives_first_does_not_prevent_the_opening(one_way_ms: int) -> None:
    """An attacker whose copies overtake all hellos gets challenges, but the client gets challenges, too."""
    path = Path(one_way_ms * NS_PER_MS)
    path.fate = lambda source, _datagram: (0,) if source == ATTACKER else (one_way_ms * NS_PER_MS,)
    copied = 0

    def copy_new() -> None:
        nonlocal copied
        for hello in hellos(path)[copied:]:
            path.send(ATTACKER, SERVER, hello)
        copied = len(hellos(path))

    path.schedule_every(NS_PER_MS // 2, copy_new)
    path.run()
    assert path.server.open_address(path.now_ns) == HOME
    assert all(path.were_readable(0))
    assert len(path.were_readable()) > 800
