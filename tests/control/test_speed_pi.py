import pytest

from lavt.control.speed_pi import GENTLE_BRAKING_MPS2, SpeedPi, confident_speed_mps

TARGET_MPS = 30 / 3.6


def drive(pi: SpeedPi, seconds: float, speed_mps: float, slope_mps2: float = 0.0) -> list[float]:
    """Return the speeds of a car with a lag of 0.2 s and a constant deceleration `slope_mps2`."""
    speeds, acceleration = [speed_mps], 0.0
    for _ in range(round(seconds * 30)):
        requested = pi.acceleration_mps2(TARGET_MPS, speeds[-1], 1 / 30)
        acceleration += (requested - acceleration) / 6
        speeds.append(speeds[-1] + (acceleration - slope_mps2) / 30)
    return speeds


def test_the_target_speed_is_reached_without_overshoot() -> None:
    """From standstill, the car overshoots the target speed by less than 0.1 m/s and then keeps it."""
    speeds = drive(SpeedPi(2.0, 6.0), 30, 0.0)
    assert max(speeds) < TARGET_MPS + 0.1
    assert speeds[-1] == pytest.approx(TARGET_MPS, abs=0.02)


def test_saturation_causes_no_overshoot() -> None:
    """After a minute of saturated throttle the overshoot is less than 0.1 m/s (anti-windup)."""
    pi = SpeedPi(2.0, 6.0)
    for _ in range(1800):
        assert pi.acceleration_mps2(TARGET_MPS, 1.0, 1 / 30) == 2.0
    assert max(drive(pi, 30, 1.0)) < TARGET_MPS + 0.1


def test_a_slope_is_compensated() -> None:
    """The integral term compensates a constant slope."""
    assert drive(SpeedPi(2.0, 6.0), 60, TARGET_MPS, slope_mps2=0.3)[-1] == pytest.approx(TARGET_MPS, abs=0.03)


def test_a_pause_is_not_integrated() -> None:
    """After a long pause one call integrates over at most 0.1 s."""
    after_long_pause, after_short_pause = SpeedPi(2.0, 6.0), SpeedPi(2.0, 6.0)
    after_long_pause.acceleration_mps2(TARGET_MPS, TARGET_MPS - 0.4, 100.0)
    after_short_pause.acceleration_mps2(TARGET_MPS, TARGET_MPS - 0.4, 0.1)
    assert after_long_pause.acceleration_mps2(1.0, 1.0, 0.0) == after_short_pause.acceleration_mps2(1.0, 1.0, 0.0)


def test_slowing_down_is_gentle() -> None:
    """Speed control brakes gently, for any excess speed."""
    assert SpeedPi(2.0, 6.0).acceleration_mps2(0.0, 10.0, 1 / 30) == -GENTLE_BRAKING_MPS2


@pytest.mark.parametrize(
    ("acceleration_mps2", "expected"),
    [(1.0, (0.5, 0.0)), (5.0, (1.0, 0.0)), (-3.0, (0.0, 0.5)), (-9.0, (0.0, 1.0)), (0, (0, 0))],
)
def test_pedals(acceleration_mps2: float, expected: tuple[float, float]) -> None:
    """Throttle is a share of the full acceleration, brake of the full braking, and one of them is 0."""
    assert SpeedPi(2.0, 6.0).pedals(acceleration_mps2) == expected


@pytest.mark.parametrize(("confidence", "share"), [(1.0, 1.0), (0.5, 1.0), (0.3, 0.6), (0.0, 0.4)])
def test_lower_confidence_lowers_the_speed(confidence: float, share: float) -> None:
    """The speed is full down to confidence 0.5, proportional to lower confidence, and at least 0.4 of full speed."""
    assert confident_speed_mps(10.0, confidence) == pytest.approx(10 * share)
