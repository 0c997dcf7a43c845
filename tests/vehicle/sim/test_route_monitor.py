import math
from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lavt.domain import NS_PER_S, EventKind, VehicleEvent
from lavt.vehicle.sim.dynamics import LINCOLN_MKZ, CarMotion
from lavt.vehicle.sim.road.road import Road, load_road, parse_road
from lavt.vehicle.sim.route_monitor import RouteMonitor

CAR = LINCOLN_MKZ
NO_RAIL_STATION_M = 40.0
"""A station on the connecting road, which has no rail on the right."""


@pytest.fixture(scope="module")
def road() -> Road:
    return load_road("a_key")


def motion_at(
    road: Road, s_m: float, lateral_m: float = 0.0, turned_rad: float = 0.0, speed_mps: float = 0.0
) -> CarMotion:
    x_m, y_m = road.point_at(s_m, lateral_m).tolist()
    return CarMotion(x_m, y_m, float(road.centre_at(s_m).heading_rad) + turned_rad, speed_mps=speed_mps)


def events_along(road: Road, places: list[tuple[float, float]], turned_rad: float = 0.0) -> list[VehicleEvent]:
    """Return the events of a car that is at each of these positions (station, lateral offset) in turn, 1 us apart."""
    monitor = RouteMonitor(road, CAR, near_station_m=places[0][0])
    events = []
    for index, (s_m, lateral_m) in enumerate(places):
        events += monitor.update(motion_at(road, s_m, lateral_m, turned_rad), index * 1000)
    return events


def kinds(events: list[VehicleEvent]) -> list[EventKind]:
    return [event.kind for event in events]


def test_a_drive_along_the_lane_has_no_event_but_completion(road: Road) -> None:
    """A car on its lane's centre completes the route once, without other events."""
    events = events_along(road, [(half_metres / 2, 0.0) for half_metres in range(270)])
    assert kinds(events) == ["completed"]
    assert events[0].mono_ns == 246 * 1000  # 123.0 m is the first position beyond 122.933 m


@pytest.mark.parametrize(("lateral_m", "turned_rad"), [(0.4, 0.05), (-0.7, -0.1)])
def test_tracking_error_is_measured_at_the_rear_axle(road: Road, lateral_m: float, turned_rad: float) -> None:
    """Cross-track error, heading error and progress are the rear axle's, left positive, also in a curve."""
    for s_m in (5.0, 50.0, 110.0):
        error = RouteMonitor(road, CAR, near_station_m=s_m).track(motion_at(road, s_m, lateral_m, turned_rad))
        assert (error.cross_track_m, error.heading_error_rad, error.progress_m) == pytest.approx(
            (lateral_m, turned_rad, s_m), abs=1e-6
        )


def test_heading_error_is_wrapped(road: Road) -> None:
    """A heading beyond a full turn has the same small error."""
    error = RouteMonitor(road, CAR, near_station_m=5.0).track(motion_at(road, 5.0, 0.0, 2 * math.pi + 0.1))
    assert error.heading_error_rad == pytest.approx(0.1)


def test_each_lane_change_of_an_edge_is_an_invasion(road: Road) -> None:
    """Each time an edge of the body changes lanes, there is one lane invasion."""
    events = events_along(road, [(5.0, 0.0), (5.1, 0.80), (5.2, 0.83), (5.3, 0.0)])
    assert kinds(events) == ["lane_invasion", "lane_invasion"]
    assert [event.detail for event in events] == [  # the lanes are numbered from the right
        "left edge from lane 2 to 3 from the right",
        "left edge from lane 3 to 2 from the right",
    ]
    events = events_along(road, [(5.0, 0.0), (5.1, -1.0), (5.2, -3.5)])
    assert [event.detail.split()[0] for event in events] == ["right", "left"]


def test_lane_invasions_are_measured_at_the_edge_of_the_body(road: Road) -> None:
    """A body of 1.86 m in a lane of 3.5 m has 0.82 m on either side: 0.81 m is inside and 0.83 m is not."""
    assert events_along(road, [(5.0, 0.0), (5.0, 0.81), (5.0, -0.81)]) == []
    assert kinds(events_along(road, [(5.0, 0.0), (5.0, 0.83)])) == ["lane_invasion"]


def test_the_start_is_no_lane_invasion(road: Road) -> None:
    """A start outside the lane is no lane invasion."""
    assert events_along(road, [(5.0, 1.5)]) == []


@pytest.mark.parametrize(("lateral_m", "kind"), [(-8.25, "rail"), (11.35, "barrier")])
def test_a_body_that_reaches_a_rail_has_one_collision(road: Road, lateral_m: float, kind: str) -> None:
    """A body whose side reaches the rail or the barrier has one collision, and the event names the obstacle."""
    clear_m = lateral_m - math.copysign(0.1, lateral_m)
    assert "collision" not in kinds(events_along(road, [(5.0, clear_m)]))
    events = [event for event in events_along(road, [(5.0, lateral_m), (5.0, lateral_m)]) if event.kind == "collision"]
    assert len(events) == 1
    assert kind in events[0].detail


def test_the_front_reaches_the_rail_before_the_axle(road: Road) -> None:
    """A car turned towards the rail hits it with its front corner while its axle is more than 2 m away."""
    assert "collision" in kinds(events_along(road, [(5.0, -7.0)], turned_rad=-0.5))
    assert "collision" not in kinds(events_along(road, [(5.0, -7.0)]))


def test_leaving_the_asphalt_without_a_rail_is_off_road(road: Road) -> None:
    """Where there is no rail, a body whose middle is beyond the shoulder is off the road; this is reported once."""
    place = (NO_RAIL_STATION_M, -8.9)
    assert kinds(events_along(road, [place, place])) == ["off_road"]
    assert events_along(road, [(NO_RAIL_STATION_M, -8.4)]) == []


def test_the_time_limit_counts_from_the_first_movement(road: Road) -> None:
    """The default time limit, 30 s more than the route takes at 10 km/h, starts when the car first exceeds 0.1 m/s."""
    monitor = RouteMonitor(road, CAR, near_station_m=0.0)
    stationary, moving = motion_at(road, 1.0), motion_at(road, 1.0, speed_mps=0.2)
    began_ns = 500 * NS_PER_S
    assert monitor.update(stationary, 0) == []
    assert monitor.update(stationary, began_ns - 1) == []
    assert monitor.update(moving, began_ns) == []
    limit_ns = round((road.route_length_m / (10 / 3.6) + 30) * NS_PER_S)
    assert monitor.update(stationary, began_ns + limit_ns) == []
    assert kinds(monitor.update(stationary, began_ns + limit_ns + 1)) == ["timeout"]
    assert monitor.update(stationary, began_ns + limit_ns + 2) == []


def test_the_time_limit_can_be_set(road: Road) -> None:
    """A drive with a time limit of 2 s times out once it has lasted longer."""
    monitor = RouteMonitor(road, CAR, near_station_m=0.0, limit_s=2.0)
    moving = motion_at(road, 1.0, speed_mps=0.2)
    assert [kinds(monitor.update(moving, at_s * NS_PER_S)) for at_s in (5, 7, 8)] == [[], [], ["timeout"]]


def test_an_edge_exactly_on_a_line_is_still_in_its_lane() -> None:
    """An edge exactly on a line is in the body's lane; 1 mm further is a lane invasion."""
    straight = parse_road("title: x\nsegments: [{length_m: 100}]\nlanes: {widths_m: [3.0]}", source="x")
    wide = replace(CAR, body_width_m=2.0)  # in a lane of 3 m half a metre is free on either side
    for lateral_m, invasions in ((0.5, 0), (-0.5, 0), (0.501, 1), (-0.501, 1)):
        monitor = RouteMonitor(straight, wide, near_station_m=5.0)
        monitor.update(motion_at(straight, 5.0), 0)
        assert kinds(monitor.update(motion_at(straight, 5.0, lateral_m), 1)) == ["lane_invasion"] * invasions


def test_both_edges_can_leave_their_lanes_in_one_step(road: Road) -> None:
    """A car turned across the road has two lane invasions in one step, the invasion by the left edge first."""
    events = events_along(road, [(5.0, 0.0), (5.0, 0.0)])
    assert events == []
    monitor = RouteMonitor(road, CAR, near_station_m=5.0)
    monitor.update(motion_at(road, 5.0), 0)
    events = monitor.update(motion_at(road, 5.0, -1.4, math.pi / 2), 1000)
    assert [event.detail for event in events] == [
        "left edge from lane 2 to 3 from the right",
        "right edge from lane 2 to 1 from the right",
    ]


def test_a_spinning_car_invades_the_next_lane_with_its_front(road: Road) -> None:
    """A car that turns around in its lane invades the next lane with its front, and then leaves that lane again."""
    monitor = RouteMonitor(road, CAR, near_station_m=5.0)
    events = []
    for index in range(181):
        events += monitor.update(motion_at(road, 5.0, 0.0, math.radians(index)), index)
    sides = [event.detail.split()[0] for event in events if event.kind == "lane_invasion"]
    assert sides == ["left", "left"], "only the front leaves its lane and returns: the rear is 1.4 m from the axle"
    assert set(kinds(events)) == {"lane_invasion"}


def test_driving_backwards_does_not_complete_a_route(road: Road) -> None:
    """A car that drives backwards from the start has negative progress, and no event but the timeout."""
    places = [(1.0 - index / 4, 0.0) for index in range(100)]
    monitor = RouteMonitor(road, CAR, near_station_m=1.0, limit_s=1e-6)
    events = []
    for index, (s_m, lateral_m) in enumerate(places):
        events += monitor.update(motion_at(road, s_m, lateral_m, math.pi, speed_mps=5.0), index * 1000)
    assert kinds(events) == ["timeout"]
    assert monitor.track(motion_at(road, -23.75)).progress_m == pytest.approx(-23.75)


def test_a_route_is_completed_at_its_end(road: Road) -> None:
    """The first step at or beyond the route's end completes it."""
    at_m = [122.0 + index / 100 for index in range(200)]
    events = events_along(road, [(s_m, 0.0) for s_m in at_m])
    assert kinds(events) == ["completed"]
    assert at_m[events[0].mono_ns // 1000] == pytest.approx(122.94)


OPEN_RAIL = """
title: open
segments: [{length_m: 100}]
rails: [{offset_m: -6, from_m: 40}]
"""


NARROWING = """
title: narrowing
segments: [{length_m: 100}]
lanes: {widths_m: [3.5], changes: [{from_m: 20, to_m: 60, widths_m: [2.5]}]}
shoulders: {left_m: 0, right_m: 0}
"""


def test_a_car_leaves_a_lane_that_narrows() -> None:
    """A car beside the centre of a narrowing lane invades the next one where the lane's edge reaches its body, and is
    off the road where the asphalt's edge reaches its middle.
    """
    road = parse_road(NARROWING, source="x")
    events = events_along(road, [(10.0 + step / 10, -0.5) for step in range(400)])
    assert kinds(events) == ["lane_invasion"]
    corner_m = 0.5 + CAR.body_width_m / 2
    front_m = 20.0 + 40.0 * (1.75 - corner_m) / 0.5  # half the width falls by 0.5 m over 40 m
    assert 10.0 + events[0].mono_ns / 1e4 == pytest.approx(front_m - CAR.rear_axle_to_front_m, abs=0.11)
    off_road = events_along(road, [(10.0 + step / 10, -1.5) for step in range(400)])
    middle_m = 20.0 + 40.0 * (1.75 - 1.5) / 0.5 - (CAR.rear_axle_to_front_m - CAR.rear_axle_to_rear_m) / 2
    (left,) = [event for event in off_road if event.kind == "off_road"]
    assert 10.0 + left.mono_ns / 1e4 == pytest.approx(middle_m, abs=0.11)


def test_grass_before_a_rail_is_off_road() -> None:
    """Grass between the asphalt and a rail is off the road."""
    road = parse_road(OPEN_RAIL, source="x")
    assert kinds(events_along(road, [(60.0, 0.0), (60.0, -2.0), (60.0, -3.0)])) == [
        "lane_invasion",
        "lane_invasion",
        "off_road",
    ]


def test_asphalt_is_limited_to_its_stations() -> None:
    """A lay-by beside the lane is road only between its stations."""
    paved = "paved: [{left_m: 2.25, right_m: -2.25}, {left_m: -2.25, right_m: -6, from_m: 30, to_m: 60}]"
    road = parse_road(f"title: x\nsegments: [{{length_m: 100}}]\n{paved}", source="x")
    for s_m, is_off_road in ((20.0, True), (45.0, False), (70.0, True)):
        assert ("off_road" in kinds(events_along(road, [(s_m, -4.0)]))) == is_off_road


def test_a_car_on_the_far_side_of_a_rail_does_not_touch_it() -> None:
    """A car that drives behind a rail passes it without a collision; a car in line with the rail hits its beginning."""
    road = parse_road(OPEN_RAIL, source="x")
    assert "collision" not in kinds(events_along(road, [(30.0 + s_m, -7.5) for s_m in range(20)]))
    assert "collision" in kinds(events_along(road, [(30.0 + s_m, -6.2) for s_m in range(20)]))


def test_one_contact_is_one_collision(road: Road) -> None:
    """Contacts less than half a second apart are one collision; a contact after a longer pause is another collision."""
    monitor = RouteMonitor(road, CAR, near_station_m=5.0)
    at_rail, off_rail = motion_at(road, 5.0, -8.25), motion_at(road, 5.0, -8.0)
    collisions = []
    for at_ms in (0, 10, 20, 500, 1021, 1500):
        monitor.update(off_rail, at_ms * 1_000_000 - 1)
        events = monitor.update(at_rail, at_ms * 1_000_000)
        collisions += [at_ms for event in events if event.kind == "collision"]
    assert collisions == [0, 1021]


def test_a_lasting_contact_is_one_collision(road: Road) -> None:
    """A car pressed against a rail for more than a second has one collision, even if it moves deeper into the rail."""
    monitor = RouteMonitor(road, CAR, near_station_m=5.0)
    events = []
    for thirds_of_a_second, lateral_m in enumerate((-8.5, -8.5, -8.5, -8.5, -8.8)):
        events += monitor.update(motion_at(road, 5.0, lateral_m), thirds_of_a_second * NS_PER_S // 3)
    assert kinds(events).count("collision") == 1


def test_a_contact_has_position_depth_and_direction(road: Road) -> None:
    """A contact has the position of the touching corner on the body, its depth, and the direction out of the rail."""
    monitor = RouteMonitor(road, CAR, near_station_m=5.0)
    monitor.update(motion_at(road, 5.0, -6.5, -0.5), 0)
    (contact,) = monitor.contacts
    assert (contact.ahead_m, contact.left_m) == (CAR.rear_axle_to_front_m, -CAR.body_width_m / 2)
    corner_offset_m = -6.5 - 0.93 * math.cos(0.5) - 3.89 * math.sin(0.5)
    rail_offset_m = -9.15
    assert contact.depth_m == pytest.approx(rail_offset_m - corner_offset_m)
    assert math.remainder(contact.out_rad - road.start[2] - math.pi / 2, 2 * math.pi) == pytest.approx(0.0)
    monitor.update(motion_at(road, 5.0), 1)
    assert monitor.contacts == ()


WINDING = """
title: winding
segments:
  - {length_m: 15, end_curvature_per_m: 0.05}
  - {length_m: 20, curvature_per_m: 0.05}
  - {length_m: 30, curvature_per_m: 0.05, end_curvature_per_m: -0.05}
  - {length_m: 20, curvature_per_m: -0.05}
rails: [{offset_m: -5, to_m: 50}, {offset_m: 6, kind: barrier, from_m: 20}]
"""
TAPERING = f"""
{WINDING}
lanes:
  widths_m: [3.5, 3.2, 0]
  driven: 1
  changes:
    - {{from_m: 10, to_m: 25, widths_m: [3.5, 2.6, 0]}}
    - {{from_m: 25, to_m: 32, widths_m: [2, 4, 3]}}
"""
ROADS = [load_road("a_key"), *(parse_road(text, source="x") for text in (OPEN_RAIL, WINDING, TAPERING))]
STEPS = st.tuples(st.floats(-0.3, 0.6), st.floats(-0.3, 0.3), st.floats(-0.1, 0.1))


@settings(max_examples=30)
@given(st.sampled_from(ROADS), st.lists(STEPS, min_size=50, max_size=300), st.floats(0.0, 90.0), st.floats(-6.0, 6.0))
def test_skipping_checks_changes_no_events(
    road: Road, steps: list[tuple[float, float, float]], s_m: float, lateral_m: float
) -> None:
    """A monitor that skips checks while no event is in reach reports the same events as one that checks every step."""
    skipping, always_checking = RouteMonitor(road, CAR, near_station_m=s_m), RouteMonitor(road, CAR, near_station_m=s_m)
    turned_rad = 0.0
    for index, (ahead_m, beside_m, turn_rad) in enumerate(steps):
        s_m, lateral_m, turned_rad = s_m + ahead_m, lateral_m + beside_m, turned_rad + turn_rad
        motion = motion_at(road, s_m, lateral_m, turned_rad)
        always_checking._event_margin._across_margin_m = 0.0
        assert skipping.update(motion, index) == always_checking.update(motion, index)
        assert (skipping.contacts == ()) == (always_checking.contacts == ())
