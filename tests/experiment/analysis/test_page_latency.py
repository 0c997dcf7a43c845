"""Tests of the times at which the page of a person who drives had the pictures, on the synthetic drive's two clocks."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from benchmarks.recompute import differences
from benchmarks.recomputing.runs import driving_interval, latencies, read
from tests.experiment.conftest import FRAME_NS, SyntheticDrive

from lavt.domain import NS_PER_MS
from lavt.experiment.analysis.metrics import measure
from lavt.recording.record import Record, read_record
from lavt.recording.table import table_of

MakeRun = Callable[..., Path]
DRIVE = SyntheticDrive()
NO_LATENCY = {"p5": None, "p50": None, "p95": None, "bound": None, "n": 0, "max": None}


def picture(number: int, decoded_ms: float, shown_ms: float, bound_ms: float = 0.1) -> dict[str, Any]:
    """Return a row of `page_picture` for a frame that the page had these times after its stamp."""
    decoded, shown = (
        DRIVE.client(number * FRAME_NS + round(late_ms * NS_PER_MS)).wall_ns for late_ms in (decoded_ms, shown_ms)
    )
    stamp_ns = DRIVE.server(number * FRAME_NS).wall_ns
    times = {"decoded_wall_ns": decoded, "shown_wall_ns": shown}
    return {"stamp_ns": stamp_ns, **times, "bound_ns": round(bound_ms * NS_PER_MS)}


def with_pictures(client: Record, *rows: dict[str, Any]) -> Record:
    return replace(client, tables={**client.tables, "page_picture": table_of(rows, [0] * len(rows), [0] * len(rows))})


@pytest.fixture(scope="module")
def records(make_run: MakeRun, tmp_path_factory: pytest.TempPathFactory) -> tuple[Record, Record]:
    """Return the records of the synthetic drive, whose clocks are 250 ms apart and drift by 20 ppm."""
    directory = make_run(tmp_path_factory.mktemp("run"))
    return read_record(directory / "server.mcap"), read_record(directory / "client.mcap")


def test_the_page_has_known_latencies(records: tuple[Record, Record]) -> None:
    """Percentiles and maximum are those of the page's times on the server's clock; the bound has both clocks' parts."""
    server, client = records
    rows = [picture(number, 70.0 + number, 80.0 + 2 * number) for number in range(20)]
    rows.append(picture(20, 90.0, 200.0, bound_ms=0.7))
    entry = measure(server, with_pictures(client, *rows)).entry
    decoded, shown = entry["page_decoded_ms"], entry["page_shown_ms"]
    expected = {"p5": 71.0, "p50": 80.0, "p95": 89.0, "max": 90.0}
    assert {name: decoded[name] for name in expected} == pytest.approx(expected, abs=1e-3)
    expected = {"p5": 82.0, "p50": 100.0, "p95": 118.0, "max": 200.0}
    assert {name: shown[name] for name in expected} == pytest.approx(expected, abs=1e-3)
    assert decoded["n"] == shown["n"] == 21
    assert decoded["bound"] == shown["bound"] == pytest.approx(entry["delta"]["bound_ms"] + 0.7)


def test_each_frame_of_the_drive_counts_once(records: tuple[Record, Record]) -> None:
    """The first time of each frame counts; frames before the drive, unknown stamps and unknown times do not."""
    server, client = records
    incomplete = {**picture(3, 1.0, 1.0), "shown_wall_ns": None}
    unknown = {**picture(4, 1.0, 1.0), "stamp_ns": 5}
    rows = [picture(1, 60.0, 70.0), picture(-1, 1.0, 1.0), picture(1, 1.0, 1.0), incomplete, unknown]
    entry = measure(server, with_pictures(client, *rows)).entry
    assert (entry["page_decoded_ms"]["n"], entry["page_shown_ms"]["n"]) == (1, 1)
    assert entry["page_decoded_ms"]["max"] == pytest.approx(60.0, abs=1e-3)
    assert entry["page_shown_ms"]["max"] == pytest.approx(70.0, abs=1e-3)


def test_without_a_person_the_latencies_of_the_page_are_null(records: tuple[Record, Record]) -> None:
    """Without pictures in a page, or without the clock offset, the page has no latencies."""
    server, client = records
    assert measure(server, client).entry["page_shown_ms"] == NO_LATENCY
    unsampled = {name: table for name, table in client.tables.items() if not name.startswith("clock")}
    without_offset = with_pictures(replace(client, tables=unsampled), picture(1, 60.0, 70.0))
    entry = measure(server, without_offset).entry
    assert (entry["delta"]["ms"], entry["page_decoded_ms"]) == (None, NO_LATENCY)


def test_the_latencies_of_a_page_are_recomputed(make_run: MakeRun, tmp_path: Path) -> None:
    """`benchmarks/recompute.py` computes the same: of each frame of the drive, the first row with all times counts."""
    directory = make_run(tmp_path / "run")
    server, client = read_record(directory / "server.mcap"), read_record(directory / "client.mcap")
    rows = [picture(number, 70.0 + number**2 / 10, 90.0 + number) for number in range(30)]
    rows += [picture(3, 500.0, 500.0), {**picture(31, 1.0, 1.0), "shown_wall_ns": None}, picture(-50, 300.0, 400.0)]
    published = measure(server, with_pictures(client, *rows)).entry
    server_rows, client_rows = read(directory, "server"), read(directory, "client")
    client_rows["page_picture"] = rows
    recomputed = latencies(server_rows, client_rows, driving_interval(server_rows)[:2])
    names = ("page_decoded_ms", "page_shown_ms")
    assert [recomputed[name]["n"] for name in names] == [30, 30]
    for name in names:
        assert list(differences(name, recomputed[name], published[name])) == []
    assert list(differences("max", recomputed["page_shown_ms"]["max"], published["page_shown_ms"]["max"] + 1e-6))
