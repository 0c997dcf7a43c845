import math
from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lavt.domain import Actuation
from lavt.vehicle.sim.dynamics import (
    GRAVITY_MPS2,
    LINCOLN_MKZ,
    RAIL_FRICTION,
    CarDynamics,
    CarMotion,
    CarParameters,
    Contact,
)

STEP_S = 1 / 240
CAR = LINCOLN_MKZ


def car_at(speed_mps: float = 0.0, parameters: CarParameters = CAR) -> CarDynamics:
    return CarDynamics(parameters, CarMotion(0.0, 0.0, 0.0, speed_mps=speed_mps), STEP_S)


def drive(car: CarDynamics, actuation: Actuation, duration_s: float) -> None:
    for _ in range(round(duration_s / STEP_S)):
        car.step(actuation)


def cruise(car: CarDynamics, speed_mps: float, steering_rad: float, duration_s: float) -> None:
    for _ in range(round(duration_s / STEP_S)):
        car.step(Actuation(steering_rad, 0.0, 0.0))
        car.motion.speed_mps = speed_mps


def test_a_car_at_rest_stays_at_rest() -> None:
    """A stationary car without throttle does not move, whatever its steering and brake."""
    for brake in (0.0, 1.0):
        car = car_at()
        drive(car, Actuation(0.3, 0.0, brake), 2.0)
        motion = car.motion
        assert (motion.x_m, motion.y_m, motion.heading_rad, motion.speed_mps) == (0.0, 0.0, 0.0, 0.0)


@pytest.mark.parametrize("steering_rad", [0.02, -0.04])
@pytest.mark.parametrize(("front_nprad", "rear_nprad"), [(155_495.0, 155_495.0), (90_000.0, 155_495.0), (2e5, 1.5e5)])
def test_yaw_rate_on_a_circle_matches_theory(steering_rad: float, front_nprad: float, rear_nprad: float) -> None:
    """At 30 km/h the yaw rate is within 1 % of v d / (L + K v^2), where K = m (l_r / C_f - l_f / C_r) / L."""
    speed_mps = 30 / 3.6
    car = car_at(speed_mps, replace(CAR, front_stiffness_nprad=front_nprad, rear_stiffness_nprad=rear_nprad))
    cruise(car, speed_mps, steering_rad, 4.0)
    front_m = CAR.front_axle_to_gravity_m
    rear_m = CAR.wheelbase_m - front_m
    understeer = CAR.mass_kg * (rear_m / front_nprad - front_m / rear_nprad) / CAR.wheelbase_m
    theory = speed_mps * steering_rad / (CAR.wheelbase_m + understeer * speed_mps**2)
    assert car.motion.yaw_rate_radps == pytest.approx(theory, rel=0.01)


def test_a_steady_circle_closes() -> None:
    """After one full turn at a steady yaw rate the rear axle is back at its start."""
    car = car_at(8.0)
    cruise(car, 8.0, 0.1, 5.0)
    motion = replace(car.motion)
    cruise(car, 8.0, 0.1, 2 * math.pi / motion.yaw_rate_radps)
    assert math.hypot(car.motion.x_m - motion.x_m, car.motion.y_m - motion.y_m) < 0.1


def test_a_slow_car_rolls_without_slip() -> None:
    """At 1 m/s the yaw rate is v tan(d) / L and the rear axle moves along the heading."""
    car = car_at(1.0)
    cruise(car, 1.0, 0.3, 2.0)
    motion = car.motion
    assert motion.yaw_rate_radps == pytest.approx(math.tan(0.3) / CAR.wheelbase_m, rel=1e-3)
    rear_m = CAR.wheelbase_m - CAR.front_axle_to_gravity_m
    assert motion.side_speed_mps == pytest.approx(rear_m * motion.yaw_rate_radps, rel=1e-3)


def test_yaw_rate_is_continuous_where_the_models_meet() -> None:
    """Accelerating and braking through 3 m/s in a turn changes the yaw rate by less than 0.01 rad/s per step."""
    car = car_at(2.5)
    drive(car, Actuation(0.3, 0.0, 0.0), 0.5)
    for actuation in (Actuation(0.3, 1.0, 0.0), Actuation(0.3, 0.0, 0.5)):
        for _ in range(240):
            before = car.motion.yaw_rate_radps
            car.step(actuation)
            assert abs(car.motion.yaw_rate_radps - before) < 0.01


def test_tyre_forces_are_limited_by_friction() -> None:
    """At 25 m/s and full steering the lateral acceleration does not exceed friction times gravity."""
    car = car_at(25.0)
    highest = 0.0
    for _ in range(480):
        car.step(Actuation(0.5, 0.0, 0.0))
        sideways, _, _ = car._tyre_accelerations()
        highest = max(highest, abs(sideways))
    assert 0.8 * CAR.friction * GRAVITY_MPS2 < highest <= CAR.friction * GRAVITY_MPS2


def test_steering_follows_with_its_lag() -> None:
    """One time constant after a small step of the command, the steering has covered 63 % of the step."""
    car = car_at()
    drive(car, Actuation(0.05, 0.0, 1.0), CAR.steering_lag_s)
    assert car.motion.steering_rad == pytest.approx(0.05 * (1 - math.exp(-1)), rel=0.02)


def test_steering_rate_and_angle_are_limited() -> None:
    """Steering follows a large step at 0.534 rad/s at most, and never beyond 0.513 rad."""
    car = car_at()
    fastest = 0.0
    for _ in range(960):
        before = car.motion.steering_rad
        car.step(Actuation(9.0, 0.0, 1.0))
        fastest = max(fastest, (car.motion.steering_rad - before) / STEP_S)
    assert fastest == pytest.approx(CAR.max_steering_rate_radps)
    assert car.motion.steering_rad == pytest.approx(CAR.max_steering_rad, rel=1e-3)
    assert car.motion.steering_rad <= CAR.max_steering_rad


def test_pedals_follow_with_their_lag() -> None:
    """One time constant after the command of full throttle, the throttle is 63 %."""
    car = car_at()
    drive(car, Actuation(0.0, 1.0, 0.0), CAR.throttle_lag_s)
    assert car.motion.throttle == pytest.approx(1 - math.exp(-1), rel=0.02)


def test_full_braking_distance_matches_theory() -> None:
    """From 30 km/h, a car whose deceleration a has a lag T stops after v^2 / 2a + v T - a T^2 / 2, and stays there."""
    speed_mps = 30 / 3.6
    car = car_at(speed_mps)
    drive(car, Actuation(0.0, 0.0, 1.0), 3.0)
    braking = CAR.max_braking_mps2 + CAR.rolling_resistance_mps2
    lag_s = CAR.brake_lag_s
    theory_m = speed_mps**2 / (2 * braking) + speed_mps * lag_s - braking * lag_s**2 / 2
    assert car.motion.speed_mps == 0.0
    assert car.motion.x_m == pytest.approx(theory_m, abs=0.1)
    drive(car, Actuation(0.0, 0.0, 1.0), 1.0)
    assert car.motion.speed_mps == 0.0


def test_full_throttle_accelerates_as_stated() -> None:
    """At full throttle the car accelerates by 2 m/s2 minus its resistance."""
    car = car_at()
    drive(car, Actuation(0.0, 1.0, 0.0), 2.0)
    before = car.motion.speed_mps
    drive(car, Actuation(0.0, 1.0, 0.0), 1.0)
    assert car.motion.speed_mps - before == pytest.approx(1.9, abs=0.02)
    assert car.motion.x_m > 0.0
    assert car.motion.y_m == 0.0


def test_without_lags_a_command_takes_effect_in_one_step() -> None:
    """With lags of zero the pedals and a small steering change take effect in the next step."""
    car = car_at(parameters=replace(CAR, steering_lag_s=0.0, throttle_lag_s=0.0, brake_lag_s=0.0))
    car.step(Actuation(0.001, 0.5, 0.25))
    assert (car.motion.steering_rad, car.motion.throttle, car.motion.brake) == (0.001, 0.5, 0.25)


def test_throttle_and_brake_have_separate_lags() -> None:
    """After 0.2 s a brake with a lag of 0.1 s has covered 86 % of a step, a throttle with a lag of 0.4 s 39 %."""
    car = car_at(parameters=replace(CAR, throttle_lag_s=0.4, brake_lag_s=0.1))
    drive(car, Actuation(0.0, 1.0, 1.0), 0.2)
    assert car.motion.throttle == pytest.approx(1 - math.exp(-0.5), rel=0.01)
    assert car.motion.brake == pytest.approx(1 - math.exp(-2), rel=0.01)


def energy_j(car: CarDynamics) -> float:
    motion = car.motion
    return (
        CAR.mass_kg * (motion.speed_mps**2 + motion.side_speed_mps**2) + CAR.yaw_inertia_kgm2 * motion.yaw_rate_radps**2
    ) / 2


@settings(max_examples=60)
@given(st.floats(4.0, 30.0), st.lists(st.floats(-0.5, 0.5), min_size=3, max_size=12), st.floats(0.0, 1.0))
def test_a_car_without_throttle_gains_no_energy(speed_mps: float, wheel_rad: list[float], brake: float) -> None:
    """A car that rolls or brakes loses energy, however it is steered and even if it slides."""
    car = car_at(speed_mps)
    for steering_rad in wheel_rad:
        for _ in range(48):
            before_j = energy_j(car)
            car.step(Actuation(steering_rad, 0.0, brake))
            if car.motion.speed_mps < CAR.kinematic_below_mps:
                return
            assert energy_j(car) <= before_j * (1 + 1e-3)
    assert energy_j(car) < CAR.mass_kg * speed_mps**2 / 2


@settings(max_examples=100)
@given(st.floats(0.0, 20.0), st.floats(-5.0, 5.0), st.floats(-1.0, 1.0), st.floats(-3.2, 3.2), st.booleans())
def test_a_rail_stops_motion_into_it_and_adds_no_energy(
    speed_mps: float, side_mps: float, yaw_radps: float, out_rad: float, front: bool
) -> None:
    """After a contact the point is outside the rail and does not move into it, and the car has gained no energy."""
    car = CarDynamics(CAR, CarMotion(0.0, 0.0, 0.3, speed_mps, side_mps, yaw_radps), STEP_S)
    ahead_m, left_m = (3.89, 0.93) if front else (-1.043, -0.93)  # the front left or the rear right corner
    before_j = energy_j(car)
    car.resolve_contact(Contact(ahead_m, left_m, 0.02, out_rad))
    motion = car.motion
    assert (motion.x_m, motion.y_m) == pytest.approx((0.02 * math.cos(out_rad), 0.02 * math.sin(out_rad)))
    assert energy_j(car) <= before_j + 1e-6
    out_ahead, out_left = math.cos(out_rad - 0.3), math.sin(out_rad - 0.3)
    from_gravity_m = ahead_m - (CAR.wheelbase_m - CAR.front_axle_to_gravity_m)
    separation_mps = (motion.speed_mps - motion.yaw_rate_radps * left_m) * out_ahead
    separation_mps += (motion.side_speed_mps + motion.yaw_rate_radps * from_gravity_m) * out_left
    if motion.speed_mps > 0.0:  # a car is not pushed backwards: its remaining speed is removed instead
        assert separation_mps >= -1e-9


def test_a_car_along_a_rail_is_slowed_by_friction() -> None:
    """A car pressed sideways into a rail at its centre of gravity loses friction times the lateral speed."""
    car = CarDynamics(CAR, CarMotion(0.0, 0.0, 0.0, 8.0, 0.5, 0.0), STEP_S)
    at_gravity_m = CAR.wheelbase_m - CAR.front_axle_to_gravity_m
    car.resolve_contact(Contact(at_gravity_m, 0.0, 0.0, -math.pi / 2))
    assert (car.motion.speed_mps, car.motion.side_speed_mps) == pytest.approx((8.0 - RAIL_FRICTION * 0.5, 0.0))
    car.resolve_contact(Contact(at_gravity_m, 0.0, 0.0, -math.pi / 2))
    assert car.motion.speed_mps == pytest.approx(8.0 - RAIL_FRICTION * 0.5)
