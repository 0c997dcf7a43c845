import math

import numpy as np
import pytest

from lavt.errors import UserError
from lavt.vehicle.sim.road.road import Road, load_road, road_names

ROUTES = {
    # length, turn between start and end (degrees), smallest radius, start x, y and heading (degrees)
    "a": (299.93, -90.54, 41.77, 384.36, 53.77, -90.44),
    "a_key": (122.93, -90.54, 41.77, 384.27, 41.77, -90.44),
    "b": (591.19, 179.66, 86.54, -414.62, -9.39, -179.63),
    "b_key": (230.55, 89.27, 86.54, -414.62, -9.39, -179.63),
    "c": (292.56, -90.17, 134.96, 216.68, 367.69, -0.43),
    "c_key": (163.68, -61.57, 134.96, 231.83, 367.64, 0.30),
}
"""Properties of the driven lane of the six routes in the map from which the routes come."""


@pytest.fixture(scope="module")
def road() -> Road:
    return load_road("a_key")


def test_the_package_includes_all_roads() -> None:
    """The package includes three routes, their key parts and a straight road."""
    assert road_names() == sorted([*ROUTES, "straight"])


@pytest.mark.parametrize("name", ROUTES)
def test_a_route_has_the_shape_of_the_map(name: str) -> None:
    """A route's length, turn, smallest radius and start pose are those of the map's lane."""
    length_m, turn_deg, radius_m, *start = ROUTES[name]
    road = load_road(name)
    assert road.route_length_m == pytest.approx(length_m, abs=0.01)
    heading_rad = road.centre_at([0.0, road.route_length_m]).heading_rad
    assert math.degrees(heading_rad[1] - heading_rad[0]) == pytest.approx(turn_deg, abs=0.02)
    curvature_per_m = road.centre_at(np.arange(0.0, road.route_length_m, 0.5)).curvature_per_m
    assert 1 / np.abs(curvature_per_m).max() == pytest.approx(radius_m, abs=0.01)
    x_m, y_m, start_rad = road.start
    assert (x_m, y_m, math.degrees(start_rad)) == pytest.approx(start, abs=0.01)


@pytest.mark.parametrize("name", ROUTES)
def test_a_route_has_the_lanes_of_the_map(name: str) -> None:
    """A route has the four lanes, shoulders, barrier and rails of the map, and the third lane is driven."""
    road = load_road(name)
    assert (road.lanes.edges_at(0.0), road.lanes.driven) == ((-5.25, -1.75, 1.75, 5.25, 8.75), 2)
    assert [(strip.left_m, strip.right_m) for strip in road.paved] == [(12.25, -8.75), (33.25, 12.25)]
    assert {mark.offset_m for mark in road.marks if mark.colour == "yellow"} == {8.75, 15.75}
    assert {mark.offset_m for mark in road.marks if mark.kind == "broken"} >= {5.25, 1.75, -1.75}
    assert {(rail.offset_m, rail.kind) for rail in road.rails} == {(12.25, "barrier"), (-9.15, "rail"), (33.65, "rail")}


@pytest.mark.parametrize("name", ROUTES)
def test_a_road_extends_beyond_its_route(name: str) -> None:
    """A road begins 20 m or more before its route, ends 60 m or more after it, and continues straight at both ends."""
    road = load_road(name)
    assert road.first_m <= -20.0
    assert road.last_m > road.route_length_m + 60.0
    for s_m in (road.first_m - 30.0, road.last_m):
        step = np.diff(road.point_at([s_m, s_m + 20.0, s_m + 30.0], 0.0), axis=0)
        assert np.hypot(*step.T) == pytest.approx([20.0, 10.0])


def test_the_route_ends_where_the_map_says(road: Road) -> None:
    """The route ends at the map's centre of lane -3 of road 38 at s = 75 m."""
    heading_rad = 3.1245246695832329  # the end is 42.464 m along the map's line and 12.25 m to its right
    x_m = 341.47150492643561 + 42.46406 * math.cos(heading_rad) + 12.25 * math.sin(heading_rad)
    y_m = -26.389396319849876 + 42.46406 * math.sin(heading_rad) - 12.25 * math.cos(heading_rad)
    end = road.centre_at(road.route_length_m)
    assert (float(end.x_m), float(end.y_m)) == pytest.approx((x_m, y_m), abs=0.001)


@pytest.mark.parametrize(
    ("key", "whole", "from_m"), [("a_key", "a", 12.0), ("b_key", "b", 0.0), ("c_key", "c", 15.155)]
)
def test_a_key_part_is_the_same_road_with_other_stations(key: str, whole: str, from_m: float) -> None:
    """A key part has its line, marks, dashes, rails and ends in the same places as its whole road."""
    part, road = load_road(key), load_road(whole)
    stations_m = np.linspace(part.first_m, part.last_m, 50)
    np.testing.assert_allclose(part.point_at(stations_m, -3.0), road.point_at(stations_m + from_m, -3.0), atol=1e-9)
    assert (part.first_m, part.last_m) == pytest.approx((road.first_m - from_m, road.last_m - from_m))
    for part_rail, rail in zip(part.rails, road.rails, strict=True):
        assert (part_rail.from_m, part_rail.to_m) == pytest.approx((rail.from_m - from_m, rail.to_m - from_m))
    for part_mark, mark in zip(part.marks, road.marks, strict=True):
        assert (part_mark.from_m, part_mark.to_m) == pytest.approx((mark.from_m - from_m, mark.to_m - from_m))
        dash_begins_m = part_mark.dash_begins_m(part.first_m, part.last_m)
        np.testing.assert_allclose(dash_begins_m + from_m, mark.dash_begins_m(road.first_m, road.last_m))


def test_a_broken_mark_has_whole_dashes_within_its_range(road: Road) -> None:
    """A broken mark has a whole dash in each period, and no dash exceeds an end of the mark."""
    mark = next(mark for mark in road.marks if mark.kind == "broken" and math.isfinite(mark.from_m))
    begin_m = mark.dash_begins_m(road.first_m, 100.0)
    assert (np.diff(begin_m) == mark.dash_m + mark.gap_m).all()
    assert mark.from_m <= begin_m[0] < mark.from_m + mark.dash_m + mark.gap_m
    last_possible_m = 100.0 - mark.dash_m
    assert last_possible_m - (mark.dash_m + mark.gap_m) < begin_m[-1] <= last_possible_m


def test_projection_searches_only_near_the_last_station(road: Road) -> None:
    """A projection finds no station farther than 15 m from the last station."""
    x_m, y_m = road.point_at(100.0, 0.0).tolist()
    s_m, *_ = road.project(x_m, y_m, 20.0)
    assert s_m <= 35.0


def test_an_unknown_road_is_rejected() -> None:
    """The error for an unknown road lists the known roads and mentions files."""
    with pytest.raises(UserError, match=r"a, a_key, b, b_key, c, c_key.*\.yaml file"):
        load_road("nowhere")
