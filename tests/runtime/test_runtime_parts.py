"""Test the parts of a runtime: the inbox, the pipeline and the recorders."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass
from itertools import count, repeat
from typing import Any

import msgspec
import pytest

from lavt.channels import CHANNELS
from lavt.domain import Now, SessionReply, State
from lavt.node import Message, Send
from lavt.nodes.payloads import Event
from lavt.recording.live_status import LiveStatus
from lavt.runtime.inbox import Inbox
from lavt.runtime.pipeline import run_stages
from lavt.runtime.recorder import UNRECORDED, WIRE_DECODERS, QueuedRecorder, Recorders, record
from lavt.transport.messages import encode

NOW = Now(1000, 5000)
STATE = State(1, 2, 8.3, 0.0, "drive", "driving", "armed", -1, "")


def message(channel: str, payload: object = None) -> Message:
    return Message(channel, payload, NOW)


class ListRecorder:
    """A recorder that stores its entries in a list."""

    def __init__(self) -> None:
        self.entries: list[tuple[str, Any, Now]] = []
        self.is_closed = False

    def write(self, topic: str, payload: Any, now: Now) -> None:
        """Store one entry."""
        self.entries.append((topic, payload, now))

    def close(self) -> None:
        """Store that the record is complete."""
        self.is_closed = True


def test_queued_messages_come_first() -> None:
    """Messages of channels with a queue come first and in order, then the newest message of each other channel."""
    inbox = Inbox()
    for channel, payload in (("state", 1), ("access_unit", 2), ("view", 3), ("access_unit", 4), ("state", 5)):
        inbox.put(message(channel, payload))
    taken = [message.payload for message in iter(inbox.take, None)]
    assert taken == [2, 4, 5, 3]
    assert inbox.counts == {"state_replaced": 1}


def test_packets_that_arrived_before_a_wake_come_first() -> None:
    """Packets that arrived before a wake can be taken first; later ones and other channels stay."""
    inbox = Inbox()
    for at_ns, channel in ((900, "control"), (1000, "rtp"), (1001, "rtp")):
        inbox.put(Message(channel, at_ns, Now(at_ns, 0)))
    assert inbox.take_arrived(999) is None
    (taken,) = iter(lambda: inbox.take_arrived(1000), None)
    assert taken.payload == 1000
    assert [message.payload for message in iter(inbox.take, None)] == [900, 1001]


def test_a_full_queue_drops_its_oldest_message() -> None:
    """A full queue drops and counts its oldest messages, and other channels lose nothing."""
    inbox = Inbox()
    inbox.put(message("session", "first"))
    length = CHANNELS["control"].length
    for number in range(length + 2):
        inbox.put(message("control", number))
    inbox.put(message("frame", "last"))
    assert inbox.counts == {"control_dropped": 2}
    taken = [message.payload for message in iter(inbox.take, None)]
    assert taken == ["first", *range(2, length + 2), "last"]


@dataclass
class Stamped:
    """A value with a stamp."""

    stamp_ns: int


def test_each_stage_gets_the_time_after_the_one_before() -> None:
    """Each stage gets the result and end time of the one before, and the timeline has all end times."""
    calls = []

    def stage(result: object) -> Callable[[Any, Now], object]:
        def call(value: object, now: Now) -> object:
            calls.append((value, now.mono_ns))
            return result

        return call

    first = message("control")
    sends = [Send("event", 1)]
    stages = [("a", stage(Stamped(42))), ("b", stage("bare")), ("c", stage(sends))]
    outcome = run_stages("node", stages, first, Now(1010, 5010), map(Now(1010, 5010).later, count(7, 7)))
    assert calls == [(first, 1010), (Stamped(42), 1017), ("bare", 1024)]
    assert (outcome.sends, outcome.end) == (sends, Now(1031, 5031))
    assert outcome.timeline is not None
    assert (outcome.timeline.stamp_ns, outcome.timeline.arrived_mono_ns) == (42, 1000)
    assert outcome.timeline.stages == (("wait", 1010), ("a", 1017), ("b", 1024), ("c", 1031))


def test_none_ends_a_pipeline() -> None:
    """A stage that returns None ends the pipeline; without a stamp there is no timeline."""
    stages = [("a", lambda _value, _now: None), ("b", lambda _value, _now: pytest.fail("called"))]
    outcome = run_stages("node", stages, message("control"), NOW, repeat(NOW.later(1)))
    assert (outcome.sends, outcome.end.mono_ns, outcome.timeline) == ([], 1001, None)


def test_the_token_is_never_recorded() -> None:
    """A session reply is recorded without its token, and token channels are not recorded."""
    recorded, token = ListRecorder(), bytes(range(100, 116))
    record(recorded, "session_reply", encode(SessionReply(True, "", 5, token, 1, "host", 0)), NOW)
    for channel in ("path_token", "video_token"):
        assert channel in UNRECORDED
        record(recorded, channel, token, NOW)
    ((topic, reply, _),) = recorded.entries
    assert (topic, reply.epoch, reply.token) == ("session_reply", 5, b"")


@pytest.mark.parametrize("channel", sorted(WIRE_DECODERS))
@pytest.mark.parametrize("data", [b"", b"\xc1", bytes(300)])
def test_unreadable_bytes_are_recorded(channel: str, data: bytes) -> None:
    """Unreadable network bytes are recorded with their size."""
    recorded = ListRecorder()
    record(recorded, channel, data, NOW)
    ((_, payload, _),) = recorded.entries
    fields = payload if isinstance(payload, dict) else msgspec.to_builtins(payload)
    assert fields["size_bytes"] == len(data)
    if channel not in ("rtp", "feedback"):
        assert payload["unreadable"] == data[:64].hex()


def test_every_network_channel_has_a_decoder() -> None:
    """Each network channel has a decoder for the record."""
    assert {name for name, channel in CHANNELS.items() if channel.carrier in ("video", "zenoh")} == set(WIRE_DECODERS)


def test_a_full_disk_ends_the_record_only() -> None:
    """An entry that cannot be written ends the record; this entry and all later ones are counted as lost."""

    class FullDisk(ListRecorder):
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
    assert not disk.is_closed


def test_a_record_is_complete_after_close() -> None:
    """Closing writes the queued entries and the number of lost ones, and completes the record."""
    disk = ListRecorder()
    recorder = QueuedRecorder(disk)
    recorder.write("event", 1, NOW)
    recorder.close(NOW)
    assert disk.entries == [("event", 1, NOW), ("counts", {"record_overflow": 0}, NOW)]
    assert disk.is_closed


@pytest.mark.parametrize("is_blocked", [False, True])
def test_the_live_status_does_not_depend_on_the_record(is_blocked: bool) -> None:
    """The live status works, and the record can be closed, even if the disk is full or does not respond."""
    unblock = threading.Event()

    class Disk(ListRecorder):
        def write(self, *_: Any) -> None:
            if is_blocked:
                unblock.wait()
            raise OSError("no space left on device")

    live, queued = LiveStatus(), QueuedRecorder(Disk(), close_timeout_s=0.02)
    recorder = Recorders(live, queued)
    recorder.write("event", Event(1, "drive_began", ""), NOW)
    assert live.ending() is None
    recorder.write("state", encode(STATE), NOW)
    recorder.write("event", Event(2, "ending", "completed"), NOW)
    assert live.ending() == "completed"
    assert live.status()["reason"] == STATE.reason
    assert live.take_updates() == [(STATE, NOW)]
    queued.close(NOW)
    unblock.set()


def test_a_full_record_queue_counts_lost_entries() -> None:
    """A full record queue loses and counts entries without blocking."""
    recorded, unblock = ListRecorder(), threading.Event()

    class Slow(ListRecorder):
        def write(self, topic: str, payload: Any, now: Now) -> None:
            unblock.wait()
            recorded.write(topic, payload, now)

    recorder = QueuedRecorder(Slow(), capacity=3)
    for number in range(20):
        recorder.write("event", number, NOW)
    assert recorder.overflow >= 16
    unblock.set()
    recorder.close(NOW)
    written = [payload for topic, payload, _ in recorded.entries if topic == "event"]
    assert written == list(range(len(written)))
    assert 3 <= len(written) <= 4, "three in the queue, and perhaps one that the thread had taken"
    assert recorded.entries[-1][:2] == ("counts", {"record_overflow": 20 - len(written)})
