"""What of the messages in and out goes into the record, and the queue in front of it."""

from __future__ import annotations

import logging
import threading
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import replace
from typing import Any, Protocol

from lavt.domain import Command, NetemReply, NetemRequest, Now, SessionReply, SessionRequest, State
from lavt.errors import BadMessage
from lavt.transport.messages import decode
from lavt.value import value

log = logging.getLogger(__name__)

LOOK_PERIOD_S = 0.02


class Recorder(Protocol):
    """Something that keeps a record."""

    def write(self, topic: str, payload: Any, now: Now) -> None:
        """Write one entry."""
        ...


def _decoded(kind: type[Any]) -> Callable[[bytes], object]:
    def read(data: bytes) -> object:
        try:
            return decode(kind, data)
        except BadMessage:
            return {"unreadable": data[:64].hex(), "size_bytes": len(data)}

    return read


def _without_token(data: bytes) -> object:
    """The token opens the path of the video; it is not for the record."""
    reply = _decoded(SessionReply)(data)
    return replace(reply, token=b"") if isinstance(reply, SessionReply) else reply


@value
class Packet:
    """A datagram of the video; sequence and timestamp where it is RTP (RFC 3550, section 5.1)."""

    sequence: int | None
    timestamp: int | None
    size_bytes: int


def _packet(data: bytes) -> Packet:
    if len(data) < 12 or data[0] >> 6 != 2:
        return Packet(None, None, len(data))
    return Packet(int.from_bytes(data[2:4], "big"), int.from_bytes(data[4:8], "big"), len(data))


def _size(data: bytes) -> object:
    return {"size_bytes": len(data)}


WIRE: dict[str, Callable[[bytes], object]] = {
    "rtp": _packet,
    "feedback": _size,
    "control": _decoded(Command),
    "state": _decoded(State),
    "session": _decoded(SessionRequest),
    "session_reply": _without_token,
    "netem": _decoded(NetemRequest),
    "netem_reply": _decoded(NetemReply),
}
"""How the bytes of a channel that crosses the network are written down."""

UNRECORDED = frozenset(
    {
        "pose", "view", "video_token", "path_token", "access_unit", "picture_lost", "rest", "condition_in_force",
        "server_ends", "clock_query", "clock_report", "probe_request", "probe_reply", "inject", "injected",
    }
)  # fmt: skip
"""Written down elsewhere (the truth, the pictures' units, samples of clocks and queues, exchanges), or secret."""


def record(recorder: Recorder, channel: str, payload: Any, now: Now) -> None:
    """Write down a message, if it belongs into the record."""
    if channel not in UNRECORDED:
        recorder.write(channel, as_written(channel, payload), now)


def as_written(channel: str, payload: Any) -> Any:
    """Give a message as it is written down: what is bytes on the network in fields."""
    read = WIRE.get(channel)
    return payload if read is None else read(payload)


class QueuedRecorder:
    """A recorder behind a bounded queue and a thread of its own, so that no node ever waits for a disk.

    Bytes of the network are taken apart in that thread too: the threads that receive them have better to do. It looks
    into the queue from time to time and is never woken: a thousand times a second would cost more than the writing.

    What does not fit, or cannot be written, is counted in `overflow`; a run with an overflow is invalid.
    """

    def __init__(self, recorder: Recorder, capacity: int = 8192) -> None:
        self.overflow = 0
        self.failed = False
        """Whether the record has ended because it could not be written."""
        self._recorder = recorder
        self._capacity = capacity
        self._queue: deque[tuple[str, Any, Now]] = deque()
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._drain, name="recorder", daemon=True)
        self._thread.start()

    def write(self, topic: str, payload: Any, now: Now) -> None:
        """Queue one entry, or count it as lost."""
        if topic in UNRECORDED:
            return
        if len(self._queue) < self._capacity:
            self._queue.append((topic, payload, now))
        else:
            self.overflow += 1

    def close(self, now: Now) -> None:
        """Write what is queued, and how much was lost."""
        self._closed.set()
        self._thread.join()
        if not self.failed:
            self._recorder.write("counts", Counter(record_overflow=self.overflow), now)

    def _drain(self) -> None:
        last = False
        while not last:
            last = self._closed.wait(LOOK_PERIOD_S)
            while self._queue:
                self._write(*self._queue.popleft())

    def _write(self, topic: str, payload: Any, now: Now) -> None:
        if self.failed:
            self.overflow += 1
            return
        try:
            self._recorder.write(topic, as_written(topic, payload), now)
        except Exception as error:  # a full disk, or whatever it is, ends the record and not the drive
            log.error("the record ends here, it cannot be written: %s", error)
            self.failed = True
            self.overflow += 1
