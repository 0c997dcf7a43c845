from __future__ import annotations

import math
import sys

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace
from tests.safety.rig import (
    MAX_ACCELERATION_MPS2,
    MAX_BRAKING_MPS2,
    MAX_STEERING_RAD,
    WHEELBASE_M,
    new_limiter,
    vehicle_at,
)

from lavt.domain import NS_PER_MS, NS_PER_S, Actuation
from lavt.errors import UserError
from lavt.safety.limiter import COMMAND_PERIOD_S, Limiter, stopping_speed_limit_mps
from lavt.safety.limits import LIMITS

LONG_NS = 3600 * NS_PER_S
SPEED_MPS = 30 / 3.6
LATERAL_RAD = math.atan(WHEELBASE_M * LIMITS.lateral_acceleration_mps2 / SPEED_MPS**2)
"""The largest wheel angle that the limit of the lateral acceleration allows at `SPEED_MPS`."""


def limit_request(
    requested: Actuation, speed_mps: float, *, after_ns: int = LONG_NS
) -> tuple[Actuation, tuple[str, ...]]:
    """Limit a request `after_ns` after the wheel was straight; return the result and the applied limits' names."""
    limiter = new_limiter()
    limiter.reset(0.0, 0)
    return limiter.limit(requested, vehicle_at(speed_mps), after_ns), limiter.applied_limits


@pytest.mark.parametrize("sign", [1, -1])
def test_lateral_acceleration_is_limited(sign: int) -> None:
    """At 30 km/h the wheel angle is limited to a lateral acceleration of 3 m/s2, to either side."""
    actuation, applied_limits = limit_request(Actuation(sign * 0.4, 0.0, 0.0), SPEED_MPS)
    assert actuation.steering_rad == pytest.approx(sign * LATERAL_RAD)
    assert SPEED_MPS**2 * math.tan(abs(actuation.steering_rad)) / WHEELBASE_M == pytest.approx(3.0)
    assert applied_limits == ("lateral acceleration",)


@pytest.mark.parametrize("sign", [1, -1])
def test_steering_angle_is_limited(sign: int) -> None:
    """At standstill the wheel angle is limited to the largest angle of the vehicle, to either side."""
    actuation, applied_limits = limit_request(Actuation(sign * 1.0, 0.0, 0.0), 0.0)
    assert (actuation.steering_rad, applied_limits) == (sign * MAX_STEERING_RAD, ("steering angle",))


@pytest.mark.parametrize("sign", [1, -1])
def test_an_angle_at_a_limit_is_not_changed(sign: int) -> None:
    """An angle exactly at the steering limit or at the lateral acceleration limit is not changed."""
    for bound_rad, speed_mps in ((MAX_STEERING_RAD, 0.0), (LATERAL_RAD, SPEED_MPS)):
        requested = Actuation(sign * bound_rad, 0.0, 0.0)
        assert limit_request(requested, speed_mps) == (requested, ())


@pytest.mark.parametrize("sign", [1, -1])
def test_steering_rate_is_limited(sign: int) -> None:
    """The steering target moves by at most 8 mrad in 10 ms and by 100 mrad in 125 ms, to either side."""
    requested = Actuation(sign * 0.1, 0.0, 0.0)
    actuation, applied_limits = limit_request(requested, SPEED_MPS, after_ns=10 * NS_PER_MS)
    assert actuation.steering_rad == pytest.approx(sign * 0.008)
    assert applied_limits == ("steering rate",)
    assert limit_request(requested, SPEED_MPS, after_ns=125 * NS_PER_MS) == (requested, ())


def test_a_change_reached_within_a_command_period_is_not_reported() -> None:
    """The limit of the steering rate is reported only if the target needs more than 20 ms to reach the request."""
    period_rad = LIMITS.steering_rate_radps * COMMAND_PERIOD_S
    for from_rad in (0.0, 0.1, -0.1):
        for turn_rad, reported_limits in ((period_rad - 1e-4, ()), (period_rad + 1e-4, ("steering rate",))):
            for sign in (1, -1):
                limiter = new_limiter()
                limiter.reset(from_rad, 0)
                requested = Actuation(from_rad + sign * turn_rad, 0.0, 0.0)
                actuation = limiter.limit(requested, vehicle_at(0.0), 4 * NS_PER_MS)
                assert actuation.steering_rad == pytest.approx(from_rad + sign * LIMITS.steering_rate_radps * 0.004)
                assert limiter.applied_limits == reported_limits
    assert limit_request(Actuation(period_rad, 0.0, 0.0), 0.0, after_ns=4 * NS_PER_MS)[1] == ()


def test_time_that_goes_back_allows_no_extra_steering() -> None:
    """Times that jump back and forth allow no more steering than the time that really passed."""
    limiter = new_limiter()
    limiter.reset(0.0, 0)
    for _ in range(20):
        for at_ns in (0, 10 * NS_PER_MS):
            reached = limiter.limit(Actuation(0.4, 0.0, 0.0), vehicle_at(), at_ns)
    assert reached.steering_rad <= 0.008 + 1e-12


def test_no_throttle_above_the_speed_limit() -> None:
    """Above 40 km/h the throttle is removed and the brake is kept; at 40 km/h the throttle is kept."""
    limit_mps = LIMITS.speed_limit_mps
    assert limit_request(Actuation(0.0, 1.0, 0.0), limit_mps) == (Actuation(0.0, 1.0, 0.0), ())
    assert limit_request(Actuation(0.0, 1.0, 0.0), limit_mps + 0.01) == (Actuation(0.0, 0.0, 0.0), ("speed",))
    assert limit_request(Actuation(0.0, 0.0, 0.7), limit_mps + 9) == (Actuation(0.0, 0.0, 0.7), ())


@pytest.mark.parametrize("speed_mps", [math.nan, math.inf, -math.inf])
def test_a_speed_that_is_not_finite_lifts_no_limit(speed_mps: float) -> None:
    """A speed that is not finite limits the wheel as at the speed limit, and removes the throttle."""
    actuation, applied_limits = limit_request(Actuation(0.5, 0.0, 0.0), speed_mps)
    at_speed_limit_rad = math.atan(WHEELBASE_M * LIMITS.lateral_acceleration_mps2 / LIMITS.speed_limit_mps**2)
    assert actuation.steering_rad == pytest.approx(at_speed_limit_rad)
    assert "lateral acceleration" in applied_limits
    assert limit_request(Actuation(0.0, 1.0, 0.0), speed_mps)[0].throttle == 0.0


@pytest.mark.parametrize("steering_rad", [math.nan, math.inf, -math.inf])
def test_a_wheel_angle_that_is_not_finite_changes_no_target(steering_rad: float) -> None:
    """A reported wheel angle that is not finite neither becomes a target nor lifts the limit of the steering rate."""
    limiter, vehicle, requested = new_limiter(), vehicle_at(0.0, steering_rad), Actuation(0.4, 0.0, 1.0)
    assert limiter.target_rad(vehicle) == 0.0
    assert limiter.limit(requested, vehicle, 0).steering_rad == 0.0
    limiter.reset(0.1, 0)
    limiter.reset(steering_rad, 10 * NS_PER_MS)
    assert limiter.target_rad(vehicle) == 0.1
    assert limiter.limit(requested, vehicle, 10 * NS_PER_MS).steering_rad == pytest.approx(0.108)


def test_before_the_first_target_the_wheel_keeps_its_angle() -> None:
    """Before the first target, the target is the wheel's reported angle."""
    limiter = new_limiter()
    assert limiter.limit(Actuation(0.4, 0.0, 1.0), vehicle_at(0.0, 0.15), LONG_NS).steering_rad == 0.15


def test_all_applied_limits_are_named() -> None:
    """All limits that changed a request are named, and none if nothing was changed."""
    _, applied_limits = limit_request(Actuation(1.0, 1.0, 0.0), 20.0, after_ns=1)
    assert applied_limits == ("steering angle", "lateral acceleration", "steering rate", "speed")
    assert limit_request(Actuation(0.01, 0.5, 0.0), SPEED_MPS)[1] == ()


@pytest.mark.parametrize("age_s", [0.0, 0.08, 0.5, 0.86, 2.0])
def test_the_speed_limit_stops_on_the_path(age_s: float) -> None:
    """A car at the stopping speed limit stops on the path's 20 m.

    It drives on for the picture age and 0.5 s, and then brakes with 4 m/s2. All the way, its speed is taken to be
    higher than the limit by what full throttle adds in 0.3 s.
    """
    speed_mps = stopping_speed_limit_mps(age_s, LIMITS, MAX_ACCELERATION_MPS2) + 0.3 * MAX_ACCELERATION_MPS2
    assert speed_mps * (age_s + 0.5) + speed_mps**2 / 8 == pytest.approx(20)


def test_a_car_too_strong_for_the_path_may_not_move() -> None:
    """The speed limit of a car that accelerates beyond every safe speed within 0.3 s is 0, never negative."""
    assert stopping_speed_limit_mps(2.0, LIMITS, 100.0) == 0.0


def test_30_kmh_is_allowed_up_to_a_picture_age_of_620_ms() -> None:
    """The stopping speed limit of the simulator's car falls below 30 km/h between picture ages of 0.61 s and 0.63 s."""
    at_610_ms, at_630_ms = (stopping_speed_limit_mps(age_s, LIMITS, MAX_ACCELERATION_MPS2) for age_s in (0.61, 0.63))
    assert at_610_ms > SPEED_MPS > at_630_ms


def limit_at_excess_speed(
    requested: Actuation, excess_mps: float, age_ns: int = NS_PER_S
) -> tuple[Actuation, tuple[str, ...]]:
    """Limit a request at a speed of `excess_mps` above the stopping speed limit; see `limit_request`."""
    limiter = new_limiter()
    limiter.reset(0.0, 0)
    speed_mps = stopping_speed_limit_mps(age_ns / NS_PER_S, LIMITS, MAX_ACCELERATION_MPS2) + excess_mps
    return limiter.limit(requested, vehicle_at(speed_mps), LONG_NS, age_ns), limiter.applied_limits


def test_excess_speed_is_braked_away() -> None:
    """Above the stopping speed limit the throttle is removed, and the car brakes.

    It brakes with 4 m/s2 for each m/s of excess speed, but not harder than a safe stop.
    """
    safe_stop_brake = LIMITS.stop_deceleration_mps2 / MAX_BRAKING_MPS2
    for excess_mps, brake in ((0.25, safe_stop_brake / 4), (1.0, safe_stop_brake), (3.0, safe_stop_brake)):
        actuation, applied_limits = limit_at_excess_speed(Actuation(0.0, 0.8, 0.0), excess_mps)
        assert (actuation.throttle, applied_limits) == (0.0, ("stopping distance",))
        assert actuation.brake == pytest.approx(brake)


def test_excess_speed_changes_either_pedal_alone() -> None:
    """Above the limit the throttle is removed even if the requested brake is harder, and a light brake is raised."""
    safe_stop_brake = LIMITS.stop_deceleration_mps2 / MAX_BRAKING_MPS2
    assert limit_at_excess_speed(Actuation(0.0, 0.8, 0.9), 1.0) == (Actuation(0.0, 0.0, 0.9), ("stopping distance",))
    actuation, applied_limits = limit_at_excess_speed(Actuation(0.0, 0.0, 0.1), 1.0)
    assert (actuation.throttle, applied_limits) == (0.0, ("stopping distance",))
    assert actuation.brake == pytest.approx(safe_stop_brake)


def test_the_stopping_distance_limit_releases_no_brake() -> None:
    """A request with a harder brake, at a speed up to the limit, or without a picture is not changed.

    A speed that is not a number does not release the brake.
    """
    assert limit_at_excess_speed(Actuation(0.0, 0.0, 0.9), 5.0) == (Actuation(0.0, 0.0, 0.9), ())
    assert limit_at_excess_speed(Actuation(0.0, 0.8, 0.0), -0.01) == (Actuation(0.0, 0.8, 0.0), ())
    assert limit_at_excess_speed(Actuation(0.0, 0.8, 0.0), 0.0) == (Actuation(0.0, 0.8, 0.0), ())
    assert limit_request(Actuation(0.0, 0.8, 0.0), 11.0) == (Actuation(0.0, 0.8, 0.0), ())
    limiter = new_limiter()
    assert limiter.limit(Actuation(0.0, 0.0, 0.2), vehicle_at(math.nan), 0, 2 * NS_PER_S).brake == 0.2


@given(
    st.lists(
        st.tuples(st.floats(-1, 1), st.floats(0, 1), st.floats(0, 1), st.floats(-20, 60), st.integers(0, NS_PER_S)),
        max_size=20,
    )
)
def test_the_limits_hold_for_any_request(requested: list[tuple[float, float, float, float, int]]) -> None:
    """Angle and rate are always within their limits, lateral acceleration as soon as the steering rate allows."""
    limiter = new_limiter()
    limiter.reset(0.0, 0)
    previous_rad, now_ns = 0.0, 0
    for steering_rad, throttle, brake, speed_mps, passed_ns in requested:
        now_ns += passed_ns
        actuation = limiter.limit(Actuation(steering_rad, throttle, brake), vehicle_at(speed_mps), now_ns)
        step_rad = LIMITS.steering_rate_radps * passed_ns / NS_PER_S
        bound_rad = math.pi / 2
        if abs(speed_mps) >= 0.1:
            bound_rad = math.atan(WHEELBASE_M * LIMITS.lateral_acceleration_mps2 / speed_mps**2)
        assert abs(actuation.steering_rad) <= MAX_STEERING_RAD
        assert abs(actuation.steering_rad - previous_rad) <= step_rad + 1e-12
        assert abs(actuation.steering_rad) <= max(bound_rad, abs(previous_rad) - step_rad) + 1e-12
        assert actuation.throttle in (0.0, throttle)
        assert actuation.brake == brake
        previous_rad = actuation.steering_rad


NUMBERS = st.floats(allow_nan=True, allow_infinity=True)


@given(
    st.tuples(NUMBERS, NUMBERS, NUMBERS),
    st.lists(st.tuples(NUMBERS, NUMBERS, st.booleans(), st.booleans()), min_size=1, max_size=5),
)
def test_whatever_a_vehicle_reports_the_output_is_within_limits(
    requested: tuple[float, float, float], reports: list[tuple[float, float, bool, bool]]
) -> None:
    """For any speed, angle and request, finite or not, the output is finite, and its angle within the vehicle's."""
    limiter = new_limiter()
    for index, (speed_mps, steering_rad, is_plausible, is_reset) in enumerate(reports):
        vehicle = replace(vehicle_at(speed_mps, steering_rad), is_speed_plausible=is_plausible)
        if is_reset:
            limiter.reset(steering_rad, index * LONG_NS)
        actuation = limiter.limit(Actuation(*requested), vehicle, index * LONG_NS, index * NS_PER_MS)
        assert all(map(math.isfinite, (actuation.throttle, actuation.brake)))
        assert abs(actuation.steering_rad) <= MAX_STEERING_RAD


@pytest.mark.parametrize("speed_mps", [LIMITS.speed_limit_mps + 1, -LIMITS.speed_limit_mps - 1])
def test_a_car_that_is_too_fast_gets_no_throttle(speed_mps: float) -> None:
    """Above the speed limit, forward or backward, the throttle is removed."""
    actuation, applied_limits = limit_request(Actuation(0.0, 1.0, 0.0), speed_mps)
    assert actuation.throttle == 0.0
    assert applied_limits == ("speed",)


def test_a_request_that_is_not_finite_brakes() -> None:
    """A request with a value that is not finite becomes the last steering target and a full brake."""
    actuation, applied_limits = limit_request(Actuation(math.nan, 1.0, 0.0), SPEED_MPS)
    assert actuation == Actuation(0.0, 0.0, 1.0)
    assert applied_limits == ("not finite",)


@pytest.mark.parametrize("sign", [1, -1])
def test_a_car_that_is_too_fast_for_its_path_brakes(sign: int) -> None:
    """Above the speed from which it can stop on its path, a car brakes without throttle, forward or backward."""
    vehicle = vehicle_at(sign * LIMITS.speed_limit_mps)
    actuation = new_limiter().limit(Actuation(0.0, 1.0, 0.0), vehicle, LONG_NS, NS_PER_S)
    assert actuation.throttle == 0.0
    assert actuation.brake > 0.0


@pytest.mark.parametrize("speed_mps", [101.0, 1e155, -1e300, sys.float_info.max, math.nan])
def test_an_impossible_speed_limits_the_wheel_as_at_the_speed_limit(speed_mps: float) -> None:
    """A speed above any vehicle's is unknown: it neither straightens the wheel in a curve nor lifts the limit."""
    at_speed_limit_rad = math.atan(WHEELBASE_M * LIMITS.lateral_acceleration_mps2 / LIMITS.speed_limit_mps**2)
    limited = limit_request(Actuation(0.5, 1.0, 0.0), speed_mps)[0]
    assert limited.steering_rad == pytest.approx(at_speed_limit_rad)
    assert limited.throttle == 0.0


def test_an_implausible_speed_gives_no_throttle_and_the_least_steering() -> None:
    """An implausible speed of 0 limits the wheel as at the speed limit, and removes the throttle."""
    limiter = new_limiter()
    limiter.reset(0.0, 0)
    vehicle = replace(vehicle_at(0.0), is_speed_plausible=False)
    actuation = limiter.limit(Actuation(0.5, 1.0, 0.0), vehicle, LONG_NS)
    at_speed_limit_rad = math.atan(WHEELBASE_M * LIMITS.lateral_acceleration_mps2 / LIMITS.speed_limit_mps**2)
    assert actuation.steering_rad == pytest.approx(at_speed_limit_rad)
    assert actuation.throttle == 0.0


@pytest.mark.parametrize("name", ["wheelbase_m", "max_steering_rad", "max_acceleration_mps2", "max_braking_mps2"])
@pytest.mark.parametrize("number", [math.nan, math.inf, 0.0, -1.0])
def test_properties_of_the_vehicle_are_positive_numbers(name: str, number: float) -> None:
    """A wheelbase, steering angle, acceleration or braking that is not positive and finite is rejected."""
    properties = {"wheelbase_m": 2.8, "max_steering_rad": 0.5, "max_acceleration_mps2": 2.0, "max_braking_mps2": 6.0}
    with pytest.raises(UserError):
        Limiter(LIMITS, **{**properties, name: number})
