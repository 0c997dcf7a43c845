"""The controller in an agent's place."""

from __future__ import annotations

from dataclasses import replace

import pytest

from lavt.control.agent import AgentController
from lavt.control.preset import DESIGNED
from lavt.domain import PATH_POINTS, Lane

STRAIGHT = Lane(centre=(0.0, 0.0, 0.0), width_m=3.5, near_m=3.6, far_m=20.0, confidence=1.0)
LOST = Lane(centre=(0.0, 0.0, 0.0), width_m=3.5, near_m=3.6, far_m=20.0, confidence=0.0)
PRESET = replace(DESIGNED, steering_limit_rad=0.3)


def controller(steering_rad: float = 0.0, speed_mps: float = 5.0) -> AgentController:
    result = AgentController(PRESET, wheelbase_m=2.8448)
    result.wanted_steering_rad, result.wanted_speed_mps = steering_rad, speed_mps
    return result


@pytest.mark.parametrize(("wanted_rad", "steering_rad"), [(0.1, 0.1), (-0.25, -0.25), (0.4, 0.3), (-1.0, -0.3)])
def test_the_steering_is_what_the_agent_wants_within_the_limit(wanted_rad: float, steering_rad: float) -> None:
    """The steering is the wanted angle, clamped to the steering limit of the preset."""
    assert controller(wanted_rad).decide(STRAIGHT, 5.0, 0).steering_rad == steering_rad


@pytest.mark.parametrize(
    ("wanted_mps", "speed_mps", "pedal"),
    [(5.0, 3.0, "throttle"), (5.0, 7.0, "brake"), (100.0, 9.0, "brake"), (-1.0, 0.5, "brake")],
)
def test_the_pedals_keep_the_wanted_speed(wanted_mps: float, speed_mps: float, pedal: str) -> None:
    """The pedals lead to the wanted speed, which is at least 0 and at most the speed of the preset."""
    decision = controller(speed_mps=wanted_mps).decide(STRAIGHT, speed_mps, 0)
    assert (decision.throttle > 0, decision.brake > 0) == (pedal == "throttle", pedal == "brake")


def test_without_a_lane_no_pedal_is_used() -> None:
    """Without a lane, the agent steers, and no pedal is used."""
    decision = controller(0.1).decide(LOST, 3.0, 0)
    assert (decision.steering_rad, decision.throttle, decision.brake) == (0.1, 0.0, 0.0)


def test_the_path_leads_along_the_lane_and_not_along_the_steering() -> None:
    """The path for a car without commands follows the seen lane, however the agent steers."""
    left_turn = Lane(centre=(0.0, 0.0, 0.01), width_m=3.5, near_m=3.6, far_m=20.0, confidence=1.0)
    path_per_m = controller(-0.2).decide(left_turn, 5.0, 0).path_curvature_per_m
    assert len(path_per_m) == PATH_POINTS
    assert min(path_per_m) > 0.005
