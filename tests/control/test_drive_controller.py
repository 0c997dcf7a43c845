import math
from importlib.metadata import EntryPoint

import pytest

from lavt.control import drive_controller
from lavt.control.drive_controller import LaneKeeper, make_controller
from lavt.control.preset import DESIGNED, PRESETS, Preset, find_preset
from lavt.control.pure_pursuit import curvature_per_m
from lavt.control.speed_control import (
    GENTLE_BRAKING_MPS2,
    SpeedPiController,
    pedals,
    speed_for_confidence_mps,
)
from lavt.domain import NS_PER_S, PATH_POINTS, Decision, Lane
from lavt.errors import UserError

WHEELBASE_M = 2.8448
SPEED_MPS = 30 / 3.6
FRAME_NS = NS_PER_S // 30
CURVE_C2_PER_M = 0.5 / 87
"""The quadratic coefficient of a lane that curves to the left with a radius of 87 m."""


def lane(c0: float = 0.0, c1: float = 0.0, c2: float = 0.0, confidence: float = 1.0) -> Lane:
    return Lane(centre=(c0, c1, c2), width_m=3.5, near_m=3.6, far_m=20.0, confidence=confidence)


def lane_keeper(preset: Preset = DESIGNED) -> LaneKeeper:
    return LaneKeeper(preset, wheelbase_m=WHEELBASE_M)


@pytest.mark.parametrize("name", sorted(PRESETS))
def test_a_decision_is_in_the_range_of_a_command(name: str) -> None:
    """For any lane, pedals are in [0, 1], one of them is 0, and the path has finite points."""
    for centre in ((0.0, 0.0, 0.0), (6.0, 1.0, 0.05), (-30.0, 0.0, 0.0), (0.0, -5.0, 0.1)):
        decision = lane_keeper(PRESETS[name]).decide(lane(*centre), SPEED_MPS, 0)
        assert 0 <= decision.throttle <= 1
        assert 0 <= decision.brake <= 1
        assert decision.throttle * decision.brake == 0
        assert len(decision.path_curvature_per_m) == PATH_POINTS
        assert all(math.isfinite(value) for value in (decision.steering_rad, *decision.path_curvature_per_m))


@pytest.mark.parametrize("speed_mps", [5.0, SPEED_MPS, 14.0])
def test_designed_limits_lateral_acceleration(speed_mps: float) -> None:
    """The designed preset never exceeds 3 m/s2 of lateral acceleration."""
    decision = lane_keeper().decide(lane(3.0), speed_mps, 0)
    for curvature in (curvature_per_m(decision.steering_rad, WHEELBASE_M), *decision.path_curvature_per_m):
        assert abs(curvature) * speed_mps**2 <= 3.0 + 1e-9
    assert curvature_per_m(decision.steering_rad, WHEELBASE_M) * speed_mps**2 == pytest.approx(3.0)


def test_paper_calibrated_limits_the_wheel_angle() -> None:
    """The paper_calibrated preset steers at most 0.21 rad: a lateral acceleration of 5.2 m/s2 at 30 km/h."""
    decision = lane_keeper(PRESETS["paper_calibrated"]).decide(lane(-4.0), SPEED_MPS, 0)
    assert decision.steering_rad == pytest.approx(-0.21)


def test_the_first_decision_follows_the_lane() -> None:
    """The first decision already steers towards the lane and accelerates."""
    decision = lane_keeper().decide(lane(0.3), 0.0, 123)
    assert decision.steering_rad > 0
    assert decision.throttle == 1.0


def lose_lane(controller: LaneKeeper, after_ns: int) -> Decision:
    """Return the decision at `after_ns`, after one picture of a left curve and then pictures without a lane."""
    decision = controller.decide(lane(c2=CURVE_C2_PER_M), SPEED_MPS, 0)
    for now_ns in range(FRAME_NS, after_ns + 1, FRAME_NS):
        decision = controller.decide(lane(confidence=0.0), SPEED_MPS, now_ns)
    return decision


def test_without_a_lane_there_is_no_throttle() -> None:
    """Without a lane the controller applies neither throttle nor brake: `LaneWatch` decides when the client brakes."""
    for after_ns in (FRAME_NS, 3 * NS_PER_S):
        decision = lose_lane(lane_keeper(), after_ns)
        assert (decision.throttle, decision.brake) == (0.0, 0.0)


def test_a_lost_lane_is_followed_from_memory() -> None:
    """Half a second after the lane was lost in a curve, the wheel still follows the curve."""
    in_curve = lane_keeper().decide(lane(c2=CURVE_C2_PER_M), SPEED_MPS, 0)
    assert lose_lane(lane_keeper(), NS_PER_S // 2).steering_rad == pytest.approx(in_curve.steering_rad, rel=0.15)


def test_a_lost_lane_with_an_offset_is_reached() -> None:
    """If the lane is lost while the car is beside its centre, the car steers to the remembered centre."""
    controller = lane_keeper()
    first = controller.decide(lane(0.8), SPEED_MPS, 0).steering_rad
    for now_ns in range(FRAME_NS, 2 * NS_PER_S, FRAME_NS):
        last = controller.decide(lane(confidence=0.0), SPEED_MPS, now_ns).steering_rad
    assert abs(last) < 0.2 * first


def test_a_new_lane_replaces_the_remembered_one() -> None:
    """After a loss, the first new lane replaces the remembered one."""
    controller = lane_keeper()
    lose_lane(controller, NS_PER_S)
    new_decision = controller.decide(lane(-0.5), SPEED_MPS, NS_PER_S + FRAME_NS)
    assert new_decision.steering_rad == lane_keeper().decide(lane(-0.5), SPEED_MPS, 0).steering_rad


def test_unknown_names_are_user_errors() -> None:
    """An unknown controller or preset is a user error that names the known ones."""
    with pytest.raises(UserError, match="lane_keeper"):
        make_controller("lane_keper", PRESETS["designed"], WHEELBASE_M)
    with pytest.raises(UserError, match="designed, paper_calibrated"):
        find_preset("tuned")


class ExternalController:
    """A controller from another package."""

    def __init__(self, preset: Preset, *, wheelbase_m: float) -> None:
        self.arguments = (preset.name, wheelbase_m)

    def decide(self, lane: Lane, speed_mps: float, now_ns: int) -> Decision:
        """Return full brake."""
        del lane, speed_mps, now_ns
        return Decision(0.0, 0.0, 1.0, (0.0,) * PATH_POINTS)


def test_a_package_adds_a_controller_by_entry_point(monkeypatch: pytest.MonkeyPatch) -> None:
    """A controller registered in the group `lavt.controllers` is found by name and gets the wheelbase."""
    entry = EntryPoint("external", f"{__name__}:ExternalController", drive_controller.ENTRY_POINTS)
    monkeypatch.setattr(drive_controller, "entry_points", lambda group: [entry] if group == "lavt.controllers" else [])
    controller = make_controller("external", PRESETS["designed"], WHEELBASE_M)
    assert getattr(controller, "arguments", None) == ("designed", WHEELBASE_M)


def drive(controller: SpeedPiController, seconds: float, speed_mps: float, slope_mps2: float = 0.0) -> list[float]:
    """Return the speeds of a car whose acceleration lags by 0.2 s, on a slope that decelerates it by `slope_mps2`."""
    speeds, acceleration = [speed_mps], 0.0
    for _ in range(round(seconds * 30)):
        requested = controller.acceleration_mps2(SPEED_MPS, speeds[-1], 1 / 30)
        acceleration += (requested - acceleration) / (0.2 * 30)
        speeds.append(speeds[-1] + (acceleration - slope_mps2) / 30)
    return speeds


def test_the_target_speed_is_reached_without_overshoot() -> None:
    """From standstill, the car exceeds the target speed by less than 0.1 m/s and then keeps it."""
    speeds = drive(SpeedPiController(), 30, 0.0)
    assert max(speeds) < SPEED_MPS + 0.1
    assert speeds[-1] == pytest.approx(SPEED_MPS, abs=0.02)


def test_anti_windup() -> None:
    """After a minute of saturated throttle the overshoot is less than 0.1 m/s (anti-windup)."""
    controller = SpeedPiController()
    for _ in range(1800):
        assert controller.acceleration_mps2(SPEED_MPS, 1.0, 1 / 30) == 2.0
    assert max(drive(controller, 30, 1.0)) < SPEED_MPS + 0.1


def test_a_slope_is_compensated() -> None:
    """The integral term compensates a constant slope."""
    assert drive(SpeedPiController(), 60, SPEED_MPS, slope_mps2=0.3)[-1] == pytest.approx(SPEED_MPS, abs=0.03)


def test_a_pause_is_not_integrated() -> None:
    """After a long pause one call integrates over at most 0.1 s."""
    after_pause, without_pause = SpeedPiController(), SpeedPiController()
    after_pause.acceleration_mps2(SPEED_MPS, SPEED_MPS - 0.4, 100.0)
    without_pause.acceleration_mps2(SPEED_MPS, SPEED_MPS - 0.4, 0.1)
    assert after_pause.acceleration_mps2(1.0, 1.0, 0.0) == without_pause.acceleration_mps2(1.0, 1.0, 0.0)


def test_slowing_down_is_gentle() -> None:
    """Speed control brakes gently, for any excess speed."""
    assert SpeedPiController().acceleration_mps2(0.0, 10.0, 1 / 30) == -GENTLE_BRAKING_MPS2


@pytest.mark.parametrize(
    ("acceleration_mps2", "expected"),
    [(1.0, (0.5, 0.0)), (5.0, (1.0, 0.0)), (-3.0, (0.0, 0.5)), (-9.0, (0.0, 1.0)), (0, (0, 0))],
)
def test_pedals(acceleration_mps2: float, expected: tuple[float, float]) -> None:
    """Throttle is the share of full acceleration, brake is the share of full braking, and one of the two is 0."""
    assert pedals(acceleration_mps2) == expected


@pytest.mark.parametrize(("confidence", "share"), [(1.0, 1.0), (0.5, 1.0), (0.3, 0.6), (0.0, 0.4)])
def test_lower_confidence_lowers_the_speed(confidence: float, share: float) -> None:
    """A confidence of 0.5 or more gives full speed; a lower one reduces it in proportion, to 0.4 of it at least."""
    assert speed_for_confidence_mps(10.0, confidence) == pytest.approx(10 * share)
