"""Records of a run: one MCAP file a side, everything that went in and out, in the order it happened.

A message's log time is the host's wall clock, its publish time the host's monotonic clock. A step of the wall clock
must not put messages in another order, so readers go by their order in the file. Formats: MCAP (mcap.dev/spec), JSON
with JSON Schema; the video is `foxglove.CompressedVideo`, which Foxglove and others play.
"""

from __future__ import annotations

import base64
import json
from collections import defaultdict
from collections.abc import Callable, Container, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Protocol

from pydantic_core import from_json

from lavt.domain import NS_PER_S, Now
from lavt.errors import WorkError
from lavt.recording.json_payload import json_schema, writer_of
from lavt.recording.mcap_reader import Messages, read_mcap
from lavt.recording.mcap_writer import McapFile
from lavt.recording.table import EMPTY, Table, table_of

CHUNK_BYTES = 64 * 1024
"""What a crash can cost at most: only whole chunks can be read again."""

KEPT_MESSAGES = 64
"""And so many before them, a tenth of a second of a drive."""

VIDEO = "video"
"""The channel of access units; its payload has `stamp_ns` and `data`."""

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
    """What the writers need of a digest, as in `hashlib`."""

    def update(self, data: bytes, /) -> None:
        """Add bytes."""
        ...


class RecordWriter:
    """Writes the record of one side.

    `digest`, where there is one, gets every message: side, channel, both times, length and JSON. Both sides of a
    run in virtual time share one, so it also holds the order between them. What `annotate` writes stays out of it, and
    so do the channels `left_out`, which are not recorded.
    """

    def __init__(
        self, path: Path, side: Side, digest: Digest | None = None, *, left_out: Container[str] = frozenset()
    ) -> None:
        self._side = side
        self._left_out = left_out
        self._digest = digest
        self._mcap = McapFile(path, library=f"lavt {side}", chunk_bytes=CHUNK_BYTES)
        self._channels: dict[str, dict[type, tuple[int, Callable[[Any], bytes]]]] = defaultdict(dict)
        """For each channel and type of payload its number, and what makes JSON of it."""
        self._schemas: dict[type, int] = {}
        self._kept: list[tuple[str, Any, Now]] = []

    def write(self, channel: str, payload: Any, now: Now) -> None:
        """Write one message, soon: a dataclass or a dict that nobody changes, on the topic "/" + `channel`.

        Raises `TypeError` for values that JSON has no words for, when it comes to them.
        """
        self._kept.append((channel, payload, now))
        if len(self._kept) >= KEPT_MESSAGES:
            self._write_kept()

    def _write_kept(self) -> None:
        kept, self._kept = self._kept, []
        entries = []
        for channel, payload, now in kept:
            if channel in self._left_out:
                continue
            kind = type(payload)
            channel_id, to_bytes = self._channels[channel].get(kind) or self._register(channel, kind)
            entries.append((channel_id, now.wall_ns, now.mono_ns, to_bytes(payload)))
        written = self._mcap.add_messages(entries)
        if self._digest is not None:
            self._digest.update(self._side.encode() + written)

    def annotate(self, name: str, entries: Mapping[str, str]) -> None:
        """Write what belongs to this machine and not to the run's result: versions, the machine itself."""
        self._mcap.add_metadata(name, entries)

    def close(self) -> None:
        """Finish the file; a file without this can still be read, but says that it is not complete."""
        if not self._mcap.closed:
            self._write_kept()
            self._mcap.close()

    def _register(self, channel: str, payload_type: type) -> tuple[int, Callable[[Any], bytes]]:
        """Add the channel of a payload type; the second type of a channel becomes a second channel of its topic."""
        if channel == VIDEO:
            schema_id = self._mcap.add_schema(_VIDEO_SCHEMA_NAME, "jsonschema", json.dumps(_VIDEO_SCHEMA).encode())
        else:
            if payload_type not in self._schemas:
                name = "object" if payload_type is dict else f"lavt.{payload_type.__name__}"
                schema = json_schema(payload_type)
                self._schemas[payload_type] = self._mcap.add_schema(name, "jsonschema", schema)
            schema_id = self._schemas[payload_type]
        channel_id = self._mcap.add_channel("/" + channel, "json", schema_id)
        self._channels[channel][payload_type] = channel_id, _video_json if channel == VIDEO else writer_of(payload_type)
        if self._digest is not None:
            self._digest.update(f"{self._side} {channel} is {channel_id}\n".encode())
        return self._channels[channel][payload_type]


def _video_json(payload: Any) -> bytes:
    stamp_ns, unit = (
        (payload["stamp_ns"], payload["data"]) if isinstance(payload, dict) else (payload.stamp_ns, payload.data)
    )
    seconds, nanoseconds = divmod(stamp_ns, NS_PER_S)
    text = base64.b64encode(unit).decode("ascii")
    # Written by hand: base64 needs no escaping, and this is by far the largest message.
    return (
        f'{{"timestamp":{{"sec":{seconds},"nsec":{nanoseconds}}},"frame_id":"camera","data":"{text}","format":"h264"}}'
    ).encode()


class _Tables(Mapping[str, Table]):
    """Tables of a record's channels, each made when it is first asked for: half of them nobody looks at."""

    def __init__(self, messages: Mapping[str, Messages]) -> None:
        self._messages = messages
        self._made: dict[str, Table] = {}

    def __getitem__(self, channel: str) -> Table:
        if channel not in self._made:
            messages = self._messages[channel]
            rows = from_json(b"[" + b",".join(messages.data) + b"]")
            self._made[channel] = table_of(rows, messages.publish_ns, messages.log_ns)
        return self._made[channel]

    def __iter__(self) -> Iterator[str]:
        return iter(self._messages)

    def __len__(self) -> int:
        return len(self._messages)


@dataclass(frozen=True, slots=True)
class Record:
    """One side's record, read back.

    `complete` is False for a file that was never finished, or is damaged: then it holds what came before. `last_ns` is
    when the last message was recorded, on the host's monotonic clock; 0 of nothing.
    """

    path: Path
    complete: bool
    tables: Mapping[str, Table]
    annotations: Mapping[str, Mapping[str, str]]
    last_ns: int

    def table(self, channel: str) -> Table:
        """Give the messages of a channel; no rows where nothing was recorded."""
        return self.tables.get(channel, EMPTY)

    def video(self) -> list[tuple[int, bytes]]:
        """Read the access units and the stamp (ns) of each from the file; they are too large to be kept."""
        units = []
        for data in read_mcap(self.path, lambda topic: topic == "/" + VIDEO).topics.get("/" + VIDEO, Messages()).data:
            fields = from_json(data)
            stamp_ns = fields["timestamp"]["sec"] * NS_PER_S + fields["timestamp"]["nsec"]
            units.append((stamp_ns, base64.b64decode(fields["data"])))
        return units


def read_record(path: Path, channels: Container[str] | None = None) -> Record:
    """Read the record at `path` into tables, without the video; `channels` names the only ones wanted.

    An unfinished file (a crash, a full disk) gives all its whole chunks. Raises `WorkError` where there is no file.
    """
    if not path.is_file():
        raise WorkError(f"there is no record at {path}")

    def wanted(topic: str) -> bool:
        channel = topic.removeprefix("/")
        return channel != VIDEO and (channels is None or channel in channels)

    content = read_mcap(path, wanted)
    messages = {topic.removeprefix("/"): each for topic, each in content.topics.items() if each.data}
    last_ns = max((max(each.publish_ns) for each in messages.values()), default=0)
    return Record(path, content.complete, _Tables(messages), content.metadata, last_ns)
