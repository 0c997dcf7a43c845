import math

import pytest

from lavt.domain import NS_PER_MS, NS_PER_S, Actuation, VehicleEvent
from lavt.vehicle.sim.road import Road, load_road
from lavt.vehicle.sim.simulator import Simulator, grid_ns
from lavt.vehicle.vehicle import Vehicle

START_NS = 1_234_567_891
GO = Actuation(0.0, 1.0, 0.0)


@pytest.fixture(scope="module")
def road() -> Road:
    return load_road("a_key")


def simulator_on(road: Road, seed: int = 1, start_mono_ns: int = START_NS) -> Simulator:
    return Simulator(road=road, seed=seed, start_mono_ns=start_mono_ns)


def test_it_is_a_vehicle_that_says_what_it_can(road: Road) -> None:
    """The simulator is a `Vehicle`: simulated, at home in virtual time, with ground truth and the limits of its car."""
    vehicle: Vehicle = simulator_on(road)
    can = vehicle.capabilities
    assert (can.simulated, can.virtual_time, can.ground_truth, can.reset) == (True, True, True, False)
    assert (can.wheelbase_m, can.max_steering_rad, can.max_braking_mps2) == (2.8448, 0.513, 6.0)


def test_the_grid_does_not_drift(road: Road) -> None:
    """Steps are at n / 240 s of the monotonic clock, rounded down, also after years."""
    assert [grid_ns(index) for index in (0, 1, 2, 3, 240)] == [0, 4_166_666, 8_333_333, 12_500_000, NS_PER_S]
    assert grid_ns(240 * 10**9) == 10**9 * NS_PER_S
    simulator = simulator_on(road)
    assert START_NS <= simulator.state().mono_ns < START_NS + NS_PER_S // 240 + 1
    for _ in range(7):
        wake_ns = simulator.next_wake_ns()
        assert wake_ns % NS_PER_S in {grid_ns(index) for index in range(240)}
        simulator.advance(wake_ns)
        assert simulator.state().mono_ns == wake_ns


def test_it_stays_at_rest_until_told_otherwise(road: Road) -> None:
    """A car that nobody commands stands where it began, and nothing happens."""
    simulator = simulator_on(road)
    before = simulator.pose()
    assert simulator.advance(START_NS + 5 * NS_PER_S) == []
    after = simulator.pose()
    assert (after.x_m, after.y_m, after.heading_rad) == (before.x_m, before.y_m, before.heading_rad)
    assert simulator.state().speed_mps == 0.0


def test_it_catches_up_whatever_the_steps(road: Road) -> None:
    """One long advance ends in the same state as many short ones."""
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


def test_a_command_takes_effect_at_the_next_point_of_the_grid(road: Road) -> None:
    """Commands given while the physics was late act at their own times, not when the physics comes to it."""
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


def test_starts_differ_by_seed_within_their_bounds(road: Road) -> None:
    """Over seeds the start fills 2 m ahead, 0.25 m and 1.5 degrees to both sides, and one seed gives one start."""
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


def test_a_drive_at_the_rail_ends_in_one_collision(road: Road) -> None:
    """Full throttle straight on: lanes are left, the barrier is hit once, and the car stays where it hit it."""
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
    """Steered by the truth at about 30 km/h the car stays within 0.5 m of the centre and completes, nothing else."""
    simulator = simulator_on(road, seed=3)
    events: list[VehicleEvent] = []
    worst_m = 0.0
    for tick in range(1, 20 * 50):
        truth = simulator.ground_truth()
        curvature = float(road.point(truth.progress_m + 0.15 * truth.speed_mps)[3])
        steering_rad = 2.85 * curvature - 0.08 * truth.cross_track_m - 0.6 * truth.heading_error_rad
        wanted = 0.8 * (30 / 3.6 - truth.speed_mps)
        simulator.apply(Actuation(steering_rad, max(0.0, wanted), max(0.0, -wanted)), simulator.pose().mono_ns)
        events += simulator.advance(START_NS + tick * 20 * NS_PER_MS)
        worst_m = max(worst_m, abs(simulator.ground_truth().cross_track_m))
        if events:
            break
    assert [event.kind for event in events] == ["completed"]
    assert worst_m < 0.5
    assert simulator.ground_truth().progress_m >= road.length_m
