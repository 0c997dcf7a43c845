"""Recording of messages: their recorded form, several recorders as one, and a recorder with a queue before the disk."""

from __future__ import annotations

import logging
import threading
from collections import Counter, deque
from collections.abc import Callable
from typing import Any, Protocol

from msgspec import Struct
from msgspec.structs import replace

from lavt.domain import Command, NetemReply, NetemRequest, Now, SessionReply, SessionRequest, State
from lavt.errors import BadMessage
from lavt.transport.messages import decode

log = logging.getLogger(__name__)

POLL_PERIOD_S = 0.02
CLOSE_TIMEOUT_S = 10.0
"""Longest time for the completion of a record; to write a full queue takes a second on an ordinary disk."""


class Recorder(Protocol):
    """A destination of record entries."""

    def write(self, topic: str, payload: Any, now: Now) -> None:
        """Write one entry."""
        ...


class RecordFile(Recorder, Protocol):
    """A recorder that must be closed."""

    def close(self) -> None:
        """Complete the record."""
        ...


class Recorders:
    """A recorder that passes each entry to several recorders, which must neither block nor raise."""

    def __init__(self, *recorders: Recorder) -> None:
        self._writes = tuple(recorder.write for recorder in recorders)

    def write(self, topic: str, payload: Any, now: Now) -> None:
        """Write one entry to each recorder, in order."""
        for write in self._writes:
            write(topic, payload, now)


def _decoder(kind: type[Any]) -> Callable[[bytes], object]:
    """Return a function that decodes a message; for unreadable bytes it returns their beginning and size."""

    def decode_or_describe(data: bytes) -> object:
        try:
            return decode(kind, data)
        except BadMessage:
            return {"unreadable": data[:64].hex(), "size_bytes": len(data)}

    return decode_or_describe


def _without_token(data: bytes) -> object:
    """Return a session reply without its token, which is a secret: it validates the video path."""
    reply = _decoder(SessionReply)(data)
    return replace(reply, token=b"") if isinstance(reply, SessionReply) else reply


class Packet(Struct, frozen=True):
    """A datagram of the video; `sequence` and `timestamp` are None unless it is RTP (RFC 3550, section 5.1)."""

    sequence: int | None
    timestamp: int | None
    size_bytes: int


def _describe_packet(data: bytes) -> Packet:
    if len(data) < 12 or data[0] >> 6 != 2:
        return Packet(None, None, len(data))
    return Packet(int.from_bytes(data[2:4], "big"), int.from_bytes(data[4:8], "big"), len(data))


def _describe_size(data: bytes) -> object:
    return {"size_bytes": len(data)}


WIRE_DECODERS: dict[str, Callable[[bytes], object]] = {
    "rtp": _describe_packet,
    "feedback": _describe_size,
    "control": _decoder(Command),
    "state": _decoder(State),
    "session": _decoder(SessionRequest),
    "session_reply": _without_token,
    "netem": _decoder(NetemRequest),
    "netem_reply": _decoder(NetemReply),
}
"""The function that decodes the bytes of each network channel for the record."""

UNRECORDED = frozenset(
    {
        "pose",
        "view",
        "video_token",
        "path_token",
        "access_unit",
        "unit_to_decode",
        "agent_action",
        "video_reception",
        "page_opened",
        "page_closed",
        "page_message",
        "page_unit",
        "page_status",
        "watch_opened",
        "watch_closed",
        "watch_message",
        "watch_unit",
        "watch_status",
        "picture_lost",
        "rest",
        "condition_in_force",
        "server_ends",
        "clock_query",
        "clock_report",
        "probe_request",
        "probe_reply",
        "inject",
        "injected",
    }
)
"""Channels that are not recorded: their content is secret, or recorded in another form (truth, access units, inputs of
a person, samples of clocks, network queues and reception)."""


def record(recorder: Recorder, channel: str, payload: Any, now: Now) -> None:
    """Record a message, unless its channel is not recorded."""
    if channel not in UNRECORDED:
        recorder.write(channel, decode_for_record(channel, payload), now)


def decode_for_record(channel: str, payload: Any) -> Any:
    """Return the recorded form of a message: the bytes of a network channel are decoded."""
    decoder = WIRE_DECODERS.get(channel)
    return payload if decoder is None else decoder(payload)


class QueuedRecorder:
    """A recorder with a bounded queue and its own thread, so that no other thread waits for a disk.

    The recorder's thread also decodes network bytes, which saves time in the receiving threads. It polls the queue,
    because to wake it a thousand times a second would cost more than the writing.

    Entries that do not fit into the queue or cannot be written are counted in `overflow`; a run with an overflow is
    invalid.
    """

    def __init__(self, file: RecordFile, capacity: int = 8192, close_timeout_s: float = CLOSE_TIMEOUT_S) -> None:
        self.overflow = 0
        self._file = file
        self._capacity = capacity
        self._close_timeout_s = close_timeout_s
        self._queue: deque[tuple[str, Any, Now]] = deque()
        self._closed = threading.Event()
        self._closed_at = Now(0, 0)
        self._thread = threading.Thread(target=self._run, name="recorder", daemon=True)
        self._thread.start()

    def write(self, topic: str, payload: Any, now: Now) -> None:
        """Queue one entry; count it as lost if the queue is full."""
        if topic in UNRECORDED:
            return
        if len(self._queue) < self._capacity:
            self._queue.append((topic, payload, now))
        else:
            self.overflow += 1

    def close(self, now: Now) -> None:
        """Write the queued entries and the number of lost ones, and complete the record, within `close_timeout_s`."""
        self._closed_at = now
        self._closed.set()
        self._thread.join(self._close_timeout_s)
        if self._thread.is_alive():
            log.error("the record is incomplete: it could not be written within %g s", self._close_timeout_s)

    def _run(self) -> None:
        """Write until closed; a full disk or any other error ends the record, not the drive."""
        try:
            self._write_until_closed()
            self._file.write("counts", Counter(record_overflow=self.overflow), self._closed_at)
            self._file.close()
        except Exception as error:
            log.error("the record ends here, because it cannot be written: %s", error)
            self._capacity = 0
            self.overflow += 1 + len(self._queue)
            self._queue.clear()

    def _write_until_closed(self) -> None:
        is_last = False
        while not is_last:
            is_last = self._closed.wait(POLL_PERIOD_S)
            while self._queue:
                topic, payload, now = self._queue.popleft()
                self._file.write(topic, decode_for_record(topic, payload), now)
