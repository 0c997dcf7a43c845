import math

import pytest

from lavt.domain import NS_PER_S, EventKind, VehicleEvent
from lavt.vehicle.sim.cars import LINCOLN_MKZ
from lavt.vehicle.sim.dynamics import CarMotion
from lavt.vehicle.sim.judge import Judge
from lavt.vehicle.sim.road import Road, load_road

CAR = LINCOLN_MKZ
SECOND_WITHOUT_RAIL_M = 40.0
"""Along the connecting road there is no rail to the right."""


@pytest.fixture(scope="module")
def road() -> Road:
    return load_road("a_key")


def motion_at(
    road: Road, s_m: float, lateral_m: float = 0.0, turned_rad: float = 0.0, speed_mps: float = 0.0
) -> CarMotion:
    x_m, y_m = road.across(s_m, lateral_m).tolist()
    return CarMotion(x_m, y_m, float(road.point(s_m)[2]) + turned_rad, speed_mps=speed_mps)


def judged(road: Road, places: list[tuple[float, float]], turned_rad: float = 0.0) -> list[VehicleEvent]:
    """Judge a car that is moved from place to place (station, lateral offset)."""
    judge = Judge(road, CAR, near_s_m=places[0][0])
    events = []
    for index, (s_m, lateral_m) in enumerate(places):
        events += judge.judge(motion_at(road, s_m, lateral_m, turned_rad), index * 1000)
    return events


def kinds(events: list[VehicleEvent]) -> list[EventKind]:
    return [event.kind for event in events]


def test_a_drive_along_the_lane_is_only_completed(road: Road) -> None:
    """A car that keeps the centre of its lane to the end completes the route and nothing else happens, and once."""
    events = judged(road, [(s_m / 2, 0.0) for s_m in range(270)])
    assert kinds(events) == ["completed"]
    assert events[0].mono_ns == 246 * 1000  # 123.0 m is the first place beyond 122.933 m


@pytest.mark.parametrize(("lateral_m", "turned_rad"), [(0.4, 0.05), (-0.7, -0.1)])
def test_the_track_is_measured_at_the_rear_axle(road: Road, lateral_m: float, turned_rad: float) -> None:
    """Cross-track, heading error and progress are the rear axle's, left positive, in the curve as on the straight."""
    for s_m in (5.0, 50.0, 110.0):
        track = Judge(road, CAR, near_s_m=s_m).track(motion_at(road, s_m, lateral_m, turned_rad))
        assert (track.cross_track_m, track.heading_error_rad, track.progress_m) == pytest.approx(
            (lateral_m, turned_rad, s_m), abs=1e-6
        )


def test_heading_error_is_the_short_way_round(road: Road) -> None:
    """A heading that went on past a full turn gives the same small error."""
    track = Judge(road, CAR, near_s_m=5.0).track(motion_at(road, 5.0, 0.0, 2 * math.pi + 0.1))
    assert track.heading_error_rad == pytest.approx(0.1)


def test_each_edge_that_changes_its_lane_is_an_invasion(road: Road) -> None:
    """To the left and back: the left edge goes and comes; a whole change of lane is left edge, then right edge."""
    away = [(5.0, 0.0), (5.1, 0.80), (5.2, 0.83)]
    events = judged(road, [*away, (5.3, 0.0)])
    assert kinds(events) == ["lane_invasion", "lane_invasion"]
    assert [event.detail for event in events] == [
        "left edge from lane 2 to 3 from the right",
        "left edge from lane 3 to 2 from the right",
    ]
    events = judged(road, [(5.0, 0.0), (5.1, -1.0), (5.2, -3.5)])
    assert [event.detail.split()[0] for event in events] == ["right", "left"]


def test_the_edge_of_the_body_counts_not_the_axle(road: Road) -> None:
    """With 0.82 m to either side of a body of 1.86 m in a lane of 3.5 m, 0.81 m is in the lane and 0.83 m is not."""
    assert judged(road, [(5.0, 0.0), (5.0, 0.81), (5.0, -0.81)]) == []
    assert kinds(judged(road, [(5.0, 0.0), (5.0, 0.83)])) == ["lane_invasion"]


def test_where_a_drive_begins_is_no_invasion(road: Road) -> None:
    """The first look only notes the lanes."""
    assert judged(road, [(5.0, 1.5)]) == []


@pytest.mark.parametrize(("lateral_m", "word"), [(-8.25, "rail"), (11.35, "barrier")])
def test_a_corner_at_a_rail_is_a_collision_once(road: Road, lateral_m: float, word: str) -> None:
    """The body's side 0.93 m from the axle reaches the rail 9.15 m right, the barrier 12.25 m left; it happens once."""
    before = lateral_m - math.copysign(0.1, lateral_m)
    assert "collision" not in kinds(judged(road, [(5.0, before)]))
    events = [event for event in judged(road, [(5.0, lateral_m), (5.0, lateral_m)]) if event.kind == "collision"]
    assert len(events) == 1
    assert word in events[0].detail


def test_the_front_reaches_the_rail_before_the_axle(road: Road) -> None:
    """A car turned to the rail hits it with its front corner though its axle is more than 2 m away."""
    assert "collision" in kinds(judged(road, [(5.0, -7.0)], turned_rad=-0.5))
    assert "collision" not in kinds(judged(road, [(5.0, -7.0)]))


def test_leaving_the_asphalt_where_no_rail_stands_is_off_road(road: Road) -> None:
    """Along the connecting road the right is open: the body's middle beyond the shoulder is off the road, once."""
    place = (SECOND_WITHOUT_RAIL_M, -8.9)
    assert kinds(judged(road, [place, place])) == ["off_road"]
    assert judged(road, [(SECOND_WITHOUT_RAIL_M, -8.4)]) == []


def test_the_time_of_a_drive_counts_from_its_first_movement(road: Road) -> None:
    """The limit is the route at 10 km/h plus 30 s, 74.3 s here, once the car exceeds 0.1 m/s; waiting is free."""
    judge = Judge(road, CAR, near_s_m=0.0)
    standing, moving = motion_at(road, 1.0), motion_at(road, 1.0, speed_mps=0.2)
    began_ns = 500 * NS_PER_S
    assert judge.judge(standing, 0) == []
    assert judge.judge(standing, began_ns - 1) == []
    assert judge.judge(moving, began_ns) == []
    limit_ns = round((road.length_m / (30 / 3.6 / 3) + 30) * NS_PER_S)
    assert judge.judge(standing, began_ns + limit_ns) == []
    assert kinds(judge.judge(standing, began_ns + limit_ns + 1)) == ["timeout"]
    assert judge.judge(standing, began_ns + limit_ns + 2) == []
