import pytest

from lavt.control.client_limits import CLIENT_LIMITS
from lavt.control.lane_watch import BRAKE_AFTER_NS, LANE_CONFIDENCE, STOP_AFTER_NS, LaneWatch
from lavt.domain import NS_PER_S, Actuation
from lavt.vehicle.sim.dynamics import LINCOLN_MKZ, CarDynamics, CarMotion
from lavt.vehicle.sim.simulator import STEPS_PER_S

START_NS = 7_000_000_000


def test_without_a_lane_the_watch_brakes_at_500_ms_and_stops_at_2500_ms() -> None:
    """Without a lane for 0.5 s the watch returns "brake", for 2.5 s "stop"."""
    watch = LaneWatch()
    assert watch.check(1.0, START_NS) == "ok"
    assert watch.check(0.0, START_NS + BRAKE_AFTER_NS - 1) == "ok"
    assert watch.check(0.0, START_NS + BRAKE_AFTER_NS) == "brake"
    assert watch.check(0.0, START_NS + STOP_AFTER_NS - 1) == "brake"
    assert watch.check(0.0, START_NS + STOP_AFTER_NS) == "stop"


def test_a_lane_restarts_the_timer() -> None:
    """One picture with a lane restarts the timer."""
    watch = LaneWatch()
    watch.check(1.0, START_NS)
    assert watch.check(0.0, START_NS + BRAKE_AFTER_NS) == "brake"
    assert watch.check(LANE_CONFIDENCE, START_NS + BRAKE_AFTER_NS + 1) == "ok"
    assert watch.check(0.0, START_NS + 2 * BRAKE_AFTER_NS) == "ok"


def test_the_threshold_is_a_setting() -> None:
    """A lane below the given threshold does not restart the timer, and one at the threshold does."""
    watch = LaneWatch(0.5)
    watch.check(1.0, START_NS)
    assert watch.check(0.49, START_NS + BRAKE_AFTER_NS) == "brake"
    assert watch.check(0.5, START_NS + BRAKE_AFTER_NS + 1) == "ok"


def test_the_first_picture_starts_the_timer() -> None:
    """If no lane was ever detected, the timer counts from the first picture."""
    watch = LaneWatch()
    assert watch.check(0.0, START_NS) == "ok"
    assert watch.check(0.0, START_NS + STOP_AFTER_NS) == "stop"


def test_the_car_has_nearly_stopped_when_the_watch_stops_it() -> None:
    """When the watch stops the simulator's car, the car has slowed from 30 km/h to 0.9 m/s in 14 m."""
    speed_mps = 30 / 3.6
    braking_m = speed_mps * BRAKE_AFTER_NS / NS_PER_S
    car = CarDynamics(LINCOLN_MKZ, CarMotion(braking_m, 0.0, 0.0, speed_mps=speed_mps), 1 / STEPS_PER_S)
    for _ in range((STOP_AFTER_NS - BRAKE_AFTER_NS) * STEPS_PER_S // NS_PER_S):
        car.step(Actuation(0.0, 0.0, CLIENT_LIMITS.brake))
    assert car.motion.speed_mps == pytest.approx(0.9, abs=0.05)
    assert car.motion.x_m == pytest.approx(14, abs=0.5)
