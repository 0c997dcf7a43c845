from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader

from lavt.domain import Lane, Now
from lavt.errors import UserError, WorkError
from lavt.nodes.payloads import VideoUnit
from lavt.recording.json_payload import json_schema, to_json
from lavt.recording.mcap_writer import McapFile
from lavt.recording.record import FORMAT_VERSION, RecordWriter, read_record
from lavt.recording.table import MISSING

WALL_NS = 1_700_000_000_000_000_123
ZSTD = b"\x28\xb5\x2f\xfd"
"""The magic number of compressed data (RFC 8878, section 3.1.1)."""


@dataclass(frozen=True, slots=True)
class Sample:
    """A payload with a field of every kind."""

    number: int
    applied_mono_ns: int | None
    speed_mps: float
    keyframe: bool
    data: bytes
    nested: Lane | None = None


def now(index: int) -> Now:
    return Now(1_000 + index, WALL_NS + index)


def sample(index: int, speed_mps: float = 0.1) -> Sample:
    return Sample(index, WALL_NS if index % 2 else None, speed_mps, index % 2 == 0, b"\x00\xff")


def write_samples(path: Path, count: int) -> None:
    writer = RecordWriter(path, "server")
    for index in range(count):
        writer.write("frame", sample(index), now(index))
    writer.close()


def test_values_are_read_back_exactly(tmp_path: Path) -> None:
    """Integers, floats, booleans, bytes (as base64) and both times are read back exactly as they were written."""
    write_samples(tmp_path / "a.mcap", 4)
    record = read_record(tmp_path / "a.mcap")
    table = record.table("frame")
    assert record.complete
    assert table.columns["number"].dtype == np.int64
    assert table.ints("applied_mono_ns").tolist() == [MISSING, WALL_NS, MISSING, WALL_NS]
    assert table.objects("applied_mono_ns") == [None, WALL_NS, None, WALL_NS]
    assert table.floats("speed_mps").tolist() == [0.1] * 4
    assert table.flags("keyframe").tolist() == [True, False, True, False]
    assert table.texts("data") == ["AP8="] * 4
    assert table.mono_ns.tolist() == [1000, 1001, 1002, 1003]
    assert table.wall_ns.tolist() == [WALL_NS + index for index in range(4)]


def test_a_channel_without_messages_is_empty(tmp_path: Path) -> None:
    """The table of a channel without messages is empty, and so are its columns."""
    write_samples(tmp_path / "a.mcap", 1)
    table = read_record(tmp_path / "a.mcap").table("nothing")
    assert len(table) == 0
    assert table.ints("stamp_ns").tolist() == []


def test_large_integers_are_never_rounded(tmp_path: Path) -> None:
    """A column of integers that do not fit into 64 bits keeps every digit, as objects."""
    writer = RecordWriter(tmp_path / "a.mcap", "server")
    for index, number in enumerate((WALL_NS, 2**64)):
        writer.write("counts", {"number": number}, now(index))
    writer.close()
    assert read_record(tmp_path / "a.mcap").table("counts").objects("number") == [WALL_NS, 2**64]


def test_a_float_beyond_64_bits_is_missing_as_an_integer(tmp_path: Path) -> None:
    """In a column of integers a float beyond 64 bits is read as `MISSING`, without a warning."""
    writer = RecordWriter(tmp_path / "a.mcap", "server")
    for index, number in enumerate((1e308, -(2.0**63), 5.0)):
        writer.write("counts", {"number": number}, now(index))
    writer.close()
    assert read_record(tmp_path / "a.mcap").table("counts").ints("number").tolist() == [MISSING, MISSING, 5]


def test_not_a_number_becomes_null(tmp_path: Path) -> None:
    """NaN and infinity, which JSON cannot represent, are written as null and read as NaN."""
    assert json.loads(to_json({"a": float("nan"), "b": [float("inf"), 1.5]})) == {"a": None, "b": [None, 1.5]}
    writer = RecordWriter(tmp_path / "a.mcap", "server")
    writer.write("frame", sample(0, float("nan")), now(0))
    writer.write("frame", sample(1, 2.5), now(1))
    writer.close()
    speed_mps = read_record(tmp_path / "a.mcap").table("frame").floats("speed_mps")
    assert np.isnan(speed_mps[0])
    assert speed_mps[1] == 2.5


def test_a_step_of_the_wall_clock_does_not_reorder_messages(tmp_path: Path) -> None:
    """Messages are read in the order in which they were written, even if the wall clock was set back between them."""
    writer = RecordWriter(tmp_path / "a.mcap", "client")
    for index, wall_ns in enumerate((5_000, 6_000, 1_000)):
        writer.write("clock", {"number": index}, Now(index, wall_ns))
    writer.close()
    assert read_record(tmp_path / "a.mcap").table("clock").ints("number").tolist() == [0, 1, 2]


@pytest.mark.parametrize("kept_share", [0.3, 0.7, 0.999])
def test_an_unfinished_file_is_recovered(tmp_path: Path, kept_share: float) -> None:
    """From a file that was cut anywhere, all messages of its whole chunks are read, and `complete` is False."""
    path = tmp_path / "a.mcap"
    writer = RecordWriter(path, "server")
    noise = np.random.Generator(np.random.Philox(1))
    for index in range(2_000):
        writer.write("frame", {"number": index, "noise": noise.bytes(150)}, now(index))
    writer.close()
    whole = path.read_bytes()
    path.write_bytes(whole[: int(len(whole) * kept_share)])
    record = read_record(path)
    numbers = record.table("frame").ints("number").tolist()
    assert not record.complete
    assert numbers == list(range(len(numbers)))
    assert len(numbers) > 2_000 * kept_share - 600, "the messages of at most one chunk, fewer than 600, are lost"


def test_a_file_that_was_never_closed_is_recovered(tmp_path: Path) -> None:
    """The record of a process that died can be read up to the last whole chunk."""
    path = tmp_path / "a.mcap"
    writer = RecordWriter(path, "server")
    for index in range(3_000):
        writer.write("frame", sample(index), now(index))
    record = read_record(path)
    writer.close()
    assert not record.complete
    assert 1_500 < len(record.table("frame")) < 3_000


def test_damage_is_detected(tmp_path: Path) -> None:
    """A record with a flipped byte in a chunk is read up to that chunk, and `complete` is False."""
    path = tmp_path / "a.mcap"
    write_samples(path, 3_000)
    content = bytearray(path.read_bytes())
    chunk = content.index(ZSTD, content.index(ZSTD) + 1)
    content[chunk + 1_000] ^= 0xFF
    path.write_bytes(bytes(content))
    record = read_record(path)
    assert not record.complete
    assert len(record.table("frame")) < 3_000


def test_a_missing_record_is_an_error(tmp_path: Path) -> None:
    """Reading a missing record is an error that names the file."""
    with pytest.raises(WorkError, match=r"server\.mcap"):
        read_record(tmp_path / "server.mcap")


@pytest.mark.parametrize("version", [None, "1", "3"])
@pytest.mark.parametrize("complete", [True, False])
def test_another_format_version_is_an_error(tmp_path: Path, version: str | None, complete: bool) -> None:
    """A record of another format version, or without one, is an error of one sentence that names both versions."""
    path = tmp_path / "server.mcap"
    file = McapFile(path, library="lavt server", chunk_bytes=0)
    if version is not None:
        file.add_metadata("format", {"version": version})
    channel = file.add_channel("/event", "json", file.add_schema("object", "jsonschema", b"{}"))
    file.add_messages([(channel, 1, 1, b"{}")])
    file.close()
    if not complete:
        path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(UserError, match=rf"server\.mcap.*version {version or 1}.*version {FORMAT_VERSION}") as error:
        read_record(path)
    assert "\n" not in str(error.value)


def test_a_record_has_its_format_version(tmp_path: Path) -> None:
    """The format version is in the metadata of a record, also before its writer has finished the file."""
    writer = RecordWriter(tmp_path / "a.mcap", "server")
    for index in range(3_000):
        writer.write("frame", sample(index), now(index))
    assert read_record(tmp_path / "a.mcap").annotations["format"] == {"version": str(FORMAT_VERSION)}
    writer.close()


def test_an_empty_file_is_an_empty_record(tmp_path: Path) -> None:
    """A file that was cut before its first message is read as an incomplete record without messages."""
    (tmp_path / "a.mcap").write_bytes(b"")
    record = read_record(tmp_path / "a.mcap")
    assert not record.complete
    assert not record.tables


def test_video_is_recorded_for_players(tmp_path: Path) -> None:
    """Access units are read back byte for byte with their stamps, and have the schema that players know."""
    path = tmp_path / "a.mcap"
    writer = RecordWriter(path, "server")
    units = [(WALL_NS + index, bytes([0, 0, 0, 1, index])) for index in range(3)]
    for index, (stamp_ns, data) in enumerate(units):
        writer.write("video", VideoUnit(stamp_ns, data), now(index))
    writer.close()
    record = read_record(path)
    assert record.video() == units
    assert "video" not in record.tables
    with path.open("rb") as stream:
        schema, channel, message = next(make_reader(stream).iter_messages())
    assert schema is not None
    assert (schema.name, schema.encoding, channel.topic) == ("foxglove.CompressedVideo", "jsonschema", "/video")
    assert json.loads(message.data)["format"] == "h264"


def test_other_readers_can_seek(tmp_path: Path) -> None:
    """The file has the counts and indexes with which other readers find the messages of a topic."""
    path = tmp_path / "a.mcap"
    write_samples(path, 3_000)
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        summary = reader.get_summary()
        assert summary is not None
        assert summary.statistics is not None
        assert summary.statistics.message_count == 3_000
        assert len(summary.chunk_indexes) > 1
        found = [json.loads(message.data)["number"] for _, _, message in reader.iter_messages(topics="/frame")]
        assert found == list(range(3_000))


def test_schemas_describe_the_payload() -> None:
    """The JSON Schema of a dataclass has its fields, allows null for optional ones, and gives the encoding of bytes."""
    schema = json.loads(json_schema(Sample))
    assert set(schema["properties"]) == {"number", "applied_mono_ns", "speed_mps", "keyframe", "data", "nested"}
    assert schema["properties"]["data"] == {"type": "string", "contentEncoding": "base64"}
    assert {"type": "null"} in schema["properties"]["applied_mono_ns"]["anyOf"]
    assert json.loads(json_schema(dict)) == {"type": "object"}


def test_the_digest_covers_content_and_order(tmp_path: Path) -> None:
    """Equal messages on both sides have equal digests; another order, time, side or value changes the digest."""

    def digest(order: list[int], shift_ns: int = 0, side_of_last: str = "client", note: str = "") -> str:
        sha = hashlib.sha256()
        writers = {
            "server": RecordWriter(tmp_path / "server.mcap", "server", sha),
            "client": RecordWriter(tmp_path / "client.mcap", "client", sha),
        }
        for index in order:
            writers["server"].write("frame", sample(index), now(index))
        writers[side_of_last].write("picture", {"number": 1}, Now(5 + shift_ns, WALL_NS))
        for writer in writers.values():
            writer.annotate("machine", {"note": note})
            writer.close()
        return sha.hexdigest()

    first = digest([0, 1])
    assert digest([0, 1], note="another machine") == first
    assert len({first, digest([1, 0]), digest([0, 1], 1), digest([0, 1], 0, "server"), digest([0, 2])}) == 5


def test_annotations_are_read_back(tmp_path: Path) -> None:
    """Annotations, such as versions, are read back as they were written."""
    writer = RecordWriter(tmp_path / "a.mcap", "server")
    writer.annotate("versions", {"lavt": "0.1.0"})
    writer.close()
    assert read_record(tmp_path / "a.mcap").annotations["versions"] == {"lavt": "0.1.0"}


@given(
    st.dictionaries(
        st.text(max_size=8),
        st.none() | st.booleans() | st.integers(-(2**63), 2**63 - 1) | st.floats(allow_nan=False, allow_infinity=False),
        max_size=6,
    )
)
def test_json_preserves_any_payload(payload: dict[str, object]) -> None:
    """Any payload of finite numbers and texts is equal to its parsed JSON."""
    assert json.loads(to_json(payload)) == payload
