import itertools
import math
from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lavt.domain import NS_PER_MS, NS_PER_S, Actuation, VehicleEvent
from lavt.vehicle.sim.dynamics import LINCOLN_MKZ
from lavt.vehicle.sim.road.road import Road, load_road, parse_road
from lavt.vehicle.sim.simulator import Simulator, grid_ns
from lavt.vehicle.vehicle import Vehicle

START_NS = 1_234_567_891
GO = Actuation(0.0, 1.0, 0.0)


@pytest.fixture(scope="module")
def road() -> Road:
    return load_road("a_key")


def simulator_on(road: Road, seed: int = 1, start_mono_ns: int = START_NS) -> Simulator:
    return Simulator(road=road, seed=seed, start_mono_ns=start_mono_ns)


def test_the_simulator_reports_its_capabilities(road: Road) -> None:
    """The simulator is a simulated `Vehicle` with virtual time, ground truth and the limits of its car."""
    vehicle: Vehicle = simulator_on(road)
    capabilities = vehicle.capabilities
    assert (capabilities.simulated, capabilities.virtual_time) == (True, True)
    assert (capabilities.ground_truth, capabilities.reset) == (True, False)
    assert (capabilities.wheelbase_m, capabilities.max_steering_rad) == (2.8448, 0.513)
    assert capabilities.max_braking_mps2 == 6.0


def test_the_grid_does_not_drift(road: Road) -> None:
    """Grid points are at n / 240 s of the monotonic clock, rounded down, even after years."""
    assert [grid_ns(index) for index in (0, 1, 2, 3, 240)] == [0, 4_166_666, 8_333_333, 12_500_000, NS_PER_S]
    assert grid_ns(240 * 10**9) == 10**9 * NS_PER_S
    simulator = simulator_on(road)
    assert START_NS <= simulator.state().mono_ns < START_NS + NS_PER_S // 240 + 1
    for _ in range(7):
        wake_ns = simulator.next_wake_ns()
        assert wake_ns % NS_PER_S in {grid_ns(index) for index in range(240)}
        simulator.advance(wake_ns)
        assert simulator.state().mono_ns == wake_ns


def test_the_car_is_stationary_until_the_first_command(road: Road) -> None:
    """A car without commands stays at its start without events."""
    simulator = simulator_on(road)
    before = simulator.pose()
    assert simulator.advance(START_NS + 5 * NS_PER_S) == []
    after = simulator.pose()
    assert (after.x_m, after.y_m, after.heading_rad) == (before.x_m, before.y_m, before.heading_rad)
    assert simulator.state().speed_mps == 0.0


def test_one_long_advance_equals_many_short_ones(road: Road) -> None:
    """One long advance has the same events and final state as many short advances."""
    one, many = simulator_on(road), simulator_on(road)
    end_ns = START_NS + 4 * NS_PER_S
    for simulator in (one, many):
        simulator.apply(Actuation(-0.03, 1.0, 0.0), START_NS)
    events = one.advance(end_ns)
    collected: list[VehicleEvent] = []
    for at_ns in range(START_NS, end_ns + 1, 7 * NS_PER_MS):
        collected += many.advance(at_ns)
    collected += many.advance(end_ns)
    assert one.ground_truth() == many.ground_truth()
    assert events == collected


def test_a_command_takes_effect_at_the_next_grid_point(road: Road) -> None:
    """A command takes effect at the first grid point after it, even if `advance` is called much later."""
    late, punctual = simulator_on(road), simulator_on(road)
    first_ns, second_ns, end_ns = START_NS + 100 * NS_PER_MS, START_NS + 900 * NS_PER_MS, START_NS + 2 * NS_PER_S
    stop = Actuation(0.1, 0.0, 1.0)
    punctual.advance(first_ns)
    punctual.apply(GO, first_ns)
    punctual.advance(second_ns)
    punctual.apply(stop, second_ns)
    late.apply(GO, first_ns)
    late.apply(stop, second_ns)
    for simulator in (late, punctual):
        simulator.advance(end_ns)
    assert late.ground_truth() == punctual.ground_truth()
    one_later = simulator_on(road)
    one_later.advance(first_ns)
    step_ns = one_later.next_wake_ns()
    one_later.apply(GO, first_ns)
    one_later.advance(step_ns)
    assert one_later._car.motion.throttle == 0.0  # the step under way had begun before the command
    one_later.advance(one_later.next_wake_ns())
    assert one_later._car.motion.throttle > 0.0


def test_the_seed_draws_the_start_within_bounds(road: Road) -> None:
    """The starts of many seeds fill 0 to 2 m ahead, 0.25 m and 1.5 degrees to both sides; one seed has one start."""
    truths = [simulator_on(road, seed=seed).ground_truth() for seed in range(60)]
    assert truths[7] == simulator_on(road, seed=7).ground_truth()
    for values, low, high in (
        ([truth.progress_m for truth in truths], 0.0, 2.0),
        ([truth.cross_track_m for truth in truths], -0.25, 0.25),
        ([math.degrees(truth.heading_error_rad) for truth in truths], -1.5, 1.5),
    ):
        span = high - low
        assert low - 1e-9 <= min(values) < low + 0.1 * span
        assert high - 0.1 * span < max(values) <= high + 1e-9


def test_driving_into_the_barrier_is_one_collision(road: Road) -> None:
    """At full throttle straight ahead the car leaves its lane, hits the barrier once and stays there."""
    simulator = simulator_on(road)
    simulator.apply(GO, START_NS)
    events = simulator.advance(START_NS + 20 * NS_PER_S)
    assert [event.kind for event in events].count("collision") == 1
    assert events[-1].kind == "collision"
    assert {event.kind for event in events} == {"lane_invasion", "collision"}
    assert simulator.state().speed_mps == 0.0
    truth = simulator.ground_truth()
    assert 7.0 < truth.cross_track_m < 12.25
    assert simulator.advance(START_NS + 21 * NS_PER_S) == []


def test_a_good_driver_completes_the_route(road: Road) -> None:
    """Steered by ground truth at 30 km/h the car stays within 0.5 m of the centre and only completes the route."""
    simulator = simulator_on(road, seed=3)
    events: list[VehicleEvent] = []
    worst_m = 0.0
    for command_number in range(1, 20 * 50):
        truth = simulator.ground_truth()
        curvature = float(road.centre_at(truth.progress_m + 0.15 * truth.speed_mps).curvature_per_m)
        steering_rad = 2.85 * curvature - 0.08 * truth.cross_track_m - 0.6 * truth.heading_error_rad
        pedal = 0.8 * (30 / 3.6 - truth.speed_mps)
        simulator.apply(Actuation(steering_rad, max(0.0, pedal), max(0.0, -pedal)), simulator.pose().mono_ns)
        events += simulator.advance(START_NS + command_number * 20 * NS_PER_MS)
        worst_m = max(worst_m, abs(simulator.ground_truth().cross_track_m))
        if events:
            break
    assert [event.kind for event in events] == ["completed"]
    assert worst_m < 0.5
    assert simulator.ground_truth().progress_m >= road.route_length_m


@settings(max_examples=25)
@given(st.lists(st.integers(0, 400 * NS_PER_MS), max_size=30))
def test_the_trajectory_does_not_depend_on_how_advance_is_called(pauses_ns: list[int]) -> None:
    """Commands at equal times give a bit-identical drive however late and unevenly `advance` is called."""
    road = load_road("a_key")
    one, other = simulator_on(road), simulator_on(road)
    for index in range(20):
        at_ns = START_NS + index * 150 * NS_PER_MS
        for simulator in (one, other):
            simulator.apply(Actuation(0.1 * math.sin(index), index % 3 / 2, 0.0), at_ns)
    events, end_ns = one.advance(START_NS + 3 * NS_PER_S), START_NS + 3 * NS_PER_S
    collected: list[VehicleEvent] = []
    for at_ns in itertools.accumulate(pauses_ns, initial=START_NS):
        collected += other.advance(min(at_ns, end_ns))
    collected += other.advance(end_ns)
    assert other.ground_truth() == one.ground_truth()
    assert collected == events


def test_steering_and_pedals_have_separate_dead_times(road: Road) -> None:
    """Steering and pedals each begin to follow after their own dead time, and then with their lag."""
    car = replace(LINCOLN_MKZ, steering_dead_time_s=0.15, pedal_dead_time_s=0.05)
    simulator = Simulator(road=road, seed=1, start_mono_ns=0, parameters=car)
    simulator.apply(Actuation(0.02, 1.0, 0.0), 0)
    motion_at_ms = {}
    for at_ms in (49, 60, 149, 160, 150 + 120):
        simulator.advance(at_ms * NS_PER_MS)
        motion_at_ms[at_ms] = replace(simulator._car.motion)
    assert (motion_at_ms[49].steering_rad, motion_at_ms[49].throttle) == (0.0, 0.0)
    assert motion_at_ms[60].throttle > 0.0
    assert motion_at_ms[149].steering_rad == 0.0
    assert motion_at_ms[160].steering_rad > 0.0
    assert motion_at_ms[270].steering_rad == pytest.approx(0.02 * (1 - math.exp(-1)), rel=0.05)


def test_dead_time_only_shifts_commands(road: Road) -> None:
    """With a dead time, the steering makes exactly the same motion as without a dead time, but later."""
    late_ns = 250 * NS_PER_MS  # a whole number of steps
    plain = Simulator(road=road, seed=1, start_mono_ns=0)
    delayed = Simulator(
        road=road, seed=1, start_mono_ns=0, parameters=replace(LINCOLN_MKZ, steering_dead_time_s=late_ns / NS_PER_S)
    )
    for index in range(50):
        for simulator in (plain, delayed):
            simulator.apply(Actuation(0.2 * math.sin(index / 5), 0.0, 1.0), index * 20 * NS_PER_MS)
    for at_ms in range(0, 1000, 50):
        plain.advance(at_ms * NS_PER_MS)
        delayed.advance(at_ms * NS_PER_MS + late_ns)
        assert delayed.state().steering_rad == plain.state().steering_rad


RAILED = """
title: straight, between a rail and a barrier
segments: [{length_m: 300}]
lanes: {widths_m: [3.5, 3.5, 3.5], driven: 1}
rails: [{offset_m: -6}, {offset_m: 6, kind: barrier}]
"""


RAIL_AHEAD = """
title: a narrow lane, and a rail that begins beside it
segments: [{length_m: 300}]
lanes: {widths_m: [3.5, 1.0], driven: 1}
shoulders: {left_m: 5, right_m: 5}
rails: [{offset_m: 0.52, from_m: 20, kind: barrier}]
"""


def drive_into_the_rail(steering_rad: float, duration_s: float) -> tuple[Simulator, list[VehicleEvent], float]:
    """Drive with constant steering and throttle; return the simulator, the events and the deepest contact (m)."""
    simulator = Simulator(road=parse_road(RAILED, source="x"), seed=1, start_mono_ns=0, continue_after_collision=True)
    simulator.apply(Actuation(steering_rad, 0.6, 0.0), 0)
    events: list[VehicleEvent] = []
    deepest_m = 0.0
    for _ in range(round(240 * duration_s)):
        events += simulator.advance(simulator.next_wake_ns())
        deepest_m = max([deepest_m, *(contact.depth_m for contact in simulator._route_monitor.contacts)])
    return simulator, events, deepest_m


@pytest.mark.parametrize(("steering_rad", "name"), [(0.03, "barrier"), (-0.03, "rail")])
def test_a_car_that_continues_after_a_collision_slides_along(steering_rad: float, name: str) -> None:
    """A car steered into a rail has one collision, enters the rail by less than 2 cm, aligns with it, and drives on."""
    simulator, events, deepest_m = drive_into_the_rail(steering_rad, 16.0)
    hits = [event.detail for event in events if event.kind == "collision"]
    assert len(hits) == 1
    assert name in hits[0]
    assert {event.kind for event in events} == {"lane_invasion", "collision"}
    assert deepest_m < 0.02
    truth = simulator.ground_truth()
    assert abs(truth.cross_track_m) == pytest.approx(6.0 - LINCOLN_MKZ.body_width_m / 2, abs=0.02)
    assert truth.heading_error_rad == pytest.approx(0.0, abs=0.01)
    assert truth.progress_m > 80.0


def test_a_rail_slows_the_car() -> None:
    """A car pressed against a rail is slower than a free car with the same throttle."""
    pressed, _, _ = drive_into_the_rail(-0.03, 10.0)
    free, events, _ = drive_into_the_rail(0.0, 10.0)
    assert "collision" not in {event.kind for event in events}
    assert pressed.state().speed_mps < 0.8 * free.state().speed_mps


def test_a_crash_at_a_large_angle_stops_the_car() -> None:
    """A car that hits the barrier at 45 degrees loses nearly all speed and does not bounce back."""
    simulator, events, _ = drive_into_the_rail(0.4, 8.0)
    assert "collision" in {event.kind for event in events}
    assert 0.0 <= simulator.state().speed_mps < 0.3


def test_a_car_that_hits_the_end_of_a_rail_stops_before_it() -> None:
    """A car that hits a rail's end with its front stops there without a jump; that is one collision."""
    road = parse_road(RAIL_AHEAD, source="x")
    simulator = Simulator(road=road, seed=1, start_mono_ns=0, continue_after_collision=True)
    simulator.apply(Actuation(0.0, 0.6, 0.0), 0)
    events, steps_m, before = [], [], simulator.pose()
    for _ in range(240 * 12):
        events += simulator.advance(simulator.next_wake_ns())
        pose = simulator.pose()
        steps_m.append(math.dist((pose.x_m, pose.y_m), (before.x_m, before.y_m)))
        before = pose
    assert [event.kind for event in events].count("collision") == 1
    assert max(steps_m) < 0.06
    assert simulator.state().speed_mps < 0.3
    assert simulator.ground_truth().progress_m < 20.0 - 3.6, "the front is 3.89 m ahead of the rear axle"


def test_the_reported_speed_can_be_wrong(road: Road) -> None:
    """A factor changes the reported speed only: the car drives as without it, and the ground truth is true."""
    exact = simulator_on(road)
    wrong = Simulator(road=road, seed=1, start_mono_ns=START_NS, speed_report_factor=1.25)
    for simulator in (exact, wrong):
        simulator.apply(GO, START_NS)
        simulator.advance(START_NS + 2 * NS_PER_S)
    assert wrong.ground_truth() == exact.ground_truth()
    assert exact.state().speed_mps == exact.ground_truth().speed_mps > 1.0
    assert wrong.state().speed_mps == 1.25 * exact.state().speed_mps
