"""What every `Camera` keeps."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from tests.nodes.stand_ins import NoiseCamera

from lavt.domain import NS_PER_S, CameraModel, Pose
from lavt.vehicle.camera import Camera
from lavt.vehicle.sim.camera import SimCamera
from lavt.vehicle.sim.road import load_road

ROAD = load_road("a_key")
X_M, Y_M, HEADING_RAD = ROAD.start
POSE = Pose(0, X_M, Y_M, HEADING_RAD)
MODEL = CameraModel(320, 240)
CAMERAS: dict[str, Callable[[], Camera]] = {
    "simulated": lambda: SimCamera(model=MODEL, rate_hz=30.0, phase_ns=3, road=ROAD, seed=1, scenery="none"),
    "stand-in of the node tests": lambda: NoiseCamera(MODEL),
}
each_camera = pytest.mark.parametrize("name", sorted(CAMERAS))


@each_camera
def test_the_same_inputs_give_the_same_bytes(name: str) -> None:
    """Two cameras made alike give equal pictures for equal number, time and pose, in buffers of their own."""
    one, other = CAMERAS[name](), CAMERAS[name]()
    other.capture(1, 5, POSE)
    first, second, again = one.capture(7, 9, POSE), other.capture(7, 9, POSE), one.capture(7, 9, POSE)
    assert first is not None
    assert second is not None
    assert again is not None
    assert first.picture.tobytes() == second.picture.tobytes() == again.picture.tobytes()
    assert not np.shares_memory(first.picture, again.picture)


@each_camera
def test_pictures_are_of_the_models_size(name: str) -> None:
    """A picture is (height, width, 3) of bytes and may be written into; the frame carries its number and time."""
    camera = CAMERAS[name]()
    frame = camera.capture(4, 99, POSE)
    assert frame is not None
    assert frame.picture.shape == (camera.model.height_px, camera.model.width_px, 3)
    assert frame.picture.dtype == np.uint8
    assert frame.picture.flags.writeable
    assert (frame.number, frame.capture_ns) == (4, 99)


@each_camera
def test_its_first_frame_comes_within_one_period(name: str) -> None:
    """The phase lies in one period of its rate."""
    camera = CAMERAS[name]()
    assert 0 <= camera.phase_ns < NS_PER_S / camera.rate_hz


@each_camera
def test_pictures_that_follow_each_other_differ(name: str) -> None:
    """Two frames of a standing vehicle are not equal: a live camera is not taken for a frozen one."""
    camera = CAMERAS[name]()
    first, second = camera.capture(1, 0, POSE), camera.capture(2, 33, POSE)
    assert first is not None
    assert second is not None
    assert not np.array_equal(first.picture[64:], second.picture[64:])
