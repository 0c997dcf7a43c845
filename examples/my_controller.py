"""A custom controller: Stanley's law (Hoffmann et al., American Control Conference 2007), compared with the default.

python examples/my_controller.py [DIRECTORY]

A package can register a controller with an entry point. Every `lavt` command then accepts, in this example,
`controller.kind: stanley`:

    [project.entry-points."lavt.controllers"]
    stanley = "my_package:Stanley"
"""

from __future__ import annotations

import math
import sys
from pathlib import Path
from tempfile import mkdtemp

from lavt.config import RunConfig
from lavt.config_file import load_config, shipped
from lavt.control.drive_controller import CONTROLLERS
from lavt.control.preset import Preset
from lavt.domain import PATH_POINTS, Decision, Lane
from lavt.experiment.runs.plan import plan_run
from lavt.experiment.runs.run import run_once


class Stanley:
    """A controller that steers the front axle onto the lane's centre, and keeps the preset's speed."""

    gain_per_s = 1.2

    def __init__(self, preset: Preset, *, wheelbase_m: float) -> None:
        self._preset, self._wheelbase_m = preset, wheelbase_m

    def decide(self, lane: Lane, speed_mps: float, now_ns: int) -> Decision:
        """Return wheel angle, pedals and path for the newest lane (vehicle frame, left positive) and speed."""
        del now_ns
        c0, c1, c2 = lane.centre
        # The lane's centre is y = c0 + c1 x + c2 x^2, with x = 0 at the rear axle and x = wheelbase at the front axle.
        lateral_error_m = c0 + (c1 + c2 * self._wheelbase_m) * self._wheelbase_m
        heading_error_rad = math.atan(c1 + 2 * c2 * self._wheelbase_m)
        steering_rad = heading_error_rad + math.atan2(self.gain_per_s * lateral_error_m, max(speed_mps, 1.0))
        limit_rad = self._preset.steering_limit_rad
        missing_mps = self._preset.speed_mps - speed_mps if lane.confidence >= self._preset.lane_confidence else 0.0
        throttle = min(max(missing_mps, 0.0), 1.0)
        path_per_m = (2 * c2,) * PATH_POINTS  # the vehicle follows this path after a command timeout
        return Decision(min(max(steering_rad, -limit_rad), limit_rad), throttle, 0.0, path_per_m)


if __name__ == "__main__":
    CONTROLLERS["stanley"] = Stanley
    directory = Path(sys.argv[1] if len(sys.argv) > 1 else mkdtemp(prefix="lavt-"))
    for kind in ("lane_keeper", "stanley"):
        changes = [f"controller.kind={kind}", "network.condition=L1", "vehicle.scenery=none"]
        run = plan_run(load_config(RunConfig, shipped("configs/demo.yaml"), changes))
        result = run_once(run, directory / kind)
        print(f"{kind} under L1: {result['ending']}, cross-track P95 {result['p95_m']:.2f} m")
