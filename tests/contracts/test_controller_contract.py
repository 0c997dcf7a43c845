"""The contract of every `DriveController`, with every preset."""

from __future__ import annotations

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lavt.control.drive_controller import CONTROLLERS, PRESETS, DriveController, make_controller
from lavt.domain import NS_PER_S, PATH_POINTS, Decision, Lane

FRAME_NS = NS_PER_S // 30
LANES = st.builds(
    Lane,
    st.tuples(st.floats(-5, 5), st.floats(-1, 1), st.floats(-0.1, 0.1)),
    st.floats(2, 5),
    st.just(3.6),
    st.floats(5, 20),
    st.floats(0, 1),
)
SEEN = st.lists(st.tuples(LANES, st.floats(0, 20)), min_size=1, max_size=12)
every_one = pytest.mark.parametrize(
    ("kind", "preset"), [(kind, preset) for kind in sorted(CONTROLLERS) for preset in sorted(PRESETS)]
)


def new(kind: str, preset: str) -> DriveController:
    return make_controller(kind, PRESETS[preset], wheelbase_m=2.8448)


def decide(controller: DriveController, seen: list[tuple[Lane, float]]) -> list[Decision]:
    return [controller.decide(lane, speed_mps, each * FRAME_NS) for each, (lane, speed_mps) in enumerate(seen)]


@every_one
@settings(max_examples=40)
@given(seen=SEEN)
def test_decisions_are_in_range_and_repeat(kind: str, preset: str, seen: list[tuple[Lane, float]]) -> None:
    """Decisions are in the range of a command, and equal for equal inputs."""
    decisions = decide(new(kind, preset), seen)
    assert decisions == decide(new(kind, preset), seen)
    for decision in decisions:
        assert abs(decision.steering_rad) <= math.pi / 4
        assert 0 <= decision.throttle <= 1
        assert 0 <= decision.brake <= 1
        assert len(decision.path_curvature_per_m) == PATH_POINTS
        assert all(abs(each) <= 1 for each in decision.path_curvature_per_m)


@every_one
@pytest.mark.parametrize("speed_mps", [0.0, 2.0, 8.3, 15.0])
def test_without_a_lane_there_is_no_throttle(kind: str, preset: str, speed_mps: float) -> None:
    """Without a lane there is no throttle, also if none was ever seen."""
    for first in ([], [(Lane((0.0, 0.0, 0.0), 3.5, 3.6, 20.0, 1.0), speed_mps)]):
        lost = [(Lane((0.0, 0.0, 0.0), 3.5, 3.6, 20.0, 0.0), speed_mps)] * 40
        decisions = decide(new(kind, preset), first + lost)[len(first) :]
        assert all(decision.throttle == 0 for decision in decisions)
