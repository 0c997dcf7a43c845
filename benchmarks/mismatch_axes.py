"""Drive the controllers that know their delay under wrong assumptions, one axis at a time, and print a table for each.

    python -m benchmarks.mismatch_axes OUT [--axis wheelbase ...] [--set conditions=[H2] ...] [--kind smith ...]
                                        [--jobs 1]

Each axis is the sweep `configs/compensation_mismatch.yaml` with other axes, in `OUT/AXIS`; a program that was
interrupted continues there. The program prints the command that drives the same sweep with a report, and tables with
the drives completed in the own lane, and the medians of P95 and of the lateral jerk. The axis `exact` has no wrong
assumption; every other axis takes its value from there. `docs/compensation.md` has the output.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from lavt.config import SweepConfig
from lavt.config_file import load_config, shipped
from lavt.experiment.report.table_format import NOTHING, format_number
from lavt.experiment.runs.plan import PlannedRun, plan_sweep
from lavt.experiment.statistics.controllers import compare_controllers
from lavt.experiment.sweep.sweep import run_all

CONFIG = "configs/compensation_mismatch.yaml"
KINDS = ("predictive", "smith", "scheduled_lookahead", "lane_keeper")
MEASURING = ("predictive", "smith")
"""The controllers that predict by a measured delay."""


@dataclass(frozen=True, slots=True)
class Axis:
    """Values of one config key."""

    title: str
    key: str = ""
    values: Sequence[float] = ()
    exact: float | None = None
    """The value in the axis `exact`; None: that axis has other settings."""
    settings: Sequence[str] = ()
    """Further changes of the config."""
    kinds: Sequence[str] = KINDS

    def changes(self, further: Sequence[str] = ()) -> list[str]:
        """Return the changes of the config, as `--set` takes them; `further` come before those of the axis."""
        values = f", {self.key}: [{', '.join(f'{value:g}' for value in self.values)}]" if self.key else ""
        axes = f"axes={{controller.kind: [{', '.join(self.kinds)}]{values}}}"
        return [*further, axes, *self.settings]

    def plan(self, further: Sequence[str] = ()) -> list[PlannedRun]:
        """Return the runs of this axis; raise `UserError` for a change that is not possible."""
        return plan_sweep(load_config(SweepConfig, shipped(CONFIG), self.changes(further)))


AXES = {
    "exact": Axis("no wrong assumption"),
    "delay": Axis(
        "error of the estimated delay, s",
        "controller.compensation.delay_error_s",
        (-0.1, -0.05, -0.025, 0.025, 0.05, 0.1),
        0.0,
    ),
    "delay_limit": Axis(
        "error of the estimated delay, far beyond, s",
        "controller.compensation.delay_error_s",
        (-0.45, -0.4, -0.35, -0.3, -0.25, -0.2, -0.15, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.45),
        0.0,
        ("conditions=[H2]",),
        MEASURING,
    ),
    "steering_lag": Axis(
        "steering lag of the car, ms (assumed: 120)", "vehicle.steering_lag_ms", (90, 108, 132, 150), 120
    ),
    "wheelbase": Axis(
        "assumed wheelbase, m (true: 2.8448)", "controller.wheelbase_m", (2.1336, 2.5603, 3.1293, 3.556), 2.8448
    ),
    "understeer": Axis(
        "front stiffness of the car, N/rad (by default 155495)",
        "vehicle.front_stiffness_nprad",
        (116_621, 139_946, 171_045, 194_369),
        155_495,
    ),
    "speed_report": Axis("reported speed / true speed", "vehicle.speed_report_factor", (0.75, 0.9, 1.1, 1.25), 1.0),
    "jitter": Axis("jitter of the video, ms", "network.video.jitter_ms", (10, 20, 40), 0),
    "control_jitter": Axis("jitter of the control, ms", "network.control.jitter_ms", (10, 20, 40), 0),
    "loss": Axis(
        "loss of frames, each independently",
        "network.video.loss",
        (0.05, 0.1, 0.2),
        0,
        ("video.repair_packets=0",),
    ),
    "bursts": Axis(
        "loss of frames, in bursts of 5",
        "network.video.loss",
        (0.05, 0.1, 0.2),
        0,
        ("network.video.loss_burst_packets=5", "video.repair_packets=0"),
    ),
    "trace": Axis(
        "handover every 10 s, which delays the video by up to 160 ms more for 1 s",
        settings=("network.video.trace=handover.csv",),
    ),
    "control_trace": Axis(
        "handover every 10 s, which delays the control by up to 160 ms more for 1 s",
        settings=("network.control.trace=handover.csv",),
    ),
    "frame_rate": Axis("frame rate, Hz (tuned for 30)", "camera.rate_hz", (10, 15), 30),
    "position_noise": Axis("noise of the seen lane's position, m", "vehicle.lane_noise_m", (0.02, 0.05, 0.1, 0.2), 0),
    "direction_noise": Axis(
        "noise of the seen lane's direction, rad", "vehicle.lane_noise_rad", (0.005, 0.01, 0.02, 0.04), 0
    ),
    "speed": Axis(
        "speed, m/s (20 to 50 km/h; tuned for 30)",
        "controller.speed_mps",
        (5.556, 8.333, 11.111, 13.889),
        settings=("routes=[b_key, c_key]", "safety.speed_limit_mps=14"),
    ),
}
"""The axes by name.

Without pixels, a frame is one packet, so without repair packets each lost packet is a lost frame. At 40 km/h and above,
the bend of `a_key` needs more than the 3 m/s2 that preset and vehicle allow.
"""


def axis_tables(axis: Axis, runs: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return lines of Markdown: a table for each condition, with a row for each controller."""
    entries = compare_controllers(runs)
    cells = {
        (entry["condition"], entry["controller"], entry["axes"].get(axis.key, axis.exact)): _cell(entry)
        for entry in entries
    }
    values = sorted({value for _, _, value in cells if value is not None})
    lines = []
    for condition in dict.fromkeys(condition for condition, _, _ in cells):
        lines += ["", f"| {condition} | {' | '.join(f'{value:g}' for value in values) or axis.title} |"]
        lines += [f"|{'---|' * (1 + max(len(values), 1))}"]
        for kind in axis.kinds:
            row = [cells.get((condition, kind, value), NOTHING) for value in values or [axis.exact]]
            lines.append(f"| `{kind}` | {' | '.join(row)} |")
    return lines


def _cell(entry: Mapping[str, Any]) -> str:
    """Return the drives completed in the own lane, and the medians of P95 and lateral jerk."""
    completed = f"{entry['completed_in_own_lane']}/{entry['runs']}"
    error_m, jerk_mps3 = (format_number(entry[name], 2) for name in ("p95_m", "lateral_jerk_rms_mps3"))
    return f"{completed}, {error_m} m, {jerk_mps3} m/s3"


def main() -> None:
    """Drive the axes."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--axis", choices=AXES, action="append")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--set", dest="changes", action="append", default=[])
    parser.add_argument("--kind", dest="kinds", choices=KINDS, action="append", default=[])
    options = parser.parse_args()
    names = options.axis or list(AXES)
    driven: dict[str, Sequence[Mapping[str, Any]]] = {}
    for name in dict.fromkeys(["exact", *names]):
        axis = AXES[name]
        if options.kinds:
            axis = replace(axis, kinds=[kind for kind in axis.kinds if kind in options.kinds])
        print(f"\n{name}: {axis.title}", flush=True)
        changes = " ".join(f"--set '{change}'" for change in axis.changes(options.changes))
        print(f"    lavt sweep {CONFIG} {changes}", flush=True)
        result, _ = run_all(
            axis.plan(options.changes), options.out / name / "runs", jobs=options.jobs, on_progress=lambda _: None
        )
        driven[name] = result.results
        shared = driven["exact"] if axis.exact is not None and name != "exact" else []
        print("\n".join(axis_tables(axis, [*shared, *driven[name]])), flush=True)
        for run, reason in result.failed:
            print(f"{run} failed: {reason}", flush=True)


if __name__ == "__main__":
    main()
