"""The detector and controller in a closed loop with the simulator's pictures, without codec and network."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest

from lavt.control.client_limits import CLIENT_LIMITS
from lavt.control.drive_controller import make_controller
from lavt.control.lane_watch import LaneState, LaneWatch
from lavt.control.preset import PRESETS
from lavt.domain import NS_PER_MS, NS_PER_S, Actuation, CameraModel, Picture
from lavt.perception.lane_detector import LaneDetector
from lavt.vehicle.sim.rendering.renderer import Renderer
from lavt.vehicle.sim.road.road import load_road
from lavt.vehicle.sim.simulator import Simulator

FRAME_NS = NS_PER_S // 30
MODEL = CameraModel()
ROAD = load_road("a_key")


@dataclass
class LaneKeepingDrive:
    """The cross-track errors, speeds and events of a drive, and the last state of the lane watch."""

    cross_track_m: list[float]
    speeds_mps: list[float]
    events: list[str]
    lane_state: LaneState


def unchanged(picture: Picture) -> Picture:
    return picture


def mirror(picture: Picture) -> Picture:
    return np.ascontiguousarray(picture[:, ::-1])


@pytest.fixture(scope="module")
def renderer() -> Renderer:
    return Renderer(ROAD, MODEL, seed=1, scenery="none")


def drive(
    renderer: Renderer,
    preset: str,
    *,
    delay_ns: int = 60 * NS_PER_MS,
    seconds: float = 28,
    change: Callable[[Picture], Picture] = unchanged,
    change_after_s: float = 1e9,
) -> LaneKeepingDrive:
    """Drive from standstill for at most `seconds`, with `change` applied to the pictures after `change_after_s`."""
    car = Simulator(road=ROAD, seed=1, start_mono_ns=0)
    detector, watch = LaneDetector(MODEL), LaneWatch()
    controller = make_controller("lane_keeper", PRESETS[preset], wheelbase_m=car.capabilities.wheelbase_m)
    result = LaneKeepingDrive([], [], [], "ok")
    for number in range(round(seconds * 30)):
        now_ns = number * FRAME_NS
        result.events += [event.kind for event in car.advance(now_ns)]
        if {"completed", "collision", "off_road"} & set(result.events):
            break
        truth = car.ground_truth()
        result.cross_track_m.append(truth.cross_track_m)
        result.speeds_mps.append(truth.speed_mps)
        picture = renderer.render(car.pose(), number)
        lane = detector.detect(picture if now_ns < change_after_s * NS_PER_S else change(picture))
        result.lane_state = watch.check(lane.confidence, now_ns)
        decision = controller.decide(lane, truth.speed_mps, now_ns)
        brake = decision.brake if result.lane_state == "ok" else CLIENT_LIMITS.brake  # as the driver node does
        car.apply(Actuation(decision.steering_rad, decision.throttle, brake), now_ns + delay_ns)
        if result.lane_state == "stop":
            break
    return result


@pytest.mark.full
@pytest.mark.parametrize("preset", ["designed", "paper_calibrated"])
def test_every_preset_drives_the_turn_at_60_ms(renderer: Renderer, preset: str) -> None:
    """Each preset completes the 90 degree turn and is within 0.2 m of the centre in 95 % of the frames."""
    result = drive(renderer, preset)
    assert result.events == ["completed"]
    assert np.percentile(np.abs(result.cross_track_m), 95) < 0.2
    assert max(result.speeds_mps) < 30 / 3.6 + 0.15


def test_grey_pictures_lead_to_a_stop(renderer: Renderer) -> None:
    """With grey pictures the car follows its last path, slows down, and the lane watch returns "stop"."""
    result = drive(renderer, "designed", change=lambda picture: np.full_like(picture, 128), change_after_s=8)
    assert result.lane_state == "stop"
    assert result.speeds_mps[-1] < result.speeds_mps[8 * 30] - 5
    assert abs(result.cross_track_m[-1]) < 0.6


def test_mirrored_pictures_lead_out_of_the_lane(renderer: Renderer) -> None:
    """With mirrored pictures the car leaves its lane, because only the pictures steer the car."""
    result = drive(
        renderer,
        "designed",
        seconds=16,
        change=mirror,
        change_after_s=0,
    )
    assert "lane_invasion" in result.events
    half_lane_width_m = 1.75
    assert np.max(np.abs(result.cross_track_m)) > half_lane_width_m
