"""Inbox, chain and recording."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from itertools import count, repeat
from typing import Any

import pytest

from lavt.channels import CHANNELS
from lavt.domain import Now, SessionReply
from lavt.node import Message, Send
from lavt.runtime.inbox import Inbox
from lavt.runtime.pipeline import walk
from lavt.runtime.recorder import UNRECORDED, WIRE, QueuedRecorder, record
from lavt.transport.messages import encode

NOW = Now(1000, 5000)


def message(channel: str, payload: object = None) -> Message:
    return Message(channel, payload, NOW)


class Kept:
    """A recorder that keeps its entries in a list."""

    def __init__(self) -> None:
        self.entries: list[tuple[str, Any, Now]] = []

    def write(self, topic: str, payload: Any, now: Now) -> None:
        """Write one entry."""
        self.entries.append((topic, payload, now))


def test_what_queues_comes_before_what_is_replaced() -> None:
    """Queued messages come in order and first, then the newest of the others."""
    inbox = Inbox()
    for channel, payload in (("state", 1), ("access_unit", 2), ("view", 3), ("access_unit", 4), ("state", 5)):
        inbox.put(message(channel, payload))
    taken = [each.payload for each in iter(inbox.take, None)]
    assert taken == [2, 4, 5, 3]
    assert inbox.counts == {"state_replaced": 1}


def test_packets_that_had_arrived_come_before_a_wake() -> None:
    """Packets that came by the time of a wake can be taken first, in order; later ones and other channels stay."""
    inbox = Inbox()
    for at_ns, channel in ((900, "control"), (1000, "rtp"), (1001, "rtp")):
        inbox.put(Message(channel, at_ns, Now(at_ns, 0)))
    assert inbox.take_arrived(999) is None
    (taken,) = iter(lambda: inbox.take_arrived(1000), None)
    assert taken.payload == 1000
    assert [each.payload for each in iter(inbox.take, None)] == [900, 1001]


def test_a_full_queue_drops_its_oldest_and_counts() -> None:
    """Beyond its length a channel loses its oldest message, and says so; a flood on one loses nothing of another."""
    inbox = Inbox()
    inbox.put(message("session", "first"))
    length = CHANNELS["control"].length
    for number in range(length + 2):
        inbox.put(message("control", number))
    inbox.put(message("frame", "last"))
    assert inbox.counts == {"control_dropped": 2}
    taken = [each.payload for each in iter(inbox.take, None)]
    assert taken == ["first", *range(2, length + 2), "last"]


@dataclass
class Stamped:
    """A value with a stamp."""

    stamp_ns: int


def test_each_stage_gets_the_time_after_the_one_before() -> None:
    """Hop after hop is called with the value and the end of the hop before, and the timeline lists all ends."""
    seen = []

    def stage(result: object) -> Callable[[Any, Now], object]:
        def call(value: object, now: Now) -> object:
            seen.append((value, now.mono_ns))
            return result

        return call

    first = message("control")
    sends = [Send("event", 1)]
    stages = [("a", stage(Stamped(42))), ("b", stage("bare")), ("c", stage(sends))]
    outcome = walk("node", stages, first, Now(1010, 5010), map(Now(1010, 5010).later, count(7, 7)))
    assert seen == [(first, 1010), (Stamped(42), 1017), ("bare", 1024)]
    assert (outcome.sends, outcome.end) == (sends, Now(1031, 5031))
    assert outcome.timeline is not None
    assert (outcome.timeline.stamp_ns, outcome.timeline.arrived_mono_ns) == (42, 1000)
    assert outcome.timeline.stages == (("wait", 1010), ("a", 1017), ("b", 1024), ("c", 1031))


def test_none_ends_a_chain() -> None:
    """A hop that returns None is the last one called; nothing is sent, and without a stamp there is no timeline."""
    stages = [("a", lambda _value, _now: None), ("b", lambda _value, _now: pytest.fail("called"))]
    outcome = walk("node", stages, message("control"), NOW, repeat(NOW.later(1)))
    assert (outcome.sends, outcome.end.mono_ns, outcome.timeline) == ([], 1001, None)


def test_the_token_is_never_recorded() -> None:
    """Of a session reply everything is written down but the token, and channels that carry it are not recorded."""
    kept, token = Kept(), bytes(range(100, 116))
    record(kept, "session_reply", encode(SessionReply(True, "", 5, token, 1, "host", 0)), NOW)
    for channel in ("path_token", "video_token"):
        assert channel in UNRECORDED
        record(kept, channel, token, NOW)
    ((topic, reply, _),) = kept.entries
    assert (topic, reply.epoch, reply.token) == ("session_reply", 5, b"")


@pytest.mark.parametrize("channel", sorted(WIRE))
@pytest.mark.parametrize("data", [b"", b"\xc1", bytes(300)])
def test_garbage_is_recorded_as_what_it_is(channel: str, data: bytes) -> None:
    """Bytes from the network that cannot be read are written down with their size, and raise nothing."""
    kept = Kept()
    record(kept, channel, data, NOW)
    ((_, payload, _),) = kept.entries
    said = payload if isinstance(payload, dict) else asdict(payload)
    assert said["size_bytes"] == len(data)
    if channel not in ("rtp", "feedback"):
        assert payload["unreadable"] == data[:64].hex()


def test_every_channel_across_the_network_has_a_way_into_the_record() -> None:
    """What crosses the network is bytes, so each such channel says how they are written down."""
    assert {name for name, row in CHANNELS.items() if row.carrier in ("video", "zenoh")} == set(WIRE)


def test_a_full_disk_ends_the_record_and_nothing_else() -> None:
    """When an entry cannot be written, that and all later ones are counted as lost; nobody is stopped by it."""

    class FullDisk(Kept):
        def write(self, topic: str, payload: Any, now: Now) -> None:
            if len(self.entries) == 2:
                raise OSError("no space left on device")
            super().write(topic, payload, now)

    disk = FullDisk()
    recorder = QueuedRecorder(disk)
    for number in range(5):
        recorder.write("event", number, NOW)
    recorder.close(NOW)
    assert [payload for _, payload, _ in disk.entries] == [0, 1]
    assert recorder.overflow == 3


def test_a_full_record_queue_loses_and_counts() -> None:
    """When the disk cannot follow, entries are lost, counted, and the count is in the record; nobody waits."""
    import threading

    kept, go = Kept(), threading.Event()

    class Slow(Kept):
        def write(self, topic: str, payload: Any, now: Now) -> None:
            go.wait()
            kept.write(topic, payload, now)

    recorder = QueuedRecorder(Slow(), capacity=3)
    for number in range(20):
        recorder.write("event", number, NOW)
    assert recorder.overflow >= 16
    go.set()
    recorder.close(NOW)
    written = [payload for topic, payload, _ in kept.entries if topic == "event"]
    assert written == list(range(len(written)))
    assert 3 <= len(written) <= 4
    assert kept.entries[-1][:2] == ("counts", {"record_overflow": 20 - len(written)})
