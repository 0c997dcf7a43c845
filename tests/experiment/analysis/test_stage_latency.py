from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from lavt.experiment.analysis.latency import ages_at_actuation_ns
from lavt.experiment.analysis.metrics import measure
from lavt.recording.record import read_record
from lavt.recording.table import table_of

MakeRun = Callable[..., Path]


def test_stage_latencies_in_pipeline_order(make_run: MakeRun, tmp_path: Path) -> None:
    """A stage has its recorded duration; the video link has tau_v minus the times in the camera and the client."""
    make_run(tmp_path)
    entry = measure(read_record(tmp_path / "server.mcap"), read_record(tmp_path / "client.mcap")).entry
    stages = {(stage["node"], stage["stage"]): stage for stage in entry["stages_ms"]}
    assert list(stages) == [
        ("camera", "encode"),
        ("camera", "packetize"),
        ("network", "video link"),
        ("receiver", "reorder and depacketize"),
        *(("driver", stage) for stage in ("reorder", "decode", "read_stamp", "lane", "control")),
        ("network", "control link"),
    ]
    assert stages["driver", "decode"]["p50"] == pytest.approx(2.0)
    # tau_v is 62 ms: 5 ms in the camera after the stamp, 47 ms on the link, and 10 ms in the client.
    link = stages["network", "video link"]
    assert (link["p50"], link["p95"]) == pytest.approx((47.0, 49.0), abs=1e-3)
    assert link["n"] == entry["tau_v_ms"]["n"]
    assert stages["network", "control link"]["p50"] == entry["tau_c_ms"]["p50"]


def test_links_need_the_clock_offset(make_run: MakeRun, tmp_path: Path) -> None:
    """If Delta is unknown, the nodes' stages are present and the network links are not."""
    unknown = {"client_clock": lambda _second: {"correction_s": None}, "probes": False}
    make_run(tmp_path, **unknown)
    entry = measure(read_record(tmp_path / "server.mcap"), read_record(tmp_path / "client.mcap")).entry
    assert {stage["node"] for stage in entry["stages_ms"]} == {"camera", "receiver", "driver"}


def test_frame_age_of_each_accepted_command() -> None:
    """Commands applied 20 and 40 ms after their frame's stamp have these ages; a rejected command has no age."""
    milliseconds = 1_000_000
    frames = table_of([{"stamp_ns": 7, "stamped_mono_ns": 10 * milliseconds}], [0], [0])
    rows = [(30, 7, "accepted"), (40, 7, "rejected"), (50, 7, "accepted"), (60, 8, "accepted"), (90, 7, "accepted")]
    command_verdicts = table_of(
        [{"applied_mono_ns": at * milliseconds, "stamp_ns": stamp, "verdict": verdict} for at, stamp, verdict in rows],
        [0] * len(rows),
        [0] * len(rows),
    )
    ages_ns = ages_at_actuation_ns(frames, command_verdicts, 0, 80 * milliseconds)
    assert np.divide(ages_ns, milliseconds).tolist() == [20.0, 40.0]


def test_age_at_actuation_includes_repeated_commands(make_run: MakeRun, tmp_path: Path) -> None:
    """With a loop latency of 76 ms and a second command 15 ms later, ages range from 76 to 91 ms."""
    make_run(tmp_path, spread_ms=0.0)
    age = measure(read_record(tmp_path / "server.mcap"), read_record(tmp_path / "client.mcap")).entry
    assert age["age_at_actuation_ms"]["p5"] == pytest.approx(76.0, abs=1e-3)
    assert age["age_at_actuation_ms"]["p95"] == pytest.approx(91.0, abs=1e-3)
