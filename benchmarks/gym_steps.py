"""Measure the steps per second of the Gymnasium environment, beside plain drives in virtual time.

    python benchmarks/gym_steps.py [--settings lane pixels video] [--repetitions 3] [--limit-s 20]

An episode by pure pursuit and a drive of the lane keeper `designed` over the same route are driven in turns, both
without records, and the program takes the CPU time of this process. It prints medians over the repetitions: the time of
a reset, the steps per second of CPU time, and the time per picture of a whole episode divided by that of a plain drive.
Imports are not measured. The last line is JSON: steps per second and ratio of each setting.
"""

from __future__ import annotations

import argparse
import json
import math
import time  # noqa: TID251 (CPU time is what is measured)
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import median
from typing import Any

import cv2
import gymnasium
import numpy as np

from lavt.config import RunConfig
from lavt.config_file import build_config
from lavt.experiment.runs.plan import plan_run
from lavt.experiment.runs.virtual_run import build_loop, drive, free_finished_loops
from lavt.gym import LANE_KEEPING

SETTINGS: dict[str, tuple[str, str, tuple[str, ...]]] = {
    "lane": ("lane", "geometry", ()),
    "pixels": ("pixels", "pixels", ("vehicle.scenery=none",)),
    "video": ("pixels", "video", ()),
}
"""By name: observation, fidelity and changes of the config."""
LOOKAHEAD_M = 8.4


@dataclass(frozen=True, slots=True)
class EpisodeCost:
    """The CPU times of one episode, and of a plain drive beside it."""

    reset_s: float
    steps_s: float
    steps: int
    plain_s: float
    plain_pictures: int

    @property
    def ratio(self) -> float:
        """The time per picture of the episode divided by that of the plain drive."""
        return (self.reset_s + self.steps_s) / self.steps / (self.plain_s / self.plain_pictures)


def drive_plain(fidelity: str, changes: Sequence[str]) -> tuple[float, int]:
    """Return the CPU time of a drive of the lane keeper, and the number of pictures that it saw while driving."""
    config = build_config(RunConfig, {}, (*changes, f"fidelity={fidelity}"), "the benchmark")
    planned = plan_run(config)
    began_s = time.process_time()
    loop = build_loop(planned, None)
    seen_before = 0

    def note_start() -> None:
        nonlocal seen_before
        if loop.client.driver.session.phase != "driving":
            seen_before = loop.client.driver.counts.get("frames_decoded", 0)
            loop.runtime.call_at(loop.runtime.true_ns + 10_000_000, note_start)

    loop.runtime.call_at(0, note_start)
    drive(loop)
    pictures = loop.client.driver.counts["frames_decoded"] - seen_before
    return time.process_time() - began_s, pictures


def drive_episode(env: gymnasium.Env[Any, Any], seed: int) -> tuple[float, float, int]:
    """Return the CPU time of a reset and of the steps of an episode by pure pursuit, and the number of steps."""
    began_s = time.process_time()
    env.reset(seed=seed)
    reset_s, steps = time.process_time() - began_s, 0
    action = np.zeros(1, np.float32)
    while True:
        c0, c1, c2 = env.unwrapped.seen_lane.centre  # type: ignore[attr-defined]
        left_m = c0 + (c1 + c2 * LOOKAHEAD_M) * LOOKAHEAD_M
        action[0] = np.clip(math.atan(2.8448 * 2 * left_m / LOOKAHEAD_M**2) / 0.2, -1, 1)
        _, _, terminated, truncated, _ = env.step(action)
        steps += 1
        if terminated or truncated:
            return reset_s, time.process_time() - began_s - reset_s, steps


def measure(name: str, repetitions: int, limit_s: float) -> list[EpisodeCost]:
    """Return the costs of the episodes of a setting."""
    observation, fidelity, changes = SETTINGS[name]
    changes = (*changes, f"vehicle.time_limit_s={limit_s}")
    env = gymnasium.make(LANE_KEEPING, observation=observation, fidelity=fidelity, changes=changes)
    config = build_config(RunConfig, {}, (*changes, f"fidelity={fidelity}"), "the benchmark")
    costs = []
    for seed in range(repetitions):
        episode = drive_episode(env, seed)
        costs.append(EpisodeCost(*episode, *drive_plain(fidelity, changes)))
        free_finished_loops(config)
    env.close()
    return costs


def main() -> None:
    """Measure, and print a line for each setting."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--settings", nargs="+", choices=SETTINGS, default=list(SETTINGS))
    parser.add_argument("--repetitions", type=int, default=3)
    parser.add_argument("--limit-s", type=float, default=20.0)
    options = parser.parse_args()
    cv2.setNumThreads(1)
    result = {}
    for name in options.settings:
        costs = measure(name, options.repetitions, options.limit_s)
        steps_per_s = median(cost.steps / cost.steps_s for cost in costs)
        ratio = median(cost.ratio for cost in costs)
        reset_s = median(cost.reset_s for cost in costs)
        print(
            f"{name}: reset {reset_s:.2f} s, {steps_per_s:.0f} steps per second of CPU time, "
            f"{ratio:.2f} times the time of a plain drive per picture"
        )
        result[name] = {"steps_per_s": round(steps_per_s, 1), "ratio": round(ratio, 3)}
    print(json.dumps(result))


if __name__ == "__main__":
    main()
