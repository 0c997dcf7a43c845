"""Drive one route in virtual time under two conditions, and compare the lane keeping.

python examples/compare_delays.py [DIRECTORY]
"""

from __future__ import annotations

import sys
from pathlib import Path
from tempfile import mkdtemp

from lavt.config import RunConfig
from lavt.config_file import load_config, shipped
from lavt.experiment.runs.plan import plan_run
from lavt.experiment.runs.run import run_once


def main() -> None:
    """Drive at L0 and at L3, and print a line for each drive."""
    directory = Path(sys.argv[1] if len(sys.argv) > 1 else mkdtemp(prefix="lavt-"))
    for condition in ("L0", "L3"):
        changes = [f"network.condition={condition}", "vehicle.scenery=none"]
        run = plan_run(load_config(RunConfig, shipped("configs/demo.yaml"), changes))
        result = run_once(run, directory / condition)
        latency_ms, p95_m = result["loop_ms"]["p50"], result["p95_m"]
        print(f"{condition}: {result['ending']}, cross-track P95 {p95_m:.2f} m, loop latency {latency_ms:.0f} ms")


if __name__ == "__main__":
    main()
