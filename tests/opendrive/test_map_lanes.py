"""Positions in lanes and routes along lanes."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lavt.errors import UserError
from lavt.opendrive.lanes import lane_point, reference_point
from lavt.opendrive.reader import parse_map, read_map
from lavt.opendrive.road_map import MapRoad
from lavt.opendrive.routes import LaneStep, find_route

HAMLET = read_map(str(Path(__file__).parent / "data" / "hamlet.xodr"))


def make_road(*, shape: str = "<line/>", offset: str = "", lanes: str, rule: str = "RHT") -> MapRoad:
    text = f"""<OpenDRIVE><road id="1" length="40" rule="{rule}">
        <planView><geometry s="0" x="0" y="0" hdg="0" length="40">{shape}</geometry></planView>
        <lanes>{offset}<laneSection s="0">{lanes}</laneSection></lanes></road></OpenDRIVE>"""
    return parse_map(text.encode(), "m.xodr").road("1")


def test_a_width_is_a_cubic_of_the_distance_from_its_entry() -> None:
    """The lane's width, position and heading follow the cubic that holds at the station, and the lane offset."""
    road = make_road(
        offset='<laneOffset s="10" a="1" b="0.1" c="0" d="0"/>',
        lanes='<right><lane id="-1"><width sOffset="0" a="3" b="0" c="0" d="0"/>'
        '<width sOffset="20" a="3" b="0.1" c="0.01" d="0.001"/></lane></right>',
    )
    assert lane_point(road, -1, 5.0) == pytest.approx((5.0, -1.5, 0.0, 3.0, -1.5))
    width_m, slope = 3 + 1 + 1 + 1, 0.1 + 0.2 + 0.3
    assert lane_point(road, -1, 30.0) == pytest.approx(
        (30.0, 3.0 - width_m / 2, math.atan(0.1 - slope / 2), width_m, 3.0 - width_m / 2)
    )


def test_lanes_with_borders_have_the_widths_between_them() -> None:
    """Where lanes have borders, the width is the distance between two borders."""
    road = make_road(
        lanes='<left><lane id="1"><border sOffset="0" a="3" b="0.1" c="0" d="0"/></lane>'
        '<lane id="2"><border sOffset="0" a="8" b="0" c="0" d="0"/></lane></left>'
    )
    assert lane_point(road, 2, 10.0)[3:] == pytest.approx((4.0, 6.0))


def test_in_a_curve_the_heading_of_a_widening_lane_depends_on_its_radius() -> None:
    """The centre line's heading is the direction between its neighbouring points."""
    road = make_road(
        shape='<arc curvature="0.04"/>',
        lanes='<right><lane id="-1"><width sOffset="0" a="3" b="0.3" c="0" d="0"/></lane></right>',
    )
    before, after = lane_point(road, -1, 19.999), lane_point(road, -1, 20.001)
    direction = math.atan2(after.y_m - before.y_m, after.x_m - before.x_m)
    assert lane_point(road, -1, 20.0).heading_rad == pytest.approx(direction, abs=1e-6)


def test_a_width_below_zero_counts_as_zero() -> None:
    """A lane that a map closes a little too early has no width there."""
    road = make_road(lanes='<right><lane id="-1"><width sOffset="0" a="3" b="-0.1" c="0" d="0"/></lane></right>')
    assert lane_point(road, -1, 35.0)[3:] == (0.0, 0.0)


@given(share=st.floats(0.0, 1.0), number=st.sampled_from(list(HAMLET.roads)))
@settings(max_examples=40)
def test_neighbouring_lanes_touch(share: float, number: str) -> None:
    """At every station, the lateral positions of lanes differ by half of the sum of their widths."""
    road = HAMLET.road(number)
    s_m = share * road.length_m
    lanes = road.sections[road.section_index(s_m)].lanes
    points = {lane: lane_point(road, lane, s_m) for lane in lanes}
    reference = reference_point(road, s_m)
    for lane, point in points.items():
        assert math.hypot(point.x_m - reference.x_m, point.y_m - reference.y_m) == pytest.approx(abs(point.t_m))
        if lane - 1 in points:
            right = points[lane - 1]
            assert point.t_m - right.t_m == pytest.approx((point.width_m + right.width_m) / 2)


def test_a_route_leads_through_a_junction() -> None:
    """A route goes through lane sections and the connecting road of its junction, and continuously so."""
    steps = find_route(HAMLET, ("1", -1), ("3", 1))
    assert steps == [LaneStep("1", 0, -1), LaneStep("1", 1, -1), LaneStep("12", 0, -1), LaneStep("3", 0, 1)]
    end = lane_point(HAMLET.road("1"), -1, 70.0, 1)
    begin = lane_point(HAMLET.road("12"), -1, 0.0)
    assert math.hypot(end.x_m - begin.x_m, end.y_m - begin.y_m) < 1e-6
    leave, enter = lane_point(HAMLET.road("12"), -1, HAMLET.road("12").length_m), lane_point(HAMLET.road("3"), 1, 45.0)
    assert math.hypot(leave.x_m - enter.x_m, leave.y_m - enter.y_m) < 1e-6
    assert leave.width_m == pytest.approx(enter.width_m)


def test_left_lanes_are_driven_towards_the_start() -> None:
    """With traffic on the right, a left lane leads from the end of a road to its start."""
    assert find_route(HAMLET, ("2", 1), ("1", 1)) == [
        LaneStep("2", 0, 1),
        LaneStep("11", 0, 1),
        LaneStep("1", 1, 1),
        LaneStep("1", 0, 1),
    ]
    assert make_road(lanes='<left><lane id="1"/></left>', rule="LHT").drives_forward(1)


@pytest.mark.parametrize(
    ("start", "goal", "message"),
    [
        (("1", -2), ("3", 1), "no way leads"),
        (("1", 1), ("2", -1), "no way leads"),
        (("9", 1), ("2", -1), "no road 9"),
        (("1", -5), ("2", -1), "road 1 has no lane -5: name one of -2, -1, 1"),
        (("1", 0), ("2", -1), "no lane 0"),
    ],
)
def test_a_route_that_does_not_exist_is_rejected(start: tuple[str, int], goal: tuple[str, int], message: str) -> None:
    """A missing road or lane, or lanes that no way joins, raise UserError."""
    with pytest.raises(UserError, match=message):
        find_route(HAMLET, start, goal)


def test_places_outside_a_road_are_rejected() -> None:
    """A station beyond the ends of a road, or a lane that it does not have there, raises UserError."""
    with pytest.raises(UserError, match=r"no s=70\.100"):
        lane_point(HAMLET.road("1"), -1, 70.1)
    with pytest.raises(UserError, match="no lane -2 at s=5"):
        lane_point(HAMLET.road("1"), -2, 5.0)
