"""The shapes of a plan view agree with closed forms."""

from __future__ import annotations

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import special

from lavt.opendrive.geometry import Clothoid, Cubic, CubicCurve, PlanElement, element_point


def test_a_line_goes_straight_ahead() -> None:
    """A point on a line lies ahead in the heading of the element."""
    point = element_point(PlanElement(10.0, 1.0, 2.0, math.pi / 6, Clothoid(50.0)), 30.0)
    assert point == pytest.approx((1.0 + 20.0 * math.sqrt(0.75), 12.0, math.pi / 6, 0.0))


def test_an_arc_is_a_part_of_a_circle() -> None:
    """A quarter of a circle to the right ends a radius ahead and a radius to the right."""
    point = Clothoid(20 * math.pi / 2, -0.05, -0.05).point(20 * math.pi / 2)
    assert point == pytest.approx((20.0, -20.0, -math.pi / 2, -0.05))


@pytest.mark.parametrize("length_m", [3.0, 40.0, 300.0])
def test_a_clothoid_agrees_with_fresnel_integrals(length_m: float) -> None:
    """A clothoid from straight to a radius of 15 m ends where the Fresnel integrals say, also after several turns."""
    scale = math.sqrt(math.pi * length_m * 15.0)
    sine, cosine = special.fresnel(length_m / scale)
    point = Clothoid(length_m, 0.0, 1 / 15.0).point(length_m)
    assert point == pytest.approx((cosine * scale, sine * scale, length_m / 30.0, 1 / 15.0), abs=1e-9)


@given(
    begin=st.floats(-0.2, 0.2),
    end=st.floats(-0.2, 0.2),
    length_m=st.floats(0.1, 100.0),
    share=st.floats(0.0, 1.0),
)
@settings(max_examples=40)
def test_the_two_parts_of_a_clothoid_make_the_whole(begin: float, end: float, length_m: float, share: float) -> None:
    """A clothoid that is cut at any point ends at the same pose."""
    cut_m = share * length_m
    middle = begin + share * (end - begin)
    whole = Clothoid(length_m, begin, end).point(length_m)
    first = Clothoid(cut_m, begin, middle).point(cut_m)
    rest = PlanElement(cut_m, first.ahead_m, first.left_m, first.turn_rad, Clothoid(length_m - cut_m, middle, end))
    assert element_point(rest, length_m)[:3] == pytest.approx(whole[:3], abs=1e-9)


def test_a_poly3_is_followed_by_arc_length() -> None:
    """On a poly3 that is a slanted line, a point lies the arc length along the slant, not along the first axis."""
    point = CubicCurve(50.0, Cubic(0.0, 1.0), Cubic(0.0, 0.75), None).point(50.0)
    assert point == pytest.approx((40.0, 30.0, math.atan(0.75), 0.0))


def test_a_param_poly3_is_followed_by_arc_length() -> None:
    """On a parabola, whose parameter is not its arc length, the closed form of the arc length gives the point."""
    # (p, p²/2) for p from 0 to 1, times 10: its arc length is 10 (p sqrt(1 + p²) + asinh p) / 2.
    p = 0.4
    along_m, length_m = (5.0 * (x * math.sqrt(1 + x * x) + math.asinh(x)) for x in (p, 1.0))
    point = CubicCurve(length_m, Cubic(0.0, 10.0), Cubic(0.0, 0.0, 5.0), 1.0).point(along_m)
    assert point == pytest.approx((4.0, 0.8, math.atan(p), 0.1 / (1 + p * p) ** 1.5))


def test_a_param_poly3_ends_at_its_last_parameter() -> None:
    """A curve whose length is rounded in the file still ends at its last parameter, so that no gap opens."""
    curve = CubicCurve(29.9, Cubic(0.0, 30.0), Cubic(0.0), 1.0)
    assert curve.point(29.9).ahead_m == pytest.approx(30.0)


@given(coefficients=st.lists(st.floats(-50.0, 50.0), min_size=6, max_size=6), share=st.floats(0.0, 1.0))
@settings(max_examples=40)
def test_every_cubic_curve_has_points(coefficients: list[float], share: float) -> None:
    """Any cubic curve, also with cusps or without extent, has a finite point at every arc length."""
    curve = CubicCurve(20.0, Cubic(0.0, *coefficients[:3]), Cubic(0.0, *coefficients[3:]), 1.0)
    assert all(map(math.isfinite, curve.point(20.0 * share)))
