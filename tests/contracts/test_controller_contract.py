"""The contract of every `DriveController`, with every preset."""

from __future__ import annotations

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lavt.control.drive_controller import CONTROLLERS, DriveController, make_controller
from lavt.control.preset import PRESETS
from lavt.domain import NS_PER_S, PATH_POINTS, Decision, Lane

FRAME_NS = NS_PER_S // 30
LANES = st.builds(
    Lane,
    centre=st.tuples(st.floats(-5, 5), st.floats(-1, 1), st.floats(-0.1, 0.1)),
    width_m=st.floats(2, 5),
    near_m=st.just(3.6),
    far_m=st.floats(5, 20),
    confidence=st.floats(0, 1),
)
OBSERVATIONS = st.lists(st.tuples(LANES, st.floats(0, 20)), min_size=1, max_size=12)
every_controller = pytest.mark.parametrize(
    ("kind", "preset"), [(kind, preset) for kind in sorted(CONTROLLERS) for preset in sorted(PRESETS)]
)


def new_controller(kind: str, preset: str) -> DriveController:
    return make_controller(kind, PRESETS[preset], wheelbase_m=2.8448)


def decide(controller: DriveController, observations: list[tuple[Lane, float]]) -> list[Decision]:
    return [
        controller.decide(lane, speed_mps, frame_number * FRAME_NS)
        for frame_number, (lane, speed_mps) in enumerate(observations)
    ]


@every_controller
@settings(max_examples=40)
@given(observations=OBSERVATIONS)
def test_decisions_are_in_range_and_reproducible(
    kind: str, preset: str, observations: list[tuple[Lane, float]]
) -> None:
    """Decisions are within the ranges of a command, and two new controllers decide equally on equal observations."""
    decisions = decide(new_controller(kind, preset), observations)
    assert decisions == decide(new_controller(kind, preset), observations)
    for decision in decisions:
        assert abs(decision.steering_rad) <= math.pi / 4
        assert 0 <= decision.throttle <= 1
        assert 0 <= decision.brake <= 1
        assert len(decision.path_curvature_per_m) == PATH_POINTS
        assert all(abs(curvature_per_m) <= 1 for curvature_per_m in decision.path_curvature_per_m)


@every_controller
@pytest.mark.parametrize("speed_mps", [0.0, 2.0, 8.3, 15.0])
def test_without_a_lane_there_is_no_throttle(kind: str, preset: str, speed_mps: float) -> None:
    """Without a lane there is no throttle, whether or not a lane was detected before."""
    detected, undetected = (
        Lane(centre=(0.0, 0.0, 0.0), width_m=3.5, near_m=3.6, far_m=20.0, confidence=confidence)
        for confidence in (1.0, 0.0)
    )
    for earlier in ([], [(detected, speed_mps)]):
        later = [(undetected, speed_mps)] * 40
        decisions = decide(new_controller(kind, preset), earlier + later)[len(earlier) :]
        assert all(decision.throttle == 0 for decision in decisions)
