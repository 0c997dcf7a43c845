from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

BENCHMARK = Path(__file__).parents[1] / "benchmarks" / "virtual_loop.py"


def test_the_benchmark_of_the_virtual_loop_runs() -> None:
    """`benchmarks/virtual_loop.py` tells how many times real time is reached and where it goes, last as JSON."""
    done = subprocess.run(
        [sys.executable, BENCHMARK, "--settings", "geometry", "--repetitions", "1", "--limit-s", "2"],
        capture_output=True, text=True, check=True, timeout=120,
    )  # fmt: skip
    last = json.loads(done.stdout.splitlines()[-1])
    assert list(last) == ["full_x", "bare_x", "geometry_x", "perception_ms", "render_ms"]
    assert last["geometry_x"] > 0
    for stage in ("render", "encode", "decode", "perception", "control", "rest"):
        assert f"{stage} " in done.stdout
