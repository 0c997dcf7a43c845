"""Exposure and sensor delay: capture times, the time of availability, and motion blur."""

from __future__ import annotations

from itertools import count, pairwise
from pathlib import Path

import numpy as np
import pytest
from tests.nodes.stand_ins import MONO_NS, at, deliver, payloads
from tests.vehicle.sim.rig import MODEL, PHASE_NS, camera_on, digest, picture_of, pose_at

from lavt.config import RunConfig
from lavt.config_file import load_config, shipped
from lavt.domain import NS_PER_MS, NS_PER_S, Picture, Pose
from lavt.experiment.runs.plan import plan_run
from lavt.experiment.runs.virtual_run import build_loop, drive, read_costs
from lavt.node import WAKE
from lavt.nodes.camera import CameraNode
from lavt.recording.record import read_record
from lavt.transport.rtp.fec import RepairSender
from lavt.transport.rtp.rtp import Packetizer
from lavt.transport.video.frame_codec import VideoSender
from lavt.transport.video.h264 import Encoder
from lavt.transport.video.path_validation import PathServer
from lavt.transport.video.stream_sender import StreamSender
from lavt.vehicle.sim.rendering.camera import SimCamera, interpolate_pose
from lavt.vehicle.sim.road.road import Road, load_road
from lavt.vehicle.sim.simulator import grid_ns

STEP_NS = NS_PER_S // 240


@pytest.fixture(scope="module")
def road() -> Road:
    return load_road("a_key")


def node_of(camera: SimCamera) -> CameraNode:
    numbers = count()
    encoder = Encoder(MODEL.width_px, MODEL.height_px, rate_hz=30, bit_rate_bps=2_000_000, gop_frames=100)
    path = PathServer(lambda: next(numbers).to_bytes(32, "big"))
    return CameraNode(
        camera, VideoSender(encoder), StreamSender(Packetizer(2, 0), RepairSender(3, 0)), path, start_ns=MONO_NS
    )


@pytest.mark.parametrize(("exposure_ns", "delay_ns"), [(0, 0), (10_000_000, 0), (8_333_333, 41_000_001), (0, 5_000)])
def test_a_frame_is_available_after_exposure_and_delay(road: Road, exposure_ns: int, delay_ns: int) -> None:
    """The node wakes after the exposure and the sensor delay; the capture time is the middle of the exposure."""
    camera = camera_on(road, scenery="none", exposure_ns=exposure_ns, sensor_delay_ns=delay_ns)
    node = node_of(camera)
    deliver(node, "pose", pose_at(road, 0.0, mono_ns=MONO_NS - 1), at(0))
    for number in range(3):
        exposure_begin_ns = MONO_NS + PHASE_NS + round(number * NS_PER_S / 30)
        assert node.next_wake_ns() == exposure_begin_ns + exposure_ns + delay_ns
        (frame,) = payloads(deliver(node, WAKE, None, at(node.next_wake_ns() - MONO_NS)), "frame")
        assert frame.capture_ns == exposure_begin_ns + exposure_ns // 2
        assert frame.stamped_mono_ns - frame.capture_ns == exposure_ns - exposure_ns // 2 + delay_ns


def capture_to_stamp_us(out: Path, *changes: str) -> list[int]:
    """Drive two virtual seconds and return the time from capture to stamp of every frame, in microseconds."""
    changes = ("vehicle.scenery=none", "record.video=false", "costs=constant", *changes)
    loop = build_loop(plan_run(load_config(RunConfig, shipped("configs/demo.yaml"), changes)), out)
    drive(loop, limit_ns=2 * NS_PER_S)
    frames = read_record(out / "server.mcap").table("frame")
    latency_ns = frames.ints("stamped_mono_ns") - frames.ints("capture_ns")
    return [round(value / 1000) for value in latency_ns.tolist()]


def test_time_from_capture_to_stamp_in_virtual_time(tmp_path: Path) -> None:
    """In a virtual run a frame is stamped half the exposure, the delay and the stages' costs after its capture."""
    (tmp_path / "run").mkdir()
    measured_us = capture_to_stamp_us(tmp_path / "run", "camera.exposure_ms=12.0", "camera.sensor_delay_ms=25.5")
    costs_us = read_costs().stages_us["camera"]
    half_exposure_us, delay_us = 6_000, 25_500
    expected_us = round(half_exposure_us + delay_us + costs_us["capture"] + costs_us["check"])
    assert len(measured_us) > 50
    assert {abs(latency_us - expected_us) for latency_us in measured_us} <= {0, 1}


def sharpness(picture: Picture) -> float:
    """Return the mean difference between rows in the lowest quarter of a picture, where the road moves fastest."""
    part = picture[-120:].astype(float).mean(axis=2)
    return float(np.abs(np.diff(part, axis=0)).mean())


def test_a_moving_car_has_motion_blur_and_a_stationary_one_has_none(road: Road) -> None:
    """At 30 km/h a longer exposure blurs the near road more; a stationary car's picture is not blurred."""
    moving = [pose_at(road, 8.33 * step / 240, mono_ns=grid_ns(step)) for step in range(10)]
    sharpness_by_exposure = []
    for exposure_ms in (0, 4, 16):
        camera = camera_on(road, scenery="none", exposure_ns=exposure_ms * NS_PER_MS)
        frame = camera.capture_after_exposure(3, grid_ns(3), moving)
        assert frame is not None
        sharpness_by_exposure.append(sharpness(frame.picture))
    assert all(longer < 0.85 * shorter for shorter, longer in pairwise(sharpness_by_exposure))
    stationary = [pose_at(road, 5.0, mono_ns=grid_ns(step)) for step in range(10)]
    frame = camera.capture_after_exposure(3, grid_ns(3), stationary)
    assert frame is not None
    assert digest(frame.picture) == digest(picture_of(camera_on(road, scenery="none"), stationary[0], 3))


def test_an_exposure_of_zero_shows_the_newest_pose(road: Road) -> None:
    """With an exposure of 0, a frame shows the newest pose that is not later than the frame's time."""
    poses = [pose_at(road, 0.1 * step, mono_ns=step * STEP_NS) for step in range(6)]
    camera = camera_on(road)
    frame = camera.capture_after_exposure(9, 3 * STEP_NS + 1, poses)
    assert frame is not None
    assert frame.capture_ns == 3 * STEP_NS + 1
    assert digest(frame.picture) == digest(picture_of(camera_on(road), poses[3], 9))
    assert camera.capture_after_exposure(9, -1, poses) is None


def test_poses_are_interpolated_and_extrapolated() -> None:
    """A pose is interpolated between two poses, extrapolated for 20 ms after them, and None before the first pose."""
    poses = [Pose(0, 0.0, 0.0, 3.1), Pose(4_000_000, 4.0, 2.0, -3.1)]
    assert interpolate_pose(poses, -1) is None
    assert interpolate_pose(poses[:1], 9) == poses[0]
    middle = interpolate_pose(poses, 2_000_000)
    assert middle is not None
    assert (middle.x_m, middle.y_m) == (2.0, 1.0)
    assert abs(middle.heading_rad) == pytest.approx(np.pi, abs=0.05)
    ahead = interpolate_pose(poses, 6_000_000)
    assert ahead is not None
    assert (ahead.x_m, ahead.y_m) == pytest.approx((6.0, 3.0))
    assert interpolate_pose(poses, 24_000_000) == interpolate_pose(poses, 900_000_000)
