from __future__ import annotations

import json
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from benchmarks.detector_cost import compare
from benchmarks.fleet_parts.costs import costs_per_vehicle
from benchmarks.growth_onset import table_row
from benchmarks.interval_coverage import percentile_bootstrap, studentised_bootstrap
from benchmarks.virtual_loop import with_rest

from lavt.errors import UserError, WorkError

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"
VIRTUAL_LOOP = BENCHMARKS / "virtual_loop.py"


def test_rest_completes_the_stages() -> None:
    """The rest is the total time minus the stages; a stage of 0 ms, or stages longer than the total, are an error."""
    assert with_rest({"render": 2.0, "encode": 3.0}, 6.0) == {"render": 2.0, "encode": 3.0, "rest": 1.0}
    with pytest.raises(WorkError, match="encode"):
        with_rest({"render": 2.0, "encode": 0.0}, 6.0)
    with pytest.raises(WorkError, match="stages"):
        with_rest({"render": 2.0, "encode": 5.0}, 6.0)


@pytest.mark.full
def test_virtual_loop_benchmark_runs() -> None:
    """`benchmarks/virtual_loop.py` prints the speed relative to real time, the stages and, last, JSON."""
    completed = subprocess.run(
        [sys.executable, VIRTUAL_LOOP, "--settings", "geometry", "--repetitions", "1", "--limit-s", "2"],
        capture_output=True,
        text=True,
        check=True,
        timeout=900,
    )
    result = json.loads(completed.stdout.splitlines()[-1])
    assert list(result) == ["full_speedup", "bare_speedup", "geometry_speedup", "perception_ms", "render_ms"]
    assert result["geometry_speedup"] > 0
    for stage in ("render", "perception", "control", "rest"):
        assert f"{stage} " in completed.stdout


@pytest.mark.full
def test_gym_benchmark_runs() -> None:
    """`benchmarks/gym_steps.py` prints a line for each setting and, last, JSON with steps per second and ratio."""
    if find_spec("gymnasium") is None:  # an import would change this process's environment
        pytest.skip("the benchmark needs gymnasium")
    completed = subprocess.run(
        [sys.executable, BENCHMARKS / "gym_steps.py", "--settings", "lane", "--repetitions", "1", "--limit-s", "2"],
        capture_output=True,
        text=True,
        check=True,
        timeout=900,
    )
    result = json.loads(completed.stdout.splitlines()[-1])
    assert result["lane"]["steps_per_s"] > 0
    assert result["lane"]["ratio"] > 0
    assert "times the time of a plain drive" in completed.stdout


def test_a_growth_onset_that_was_not_found_is_a_dash() -> None:
    """A case without an onset, by theory or measured, has a dash in its table row."""
    assert table_row(1.3, 15.0, 6.0, 461.9, None) == "| 1.3 s | 15 Hz | 6 m/s | 461.9 ms | – | – |"
    assert table_row(1.3, 15.0, 6.0, None, 462.7) == "| 1.3 s | 15 Hz | 6 m/s | – | 462.7 ms | – |"
    assert table_row(1.3, 15.0, 6.0, 461.9, 460.0).endswith("| 461.9 ms | 460.0 ms | -1.9 ms |")


@pytest.mark.full
def test_growth_onset_benchmark_runs() -> None:
    """`benchmarks/growth_onset.py` prints theory and measurement of each case as a table row."""
    completed = subprocess.run(
        [sys.executable, BENCHMARKS / "growth_onset.py", "--lookaheads", "0.74", "--rates", "15", "--speeds", "6"],
        capture_output=True,
        text=True,
        check=True,
        timeout=900,
    )
    header, _, row = completed.stdout.splitlines()
    assert header.count("|") == row.count("|")
    assert row.startswith("| 0.74 s | 15 Hz | 6 m/s | ")
    theory_ms, measured_ms, difference_ms = (float(cell.split()[0]) for cell in row.split("|")[-4:-1])
    assert theory_ms > 0
    assert measured_ms > 0
    assert abs(difference_ms) < theory_ms


@pytest.mark.full
def test_stamp_reading_study_runs() -> None:
    """`benchmarks/stamp_reading.py` prints a table for each size, a table of the checks and, with --json, JSON."""
    requested = ["--sizes", "320x240", "--rates-kbps", "460", "--frames", "40", "--processes", "1", "--json"]
    completed = subprocess.run(
        [sys.executable, BENCHMARKS / "stamp_reading.py", *requested],
        capture_output=True,
        text=True,
        check=True,
        timeout=900,
    )
    lines = completed.stdout.splitlines()
    assert lines[4].startswith("| 460 | ")
    result = json.loads(lines[-1])
    links = [(link["loss"], link["repair"]) for link in result["links"]]
    assert links == [(0.0, 0), (0.01, 0), (0.01, 1), (0.05, 0), (0.05, 1), (0.05, 2)]
    loss_free = result["links"][0]
    assert loss_free["accepted"] == loss_free["frames"] == loss_free["intact"] == loss_free["intact_usable"] == 40
    assert (loss_free["rejected_share"], loss_free["usable_share_of_intact"]) == (0.0, 1.0)


@pytest.mark.full
def test_rendezvous_benchmark_runs() -> None:
    """`benchmarks/rendezvous.py` prints the delays of packets with and without the forwarder; the last line is JSON."""
    completed = subprocess.run(
        [sys.executable, BENCHMARKS / "rendezvous.py", "--seconds", "0.5"],
        capture_output=True,
        text=True,
        check=True,
        timeout=900,
    )
    delays_us = json.loads(completed.stdout.splitlines()[-1])["us"]
    assert delays_us["straight"]["p50"] > 0
    assert delays_us["through"]["p50"] > 0


def test_the_costs_of_a_vehicle_are_found_from_steps() -> None:
    """From steps whose costs are straight lines, the costs per state and per session are found again."""
    steps = [
        {
            "topology": "clients",
            "light": light,
            "driven": driven,
            "sent_per_s": light * rate_hz,
            "processor_share": 0.01 + 2e-5 * (light * rate_hz + 100 * driven) + 3e-4 * (light + 2 * driven),
            "resident_mb": 70 + 0.5 * (light + 2 * driven),
            "descriptors": 20,
            "states_received_share": 1.0,
        }
        for light, driven, rate_hz in ((1, 1, 50), (10, 1, 50), (10, 10, 50), (100, 1, 50), (100, 10, 5))
    ]
    with_losses = [*steps, {**steps[0], "processor_share": 9.0, "states_received_share": 0.5}]
    costs = costs_per_vehicle(with_losses, "clients")
    assert costs["processor_s_per_state"] == pytest.approx(2e-5, rel=0.01)
    assert costs["processor_s_per_session_s"] == pytest.approx(3e-4, rel=0.01)
    assert costs["resident_mb_per_session"] == pytest.approx(0.5, rel=0.01)
    assert costs["descriptors_per_session"] == pytest.approx(0, abs=1e-6)
    assert costs_per_vehicle(steps, "routers") == {}


@pytest.mark.full
@pytest.mark.timeout(1800)
def test_fleet_benchmark_runs() -> None:
    """`benchmarks/fleet.py` drives a vehicle among light ones, and prints a row for each step and, last, JSON."""
    completed = subprocess.run(
        [sys.executable, BENCHMARKS / "fleet.py", "--short", "--vehicles", "2"],
        capture_output=True,
        text=True,
        check=False,
        timeout=900,
    )
    assert completed.returncode == 0, completed.stderr
    result = json.loads(completed.stdout.splitlines()[-1])
    assert [step["topology"] for step in result["steps"]] == ["routers", "clients"]
    for step in result["steps"]:
        assert step["state_ms"][0] > 0
        assert step["round_trip_ms"][0] > 0
        assert step["resident_mb"] > 0
    assert result["rendezvous"]["processor_us_per_packet"] >= 0
    assert completed.stdout.count("\n| routers | 2 | 1 |") == 1


def test_the_bootstraps_of_the_coverage_study() -> None:
    """Both bootstraps of equal values have no width; otherwise both include the mean, and the studentised is wider."""
    generator = np.random.default_rng(1)
    values = np.array([[1.0, 2.0, 4.0, 5.0], [0.0, 1.0, 1.0, 2.0]])
    for method in (percentile_bootstrap, studentised_bootstrap):
        assert list(method(np.ones((2, 4)), generator)) == [1.0, 1.0]
        low, high = method(values, generator)
        assert low < 2.0 < high
    narrow, wide = percentile_bootstrap(values, generator), studentised_bootstrap(values, generator)
    assert wide[1] - wide[0] > narrow[1] - narrow[0]


def test_detector_costs_are_compared_in_turn(tmp_path: Path) -> None:
    """`benchmarks/detector_cost.py` gives a time of searching and of following for each version, picture and round."""
    source = BENCHMARKS.parent / "src"
    times_ms = compare((source, source), [np.zeros((480, 640, 3), dtype=np.uint8)] * 2, rounds=2)
    assert times_ms.shape == (2, 2, 4)
    assert (times_ms > 0).all()
    with pytest.raises(UserError, match="no package lavt"):
        compare((source, tmp_path), [], rounds=1)
