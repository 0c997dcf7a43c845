from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
from benchmarks.virtual_loop import with_rest

from lavt.errors import WorkError

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"
BENCHMARK = BENCHMARKS / "virtual_loop.py"


def test_stages_make_up_the_whole() -> None:
    """What the stages leave of the whole is the rest; a stage without any time, or more than the whole, is an error."""
    assert with_rest({"render": 2.0, "encode": 3.0}, 6.0) == {"render": 2.0, "encode": 3.0, "rest": 1.0}
    with pytest.raises(WorkError, match="encode"):
        with_rest({"render": 2.0, "encode": 0.0}, 6.0)
    with pytest.raises(WorkError, match="stages"):
        with_rest({"render": 2.0, "encode": 5.0}, 6.0)


@pytest.mark.full
def test_the_benchmark_of_the_virtual_loop_runs() -> None:
    """`benchmarks/virtual_loop.py` tells how many times real time is reached and where it goes, last as JSON."""
    done = subprocess.run(
        [sys.executable, BENCHMARK, "--settings", "geometry", "--repetitions", "1", "--limit-s", "2"],
        capture_output=True, text=True, check=True, timeout=120,
    )  # fmt: skip
    last = json.loads(done.stdout.splitlines()[-1])
    assert list(last) == ["full_x", "bare_x", "geometry_x", "perception_ms", "render_ms"]
    assert last["geometry_x"] > 0
    for stage in ("render", "perception", "control", "rest"):
        assert f"{stage} " in done.stdout


@pytest.mark.full
def test_the_benchmark_of_the_onset_runs() -> None:
    """`benchmarks/growth_onset.py` prints theory and measurement of each case as a row of a table."""
    done = subprocess.run(
        [sys.executable, BENCHMARKS / "growth_onset.py", "--lookaheads", "0.74", "--rates", "15", "--speeds", "6"],
        capture_output=True, text=True, check=True, timeout=300,
    )  # fmt: skip
    header, _, row = done.stdout.splitlines()
    assert header.count("|") == row.count("|")
    assert row.startswith("| 0.74 s | 15 Hz | 6 m/s | ")
    theory_ms, measured_ms, difference_ms = (float(cell.split()[0]) for cell in row.split("|")[-4:-1])
    assert theory_ms > 0
    assert measured_ms > 0
    assert abs(difference_ms) < theory_ms


@pytest.mark.full
def test_the_study_of_the_stamp_runs() -> None:
    """`benchmarks/stamp_reading.py` prints a table for each size and one of the checks, and last, if asked, JSON."""
    requested = ["--sizes", "320x240", "--rates-kbps", "460", "--frames", "40", "--processes", "1", "--json"]
    done = subprocess.run(
        [sys.executable, BENCHMARKS / "stamp_reading.py", *requested],
        capture_output=True, text=True, check=True, timeout=120,
    )  # fmt: skip
    lines = done.stdout.splitlines()
    assert lines[4].startswith("| 460 | ")
    last = json.loads(lines[-1])
    assert [(cell["loss"], cell["repair"]) for cell in last["cells"]] == [
        (0.0, 0), (0.01, 0), (0.01, 1), (0.05, 0), (0.05, 1), (0.05, 2),
    ]  # fmt: skip
    whole = last["cells"][0]
    assert whole["accepted"] == whole["frames"] == whole["intact"] == whole["intact_good"] == 40
    assert (whole["unread_share"], whole["good_of_intact"]) == (0.0, 1.0)


@pytest.mark.full
def test_the_benchmark_of_the_rendezvous_runs() -> None:
    """`benchmarks/rendezvous.py` tells how long packets take straight and through the process, last as JSON."""
    done = subprocess.run(
        [sys.executable, BENCHMARKS / "rendezvous.py", "--seconds", "0.5"],
        capture_output=True, text=True, check=True, timeout=120,
    )  # fmt: skip
    took_us = json.loads(done.stdout.splitlines()[-1])["us"]
    assert took_us["straight"]["p50"] > 0
    assert took_us["through"]["p50"] > 0
