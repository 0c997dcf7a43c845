import pytest

from lavt.control.speed_pi import GENTLE_BRAKING_MPS2, SpeedPi, confident_speed_mps

TARGET_MPS = 30 / 3.6


def drive(pi: SpeedPi, seconds: float, speed_mps: float, slope_mps2: float = 0.0) -> list[float]:
    """Give the speeds of a car that accelerates as told, 0.2 s late, with something that holds it back."""
    speeds, acceleration = [speed_mps], 0.0
    for _ in range(round(seconds * 30)):
        wanted = pi.acceleration_mps2(TARGET_MPS, speeds[-1], 1 / 30)
        acceleration += (wanted - acceleration) / 6
        speeds.append(speeds[-1] + (acceleration - slope_mps2) / 30)
    return speeds


def test_from_standstill_the_speed_is_reached_and_hardly_passed() -> None:
    """Long full throttle winds nothing up: the speed is passed by less than 0.1 m/s and held."""
    speeds = drive(SpeedPi(2.0, 6.0), 30, 0.0)
    assert max(speeds) < TARGET_MPS + 0.1
    assert speeds[-1] == pytest.approx(TARGET_MPS, abs=0.02)


def test_a_long_climb_that_is_too_steep_winds_nothing_up() -> None:
    """After a minute of full throttle without getting on, the speed is passed by less than 0.1 m/s too."""
    pi = SpeedPi(2.0, 6.0)
    for _ in range(1800):
        assert pi.acceleration_mps2(TARGET_MPS, 1.0, 1 / 30) == 2.0
    assert max(drive(pi, 30, 1.0)) < TARGET_MPS + 0.1


def test_a_slope_is_learnt() -> None:
    """What holds the car back all the time is made up for by the integral."""
    assert drive(SpeedPi(2.0, 6.0), 60, TARGET_MPS, slope_mps2=0.3)[-1] == pytest.approx(TARGET_MPS, abs=0.03)


def test_a_pause_teaches_nothing() -> None:
    """After a long time without being asked the integral has moved by no more than a tenth of a second's worth."""
    rested, fresh = SpeedPi(2.0, 6.0), SpeedPi(2.0, 6.0)
    rested.acceleration_mps2(TARGET_MPS, TARGET_MPS - 0.4, 100.0)
    fresh.acceleration_mps2(TARGET_MPS, TARGET_MPS - 0.4, 0.1)
    assert rested.acceleration_mps2(1.0, 1.0, 0.0) == fresh.acceleration_mps2(1.0, 1.0, 0.0)


def test_slowing_down_is_gentle() -> None:
    """However much too fast the car is, holding a speed brakes gently."""
    assert SpeedPi(2.0, 6.0).acceleration_mps2(0.0, 10.0, 1 / 30) == -GENTLE_BRAKING_MPS2


@pytest.mark.parametrize(
    ("acceleration_mps2", "expected"),
    [(1.0, (0.5, 0.0)), (5.0, (1.0, 0.0)), (-3.0, (0.0, 0.5)), (-9.0, (0.0, 1.0)), (0, (0, 0))],
)
def test_the_pedals_share_what_is_wanted(acceleration_mps2: float, expected: tuple[float, float]) -> None:
    """Throttle is a share of the full acceleration, brake one of the full braking, never both."""
    assert SpeedPi(2.0, 6.0).pedals(acceleration_mps2) == expected


@pytest.mark.parametrize(("confidence", "share"), [(1.0, 1.0), (0.5, 1.0), (0.3, 0.6), (0.0, 0.4)])
def test_less_confidence_is_less_speed(confidence: float, share: float) -> None:
    """Full speed down to confidence 0.5, in proportion below it, never less than 0.4 of it."""
    assert confident_speed_mps(10.0, confidence) == pytest.approx(10 * share)
