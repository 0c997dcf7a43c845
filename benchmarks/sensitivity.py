"""Vary a preset's settings one at a time, and print theory and measurements as Markdown tables.

    python benchmarks/sensitivity.py [--routes a_key,b_key,c_key] [--repetitions 3] [--jobs N]

The drives use geometry fidelity: the lane's true centre replaces the detector, and all else is as in the whole loop.
The inherent latency is `paper_wifi5`, the stopping-distance limit is 200 m, and the seeds are the same in every column.
`docs/controllers.md` has the output.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Any

from lavt.config import SweepConfig
from lavt.config_file import load_config, parse_config, shipped
from lavt.control.preset import Preset, find_preset
from lavt.experiment.boundary.delay_margin import LateralLoop, critical_delay_s, phase_margin_rad
from lavt.experiment.runs.plan import plan_sweep
from lavt.experiment.sweep.sweep import run_all

DELAY_S = 0.081
"""Delay at L0 with `paper_wifi5`: 62 ms of video, 9 ms of control, 10 ms of processing; see find_designed_preset.py."""
CONDITIONS = ("L0", "L1", "L2", "L3", "L5")
"""Without L4, which has the same total delay as L3."""

SettingValues = Sequence[float]


def variations(preset: Preset) -> dict[str, SettingValues]:
    """Return the values of each varied setting, by config key; they include the preset's value."""
    limits: dict[str, SettingValues] = (
        {"controller.lateral_limit_mps2": (2.0, 3.0, 4.5)}
        if math.isfinite(preset.lateral_limit_mps2)
        else {"controller.steering_limit_rad": (0.14, 0.21, 0.30, 0.50)}
    )
    return {
        "controller.lookahead_s": tuple(round(preset.lookahead_s * factor, 3) for factor in (0.8, 0.9, 1.0, 1.1, 1.25)),
        **limits,
        "controller.speed_mps": (5.0, 30 / 3.6, 10.0),
        "camera.rate_hz": (15.0, 30.0, 60.0),
    }


def loop_with(preset: Preset, key: str, value: float) -> LateralLoop:
    """Return the theoretical loop with one setting changed. A changed limit has no effect: the theory has no limits."""
    settings = {"controller.lookahead_s": preset.lookahead_s, "controller.speed_mps": preset.speed_mps, key: value}
    return LateralLoop(
        lookahead_s=settings["controller.lookahead_s"],
        speed_mps=settings["controller.speed_mps"],
        frame_rate_hz=settings.get("camera.rate_hz", 30.0),
    )


def run_drives(preset: str, key: str, values: SettingValues, options: argparse.Namespace) -> list[Mapping[str, Any]]:
    """Drive with every value of the setting under every condition, and return the results."""
    base = load_config(SweepConfig, shipped("configs/paper.yaml")).model_dump(mode="json")
    base["controller"]["preset"] = preset
    config = {
        **base,
        "safety": {**base["safety"], "stopping_distance_limit_m": 200.0},  # the speed must not depend on the delay
        "fidelity": "geometry",
        "routes": options.routes.split(","),
        "conditions": list(CONDITIONS),
        "repetitions": options.repetitions,
        "axes": {key: list(values)},
    }
    planned = plan_sweep(parse_config(SweepConfig, config, "sensitivity"))
    with TemporaryDirectory() as directory:
        sweep_result, _ = run_all(planned, Path(directory), jobs=options.jobs, on_progress=lambda _: None)
    if sweep_result.failed:
        raise SystemExit(f"failed: {sweep_result.failed}")
    return list(sweep_result.results)


def format_cell(results: Sequence[Mapping[str, Any]]) -> str:
    """Format the share of completed drives and the median of their P95 cross-track errors."""
    p95_m = [result["p95_m"] for result in results if result["ending"] == "completed"]
    share = f"{len(p95_m)}/{len(results)}"
    return f"{share}, {median(p95_m):.2f} m" if p95_m else share


def print_table(preset: Preset, key: str, values: SettingValues, options: argparse.Namespace) -> None:
    """Print the table of one setting."""
    results = run_drives(preset.name, key, values, options)
    print(f"\n`{preset.name}`, `{key}`:\n")
    print("| value | phase margin at L0 | critical delay | " + " | ".join(CONDITIONS) + " |")
    print("|---" * (3 + len(CONDITIONS)) + "|")
    for value in values:
        loop = loop_with(preset, key, value)
        margin_deg, critical_ms = math.degrees(phase_margin_rad(loop, DELAY_S)), 1e3 * critical_delay_s(loop)
        results_of_value = [result for result in results if result["axes"][key] == value]
        cells = [
            format_cell([result for result in results_of_value if result["condition"] == name]) for name in CONDITIONS
        ]
        print(f"| {value:.3g} | {margin_deg:.0f} deg | {critical_ms:.0f} ms | " + " | ".join(cells) + " |", flush=True)


def main() -> None:
    """Print the tables of both presets."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--routes", default="a_key,b_key,c_key")
    parser.add_argument("--repetitions", type=int, default=3)
    parser.add_argument("--jobs", type=int, default=None)
    options = parser.parse_args()
    for name in ("designed", "paper_calibrated"):
        preset = find_preset(name)
        for key, values in variations(preset).items():
            print_table(preset, key, values, options)


if __name__ == "__main__":
    main()
