import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lavt.vehicle.sim.road.centreline import Centreline, Segment

CURVATURES = st.floats(-0.05, 0.05)
LINES = st.builds(lambda length: Segment(length, 0.0, 0.0), st.floats(1.0, 80.0))
ARCS = st.builds(lambda length, curvature: Segment(length, curvature, curvature), st.floats(1.0, 80.0), CURVATURES)
CLOTHOIDS = st.builds(Segment, st.floats(1.0, 80.0), CURVATURES, CURVATURES)
SEGMENTS = st.lists(st.one_of(LINES, ARCS, CLOTHOIDS), min_size=1, max_size=6)

FIRST_M = -10.0
"""The station at which the lines of the tests begin."""


def line_of(segments: list[Segment]) -> Centreline:
    return Centreline(FIRST_M, (3.0, -2.0, 0.7), segments)


@settings(max_examples=200)
@given(SEGMENTS, st.floats(0, 1), st.floats(-8.0, 8.0), st.floats(-12.0, 12.0))
def test_projection_inverts_station_and_offset(
    segments: list[Segment], share: float, offset_m: float, window_shift_m: float
) -> None:
    """A point constructed from a station and an offset is projected back to this station and offset."""
    line = line_of(segments)
    s_m = FIRST_M + share * (line.last_m - FIRST_M)
    x_m, y_m, heading_rad, _ = (float(value) for value in line.sample(s_m))
    projection = line.project(
        x_m - offset_m * math.sin(heading_rad),
        y_m + offset_m * math.cos(heading_rad),
        s_m + window_shift_m - 13.0,
        s_m + window_shift_m + 13.0,
    )
    assert projection[:3] == pytest.approx((s_m, offset_m, heading_rad), abs=1e-6)


@settings(max_examples=50)
@given(st.floats(20.0, 200.0), CURVATURES, CURVATURES)
def test_a_clothoids_position_is_the_integral_of_its_heading(length_m: float, begin: float, end: float) -> None:
    """Positions on a clothoid equal the integral of the heading within 0.1 mm over 200 m."""
    line = Centreline(0.0, (0.0, 0.0, 0.0), [Segment(length_m, begin, end)])
    middles_m = (np.arange(200_000) + 0.5) * length_m / 200_000
    turn_rad = begin * middles_m + (end - begin) / length_m * middles_m**2 / 2
    step_m = length_m / 200_000
    x_m, y_m, heading_rad, _ = line.sample(length_m)
    assert float(x_m) == pytest.approx(np.cos(turn_rad).sum() * step_m, abs=1e-4)
    assert float(y_m) == pytest.approx(np.sin(turn_rad).sum() * step_m, abs=1e-4)
    assert float(heading_rad) == pytest.approx((begin + end) / 2 * length_m, abs=1e-9)


def test_a_clothoid_is_the_fresnel_integral() -> None:
    """A clothoid from straight to a radius of 50 m in 100 m ends at the tabulated point of Euler's spiral."""
    line = Centreline(0.0, (0.0, 0.0, 0.0), [Segment(100.0, 0.0, 0.02)])
    x_m, y_m, _, _ = line.sample(100.0)
    # x and y are the integrals of cos t^2 and sin t^2 from 0 to 1 (0.904524238 and 0.310268302), times 100 m.
    assert (float(x_m), float(y_m)) == pytest.approx((90.4524238, 31.0268302), abs=1e-6)


@settings(max_examples=100)
@given(SEGMENTS)
def test_a_centreline_is_continuous(segments: list[Segment]) -> None:
    """At every joint position and heading are continuous, and the curvature changes to that of the next segment."""
    line = line_of(segments)
    joint_m = FIRST_M
    for before, after in itertools.pairwise(segments):
        joint_m += before.length_m
        x_m, y_m, heading_rad, curvature = line.sample([joint_m - 1e-6, joint_m + 1e-6])
        assert math.hypot(x_m[1] - x_m[0], y_m[1] - y_m[0]) == pytest.approx(2e-6, abs=1e-7)
        assert heading_rad[1] - heading_rad[0] == pytest.approx(0.0, abs=1e-6)
        assert curvature.tolist() == pytest.approx([before.end_curvature_per_m, after.curvature_per_m], abs=1e-6)


def test_a_centreline_is_straight_beyond_both_ends() -> None:
    """The line is straight before the first segment and after the last segment."""
    line = line_of([Segment(30.0, 0.02, 0.02)])
    _, _, heading_rad, curvature = line.sample([-60.0, -11.0, 20.1, 70.0])
    assert heading_rad[0] == heading_rad[1]
    assert heading_rad[2] == heading_rad[3]
    assert curvature.tolist() == [0.0, 0.0, 0.0, 0.0]
