"""The costs of one vehicle, from the steps of `fleet.py`, and the steps' rows in a table."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

MIN_STEPS = 2
MIN_RECEIVED_SHARE = 0.95
"""A step in which more states are lost shows a limit, not the cost of a state."""


def costs_per_vehicle(steps: Sequence[Mapping[str, Any]], topology: str) -> dict[str, float]:
    """Return the router's costs of one light vehicle: straight lines through all steps with this topology.

    `processor_s_per_state` is the time for one state that comes in and goes out to one subscriber,
    `processor_s_per_session_s` that for one connected vehicle in one second without states. Driven vehicles count as
    100 messages a second and two sessions each. Steps with lost states are left out. Empty if too few steps remain.
    """
    chosen = [step for step in steps if step["topology"] == topology and is_complete(step)]
    sessions = np.array([step["light"] + 2 * step["driven"] for step in chosen], dtype=float)
    if len(set(sessions)) < MIN_STEPS:
        return {}
    # A driven vehicle's command goes to the vehicle; its state goes to the client and to the watcher.
    messages = np.array([step["sent_per_s"] + 100.0 * step["driven"] for step in chosen])
    shares = np.array([step["processor_share"] for step in chosen])
    columns = np.column_stack([np.ones_like(sessions), messages, sessions])
    if np.linalg.matrix_rank(columns / columns.max(axis=0)) < columns.shape[1] or len(chosen) <= columns.shape[1]:
        columns = columns[:, :2]  # the rate was the same in all steps: sessions and messages cannot be told apart
    (_, per_message, *per_session), *_ = np.linalg.lstsq(columns, shares, rcond=None)
    costs = {"processor_s_per_state": float(per_message)}
    if per_session:
        costs["processor_s_per_session_s"] = float(per_session[0])
    for name in ("resident_mb", "descriptors"):
        values = np.array([step[name] for step in chosen], dtype=float)
        costs[f"{name}_per_session"] = float(np.polyfit(sessions, values, 1)[0])
    return {name: float(f"{value:.3g}") for name, value in costs.items()}


def is_complete(step: Mapping[str, Any]) -> bool:
    """Return whether nearly all states of the sampled vehicles arrived."""
    return bool(step["states_received_share"] >= MIN_RECEIVED_SHARE)


def table_row(step: Mapping[str, Any]) -> list[str]:
    """Return a step's row."""
    return [
        step["topology"],
        str(step["light"]),
        str(step["driven"]),
        f"{step['rate_hz']:g}",
        f"{step['processor_share']:.3f}",
        f"{step['resident_mb']:.0f}",
        f"{step['descriptors']}, {step['threads']}",
        _times(step["state_ms"]),
        f"{100 * step['states_received_share']:.1f} %",
        _times(step["round_trip_ms"]),
        str(step["lost_commands"]),
        f"{step['built_s']:.0f}",
    ]


def _times(values: Sequence[float]) -> str:
    return f"{values[0]:.2f} / {values[1]:.2f}" if values else "none"
