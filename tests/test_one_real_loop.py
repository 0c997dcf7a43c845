"""A drive in real time with Zenoh routers, UDP, H.264, the relay and a process per side; lateness fails no test."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from lavt.config import RunConfig
from lavt.config_file import load_config, shipped
from lavt.experiment.runs.plan import plan_run
from lavt.experiment.runs.run import run_once
from lavt.recording.record import Record, read_record

VIDEO_MS, CONTROL_MS = 75.0, 40.0
CHANGES = (
    "time=real",
    "vehicle.scenery=none",
    "vehicle.time_limit_s=4",
    f"network.video.delay_ms={VIDEO_MS}",
    f"network.control.delay_ms={CONTROL_MS}",
)


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Drive for some seconds; return the output directory."""
    directory = tmp_path_factory.mktemp("real") / "run"
    run_once(plan_run(load_config(RunConfig, shipped("configs/demo.yaml"), CHANGES)), directory)
    return directory


@pytest.fixture(scope="module")
def records(out: Path) -> tuple[Record, Record]:
    """Return the records of server and client."""
    return read_record(out / "server.mcap"), read_record(out / "client.mcap")


def test_pictures_arrive_and_commands_are_accepted(records: tuple[Record, Record]) -> None:
    """The client reads the stamps in the vehicle's pictures, and the vehicle accepts commands made from them."""
    server, client = records
    tables = (server.table("frame"), client.table("picture"))
    sent_stamps, read_stamps = (set(table.ints("stamp_ns").tolist()) for table in tables)
    assert len(sent_stamps & read_stamps) > 30
    admissions = server.table("admission")
    accepted_stamps = {
        stamp_ns
        for stamp_ns, verdict in zip(admissions.ints("stamp_ns").tolist(), admissions.texts("verdict"), strict=True)
        if verdict == "accepted"
    }
    assert len(accepted_stamps) > 10
    assert accepted_stamps <= sent_stamps & read_stamps


def test_the_car_moved(records: tuple[Record, Record]) -> None:
    """The drive begins, the car moves along its route, and both records are complete."""
    server, client = records
    assert "drive_began" in server.table("event").texts("kind")
    assert max(server.table("truth").floats("progress_m")) > 1.0
    assert server.complete
    assert client.complete


def test_nothing_arrives_before_its_delay(out: Path, records: tuple[Record, Record]) -> None:
    """Pictures and commands take at least as long as the injected delays."""
    result: dict[str, Any] = json.loads((out / "result.json").read_text())
    assert result["injected_ms"] == {"video": VIDEO_MS, "control": CONTROL_MS}
    server, client = records
    pictures = client.table("picture")
    latency_ns = (pictures.ints("read_wall_ns") - pictures.ints("stamp_ns"))[pictures.ints("stamp_ns") > 0]
    assert latency_ns.min() >= VIDEO_MS * 1e6
    admissions = server.table("admission")
    assert (admissions.ints("received_wall_ns") - admissions.ints("sent_wall_ns")).min() >= CONTROL_MS * 1e6
