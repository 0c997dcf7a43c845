"""An agent that learns to drive over a delayed network, with numpy alone, compared with pure pursuit.

python examples/gym_lane_keeping.py [DIRECTORY] [--generations N] [--video-ms MS] [--control-ms MS]

The policy is linear: the steering is a weighted sum of the seen lane and of the last actions, which the delayed picture
does not show yet. The cross-entropy method (Rubinstein, European Journal of Operational Research 99, 1997) finds the
weights: each generation draws policies, drives with each of them, and moves towards the best ones. The weights are
written to DIRECTORY/policy.txt.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from lavt.gym import LANE_KEEPING

ACTIONS = 8
"""How many of the last actions the policy knows: those of 0.27 s at 30 pictures a second."""
SEEN_M = np.array([6.0, 14.0])
"""The policy knows the offset of the lane's centre at these distances ahead."""
POLICIES, BEST = 16, 4
SPREAD = np.array([0.2] * len(SEEN_M) + [0.05] * ACTIONS)
"""Standard deviation of the weights in the first generation; their mean is 0."""
TRAINING_STEPS = 270
"""Steps of a drive in training: 9 s, in which the car starts, and drives half of the first bend."""
UNSEEN_SEEDS = range(1000, 1005)
WHEELBASE_M, STEERING_SCALE_RAD = 2.8448, 0.2
Policy = Callable[[NDArray[np.float32]], float]


def pure_pursuit(observation: NDArray[np.float32]) -> float:
    """Return the action of the lane keeper `designed`: the circle to the lane's point that is 1.01 s ahead."""
    c0, c1, c2, _, speed_mps = observation[:5].tolist()
    distance_m = min(max(1.01 * speed_mps, 4.0), 20.0)
    left_m = c0 + (c1 + c2 * distance_m) * distance_m
    return math.atan(WHEELBASE_M * 2 * left_m / distance_m**2) / STEERING_SCALE_RAD


def linear(weights: NDArray[np.float64]) -> Policy:
    """Return the policy with these weights: for the offsets of the lane, and for the last actions."""

    def act(observation: NDArray[np.float32]) -> float:
        c0, c1, c2 = observation[:3].tolist()
        offsets_m = c0 + (c1 + c2 * SEEN_M) * SEEN_M
        return float(weights @ np.concatenate([offsets_m, observation[7:]]))

    return act


def drive(env: gymnasium.Env[Any, Any], policy: Policy, seed: int, steps: int = 100_000) -> tuple[float, str]:
    """Return the sum of rewards of an episode, and its ending."""
    observation, info = env.reset(seed=seed)
    total = 0.0
    for _ in range(steps):
        action = np.clip([policy(observation)], -1.0, 1.0).astype(np.float32)
        observation, reward, terminated, truncated, info = env.step(action)
        total += float(reward)
        if terminated or truncated:
            break
    return total, info["ending"]


def train(env: gymnasium.Env[Any, Any], generations: int) -> NDArray[np.float64]:
    """Return the weights that the cross-entropy method finds, and print the returns of each generation."""
    generator = np.random.default_rng(1)
    mean, spread = np.zeros(len(SPREAD)), SPREAD
    for generation in range(generations):
        weights = generator.normal(mean, spread, (POLICIES, len(mean)))
        returns = [drive(env, linear(candidate), generation, TRAINING_STEPS)[0] for candidate in weights]
        best = weights[np.argsort(returns)[-BEST:]]
        mean, spread = best.mean(axis=0), np.maximum(best.std(axis=0), SPREAD / 10)
        mean_return, best_return = np.mean(returns), np.max(returns)
        print(
            f"generation {generation + 1}: return {mean_return:.2f} on average, {best_return:.2f} at best", flush=True
        )
    return mean


def main() -> None:
    """Train a policy, and compare it with pure pursuit on starts that it has not seen."""
    parser = argparse.ArgumentParser()
    parser.add_argument("directory", nargs="?", type=Path, default=None)
    parser.add_argument("--generations", type=int, default=10)
    parser.add_argument("--video-ms", type=float, default=250.0)
    parser.add_argument("--control-ms", type=float, default=100.0)
    options = parser.parse_args()
    directory = options.directory or Path(mkdtemp(prefix="lavt-"))
    env = gymnasium.make(
        LANE_KEEPING,
        video_ms=options.video_ms,
        control_ms=options.control_ms,
        action_history=ACTIONS,
        steering_scale_rad=STEERING_SCALE_RAD,
    )
    weights = train(env, options.generations)
    np.savetxt(directory / "policy.txt", weights)
    for name, policy in {"pure pursuit": pure_pursuit, "trained policy": linear(weights)}.items():
        drives = [drive(env, policy, seed) for seed in UNSEEN_SEEDS]
        completed = sum(ending == "completed" for _, ending in drives)
        print(f"{name}: {completed} of {len(drives)} routes completed, return {np.mean([r for r, _ in drives]):.2f}")
    env.close()


if __name__ == "__main__":
    main()
