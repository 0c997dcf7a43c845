from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.safety.rig import MAX_STEERING_RAD, WHEELBASE_M, new_limiter, vehicle_at

from lavt.domain import NS_PER_MS, NS_PER_S, Actuation
from lavt.safety.limiter import COMMAND_PERIOD_S, stopping_speed_limit_mps
from lavt.safety.limits import LIMITS

AGES_NS = 3600 * NS_PER_S
SPEED_MPS = 30 / 3.6
LATERAL_RAD = math.atan(WHEELBASE_M * LIMITS.lateral_acceleration_mps2 / SPEED_MPS**2)


def limited(requested: Actuation, speed_mps: float, *, after_ns: int = AGES_NS) -> tuple[Actuation, tuple[str, ...]]:
    """Give what becomes of `requested`, so long after the wheel stood straight."""
    limiter = new_limiter()
    limiter.start(0.0, 0)
    return limiter.limit(requested, vehicle_at(speed_mps), after_ns), limiter.changed


@pytest.mark.parametrize("sign", [1, -1])
def test_lateral_acceleration_is_limited(sign: int) -> None:
    """At 30 km/h no wheel angle beyond that of 3 m/s2 on the kinematic car gets through, to either side."""
    actuation, changed = limited(Actuation(sign * 0.4, 0.0, 0.0), SPEED_MPS)
    assert actuation.steering_rad == pytest.approx(sign * LATERAL_RAD)
    assert SPEED_MPS**2 * math.tan(abs(actuation.steering_rad)) / WHEELBASE_M == pytest.approx(3.0)
    assert changed == ("lateral acceleration",)


@pytest.mark.parametrize("sign", [1, -1])
def test_the_wheel_turns_no_further_than_the_cars(sign: int) -> None:
    """At standstill the limit is the vehicle's own largest angle, to either side."""
    actuation, changed = limited(Actuation(sign * 1.0, 0.0, 0.0), 0.0)
    assert (actuation.steering_rad, changed) == (sign * MAX_STEERING_RAD, ("steering angle",))


@pytest.mark.parametrize("sign", [1, -1])
def test_an_angle_at_a_limit_is_not_changed(sign: int) -> None:
    """The largest angle at standstill and that of the lateral acceleration at 30 km/h get through as they are."""
    for bound_rad, speed_mps in ((MAX_STEERING_RAD, 0.0), (LATERAL_RAD, SPEED_MPS)):
        requested = Actuation(sign * bound_rad, 0.0, 0.0)
        assert limited(requested, speed_mps) == (requested, ())


@pytest.mark.parametrize("sign", [1, -1])
def test_the_wheel_turns_no_faster_than_the_rate(sign: int) -> None:
    """In 10 ms the target moves by 8 mrad at most, and the rest follows as time goes on; to either side."""
    requested = Actuation(sign * 0.1, 0.0, 0.0)
    actuation, changed = limited(requested, SPEED_MPS, after_ns=10 * NS_PER_MS)
    assert actuation.steering_rad == pytest.approx(sign * 0.008)
    assert changed == ("steering rate",)
    assert limited(requested, SPEED_MPS, after_ns=125 * NS_PER_MS) == (requested, ())


def test_what_is_reached_within_a_command_period_is_not_called_limited() -> None:
    """A target that the wheel reaches within 20 ms was not changed by the limit, only spread over ticks of 4 ms."""
    period_rad = LIMITS.steering_rate_radps * COMMAND_PERIOD_S
    for from_rad in (0.0, 0.1, -0.1):
        for turn_rad, named in ((0.0159, ()), (0.0161, ("steering rate",))):
            for sign in (1, -1):
                limiter = new_limiter()
                limiter.start(from_rad, 0)
                requested = Actuation(from_rad + sign * turn_rad, 0.0, 0.0)
                actuation = limiter.limit(requested, vehicle_at(0.0), 4 * NS_PER_MS)
                assert actuation.steering_rad == pytest.approx(from_rad + sign * 0.0032)
                assert limiter.changed == named
    assert limited(Actuation(period_rad, 0.0, 0.0), 0.0, after_ns=4 * NS_PER_MS)[1] == ()


def test_a_time_that_goes_back_gives_no_extra_turn() -> None:
    """Asked at times that jump back and forth the wheel turns no further than in the time that really passed."""
    limiter = new_limiter()
    limiter.start(0.0, 0)
    for _ in range(20):
        for at_ns in (0, 10 * NS_PER_MS):
            reached = limiter.limit(Actuation(0.4, 0.0, 0.0), vehicle_at(), at_ns)
    assert reached.steering_rad <= 0.008 + 1e-12


def test_no_throttle_above_the_speed_limit() -> None:
    """Above 40 km/h the throttle is taken away; at it and below it stays, and the brake always does."""
    limit_mps = LIMITS.speed_limit_mps
    assert limited(Actuation(0.0, 1.0, 0.0), limit_mps) == (Actuation(0.0, 1.0, 0.0), ())
    assert limited(Actuation(0.0, 1.0, 0.0), limit_mps + 0.01) == (Actuation(0.0, 0.0, 0.0), ("speed",))
    assert limited(Actuation(0.0, 0.0, 0.7), limit_mps + 9) == (Actuation(0.0, 0.0, 0.7), ())


@pytest.mark.parametrize("speed_mps", [math.nan, math.inf, -math.inf])
def test_a_speed_that_is_no_number_lifts_no_limit(speed_mps: float) -> None:
    """With a speed that is not finite the wheel is limited as at the highest speed, and there is no throttle."""
    actuation, changed = limited(Actuation(0.5, 0.0, 0.0), speed_mps)
    top_rad = math.atan(WHEELBASE_M * LIMITS.lateral_acceleration_mps2 / LIMITS.speed_limit_mps**2)
    assert actuation.steering_rad == pytest.approx(top_rad)
    assert "lateral acceleration" in changed
    assert limited(Actuation(0.0, 1.0, 0.0), speed_mps)[0].throttle == 0.0


def test_before_it_begins_the_wheel_stays_where_it_is() -> None:
    """Until a first target is set, the wheel is asked to stay where the vehicle reports it."""
    limiter = new_limiter()
    assert limiter.limit(Actuation(0.4, 0.0, 1.0), vehicle_at(0.0, 0.15), AGES_NS).steering_rad == 0.15


def test_all_limits_that_changed_something_are_named() -> None:
    """Several limits at once are all named, and none when nothing was changed."""
    _, changed = limited(Actuation(1.0, 1.0, 0.0), 20.0, after_ns=1)
    assert changed == ("steering angle", "lateral acceleration", "steering rate", "speed")
    assert limited(Actuation(0.01, 0.5, 0.0), SPEED_MPS)[1] == ()


@pytest.mark.parametrize("age_s", [0.0, 0.08, 0.5, 0.86, 2.0])
def test_the_sight_limit_is_the_speed_that_stops_on_the_path(age_s: float) -> None:
    """From the limit the car covers exactly the 20 m of a path in the picture's age, 0.5 s, and braking with 4 m/s2."""
    speed_mps = stopping_speed_limit_mps(age_s, LIMITS)
    assert speed_mps * (age_s + 0.5) + speed_mps**2 / 8 == pytest.approx(20)


def test_30_kmh_is_within_sight_up_to_860_ms() -> None:
    """The limit lies above 30 km/h for pictures of up to 0.86 s, and below it for older ones."""
    assert stopping_speed_limit_mps(0.85, LIMITS) > SPEED_MPS > stopping_speed_limit_mps(0.87, LIMITS)


def by_stopping_distance(
    requested: Actuation, excess_mps: float, age_ns: int = NS_PER_S
) -> tuple[Actuation, tuple[str, ...]]:
    """Give what becomes of `requested` at a speed so far above the sight limit."""
    limiter = new_limiter()
    limiter.start(0.0, 0)
    speed_mps = stopping_speed_limit_mps(age_ns / NS_PER_S, LIMITS) + excess_mps
    return limiter.limit(requested, vehicle_at(speed_mps), AGES_NS, age_ns), limiter.changed


def test_faster_than_sight_allows_it_brakes() -> None:
    """Above the limit there is no throttle and a brake of 4 m/s2 for each m/s too much, at most that of a safe stop."""
    full = LIMITS.stop_deceleration_mps2 / 6.0
    for excess_mps, brake in ((0.25, full / 4), (1.0, full), (3.0, full)):
        actuation, changed = by_stopping_distance(Actuation(0.0, 0.8, 0.0), excess_mps)
        assert (actuation.throttle, changed) == (0.0, ("sight",))
        assert actuation.brake == pytest.approx(brake)


def test_faster_than_sight_allows_either_pedal_is_changed_alone() -> None:
    """Above the limit a throttle is taken away from under a harder brake, and a brake is pressed without a throttle."""
    full = LIMITS.stop_deceleration_mps2 / 6.0
    assert by_stopping_distance(Actuation(0.0, 0.8, 0.9), 1.0) == (Actuation(0.0, 0.0, 0.9), ("sight",))
    actuation, changed = by_stopping_distance(Actuation(0.0, 0.0, 0.1), 1.0)
    assert (actuation.throttle, changed) == (0.0, ("sight",))
    assert actuation.brake == pytest.approx(full)


def test_sight_eases_no_brake_and_names_what_it_changes_only() -> None:
    """Who brakes harder than that is left alone, and so is who stays below the limit or drives by no picture."""
    assert by_stopping_distance(Actuation(0.0, 0.0, 0.9), 5.0) == (Actuation(0.0, 0.0, 0.9), ())
    assert by_stopping_distance(Actuation(0.0, 0.8, 0.0), -0.01) == (Actuation(0.0, 0.8, 0.0), ())
    assert by_stopping_distance(Actuation(0.0, 0.8, 0.0), 0.0) == (Actuation(0.0, 0.8, 0.0), ())
    assert limited(Actuation(0.0, 0.8, 0.0), 11.0) == (Actuation(0.0, 0.8, 0.0), ())
    limiter = new_limiter()
    assert limiter.limit(Actuation(0.0, 0.0, 0.2), vehicle_at(math.nan), 0, 2 * NS_PER_S).brake == 0.2


@given(
    st.lists(
        st.tuples(st.floats(-1, 1), st.floats(0, 1), st.floats(0, 1), st.floats(-20, 60), st.integers(0, NS_PER_S)),
        max_size=20,
    )
)
def test_whatever_is_requested_the_limits_hold(requested: list[tuple[float, float, float, float, int]]) -> None:
    """Any series of commands at any speeds: rate and angle hold at once, lateral acceleration as fast as the rate."""
    limiter = new_limiter()
    limiter.start(0.0, 0)
    before_rad, now_ns = 0.0, 0
    for steering_rad, throttle, brake, speed_mps, passed_ns in requested:
        now_ns += passed_ns
        actuation = limiter.limit(Actuation(steering_rad, throttle, brake), vehicle_at(speed_mps), now_ns)
        step_rad = LIMITS.steering_rate_radps * passed_ns / NS_PER_S
        bound_rad = math.pi / 2
        if abs(speed_mps) >= 0.1:
            bound_rad = math.atan(WHEELBASE_M * LIMITS.lateral_acceleration_mps2 / speed_mps**2)
        assert abs(actuation.steering_rad) <= MAX_STEERING_RAD
        assert abs(actuation.steering_rad - before_rad) <= step_rad + 1e-12
        assert abs(actuation.steering_rad) <= max(bound_rad, abs(before_rad) - step_rad) + 1e-12
        assert actuation.throttle in (0.0, throttle)
        assert actuation.brake == brake
        before_rad = actuation.steering_rad
