"""Tests of the detector `onnx` with a tiny network, in which paint is whatever is brighter than 0.8."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from tests.perception.conftest import LANE, Scene
from tests.support.onnx_model import write_pixel_model

from lavt.assembly.detection.detectors import build_detector
from lavt.assembly.detection.onnx import build_network_paint
from lavt.domain import CameraModel, Now
from lavt.errors import UserError
from lavt.perception.calibration import calibrated_pinhole_camera
from lavt.perception.detection import DetectorSettings
from lavt.perception.network_paint import NetworkPaint

CAMERA = calibrated_pinhole_camera(CameraModel())
SIZE = (320, 240)
MEAN_OF_COLOURS = [1 / 3] * 3


def write_file(directory: Path, output: dict[str, Any] | None = None, **expected: Any) -> DetectorSettings:
    """Write a network and its file; return the settings of a detector that uses them."""
    write_pixel_model(directory / "bright.onnx", [[0.0] * 3, MEAN_OF_COLOURS], [0.8, 0.0], SIZE)
    file = directory / "bright.yaml"
    keys = {
        "model": "bright.onnx",
        "input": {"width_px": SIZE[0], "height_px": SIZE[1]} | expected,
        "output": {"name": "lanes"} if output is None else output,
    }
    file.write_text(yaml.safe_dump(keys))
    return DetectorSettings(file=str(file))


def paint_finder(settings: DetectorSettings) -> NetworkPaint:
    return build_network_paint(CAMERA, settings)


@pytest.mark.parametrize("resize", ["stretch", "letterbox"])
@pytest.mark.parametrize("shape", [(480, 640, 3), (360, 640, 3)])
def test_bright_pixels_are_found_where_they_are(tmp_path: Path, shape: tuple[int, int, int], resize: str) -> None:
    """The mask has the picture's size, with paint at the place of the bright pixels, with and without a letterbox."""
    picture = np.full(shape, 85, dtype=np.uint8)
    picture[200:240, 100:140] = 250
    mask = paint_finder(write_file(tmp_path, resize=resize)).find_paint(picture)
    assert mask.shape == shape[:2]
    rows, columns = np.nonzero(mask >= 128)
    assert (rows.min(), columns.min()) == pytest.approx((200, 100), abs=3)
    assert (rows.max(), columns.max()) == pytest.approx((239, 139), abs=3)
    assert np.count_nonzero(mask >= 128) > 0.8 * 40 * 40


def test_colours_are_normalized_in_their_order(tmp_path: Path) -> None:
    """The network gets (value x scale - mean) / deviation in the configured order of colours."""
    write_pixel_model(tmp_path / "red.onnx", [[0.0] * 3, [1.0, 0.0, 0.0]], [0.0, 0.0], SIZE)
    picture = np.zeros((240, 320, 3), dtype=np.uint8)
    picture[..., 2] = 130  # red; with scale 0.01, mean 1.25 and deviation 2 it is 0.025
    for channels, mean, is_paint in (("rgb", 1.25, True), ("rgb", 1.35, False), ("bgr", 1.25, False)):
        settings = write_file(
            tmp_path, channels=channels, scale=0.01, mean=[mean, 1.25, 1.25], deviation=[2.0, 1.0, 1.0]
        )
        file = Path(settings.file)
        file.write_text(file.read_text().replace("bright.onnx", "red.onnx"))
        assert (paint_finder(settings).find_paint(picture) == 255).all() == is_paint
    assert paint_finder(settings)._blob(picture, (0, 0, *SIZE))[0, :, 0, 0] == pytest.approx([-0.625, -1.25, 0.05])


def test_a_single_class_has_a_threshold(tmp_path: Path) -> None:
    """With one class, paint is where its value exceeds the threshold."""
    settings = write_file(tmp_path, {"name": "lanes", "classes": ["lane"], "threshold": 0.6})
    write_pixel_model(tmp_path / "bright.onnx", [MEAN_OF_COLOURS], [0.0], SIZE)
    picture = np.full((240, 320, 3), 140, dtype=np.uint8)  # 0.55
    picture[100:] = 170  # 0.67
    mask = paint_finder(settings).find_paint(picture)
    assert not mask[:98].any()
    assert mask[102:].all()


def test_the_lane_is_found_through_the_network(tmp_path: Path) -> None:
    """The network's paint gets LAVT's own search and fit."""
    detector = build_detector("onnx", CAMERA, write_file(tmp_path))
    picture = Scene(CameraModel()).render(LANE, offset_m=0.3)
    lane = detector.detect(picture)
    assert lane.centre[0] == pytest.approx(-0.3, abs=0.06)
    assert lane.width_m == pytest.approx(3.5, abs=0.06)
    assert lane.confidence > 0.6


@pytest.mark.parametrize(
    ("output", "reason"),
    [
        ({}, "has several outputs: set output.name to one of lanes, other"),
        ({"name": "paint"}, "has no output 'paint': set output.name to one of lanes, other"),
        ({"name": "other"}, "'other'.*has the shape .1, 3, 240, 320., but 2 classes need .1, 2, height, width."),
        ({"name": "lanes", "paint": ["kerb"]}, "'kerb', which is not a class: name at least one of"),
        ({"name": "lanes", "paint": []}, "paint is empty"),
    ],
)
def test_another_output_is_rejected(tmp_path: Path, output: dict[str, Any], reason: str) -> None:
    """An output that does not exist, or has other classes, is rejected before the first picture, with its remedy."""
    with pytest.raises(UserError, match=reason):
        paint_finder(write_file(tmp_path, output))


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (b"not a network" * 20, "OpenCV cannot read .*bright.onnx"),
        (None, ".*bright.onnx is not a file: correct the key model"),
    ],
)
def test_an_unreadable_network_is_rejected(tmp_path: Path, content: bytes | None, reason: str) -> None:
    """A missing file, and a file that is not ONNX, are user errors."""
    settings = write_file(tmp_path)
    model = tmp_path / "bright.onnx"
    model.unlink()
    if content is not None:
        model.write_bytes(content)
    with pytest.raises(UserError, match=reason):
        paint_finder(settings)


def test_the_detector_needs_its_file() -> None:
    """Without a file that describes the network, the message names the key and the option."""
    with pytest.raises(UserError, match=r"perception\.file, or --detector-file"):
        paint_finder(DetectorSettings())


@pytest.mark.parametrize(("picture_ms", "is_accepted"), [(30, True), (40, False)])
def test_a_rate_that_cannot_be_kept_is_refused(tmp_path: Path, picture_ms: int, *, is_accepted: bool) -> None:
    """At 30 Hz, 30 ms a picture are accepted and 40 ms are not; the message says both times and a rate to use."""
    times_ns = iter(range(0, 10**12, picture_ms * 1_000_000))

    def now() -> Now:
        return Now(next(times_ns), 0)

    settings = write_file(tmp_path)
    if is_accepted:
        build_detector("onnx", CAMERA, settings, rate_hz=30.0, now=now)
        return
    with pytest.raises(UserError, match=r"takes 40\.0 ms a picture .* 30 pictures a second leave 33\.3 ms.* to 25"):
        build_detector("onnx", CAMERA, settings, rate_hz=30.0, now=now)
