from __future__ import annotations

import math

import numpy as np
import pytest
import yaml

from lavt.errors import UserError
from lavt.vehicle.sim.road.random_road import (
    BENDS,
    LARGEST_HEADING_RAD,
    RADIUS_M,
    STRAIGHT_M,
    TURN_RAD,
    random_road_number,
    random_road_text,
)
from lavt.vehicle.sim.road.road import load_road, parse_road

NUMBERS = range(1, 101)


def test_a_number_always_gives_the_same_road() -> None:
    """Road 1 has the recorded segments, and other numbers give other roads."""
    lengths_m = [segment["length_m"] for segment in yaml.safe_load(random_road_text(1))["segments"]]
    assert lengths_m[:5] == [29.1109, 27.3753, 18.1874, 27.3753, 62.1647]
    assert len({random_road_text(number) for number in NUMBERS}) == len(NUMBERS)


@pytest.mark.parametrize(
    ("name", "number"),
    [("random_1", 1), ("random_30", 30), ("random_0", None), ("random_01", None), ("random_", None), ("a", None)],
)
def test_names_of_random_roads(name: str, number: int | None) -> None:
    """A random road's name is `random_` and a positive number without leading zeros."""
    assert random_road_number(name) == number
    if number is None and name != "a":
        with pytest.raises(UserError, match="random_1"):
            load_road(name)


def test_random_roads_have_the_documented_distributions() -> None:
    """Bends, radii, turns and straights are within their limits, and spread over them."""
    bends, radii_m, straights_m = [], [], []
    for number in NUMBERS:
        segments = yaml.safe_load(random_road_text(number))["segments"]
        arcs = [s for s in segments if s.get("curvature_per_m") and "end_curvature_per_m" not in s]
        straights_m += [s["length_m"] for s in segments if "curvature_per_m" not in s]
        radii_m += [1 / abs(arc["curvature_per_m"]) for arc in arcs]
        bends.append(len(arcs))
        for index, arc in ((index, s) for index, s in enumerate(segments) if s in arcs):
            clothoid_m = segments[index - 1]["length_m"]
            turn_rad = (arc["length_m"] + clothoid_m) * abs(arc["curvature_per_m"])
            assert TURN_RAD[0] - 1e-5 <= turn_rad <= TURN_RAD[1] + 1e-5
            assert clothoid_m * abs(arc["curvature_per_m"]) <= 0.8 * turn_rad + 1e-5
    assert set(bends) == set(range(BENDS[0], BENDS[1] + 1))
    assert RADIUS_M[0] - 0.01 <= min(radii_m) < 45
    assert 180 < max(radii_m) <= RADIUS_M[1] + 0.01
    assert np.median(radii_m) == pytest.approx(math.sqrt(RADIUS_M[0] * RADIUS_M[1]), rel=0.15)
    assert STRAIGHT_M[0] <= min(straights_m) < 25
    assert 75 < max(straights_m) <= STRAIGHT_M[1]


def test_random_roads_lead_onwards() -> None:
    """A road never turns by more than 90 degrees from its first direction, and bends to both sides are as frequent."""
    left = right = 0
    for number in NUMBERS:
        road = load_road(f"random_{number}")
        heading_rad = road.centre_at(np.arange(0.0, road.route_length_m, 1.0)).heading_rad
        assert np.abs(heading_rad).max() <= LARGEST_HEADING_RAD + 1e-4
        left += sum(segment.curvature_per_m > 0 for segment in road.segments)
        right += sum(segment.curvature_per_m < 0 for segment in road.segments)
    assert left == pytest.approx(right, rel=0.25)


def test_a_part_of_a_random_road() -> None:
    """A road file can be a part of a random road."""
    part = parse_road("{title: Part, part_of: random_2, from_m: 20.0, length_m: 60.0}", "part.yaml")
    x_m, y_m = part.point_at(10.0, 0.0)
    assert (x_m, y_m) == pytest.approx(load_road("random_2").point_at(30.0, 0.0).tolist())
