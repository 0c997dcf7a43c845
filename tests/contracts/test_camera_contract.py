"""The contract of every `Camera`."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from tests.nodes.stand_ins import NoiseCamera
from tests.vehicle.moving_video import MODEL as MODEL_OF_THE_VIDEO
from tests.vehicle.moving_video import write_video

from lavt.clock import MachineClock
from lavt.domain import NS_PER_S, CameraModel, Pose
from lavt.vehicle.camera import Camera, CapturedFrame
from lavt.vehicle.sim.rendering.camera import SimCamera
from lavt.vehicle.sim.road.road import load_road
from lavt.vehicle.video_device import VideoDevice

ROAD = load_road("a_key")
X_M, Y_M, HEADING_RAD = ROAD.start
POSE = Pose(0, X_M, Y_M, HEADING_RAD)
MODEL = CameraModel(320, 240)
TIMEOUT_S = 20.0
RENDERING_CAMERAS: dict[str, Callable[[], Camera]] = {
    "simulated": lambda: SimCamera(model=MODEL, rate_hz=30.0, phase_ns=3, road=ROAD, seed=1, scenery="none"),
    "stand-in of the node tests": lambda: NoiseCamera(MODEL),
}
"""Cameras that render a picture for any frame number, time and pose."""
each_camera = pytest.mark.parametrize("name", [*sorted(RENDERING_CAMERAS), "device"])


@pytest.fixture
def camera(name: str, tmp_path: Path) -> Iterator[Camera]:
    if name in RENDERING_CAMERAS:
        yield RENDERING_CAMERAS[name]()
        return
    path = write_video(tmp_path / "video.avi", rate_hz=30.0)
    device = VideoDevice(str(path), model=MODEL_OF_THE_VIDEO, rate_hz=30.0, clock=MachineClock())
    yield device
    device.close()


def capture(camera: Camera, number: int, at_ns: int) -> CapturedFrame:
    """Wait until the camera has a frame, and return it."""
    assert not isinstance(camera, VideoDevice) or camera.wait(TIMEOUT_S)
    frame = camera.capture(number, at_ns, POSE)
    assert frame is not None
    return frame


@pytest.mark.parametrize("name", sorted(RENDERING_CAMERAS))
def test_rendered_pictures_are_byte_for_byte_reproducible(name: str) -> None:
    """Two equal rendering cameras return equal pictures for equal inputs; no two pictures share a buffer."""
    camera, other_camera = RENDERING_CAMERAS[name](), RENDERING_CAMERAS[name]()
    other_camera.capture(1, 5, POSE)
    first, other, repeated = capture(camera, 7, 9), capture(other_camera, 7, 9), capture(camera, 7, 9)
    assert first.picture.tobytes() == other.picture.tobytes() == repeated.picture.tobytes()
    assert not np.shares_memory(first.picture, repeated.picture)


@each_camera
def test_pictures_have_the_models_size(camera: Camera) -> None:
    """A picture is a writable array of bytes of shape (height, width, 3)."""
    frame = capture(camera, 4, 99)
    assert frame.picture.shape == (camera.model.height_px, camera.model.width_px, 3)
    assert frame.picture.dtype == np.uint8
    assert frame.picture.flags.writeable


@each_camera
def test_a_frame_carries_its_number_and_its_capture_time_if_known(camera: Camera, name: str) -> None:
    """A frame has the requested number; only a rendered frame has the requested capture time, others have none."""
    frame = capture(camera, 4, 99)
    assert (frame.number, frame.capture_ns) == (4, 99 if name in RENDERING_CAMERAS else None)


@each_camera
def test_the_first_frame_comes_within_one_period(camera: Camera) -> None:
    """The phase is less than one frame period."""
    assert 0 <= camera.phase_ns < NS_PER_S / camera.rate_hz


@each_camera
def test_consecutive_pictures_differ(camera: Camera) -> None:
    """Two frames of a stationary vehicle differ, so a live camera is not taken for a frozen one."""
    first, second = capture(camera, 1, 0), capture(camera, 2, 33)
    assert not np.array_equal(first.picture[64:], second.picture[64:])
    assert not np.shares_memory(first.picture, second.picture)
