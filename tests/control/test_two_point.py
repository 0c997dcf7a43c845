import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import quad, solve_ivp

from lavt.control.preset import DESIGNED, Preset
from lavt.control.pure_pursuit import curvature_per_m
from lavt.control.two_point import MAX_STEP_S, TwoPointDriver, TwoPointSettings
from lavt.domain import NS_PER_MS, NS_PER_S, Decision, Lane

WHEELBASE_M = 2.8448
SPEED_MPS = 30 / 3.6
MODEL = TwoPointSettings()
NO_LIMITS = Preset("no limits", lookahead_s=1.0)
FAR_ONLY = replace(MODEL, near_gain=0.0, near_integral_gain_per_s=0.0, far_gain=16.0, eye_ahead_m=0.0)
"""With a steering ratio of 16, the wanted angle of the road wheels is the far angle."""


def lane(c0: float = 0.0, c1: float = 0.0, c2: float = 0.0, confidence: float = 1.0) -> Lane:
    return Lane(centre=(c0, c1, c2), width_m=3.5, near_m=3.6, far_m=20.0, confidence=confidence)


def new_driver(settings: TwoPointSettings = MODEL, preset: Preset = NO_LIMITS) -> TwoPointDriver:
    return TwoPointDriver(preset, wheelbase_m=WHEELBASE_M, settings=settings)


def decide_at(driver: TwoPointDriver, seen: Lane, *times_ns: int, speed_mps: float = SPEED_MPS) -> list[Decision]:
    return [driver.decide(seen, speed_mps, now_ns) for now_ns in times_ns]


def offset_angle(offset_m: Callable[[float], float], ahead_m: float) -> Callable[[float], float]:
    return lambda time_s: math.atan2(offset_m(time_s), ahead_m - MODEL.eye_ahead_m)


def test_steering_solves_the_differential_equation() -> None:
    """For a lane that moves sideways, the wheel follows an independent numerical solution of the model's equations."""
    delay_s, lag_s, ratio = MODEL.reaction_delay_s, MODEL.neuromuscular_lag_s, MODEL.steering_ratio

    def offset_m(time_s: float) -> float:
        return 0.5 * math.sin(2 * time_s)

    near, far = offset_angle(offset_m, MODEL.near_point_m), offset_angle(offset_m, 20.0)

    def wanted_rad(time_s: float) -> float:
        if time_s < 0:
            return 0.0
        integral = quad(lambda at_s: min(max(near(at_s), -0.07), 0.07), 0, time_s, limit=200, epsabs=1e-6)[0]
        angles_rad = MODEL.far_gain * far(time_s) + MODEL.near_gain * near(time_s)
        return (angles_rad + MODEL.near_integral_gain_per_s * float(integral)) / ratio

    solution = solve_ivp(
        lambda time_s, hands: [(wanted_rad(time_s - delay_s) - hands[0]) / lag_s],
        (0.0, 4.0),
        [0.0],
        max_step=0.02,
        rtol=1e-6,
        dense_output=True,
    )
    driver, step_ns = new_driver(), NS_PER_S // 500
    steering = [
        driver.decide(lane(offset_m(number * step_ns / NS_PER_S)), SPEED_MPS, number * step_ns).steering_rad
        for number in range(2001)
    ]
    expected = solution.sol(np.arange(2001) * step_ns / NS_PER_S)[0]
    assert np.ptp(expected) > 0.03
    # A picture is seen every 2 ms, so the wheel is 1 ms late on average, at up to 0.05 rad/s.
    assert np.max(np.abs(steering - expected)) < 2e-4


@pytest.mark.parametrize("lag_s", [0.11, 0.0])
@pytest.mark.parametrize("delay_s", [0.12, 0.0])
def test_delay_and_lag_are_exact(delay_s: float, lag_s: float) -> None:
    """After a step of the far point, the wheel waits for the reaction delay, then approaches its angle."""
    driver = new_driver(replace(FAR_ONLY, reaction_delay_s=delay_s, neuromuscular_lag_s=lag_s))
    begun_ns, delay_ns = 7 * NS_PER_S, round(delay_s * NS_PER_S)
    decide_at(driver, lane(), begun_ns - NS_PER_S)
    target_rad = math.atan2(2.0, 20.0)
    times_ns = {begun_ns, *(begun_ns + delay_ns + after_ns for after_ns in (-1, 0, 1, 10**7, 3 * 10**7 + 1, 9 * 10**8))}
    for now_ns in sorted(times_ns - {begun_ns - 1}):
        (decision,) = decide_at(driver, lane(2.0), now_ns)
        moving_s = (now_ns - begun_ns - delay_ns) / NS_PER_S
        share = 0.0 if moving_s < 0 else 1.0 if lag_s == 0 else 1 - math.exp(-moving_s / lag_s)
        assert decision.steering_rad == pytest.approx(target_rad * share, abs=1e-12)


def test_the_angle_does_not_depend_on_the_times_of_other_decisions() -> None:
    """Decisions between two pictures' effects do not change the wheel angle that is reached later."""
    often, seldom = new_driver(FAR_ONLY), new_driver(FAR_ONLY)
    decide_at(often, lane(1.0), *range(0, NS_PER_S // 2, 3 * NS_PER_MS))
    decide_at(seldom, lane(1.0), 0)
    at_end = [decide_at(driver, lane(1.0), NS_PER_S // 2)[0].steering_rad for driver in (often, seldom)]
    assert at_end[0] == pytest.approx(at_end[1], abs=1e-12)
    assert at_end[0] > 0.04


def test_a_far_lane_to_the_left_turns_the_wheel_to_the_left() -> None:
    """A lane that curves to the left turns the wheel to the left, and its mirror image equally to the right."""
    left, right = (decide_at(new_driver(), lane(c2=c2), 0, NS_PER_S)[-1].steering_rad for c2 in (0.01, -0.01))
    assert left > 0.02
    assert right == -left


def test_the_far_point_is_within_the_lane_that_is_seen() -> None:
    """If the lane is seen up to 12 m only, the far point is there."""
    short = Lane(centre=(1.0, 0.0, 0.0), width_m=3.5, near_m=3.6, far_m=12.0, confidence=1.0)
    decision = decide_at(new_driver(FAR_ONLY), short, 0, 5 * NS_PER_S)[-1]
    assert decision.steering_rad == pytest.approx(math.atan2(1.0, 12.0))


def turned_rad(*, offset_m: float, stamps_ns: Sequence[int]) -> float:
    """Return the angle by which only the integral of the near angle turns the wheel."""
    integral = replace(
        MODEL, far_gain=0.0, near_gain=0.0, steering_ratio=1.0, reaction_delay_s=0.0, neuromuscular_lag_s=0.0
    )
    driver, now_ns, angle_rad = new_driver(integral), 0, 0.0
    for stamp_ns in stamps_ns:
        now_ns += 40 * NS_PER_MS
        driver.note_stamp(stamp_ns)
        angle_rad = driver.decide(lane(offset_m), SPEED_MPS, now_ns).steering_rad
    return angle_rad


def test_the_near_angle_is_integrated_over_the_time_between_stamps() -> None:
    """The stamps give the time between pictures: not their arrival, no negative time, and at most `MAX_STEP_S`."""
    near_rad = math.atan2(0.1, MODEL.near_point_m - MODEL.eye_ahead_m)
    for stamps_ms, seconds in (((0, 33), 0.033), ((0, -50), 0.0), ((0, 5000), MAX_STEP_S)):
        angle_rad = turned_rad(offset_m=0.1, stamps_ns=[10**18 + ms * NS_PER_MS for ms in stamps_ms])
        assert angle_rad == pytest.approx(MODEL.near_integral_gain_per_s * near_rad * seconds)


def test_a_large_near_angle_is_limited_in_the_integral() -> None:
    """An offset of 3 m is integrated like the largest near angle."""
    angle_rad = turned_rad(offset_m=-3.0, stamps_ns=[0, 33 * NS_PER_MS])
    assert angle_rad == pytest.approx(-MODEL.near_integral_gain_per_s * 0.07 * 0.033)


def test_the_limits_of_the_preset_hold() -> None:
    """The lateral acceleration is at most the preset's, and the wheel leaves the limit when the lane asks for it."""
    driver = new_driver(preset=DESIGNED)
    decisions = decide_at(driver, lane(c2=0.05), *range(0, 10 * NS_PER_S, 33 * NS_PER_MS))
    for decision in decisions:
        for curvature in (curvature_per_m(decision.steering_rad, WHEELBASE_M), *decision.path_curvature_per_m):
            assert abs(curvature) * SPEED_MPS**2 <= 3.0 + 1e-9
    # The wanted angle did not grow beyond the limit, so the wheel turns back within the driver's own delay.
    (_, later) = decide_at(driver, lane(c2=-0.05), 10 * NS_PER_S, 11 * NS_PER_S)
    assert later.steering_rad < 0


def test_without_a_lane_the_wheel_is_held() -> None:
    """When the lane is lost, the wheel ends its movement and stays, without throttle; then the model goes on."""
    driver = new_driver()
    decide_at(driver, lane(c2=0.005), 0)
    lost = decide_at(driver, lane(3.0, confidence=0.0), 2 * NS_PER_S, 3 * NS_PER_S, 4 * NS_PER_S)
    assert lost[0].steering_rad > 0.01
    assert [decision.steering_rad for decision in lost[1:]] == pytest.approx([lost[0].steering_rad] * 2, abs=1e-6)
    assert all(decision.throttle == decision.brake == 0 for decision in lost)
    found = decide_at(driver, lane(c2=0.010), 5 * NS_PER_S, 6 * NS_PER_S)
    assert found[0].steering_rad == pytest.approx(lost[-1].steering_rad, abs=1e-6)
    assert found[1].steering_rad > lost[-1].steering_rad + 0.01


def test_a_stationary_car_restarts_the_model() -> None:
    """After the car was stationary, the wheel angles of the next drive are those of a new driver."""
    used, new = new_driver(), new_driver()
    decide_at(used, lane(1.0, 0.1, 0.01), *range(0, 2 * NS_PER_S, 33 * NS_PER_MS))
    assert decide_at(used, lane(1.0), 3 * NS_PER_S, speed_mps=0.0)[0].steering_rad == 0
    times_ns = range(10 * NS_PER_S, 11 * NS_PER_S, 33 * NS_PER_MS)
    angles = [[d.steering_rad for d in decide_at(driver, lane(-0.5), *times_ns)] for driver in (used, new)]
    assert angles[0] == angles[1]
    assert min(angles[0]) < -0.01


def noisy_angles(noise_rad: float, seed: int) -> list[float]:
    driver = TwoPointDriver(NO_LIMITS, wheelbase_m=WHEELBASE_M, settings=replace(MODEL, noise_rad=noise_rad), seed=seed)
    return [decision.steering_rad for decision in decide_at(driver, lane(), *range(0, NS_PER_S, 33 * NS_PER_MS))]


def test_the_noise_is_reproducible() -> None:
    """By default there is no noise. Equal seeds give equal noise, others other noise."""
    assert set(noisy_angles(MODEL.noise_rad, 1)) == {0.0}
    assert noisy_angles(0.01, 1) == noisy_angles(0.01, 1) != noisy_angles(0.01, 2)
    assert np.std(noisy_angles(0.01, 1)) > 1e-4
