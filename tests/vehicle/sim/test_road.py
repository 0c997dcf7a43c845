import math

import numpy as np
import pytest

from lavt.errors import UserError
from lavt.vehicle.sim.road import Road, load_road, parse_road, road_names


@pytest.fixture(scope="module")
def road() -> Road:
    return load_road("a_key")


def test_the_route_has_the_length_and_the_turn_of_the_map(road: Road) -> None:
    """A key is 123 m long and turns right by 90.5 degrees."""
    assert road.length_m == pytest.approx(122.93, abs=0.01)
    _, _, heading_rad, _ = road.point([0.0, road.length_m])
    assert math.degrees(heading_rad[1] - heading_rad[0]) == pytest.approx(-90.54, abs=0.01)


def test_the_route_starts_where_the_map_says(road: Road) -> None:
    """The start is the map's centre of lane -3 of road 37 at s = 14 m."""
    x_m, y_m, heading_rad = road.start
    assert (x_m, y_m) == pytest.approx((384.269, 41.768), abs=0.001)
    assert math.degrees(heading_rad) == pytest.approx(-90.44, abs=0.01)


def test_the_route_ends_where_the_map_says(road: Road) -> None:
    """The end is the map's centre of lane -3 of road 38 at s = 75 m: 42.464 m along its line, 12.25 m to the right."""
    heading_rad = 3.1245246695832329
    x_m = 341.47150492643561 + 42.46406 * math.cos(heading_rad) + 12.25 * math.sin(heading_rad)
    y_m = -26.389396319849876 + 42.46406 * math.sin(heading_rad) - 12.25 * math.cos(heading_rad)
    end_x_m, end_y_m, _, _ = road.point(road.length_m)
    assert (float(end_x_m), float(end_y_m)) == pytest.approx((x_m, y_m), abs=0.01)


def test_the_curve_has_the_radius_of_the_lane(road: Road) -> None:
    """Three points of the curve lie on a circle of 41.77 m."""
    p = road.across([20.0, 45.0, 70.0], 0.0)
    a, b, c = (float(np.hypot(*(p[i] - p[j]))) for i, j in ((0, 1), (1, 2), (2, 0)))
    d, e = p[1] - p[0], p[2] - p[0]
    assert a * b * c / (2 * abs(d[0] * e[1] - d[1] * e[0])) == pytest.approx(41.766, abs=0.001)


def test_there_is_road_before_the_start_and_beyond_the_end(road: Road) -> None:
    """20 m lie before the start and at least 60 m beyond the end, and both go straight on."""
    assert road.first_m == -20.0
    assert road.last_m > road.length_m + 60.0
    step = np.diff(road.across([-60.0, -50.0, 310.0, 320.0], 0.0), axis=0)
    assert np.hypot(*step[0]) == pytest.approx(10.0)
    assert np.hypot(*step[2]) == pytest.approx(10.0)


@pytest.mark.parametrize("offset_m", [-9.0, -1.0, 0.0, 0.5, 12.0])
def test_projection_undoes_what_across_does(road: Road, offset_m: float) -> None:
    """A place made from a station and an offset projects to them, wherever near it the search begins."""
    for s_m in np.linspace(-25.0, 300.0, 131).tolist():
        x_m, y_m = road.across(s_m, offset_m).tolist()
        _, _, heading_rad, _ = road.point(s_m)
        found = road.project(x_m, y_m, s_m + 8.0)
        assert found == pytest.approx((s_m, offset_m, float(heading_rad)), abs=1e-6)


def test_projection_looks_only_near_the_last_station(road: Road) -> None:
    """A search that begins far away stays in its window and does not jump to the nearest piece of road."""
    x_m, y_m = road.across(100.0, 0.0).tolist()
    assert road.project(x_m, y_m, 20.0)[0] <= 35.0


def test_edges_of_lanes_surround_the_driven_lane(road: Road) -> None:
    """The driven lane is 3.5 m wide with the reference in its middle."""
    assert road.lanes.edges_m == (-5.25, -1.75, 1.75, 5.25, 8.75)
    assert road.lanes.driven == 2


def test_an_unknown_road_is_refused_with_the_known_ones() -> None:
    """The error for an unknown name lists what there is."""
    assert "a_key" in road_names()
    with pytest.raises(UserError, match=r"known are: .*a_key"):
        load_road("nowhere")


@pytest.mark.parametrize("name", road_names())
def test_every_road_that_comes_along_is_valid(name: str) -> None:
    """Every road of the package loads, and its route lies on its segments."""
    road = load_road(name)
    assert road.first_m <= 0.0 < road.length_m <= road.last_m


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("title: x", "origin"),
        ("title: x\nradius: 3", "radius"),
        ("title: [", "not YAML"),
        ("title: x\nlanes: {left_edge_m: 1, widths_m: [3], driven: 0, colour: red}", r"lanes\.colour"),
    ],
)
def test_a_wrong_file_is_refused_with_the_place(text: str, words: str) -> None:
    """Missing and unknown keys and bad YAML are refused by a sentence that names the file and the key."""
    with pytest.raises(UserError, match=rf"(?s)x\.yaml.*{words}"):
        parse_road(text, source="x.yaml")
