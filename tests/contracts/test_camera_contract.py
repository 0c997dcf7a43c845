"""What every `Camera` keeps."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from tests.nodes.stand_ins import NoiseCamera
from tests.vehicle.moving_video import MODEL as MOVING
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
LONG_S = 20.0
DRAWN: dict[str, Callable[[], Camera]] = {
    "simulated": lambda: SimCamera(model=MODEL, rate_hz=30.0, phase_ns=3, road=ROAD, seed=1, scenery="none"),
    "stand-in of the node tests": lambda: NoiseCamera(MODEL),
}
"""Those that make a picture of what they are told."""
each_camera = pytest.mark.parametrize("name", [*sorted(DRAWN), "device"])


@pytest.fixture
def camera(name: str, tmp_path: Path) -> Iterator[Camera]:
    if name in DRAWN:
        yield DRAWN[name]()
        return
    path = write_video(tmp_path / "video.avi", rate_hz=30.0)
    device = VideoDevice(str(path), model=MOVING, rate_hz=30.0, clock=MachineClock())
    yield device
    device.close()


def taken(camera: Camera, number: int, at_ns: int) -> CapturedFrame:
    """Give a frame, when there is one."""
    assert not isinstance(camera, VideoDevice) or camera.wait(LONG_S)
    frame = camera.capture(number, at_ns, POSE)
    assert frame is not None
    return frame


@pytest.mark.parametrize("name", sorted(DRAWN))
def test_the_same_inputs_give_the_same_bytes(name: str) -> None:
    """Two cameras made alike that draw give equal pictures for equal number, time and pose, in buffers of their own."""
    one, other = DRAWN[name](), DRAWN[name]()
    other.capture(1, 5, POSE)
    first, second, again = taken(one, 7, 9), taken(other, 7, 9), taken(one, 7, 9)
    assert first.picture.tobytes() == second.picture.tobytes() == again.picture.tobytes()
    assert not np.shares_memory(first.picture, again.picture)


@each_camera
def test_pictures_are_of_the_models_size(camera: Camera) -> None:
    """A picture is (height, width, 3) of bytes and may be written into."""
    frame = taken(camera, 4, 99)
    assert frame.picture.shape == (camera.model.height_px, camera.model.width_px, 3)
    assert frame.picture.dtype == np.uint8
    assert frame.picture.flags.writeable


@each_camera
def test_a_frame_carries_its_number_and_its_time_if_known(camera: Camera, name: str) -> None:
    """A frame has the number that it was asked by; one that is drawn is of the time asked for, a file's is of none."""
    frame = taken(camera, 4, 99)
    assert (frame.number, frame.capture_ns) == (4, 99 if name in DRAWN else None)


@each_camera
def test_its_first_frame_comes_within_one_period(camera: Camera) -> None:
    """The phase lies in one period of its rate."""
    assert 0 <= camera.phase_ns < NS_PER_S / camera.rate_hz


@each_camera
def test_pictures_that_follow_each_other_differ(camera: Camera) -> None:
    """Two frames of a standing vehicle are not equal: a live camera is not taken for a frozen one."""
    first, second = taken(camera, 1, 0), taken(camera, 2, 33)
    assert not np.array_equal(first.picture[64:], second.picture[64:])
    assert not np.shares_memory(first.picture, second.picture)
