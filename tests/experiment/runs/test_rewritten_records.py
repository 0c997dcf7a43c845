"""Tests of records that another program has rewritten: file and checksums are valid, but messages are not LAVT's."""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from lavt.errors import UserError
from lavt.experiment.analysis.drive_data import capture_to_stamp_ms, read_drive
from lavt.experiment.analysis.results import IDENTITY_KEYS
from lavt.experiment.runs.run import compute_result
from lavt.recording.mcap_reader import read_mcap
from lavt.recording.mcap_writer import McapFile
from lavt.recording.record import read_record
from lavt.streams import stream

SIDES = ("server", "client")
Rows = list[tuple[int, int, bytes]]
"""The messages of a topic: (log time, publish time, data)."""
Topics = dict[str, dict[str, Rows]]
"""The messages by side and topic."""
VALUES: list[Any] = [None, "", "x", -1, 0, 1, 2**31, 2**63 - 1, -(2**63), 2**63, 10**30, 1e308, -1e308, 0.5, True]
VALUES += [False, [], {}, [[]], [1, 2], [["a", 1]], [[1, "a"]], [[None, None]], [[1e308, 1]], [["a", 10**30]], {"a": 1}]
TEXTS = [
    b"",
    b"{",
    b"1,1",
    b"NaN",
    b"1e999",
    b'{"a":1,"a":2}',
    b"[" * 5000,
    *(json.dumps(value).encode() for value in VALUES),
]
TIMES_NS = [0, 2**63 - 1, 2**63, 2**64 - 1]


@pytest.fixture(scope="module")
def topics(make_run: Callable[..., Path], tmp_path_factory: pytest.TempPathFactory) -> Topics:
    """Return the messages of a short drive."""
    directory = make_run(tmp_path_factory.mktemp("drive"), seconds=2.0, capture_ms=5.0)
    topics_of_sides = {side: read_mcap(directory / f"{side}.mcap", lambda _: True).topics for side in SIDES}
    return {
        side: {
            topic: list(zip(messages.log_ns, messages.publish_ns, messages.data, strict=True))
            for topic, messages in topics.items()
        }
        for side, topics in topics_of_sides.items()
    }


def write(directory: Path, side: str, topics: list[tuple[str, Rows]]) -> None:
    """Write a record as LAVT does, without LAVT's checks."""
    file = McapFile(directory / f"{side}.mcap", library="another program", chunk_bytes=65_536)
    file.add_metadata("format", {"version": "2"})
    schema = file.add_schema("object", "jsonschema", b"{}")
    for topic, rows in topics:
        channel = file.add_channel(topic, "json", schema)
        file.add_messages((channel, log_ns, publish_ns, data) for log_ns, publish_ns, data in rows)
    file.close()


def mutate(rows: Rows, generator: Any) -> Rows:
    """Return the messages with one kind of random change to some or all of them.

    The kinds: a field gets another value; a field becomes null, and another field is added; the whole content is
    replaced; both times are replaced; the message is left out.
    """

    def any_of(values: list[Any]) -> Any:
        return values[generator.integers(len(values))]

    kind = any_of(["value", "value", "value", "null", "content", "times", "left out"])
    _, _, first_data = rows[0]
    names, value, text = list(json.loads(first_data)), any_of(VALUES), any_of(TEXTS)
    name, time_ns, share = any_of(names), any_of(TIMES_NS), any_of([0.01, 0.5, 1.0])
    changed = []
    for log_ns, publish_ns, data in rows:
        fields = json.loads(data)
        if generator.random() > share:
            changed.append((log_ns, publish_ns, data))
        elif kind == "value":
            changed.append((log_ns, publish_ns, json.dumps({**fields, name: value}).encode()))
        elif kind == "null":
            changed.append((log_ns, publish_ns, json.dumps({**fields, name: None, "additional": 1}).encode()))
        elif kind == "content":
            changed.append((log_ns, publish_ns, text))
        elif kind == "times":
            changed.append((time_ns, time_ns, data))
    return changed


def rejection(directory: Path, injection: str) -> str:
    """Evaluate a run as `lavt report` does; return the sentence of the rejection, or "" if the run is not rejected."""
    identity = {**dict.fromkeys(IDENTITY_KEYS), "injection": injection, "inherent": "network", "condition": "L0"}
    identity["injected_ms"] = {"video": 0.0, "control": 0.0}
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of NumPy, about overflow
            read_drive(directory, compute_result(directory, identity, None))
        capture_to_stamp_ms(directory / "server.mcap")
        read_record(directory / "server.mcap", channels=()).video()
    except UserError as error:
        return str(error)
    return ""


def check_mutations(topics: Topics, directory: Path, seed: int, count: int) -> int:
    """Evaluate rewritten records; return how many were rejected."""
    generator, rejected = stream(seed, "rewritten records"), 0
    for _ in range(count):
        for side in SIDES:
            written = list(topics[side].items())
            for _ in range(generator.integers(3)):
                index = int(generator.integers(len(written)))
                topic, rows = written[index]
                rows = mutate(topics[side][topic], generator)
                if generator.random() <= 0.1:
                    topic = written[index - 1][0]  # the messages come on a topic of other messages
                written[index] = topic, rows
            write(directory, side, written)
        sentence = rejection(directory, str(generator.choice(["none", "netem", "relay"])))
        assert "\n" not in sentence
        rejected += sentence != ""
    return rejected


def test_rewritten_records_are_evaluated_or_rejected(topics: Topics, tmp_path: Path) -> None:
    """A record with other types, ranges, fields or topics than LAVT's is evaluated, or rejected with one sentence."""
    assert 3 < check_mutations(topics, tmp_path, seed=1, count=30) < 30


@pytest.mark.full
def test_many_rewritten_records_are_evaluated_or_rejected(topics: Topics, tmp_path: Path) -> None:
    """Each of many random records is evaluated, or rejected with one sentence."""
    assert check_mutations(topics, tmp_path, seed=2, count=500) > 50


@pytest.mark.parametrize(
    ("topic", "data"),
    [
        ("/truth", b'{"mono_ns":1000000000001,"progress_m":1e12,"cross_track_m":0}'),
        ("/event", b'{"kind":"drive_began","mono_ns":9223372036854775808}'),
        ("/event", b"1"),
        ("/event", b'{"kind":"a"},{"kind":"b"}'),
        ("/timeline", b'{"node":"camera","stages":[["capture",1e999]]}'),
        ("/video", b'{"timestamp":[],"data":1}'),
    ],
)
def test_a_wrong_message_is_evaluated_or_rejected(topics: Topics, tmp_path: Path, topic: str, data: bytes) -> None:
    """A record with a wrong message at the end of a channel is evaluated, or rejected with one sentence."""
    for side in SIDES:
        rows = topics[side].get(topic, [])
        last = [(*rows[-1][:2], data)] if rows else []
        write(tmp_path, side, [*topics[side].items(), (topic, last)])
    assert "\n" not in rejection(tmp_path, "none")
