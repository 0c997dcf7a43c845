"""Safe stops without commands stay in the lane, wherever the last command arrives.

"In the lane plus 0.3 m" means: between the last command and standstill, no corner of the body is more than 0.3 m beyond
the lane's edge. The edge is the middle of the lane's line. The corners are those of `sim/route_monitor.py`: 3.89 m
ahead of the rear axle or 1.04 m behind it, 0.93 m to each side. A limit for the corners is stricter than one for the
rear axle, because the front swings out.
"""

from __future__ import annotations

from functools import cache

import pytest
from tests.safety.stops import (
    ALLOWED_BEYOND_M,
    ROUTES,
    SPEED_MPS,
    StopPair,
    curves,
    full_throttle_stops,
    metres,
    stops,
)

from lavt.config import RunConfig
from lavt.config_file import parse_config
from lavt.domain import PATH_POINTS, PATH_STEP_M
from lavt.experiment.runs.monitored_run import drive_monitored
from lavt.experiment.runs.plan import plan_run
from lavt.safety.limiter import stopping_speed_limit_mps
from lavt.safety.limits import LIMITS
from lavt.vehicle.sim.dynamics import LINCOLN_MKZ
from lavt.vehicle.sim.road.road import load_road

pytestmark = pytest.mark.full


@cache
def stops_of(route: str) -> list[StopPair]:
    """Return the stops of a route, which is driven once for all tests."""
    return list(stops(route))


def test_all_curves_of_the_six_routes_are_tested() -> None:
    """All bends of the six routes are tested: ten curves, with radii down to 42 m."""
    found = [
        (curve.route, round(curve.from_m), round(curve.to_m), round(curve.radius_m))
        for route in ROUTES
        for curve in curves(route, load_road(route))
    ]
    # Route, stations of the curve's beginning and end (m), and smallest radius (m).
    assert found == [
        ("a", 26, 92, -42),
        ("a_key", 14, 80, -42),
        ("b", 10, 144, 87),
        ("b", 236, 248, -488),
        ("b", 266, 282, 512),
        ("b", 290, 591, 192),
        ("b_key", 10, 144, 87),
        ("c", 7, 13, 512),
        ("c", 34, 248, -135),
        ("c_key", 19, 164, -135),
    ]


@pytest.mark.parametrize("route", ROUTES)
def test_the_stops_begin_at_every_metre(route: str) -> None:
    """The stops begin a metre apart, from at most 16 m before each curve to its end, at 30 km/h +- 1 km/h."""
    pairs = stops_of(route)
    expected = [metre for curve in curves(route, load_road(route)) for metre in metres(curve)]
    assert [int(pair.followed.at_m) for pair in pairs] == expected
    assert all(abs(pair.followed.speed_mps - SPEED_MPS) < 1 / 3.6 for pair in pairs)


@pytest.mark.parametrize("route", ROUTES)
def test_a_safe_stop_stays_in_the_lane(route: str) -> None:
    """A safe stop from 30 km/h anywhere in a curve stays in the lane plus 0.3 m."""
    followed = [pair.followed for pair in stops_of(route)]
    assert {stop.final_state for stop in followed} == {"safe_stop"}
    assert max(stop.beyond_m for stop in followed) <= ALLOWED_BEYOND_M
    assert max(stop.covered_m for stop in followed) < PATH_STEP_M * PATH_POINTS


@pytest.mark.parametrize("route", ["a", "a_key", "b"])
def test_a_stop_with_the_wheel_held_leaves_the_lane(route: str) -> None:
    """With the wheel held, stops in tight bends leave the lane plus 0.3 m, so path following is needed."""
    held = [pair.held for pair in stops_of(route)]
    assert {stop.final_state for stop in held} == {"safe_stop"}
    assert max(stop.beyond_m for stop in held) > ALLOWED_BEYOND_M


def test_a_safe_stop_under_delay_stays_in_the_lane() -> None:
    """At L3 the body stays 0.1 m inside the lane; with the wheel held, it goes more than 1 m beyond the lane's edge.

    The last picture was taken 2.5 m before the stop begins.
    """
    _, followed, held = zip(*stops("a", "L3"), strict=True)
    # If the path began where its command arrived, the largest distance would be +0.02 m.
    assert max(stop.beyond_m for stop in followed) < -0.1
    assert max(stop.beyond_m for stop in held) > 1.0


def test_with_old_pictures_the_car_drives_slower() -> None:
    """At 0.9 s of delay the car drives at its stopping speed limit, which is lower than 30 km/h, within 0.1 m/s."""
    config = {
        "vehicle": {"route": "straight"},
        "network": {"inherent": "paper_wifi5", "condition": "L0", "video": {"delay_ms": 900.0}},
        "controller": {"lookahead_s": 2.4},  # stable at this delay
        "safety": {"picture_age_limit_ms": 2000.0},
        "fidelity": "geometry",
    }
    run = drive_monitored(plan_run(parse_config(RunConfig, config, "the test")), limit_s=25)
    speeds_mps = run.speed_mps[run.time_s > 10]
    allowed_mps = stopping_speed_limit_mps(run.total_delay_ms / 1000, LIMITS, LINCOLN_MKZ.max_acceleration_mps2)
    assert allowed_mps < SPEED_MPS - 0.8
    assert max(abs(speeds_mps - allowed_mps)) < 0.1
    assert len(run.limited_s[run.limited_s > 10]) > 100


@pytest.mark.parametrize(("delay_ms", "start_mps"), [(0.0, 8.6), (300.0, 7.4), (800.0, 6.4), (1700.0, 4.6)])
def test_a_car_at_full_throttle_stops_on_its_path(delay_ms: float, start_mps: float) -> None:
    """When commands with full throttle cease, the car stops on the 20 m of path that begin at its last picture.

    During the drive the car reaches its stopping speed limit. Some stops begin before that, with full throttle; others
    begin at the limit, with little throttle.
    """
    found = list(full_throttle_stops(delay_ms, start_mps))
    assert len(found) > 20
    assert min(stop.throttle for stop in found) < 0.5
    assert max(stop.throttle for stop in found) > 0.9
    assert {stop.stop.final_state for stop in found} == {"safe_stop"}
    assert max(stop.since_picture_m for stop in found) < PATH_STEP_M * PATH_POINTS - 1.5
