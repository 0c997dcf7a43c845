"""A fast writer of MCAP files (mcap.dev/spec): a side writes hundreds of messages for each second of a drive.

The writer of the package `mcap` takes 10 us for a message, this writer takes 2 us. The package's classes write the
other records (header, schemas, channels, indexes), which are rare, and the tests read the files with the package's
reader. In this module, "record" has MCAP's meaning: one entry of the file, such as a message, a channel or an index.
"""

from __future__ import annotations

import struct
import zlib
from collections import defaultdict
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Final

import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
)

MAGIC: Final = b"\x89MCAP0\r\n"
_MESSAGE: Final = struct.Struct("<BQHIQQ")
"""Opcode, length of the rest, channel, sequence number, log time and publish time of a message; its data follow."""
_MESSAGE_OPCODE: Final = int(Opcode.MESSAGE)
_HEAD_BYTES: Final = 9
"""Length of the head of a record: its opcode, and the length of the content that follows."""
_MESSAGE_FIELDS_BYTES: Final = _MESSAGE.size - _HEAD_BYTES
_MESSAGE_INDEX: Final = struct.Struct("<BQHI")
"""Opcode, length of the rest, channel, and length of the entries of an index; its entries (log time, offset) follow."""
_MESSAGE_INDEX_FIELDS_BYTES: Final = _MESSAGE_INDEX.size - _HEAD_BYTES
_FOOTER_BYTES: Final = 20
"""Length of a footer's content: two offsets and a checksum."""
_COMPRESSION_LEVEL: Final = 1
"""The fastest ordinary level of zstd, which compresses the JSON of a drive to a ninth. Level 3 takes a third longer and
gives the same size."""


class McapFile:
    """An MCAP file that is being written, in independently readable chunks of about `chunk_bytes`."""

    def __init__(self, path: Path, *, library: str, chunk_bytes: int) -> None:
        self._file = path.open("wb")
        self._chunk_bytes = chunk_bytes
        self._compressor = zstandard.ZstdCompressor(level=_COMPRESSION_LEVEL)
        self._schemas: list[Schema] = []
        self._channels: list[Channel] = []
        self._chunk_indexes: list[ChunkIndex] = []
        self._metadata_indexes: list[MetadataIndex] = []
        self._counts: defaultdict[int, int] = defaultdict(int)
        self._sequence = 0
        self._size: int = 0
        self._begin_chunk()
        self._file.write(MAGIC + _bytes(Header(profile="", library=library)))

    @property
    def closed(self) -> bool:
        """Whether the file is finished."""
        return self._file.closed

    def add_schema(self, name: str, encoding: str, data: bytes) -> int:
        """Add a schema and return its id."""
        schema = Schema(id=len(self._schemas) + 1, name=name, encoding=encoding, data=data)
        self._schemas.append(schema)
        self._append(_bytes(schema))
        return schema.id

    def add_channel(self, topic: str, encoding: str, schema_id: int) -> int:
        """Add a channel and return its id."""
        channel_id = len(self._channels) + 1
        channel = Channel(id=channel_id, topic=topic, message_encoding=encoding, metadata={}, schema_id=schema_id)
        self._channels.append(channel)
        self._append(_bytes(channel))
        return channel_id

    def add_messages(self, entries: Iterable[tuple[int, int, int, bytes]]) -> bytes:
        """Add messages, each (channel, log time, publish time, data), and return their uncompressed MCAP records."""
        added: list[bytes] = []
        size, sequence, pack, messages = self._size, self._sequence, _MESSAGE.pack, self._messages
        for channel_id, log_ns, publish_ns, data in entries:
            sequence += 1
            length = _MESSAGE_FIELDS_BYTES + len(data)
            added += (pack(_MESSAGE_OPCODE, length, channel_id, sequence & 0xFFFFFFFF, log_ns, publish_ns), data)
            messages[channel_id] += (log_ns, size)
            size += _HEAD_BYTES + length
        self._size, self._sequence = size, sequence
        written = b"".join(added)
        self._parts.append(written)
        if size > self._chunk_bytes:
            self._finish_chunk()
        return written

    def add_metadata(self, name: str, entries: Mapping[str, str]) -> None:
        """Add named entries that have no time."""
        record = _bytes(Metadata(name=name, metadata=dict(entries)))
        self._metadata_indexes.append(MetadataIndex(offset=self._file.tell(), length=len(record), name=name))
        self._file.write(record)

    def close(self) -> None:
        """Write the last chunk and the indexes, and close the file."""
        self._finish_chunk()
        self._file.write(_bytes(DataEnd(data_section_crc=0)))
        begin = self._file.tell()
        records = [*self._schemas, *self._channels, self._statistics(), *self._chunk_indexes, *self._metadata_indexes]
        summary = b"".join(_bytes(record) for record in records)
        crc = zlib.crc32(summary + struct.pack("<BQQQ", Opcode.FOOTER, _FOOTER_BYTES, begin, 0))
        footer = Footer(summary_start=begin, summary_offset_start=0, summary_crc=crc)
        self._file.write(summary + _bytes(footer) + MAGIC)
        self._file.close()

    def _append(self, record: bytes) -> None:
        self._parts.append(record)
        self._size += len(record)

    def _begin_chunk(self) -> None:
        self._parts: list[bytes] = []
        self._size = 0
        self._messages: defaultdict[int, list[int]] = defaultdict(list)
        """For each channel, a flat list: log time and offset of the first message, of the second, and so on."""

    def _finish_chunk(self) -> None:
        if not self._messages:
            return
        content = b"".join(self._parts)
        first_ns = min(min(entries[::2]) for entries in self._messages.values())
        last_ns = max(max(entries[::2]) for entries in self._messages.values())
        data = self._compressor.compress(content)
        chunk = _bytes(
            Chunk(
                compression="zstd",
                data=data,
                message_start_time=first_ns,
                message_end_time=last_ns,
                uncompressed_crc=zlib.crc32(content),
                uncompressed_size=len(content),
            )
        )
        chunk_begin = self._file.tell()
        indexes_begin = chunk_begin + len(chunk)
        offsets, indexes = {}, b""
        for channel_id, entries in self._messages.items():
            offsets[channel_id] = indexes_begin + len(indexes)
            indexes += _message_index(channel_id, entries)
            self._counts[channel_id] += len(entries) // 2
        self._chunk_indexes.append(
            ChunkIndex(
                chunk_length=len(chunk),
                chunk_start_offset=chunk_begin,
                compression="zstd",
                compressed_size=len(data),
                message_end_time=last_ns,
                message_index_length=len(indexes),
                message_index_offsets=offsets,
                message_start_time=first_ns,
                uncompressed_size=len(content),
            )
        )
        self._file.write(chunk + indexes)
        self._begin_chunk()

    def _statistics(self) -> Statistics:
        chunks = self._chunk_indexes
        return Statistics(
            attachment_count=0,
            channel_count=len(self._channels),
            channel_message_counts=dict(self._counts),
            chunk_count=len(chunks),
            message_count=sum(self._counts.values()),
            message_end_time=max((chunk.message_end_time for chunk in chunks), default=0),
            message_start_time=min((chunk.message_start_time for chunk in chunks), default=0),
            metadata_count=len(self._metadata_indexes),
            schema_count=len(self._schemas),
        )


def _message_index(channel_id: int, entries: list[int]) -> bytes:
    packed = struct.pack(f"<{len(entries)}Q", *entries)
    length = _MESSAGE_INDEX_FIELDS_BYTES + len(packed)
    return _MESSAGE_INDEX.pack(Opcode.MESSAGE_INDEX, length, channel_id, len(packed)) + packed


def _bytes(record: McapRecord) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    return bytes(builder.end())  # type: ignore[no-untyped-call]
