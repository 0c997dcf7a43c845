"""Tests of drives in virtual time under conditions with more than a constant delay."""

from __future__ import annotations

import json
from hashlib import sha256
from pathlib import Path
from typing import Any

import pytest

from lavt.config import RunConfig, SweepConfig
from lavt.config_file import conditions, load_config, parse_config, shipped
from lavt.domain import NS_PER_S
from lavt.experiment.runs.plan import plan_run, plan_sweep
from lavt.experiment.runs.run import run_once
from lavt.experiment.runs.virtual_run import build_loop, drive
from lavt.recording.record import read_record
from lavt.recording.table import MISSING

IMPAIRED_CONDITIONS = sorted(name for name in conditions() if name[0] not in "LH")


def all_but_one_full(names: list[str], quick: str) -> list[Any]:
    """Mark all names but one as `full`."""
    return [name if name == quick else pytest.param(name, marks=pytest.mark.full) for name in names]


def drive_run(out: Path, *further_changes: str) -> dict[str, Any]:
    changes = ("vehicle.scenery=none", "record.video=false", *further_changes)
    return run_once(plan_run(load_config(RunConfig, shipped("configs/demo.yaml"), changes)), out)


def link_counts(side: Path) -> dict[str, dict[str, int]]:
    """Return the recorded counters of a side, by link and by counter."""
    table = read_record(side).table("counts")
    names = ("packets", "lost", "dropped", "overtook")
    columns = {name: table.ints(f"link_{name}") for name in names}
    return {
        node: {name: int(columns[name][row]) for name in names}
        for row, node in enumerate(table.texts("node"))
        if node.startswith("link ") and columns["packets"][row] != MISSING
    }


def test_a_constant_delay_has_no_link_counters(tmp_path: Path) -> None:
    """With a constant delay only, the record has no counters of links."""
    drive_run(tmp_path / "run", "fidelity=geometry", "network.condition=L4", "vehicle.time_limit_s=2")
    assert link_counts(tmp_path / "run/server.mcap") == link_counts(tmp_path / "run/client.mcap") == {}


@pytest.mark.parametrize("name", all_but_one_full(IMPAIRED_CONDITIONS, "loss_burst"))
def test_every_condition_is_driven_reproducibly(name: str, tmp_path: Path) -> None:
    """Without pixels, every condition is completed in a valid run, with a reproducible digest."""
    changes = ("fidelity=geometry", f"network.condition={name}")
    result, repeated = drive_run(tmp_path / "run", *changes), drive_run(tmp_path / "again", *changes)
    assert (result["ending"], result["valid"], result["invalid_reasons"]) == ("completed", True, [])
    assert result["digest"] == repeated["digest"]
    short = (*changes, "vehicle.time_limit_s=2")
    one_seed, other_seed = (drive_run(tmp_path / f"{seed}", *short, f"seed={seed}") for seed in (1, 2))
    assert one_seed["digest"] != other_seed["digest"]


def test_lost_packets_are_counted_and_missing(tmp_path: Path) -> None:
    """The sender's record has the number of lost packets, and so many packets are missing in the receiver's record."""
    drive_run(tmp_path / "run", "fidelity=pixels", "vehicle.time_limit_s=5", "network.condition=loss")
    server, client = (read_record(tmp_path / f"run/{side}.mcap") for side in ("server", "client"))
    video = link_counts(tmp_path / "run/server.mcap")["link rtp"]
    control = link_counts(tmp_path / "run/client.mcap")["link control"]
    assert 0.05 < video["lost"] / video["packets"] < 0.15
    assert 0.05 < control["lost"] / control["packets"] < 0.15
    for sender, receiver, topic, counts in ((server, client, "rtp", video), (client, server, "control", control)):
        sent, received = len(sender.table(topic)), len(receiver.table(topic))
        assert sent == counts["packets"]
        assert 0 <= sent - counts["lost"] - received <= 10  # up to 10 were in transit at the end


@pytest.mark.parametrize("name", all_but_one_full(IMPAIRED_CONDITIONS, "reorder"))
def test_video_under_every_condition(name: str, tmp_path: Path) -> None:
    """Real video passes a link under every condition, and the link's counters show the impairment of the condition."""
    changes = ("vehicle.scenery=none", "record.video=false", f"network.condition={name}")
    planned = plan_run(load_config(RunConfig, shipped("configs/demo.yaml"), changes))
    loop = build_loop(planned, tmp_path / "run")
    drive(loop, limit_ns=4 * NS_PER_S)
    counts = link_counts(tmp_path / "run/server.mcap")["link rtp"]
    assert counts["packets"] > 500
    assert (counts["lost"] > 0) == name.startswith("loss")
    assert (counts["dropped"] > 0) == (name == "rate_short_queue")
    assert (counts["overtook"] > 0) == (name == "reorder")


def test_a_trace_has_no_constant_delay_and_a_recorded_digest(tmp_path: Path) -> None:
    """The injected delay of a trace is null, and the record has the digest of every trace."""
    (tmp_path / "mine.csv").write_text("time_s,delay_ms\n0,20\n60,80\n")
    changes = (f"network.video.trace={tmp_path / 'mine.csv'}", "network.control.trace=fading.mahimahi")
    planned = plan_run(load_config(RunConfig, shipped("configs/demo.yaml"), (*changes, "fidelity=geometry")))
    assert planned.identity["injected_ms"] == {"video": None, "control": 0.0}
    assert planned.identity["injected_least_ms"] == {"video": 0.0, "control": 0.0}
    result = run_once(planned, tmp_path / "run")
    assert (result["injected_ms"]["video"], result["valid"]) == (None, True)
    traces = json.loads(read_record(tmp_path / "run/server.mcap").annotations["model"]["traces"])
    assert traces == {
        str(tmp_path / "mine.csv"): sha256((tmp_path / "mine.csv").read_bytes()).hexdigest(),
        "fading.mahimahi": sha256(shipped("netem/traces/fading.mahimahi").read_bytes()).hexdigest(),
    }


def test_a_slow_link_ends_the_drive_in_a_valid_run(tmp_path: Path) -> None:
    """If frames wait for seconds in a slow link's queue, the drive ends with a safe stop, and the run is valid."""
    result = drive_run(tmp_path / "run", "network.condition=rate")
    assert (result["ending"], result["valid"], result["invalid_reasons"]) == ("safe_stop", True, [])
    assert result["loop_ms"]["p50"] > 1000


AXES: list[tuple[str, list[Any], str]] = [
    ("network.video.loss", [0.0, 0.2], "geometry"),
    ("network.control.loss_burst_packets", [1.0, 4.0], "geometry"),
    ("network.video.jitter_ms", [0.0, 20.0], "geometry"),
    ("network.video.jitter_distribution", ["normal", "pareto"], "geometry"),
    ("network.video.trace", ["", "handover.csv", "fading.mahimahi"], "geometry"),
    ("network.video.rate_bps", [0, 3_000_000], "video"),
    ("network.video.delay_ms", [0.0, 33.0], "geometry"),
    ("camera.rate_hz", [20.0, 30.0], "geometry"),
    ("controller.speed_mps", [5.0, 8.0], "geometry"),
    ("controller.lookahead_s", [0.7, 1.2], "geometry"),
    ("controller.preset", ["designed", "paper_calibrated"], "geometry"),
    ("video.bit_rate_bps", [1_000_000, 4_000_000], "video"),
    ("vehicle.light", ["noon", "low_sun"], "pixels"),
    ("vehicle.weather", ["clear", "fog"], "pixels"),
]


@pytest.mark.parametrize(
    ("key", "values", "fidelity"),
    [
        pytest.param(key, values, fidelity, id=key, marks=() if fidelity == "geometry" else pytest.mark.full)
        for key, values, fidelity in AXES
    ],
)
def test_config_values_as_axes(key: str, values: list[Any], fidelity: str, tmp_path: Path) -> None:
    """Each of these config keys works as an axis: the runs have one seed, the axis's values, and different digests."""
    sweep = {
        "fidelity": fidelity,
        "conditions": ["L1"],
        "vehicle": {"time_limit_s": 6.0 if fidelity == "geometry" else 1.0, "scenery": "light"},
        "record": {"video": False},
        "network": {"control": {"loss": 0.2}, "video": {"jitter_ms": 5.0}},
        "axes": {key: values},
    }
    runs = plan_sweep(parse_config(SweepConfig, sweep, "test"))
    results = [run_once(run, tmp_path / run.name.replace("/", "-")) for run in runs]
    assert [result["axes"] for result in results] == [{key: value} for value in values]
    assert len({result["seed"] for result in results}) == 1
    assert len({result["digest"] for result in results}) == len(values)
    assert all(result["valid"] for result in results), [result["invalid_reasons"] for result in results]
