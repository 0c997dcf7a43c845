"""docs/records.md lists the channels and fields that are recorded."""

from __future__ import annotations

import re
import struct
import types
import zlib
from collections import defaultdict
from pathlib import Path
from typing import Any, get_args, get_type_hints

import pytest
import zstandard
from msgspec import Struct, json, structs

from lavt.channels import CHANNELS
from lavt.config import RunConfig
from lavt.config_file import load_config, shipped
from lavt.domain import (
    NS_PER_S,
    Command,
    GroundTruth,
    Lane,
    NetemReply,
    NetemRequest,
    SessionReply,
    SessionRequest,
    State,
)
from lavt.experiment.runs.plan import plan_run
from lavt.experiment.runs.virtual_run import build_loop, drive
from lavt.nodes.payloads import (
    Admission,
    AtWheel,
    Event,
    FrameWritten,
    HumanSample,
    InjectionSample,
    LaneSeen,
    PagePicture,
    PictureRead,
    RelayDelay,
    Route,
    SpeedLimitSample,
)
from lavt.runtime.pipeline import Timeline
from lavt.runtime.recorder import UNRECORDED, Packet
from lavt.transport.clock_sync.clock_report import ClockReport
from lavt.transport.clock_sync.probe import ClockProbe
from lavt.transport.rtp.reception_stats import ReceptionSample

PAGE = (Path(__file__).parents[2] / "docs/records.md").read_text()
ON_THE_WIRE: dict[str, type[Struct]] = {
    "control": Command,
    "state": State,
    "session": SessionRequest,
    "session_reply": SessionReply,
    "netem": NetemRequest,
    "netem_reply": NetemReply,
}
"""The channels whose fields are in docs/wire.md."""
PAYLOADS: dict[str, type[Struct]] = {
    "frame": FrameWritten,
    "picture": PictureRead,
    "admission": Admission,
    "wheel": AtWheel,
    "speed_limit": SpeedLimitSample,
    "truth": GroundTruth,
    "route": Route,
    "event": Event,
    "lane": LaneSeen,
    "human_input": HumanSample,
    "page_picture": PagePicture,
    "relay_delay": RelayDelay,
    "clock": ClockReport,
    "clock_probe": ClockProbe,
    "timeline": Timeline,
    "injection": InjectionSample,
    "reception": ReceptionSample,
    "rtp": Packet,
}
"""The channels whose fields are in a table of the page."""
IN_WORDS = {"video", "feedback", "counts"}
"""The channels whose fields are in the table of channels."""
JSON_TYPES = {int: "integer", float: "number", str: "text", bool: "boolean", types.NoneType: "null", Lane: "object"}


def json_type(annotation: Any) -> str:
    """Return the JSON type of a field as the page writes it."""
    if isinstance(annotation, types.UnionType):
        return " or ".join(json_type(part) for part in get_args(annotation))
    return JSON_TYPES.get(annotation, "array")


def read_messages(path: Path) -> dict[str, list[dict[str, Any]]]:
    """Read a record as the page describes it, without the package `mcap`."""
    data, topics = path.read_bytes(), {}
    messages: dict[str, list[dict[str, Any]]] = defaultdict(list)

    def handle(records: bytes) -> None:
        at = 0
        while at < len(records):
            opcode, length = struct.unpack_from("<BQ", records, at)
            body = records[at + 9 : at + 9 + length]
            at += 9 + length
            if opcode == 6:
                (size, crc), name_bytes = struct.unpack_from("<QI", body, 16), int.from_bytes(body[28:32], "little")
                content = zstandard.ZstdDecompressor().decompress(body[40 + name_bytes :], max_output_size=size)
                assert (body[32 : 32 + name_bytes], zlib.crc32(content)) == (b"zstd", crc)
                handle(content)
            elif opcode == 4:
                topic_bytes = int.from_bytes(body[4:8], "little")
                topics[int.from_bytes(body[:2], "little")] = body[8 : 8 + topic_bytes].decode()
            elif opcode == 5:
                messages[topics[int.from_bytes(body[:2], "little")]].append(json.decode(body[22:]))
            elif opcode == 15:  # the end of the data; indexes follow
                return

    assert data[:8] == data[-8:] == b"\x89MCAP0\r\n"
    handle(data[8:-8])
    return messages


def test_every_recorded_channel_is_documented() -> None:
    """The table of channels has every channel that a node's message can be recorded on, and no other."""
    table = PAGE.partition("## Channels")[2].partition("\n## ")[0]
    of_nodes = {name for name, channel in CHANNELS.items() if channel.sender != "operator"}
    assert set(re.findall(r"^\| `(\w+)` \|", table, re.MULTILINE)) == of_nodes - UNRECORDED
    assert of_nodes - UNRECORDED == {*ON_THE_WIRE, *PAYLOADS, *IN_WORDS}


@pytest.mark.parametrize("channel", PAYLOADS)
def test_the_fields_of_each_channel_are_documented(channel: str) -> None:
    """The page has each field of the channel, in its order, with its JSON type and its meaning."""
    hints = get_type_hints(PAYLOADS[channel])
    expected = [[f"`{field.name}`", json_type(hints[field.name])] for field in structs.fields(PAYLOADS[channel])]
    table = PAGE.partition(f"\n| {channel} |")[2].partition("\n\n")[0]
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in table.splitlines() if line.startswith("| ")]
    assert [row[:2] for row in rows] == expected, "\n".join(f"| {' | '.join(row)} | |" for row in expected)
    assert all(row[2] for row in rows)


def test_the_records_of_a_run_have_the_documented_fields(tmp_path: Path) -> None:
    """A reader of MCAP as the page describes it finds the documented channels and fields in the records of a run."""
    (tmp_path / "run").mkdir()
    run = plan_run(load_config(RunConfig, shipped("configs/demo.yaml"), ("fidelity=geometry",)))
    drive(build_loop(run, tmp_path / "run"), limit_ns=3 * NS_PER_S)
    for side in ("server", "client"):
        messages = read_messages(tmp_path / "run" / f"{side}.mcap")
        assert messages.keys() >= {"/clock", "/timeline", "/session", "/frame" if side == "server" else "/picture"}
        for topic, payloads in messages.items():
            kind = {**PAYLOADS, **ON_THE_WIRE}.get(topic.removeprefix("/"))
            if kind is not None:
                names = {field.name for field in structs.fields(kind)}
                assert all(payload.keys() == names for payload in payloads), topic
