"""Records of runs: one MCAP file per side with all inputs and outputs of that side, in the order of their occurrence.

A message's log time is the host's wall clock, its publish time the host's monotonic clock. Readers keep the order of
the file, so that a step of the wall clock does not reorder messages. Formats: MCAP (mcap.dev/spec), JSON with JSON
Schema. The video is `foxglove.CompressedVideo`, which Foxglove and other programs play.
"""

from __future__ import annotations

import base64
import json
from collections import defaultdict
from collections.abc import Callable, Container, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Protocol

from pydantic_core import from_json

from lavt.domain import NS_PER_S, Now
from lavt.errors import UserError, WorkError, describe_error
from lavt.recording.json_payload import json_schema, to_json
from lavt.recording.mcap_reader import McapContent, Messages, read_mcap
from lavt.recording.mcap_writer import McapFile
from lavt.recording.table import EMPTY, Table, table_of

FORMAT_VERSION = 2
"""The version of the channels and their fields, in the metadata `format`. Records without this entry have version 1."""

CHUNK_BYTES = 64 * 1024
"""A crash loses at most one unfinished chunk: only whole chunks can be read again."""

BUFFERED_MESSAGES = 64
"""A crash also loses up to this many messages, which are not in a chunk yet: a tenth of a second of a drive."""

VIDEO = "video"
"""The channel of access units; its payload has `stamp_ns` and `data`."""

_FORMAT = "format"

_VIDEO_SCHEMA_NAME = "foxglove.CompressedVideo"
_VIDEO_SCHEMA = {
    "type": "object",
    "title": _VIDEO_SCHEMA_NAME,
    "properties": {
        "timestamp": {
            "type": "object",
            "title": "time",
            "properties": {
                "sec": {"type": "integer", "minimum": 0},
                "nsec": {"type": "integer", "minimum": 0, "maximum": NS_PER_S - 1},
            },
        },
        "frame_id": {"type": "string"},
        "data": {"type": "string", "contentEncoding": "base64"},
        "format": {"type": "string"},
    },
}

Side = Literal["server", "client"]


class Digest(Protocol):
    """A hash object as in `hashlib`, with only the method that the writers call."""

    def update(self, data: bytes, /) -> None:
        """Add bytes."""
        ...


class RecordWriter:
    """A writer of one side's record.

    `digest`, if given, is updated with the side, channel, times, length and JSON of every message. Both sides of a run
    in virtual time share one digest, which therefore also covers the order of messages on different sides. The digest
    does not cover annotations. Channels in `left_out` are neither recorded nor covered by the digest.
    """

    def __init__(
        self, path: Path, side: Side, digest: Digest | None = None, *, left_out: Container[str] = frozenset()
    ) -> None:
        self._side = side
        self._left_out = left_out
        self._digest = digest
        self._mcap = McapFile(path, library=f"lavt {side}", chunk_bytes=CHUNK_BYTES)
        self._mcap.add_metadata(_FORMAT, {"version": str(FORMAT_VERSION)})
        self._channels: dict[str, dict[type, tuple[int, Callable[[Any], bytes]]]] = defaultdict(dict)
        """For each channel and payload type, the id of the MCAP channel and the serializer."""
        self._schemas: dict[type, int] = {}
        self._buffer: list[tuple[str, Any, Now]] = []

    def write(self, channel: str, payload: Any, now: Now) -> None:
        """Buffer one message for the topic "/" + `channel`; its payload must not change afterwards.

        Values that JSON cannot represent raise `TypeError` when the buffer is written: in this call, in a later one or
        in `close`.
        """
        self._buffer.append((channel, payload, now))
        if len(self._buffer) >= BUFFERED_MESSAGES:
            self._flush()

    def _flush(self) -> None:
        buffered, self._buffer = self._buffer, []
        entries = []
        for channel, payload, now in buffered:
            if channel in self._left_out:
                continue
            kind = type(payload)
            channel_id, to_bytes = self._channels[channel].get(kind) or self._register(channel, kind)
            entries.append((channel_id, now.wall_ns, now.mono_ns, to_bytes(payload)))
        written = self._mcap.add_messages(entries)
        if self._digest is not None:
            self._digest.update(self._side.encode() + written)

    def annotate(self, name: str, entries: Mapping[str, str]) -> None:
        """Write metadata that are not results of the run, such as versions or the machine."""
        self._mcap.add_metadata(name, entries)

    def close(self) -> None:
        """Finish the file. Without this call the file can still be read, but its `Record` is not `complete`."""
        if not self._mcap.closed:
            self._flush()
            self._mcap.close()

    def _register(self, channel: str, payload_type: type) -> tuple[int, Callable[[Any], bytes]]:
        """Add an MCAP channel for a payload type; a second type on one topic gets a second MCAP channel."""
        if channel == VIDEO:
            schema_id = self._mcap.add_schema(_VIDEO_SCHEMA_NAME, "jsonschema", json.dumps(_VIDEO_SCHEMA).encode())
        else:
            if payload_type not in self._schemas:
                name = "object" if payload_type is dict else f"lavt.{payload_type.__name__}"
                schema = json_schema(payload_type)
                self._schemas[payload_type] = self._mcap.add_schema(name, "jsonschema", schema)
            schema_id = self._schemas[payload_type]
        channel_id = self._mcap.add_channel("/" + channel, "json", schema_id)
        serialize = _video_json if channel == VIDEO else to_json
        self._channels[channel][payload_type] = channel_id, serialize
        if self._digest is not None:
            self._digest.update(f"{self._side} {channel} is {channel_id}\n".encode())
        return self._channels[channel][payload_type]


def _video_json(payload: Any) -> bytes:
    stamp_ns, unit = (
        (payload["stamp_ns"], payload["data"]) if isinstance(payload, dict) else (payload.stamp_ns, payload.data)
    )
    seconds, nanoseconds = divmod(stamp_ns, NS_PER_S)
    text = base64.b64encode(unit).decode("ascii")
    # Formatted without the module `json`: video is by far the largest message, and base64 needs no escaping.
    return (
        f'{{"timestamp":{{"sec":{seconds},"nsec":{nanoseconds}}},"frame_id":"camera","data":"{text}","format":"h264"}}'
    ).encode()


class _Tables(Mapping[str, Table]):
    """The tables of a record's channels. A table is parsed on first access, because half of them are never read."""

    def __init__(self, messages: Mapping[str, Messages]) -> None:
        self._messages = messages
        self._parsed: dict[str, Table] = {}

    def __getitem__(self, channel: str) -> Table:
        if channel not in self._parsed:
            messages = self._messages[channel]
            rows = from_json(b"[" + b",".join(messages.data) + b"]")
            if len(rows) != len(messages.data) or not all(type(row) is dict for row in rows):
                raise ValueError(f"a message of the channel {channel} is not a JSON object")
            self._parsed[channel] = table_of(rows, messages.publish_ns, messages.log_ns)
        return self._parsed[channel]

    def __iter__(self) -> Iterator[str]:
        return iter(self._messages)

    def __len__(self) -> int:
        return len(self._messages)


@dataclass(frozen=True, slots=True)
class Record:
    """One side's record, read from its file.

    `complete` is False for an unfinished or damaged file, of which only the intact beginning is read. `last_ns` is the
    time of the last message on the host's monotonic clock, or 0 without messages.
    """

    path: Path
    complete: bool
    tables: Mapping[str, Table]
    annotations: Mapping[str, Mapping[str, str]]
    last_ns: int

    def table(self, channel: str) -> Table:
        """Return the messages of a channel; the table is empty if none were recorded."""
        return self.tables.get(channel, EMPTY)

    def video(self) -> list[tuple[int, bytes]]:
        """Read the (stamp in ns, data) of each access unit from the file; `tables` leaves them out, as too large."""
        units = []
        content = read_mcap(self.path, lambda topic: topic == "/" + VIDEO)
        with evaluating(self.path):
            for data in content.topics.get("/" + VIDEO, Messages()).data:
                fields = from_json(data)
                stamp_ns = int(fields["timestamp"]["sec"]) * NS_PER_S + int(fields["timestamp"]["nsec"])
                units.append((stamp_ns, base64.b64decode(fields["data"])))
        return units


@contextmanager
def evaluating(path: Path) -> Iterator[None]:
    """Convert an error of a computation with the records at `path` into a `UserError`.

    Records that another program wrote can have values of a type or range that LAVT does not write, which can cause
    nearly any error. Damage does not get this far: checksums detect it.
    """
    try:
        yield
    except (ArithmeticError, AttributeError, LookupError, MemoryError, RecursionError, TypeError, ValueError) as error:
        reason = " ".join(describe_error(error).split())
        raise UserError(
            f"{path} has records that LAVT cannot evaluate ({reason}): name a run that LAVT recorded"
        ) from error


def read_record(path: Path, channels: Container[str] | None = None) -> Record:
    """Read the record at `path` into tables, without the video; read only `channels`, if given.

    If a crash or a full disk left the file unfinished, all its whole chunks are read. Raises `WorkError` if there is no
    file, and `UserError` for a record in another format version.
    """
    if not path.is_file():
        raise WorkError(f"there is no record at {path}: name the directory of a run")

    def is_wanted(topic: str) -> bool:
        channel = topic.removeprefix("/")
        return channel != VIDEO and (channels is None or channel in channels)

    content = read_mcap(path, is_wanted)
    _check_version(path, content)
    by_channel = {topic.removeprefix("/"): messages for topic, messages in content.topics.items() if messages.data}
    last_ns = max((max(messages.publish_ns) for messages in by_channel.values()), default=0)
    return Record(path, content.complete, _Tables(by_channel), content.metadata, last_ns)


def _check_version(path: Path, content: McapContent) -> None:
    """Raise `UserError` for a record in a format version other than `FORMAT_VERSION`.

    The version is the first entry of a file. A file that was cut before this entry is accepted, and is empty.
    """
    version = content.metadata.get(_FORMAT, {}).get("version")
    if version is None and not content.complete and not content.topics:
        return
    if version != str(FORMAT_VERSION):
        raise UserError(
            f"{path} is a record in format version {version or 1}, and only version {FORMAT_VERSION} can be read: "
            "read it with the LAVT version that wrote it, or repeat the run"
        )
