from __future__ import annotations

import csv
import errno
import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from tests.perception.conftest import Line, Scene

from lavt.assembly.cameras import camera_of_file
from lavt.assembly.entropy import MachineEntropy
from lavt.assembly.nodes import build_client
from lavt.cli.main import build_app
from lavt.clock import MachineClock
from lavt.config import ClientConfig
from lavt.config_file import parse_config, shipped
from lavt.domain import CameraModel
from lavt.errors import UserError
from lavt.nodes.driver import DriverNode
from lavt.perception.calibration import calibrated_pinhole_camera
from lavt.perception.lane_detector import LaneDetector
from lavt.transport.video.video_file import write_video

CALIBRATION = """
width_px: 640
height_px: 480
fx_px: 330.0
fy_px: 331.0
cx_px: 321.0
cy_px: 238.0
distortion: [-0.28, 0.07, 0.0005, -0.0003, 0.0]
x_m: 1.6
z_m: 1.4
"""
CAMERA_MATRIX = "fx_px: 330.0\nfy_px: 331.0\ncx_px: 321.0\ncy_px: 238.0"
FISHEYE = "lens: fisheye\nwidth_px: 640\nheight_px: 480\nx_m: 1.6\nz_m: 1.4\n{}\n"
ROAD = np.full((480, 640, 3), 85, dtype=np.uint8)
Show = Callable[..., None]


@pytest.fixture
def show(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Show:
    """Return a function that runs `lavt perception show` in a directory with a calibration and a picture."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("OPENCV_FFMPEG_LOGLEVEL", "-8")  # the command sets it for its process
    Path("camera.yaml").write_text(CALIBRATION)
    cv2.imwrite("road.png", ROAD)

    def show_here(source: str, *options: str, camera: str = "camera.yaml") -> None:
        build_app()(["perception", "show", source, "--camera", camera, *options], standalone_mode=False)

    return show_here


def test_the_steps_of_a_picture_are_drawn(show: Show) -> None:
    """For a picture, the output is one picture with twelve labelled steps."""
    show("road.png")
    steps = cv2.imread("road-steps.png")
    assert steps is not None
    rows, columns, height_px, width_px = 3, 4, 518, 640
    assert steps.shape == (rows * height_px, columns * width_px, 3)
    assert steps[:38].max() > 200  # the labels


def test_the_size_of_the_steps_can_be_chosen(show: Show) -> None:
    """With `--tile-width-px 200` each step is 200 x 150 pixels, below its label."""
    show("road.png", "--tile-width-px", "200")
    steps = cv2.imread("road-steps.png")
    assert steps is not None
    assert steps.shape == (3 * (150 + 12), 4 * 200, 3)


def test_several_sources_give_a_drawing_and_a_row_for_each(show: Show, capsys: pytest.CaptureFixture[str]) -> None:
    """Of pictures, videos and directories, each file is drawn, and each picture has a row in the CSV file."""
    Path("more").mkdir()
    lane = Scene(CameraModel()).render()
    cv2.imwrite("more/road.png", lane)
    write_video(Path("more/drive.mp4"), [lane] * 3, 30.0)
    Path("more/notes.txt").touch()
    show("road.png", "more", "--csv", "rows.csv", camera=str(shipped("configs/demo.yaml")))
    drawn = {file.name for file in Path("perception-steps").iterdir()}
    assert drawn == {"road-steps.png", "road-2-steps.png", "drive-steps.mp4"}
    with Path("rows.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert [(row["source"], row["picture"]) for row in rows] == [
        ("road.png", "0"), *(("more/drive.mp4", str(number)) for number in range(3)), ("more/road.png", "0")
    ]  # fmt: skip
    empty, first, second, _, picture = rows
    assert (empty["followed"], empty["centre_m"], empty["confidence"]) == ("false", "", "0.0")
    assert (first["searched"], second["searched"], picture["searched"]) == ("true", "false", "true")
    assert abs(float(picture["centre_m"])) < 0.05
    assert float(picture["width_m"]) == pytest.approx(3.5, abs=0.05)
    printed = capsys.readouterr().out
    assert "drive.mp4: 3 pictures, 3 with a lane (100 %)" in printed
    assert "road.png: confidence 0.00, no lane" in printed


def test_an_unusable_file_loses_no_row(show: Show, capsys: pytest.CaptureFixture[str]) -> None:
    """If a later file cannot be used, the sentences and rows of the earlier ones are kept."""
    Path("more").mkdir()
    cv2.imwrite("more/a.png", ROAD)
    cv2.imwrite("more/b.png", ROAD[::2, ::2])
    with pytest.raises(UserError, match=r"b\.png is 320 x 240"):
        show("more", "--no-draw", "--csv", "rows.csv")
    assert "a.png: confidence 0.00, no lane" in capsys.readouterr().out
    assert Path("rows.csv").read_text().count("a.png,0,0.0,false") == 1


def test_the_rows_are_printed_as_json(show: Show, capsys: pytest.CaptureFixture[str]) -> None:
    """With `--json`, the only output is a list of one object for each picture; `--no-draw` draws nothing."""
    show("road.png", "road.png", "--json", "--no-draw")
    rows = json.loads(capsys.readouterr().out)
    assert [row["source"] for row in rows] == ["road.png"] * 2
    assert all(row["confidence"] == 0 and row["followed"] is False and row["width_m"] is None for row in rows)
    assert {path.name for path in Path().iterdir()} == {"camera.yaml", "road.png"}


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs a disk that is always full: /dev/full")
def test_a_full_disk_is_named_with_the_table(show: Show) -> None:
    """If the disk of the CSV file is full, the error names this file."""
    with pytest.raises(OSError, match="/dev/full") as raised:
        show("road.png", "--no-draw", "--csv", "/dev/full")
    assert raised.value.errno == errno.ENOSPC


@pytest.mark.parametrize(("lane_confidence", "followed"), [("0.9", True), ("0.95", False)])
def test_the_threshold_of_a_followed_lane_can_be_chosen(
    show: Show, capsys: pytest.CaptureFixture[str], lane_confidence: str, *, followed: bool
) -> None:
    """A lane counts as followed from the confidence `--lane-confidence` on."""
    cv2.imwrite("lane.png", Scene(CameraModel()).render((Line(1.75), Line(-1.75, dash_m=3.0))))
    demo = str(shipped("configs/demo.yaml"))
    show("lane.png", "--json", "--no-draw", "--lane-confidence", lane_confidence, camera=demo)
    (row,) = json.loads(capsys.readouterr().out)
    assert row["followed"] is followed, row["confidence"]


@pytest.mark.parametrize("name", ["demo.yaml", "client.yaml", "sweep.yaml"])
def test_a_config_is_a_calibration(show: Show, name: str) -> None:
    """The camera of a config file, even with default values, can be used as a calibration."""
    show("road.png", "--out", "steps.jpg", camera=str(shipped(f"configs/{name}")))
    assert Path("steps.jpg").is_file()
    assert camera_of_file(shipped(f"configs/{name}")) == calibrated_pinhole_camera(CameraModel())


def test_the_steps_of_a_video_are_a_video(show: Show) -> None:
    """For a video, the output is a video with the same number of pictures."""
    write_video(Path("road.mp4"), [ROAD] * 3, 30.0)
    show("road.mp4", "--out", "steps.mp4")
    video = cv2.VideoCapture("steps.mp4")
    assert int(video.get(cv2.CAP_PROP_FRAME_COUNT)) == 3


@pytest.mark.parametrize(
    ("source", "calibration", "options", "reason"),
    [
        ("nothing.png", CALIBRATION, (), "nothing.png"),
        ("empty_directory", CALIBRATION, (), "has no picture, video or record"),
        (".", CALIBRATION, ("--out", "road.png"), "road.png is a file"),
        ("road.png", CALIBRATION, ("--csv", "nowhere/rows.csv"), "nowhere is not a directory"),
        ("road.png", CALIBRATION, ("--detector", "eyes"), "there is no detector 'eyes'; choose one of"),
        ("camera.yaml", CALIBRATION, (), "camera.yaml"),
        ("empty.mp4", CALIBRATION, (), "empty.mp4"),
        ("record.mcap", CALIBRATION, (), "has no picture"),
        ("small.png", CALIBRATION, (), "320 x 240"),
        ("road.png", CALIBRATION + "fx: 3.0\n", (), "did you mean 'fx_px'"),
        ("road.png", CALIBRATION + "pich_deg: 3.0\n", (), "did you mean 'pitch_deg'"),
        ("road.png", CALIBRATION + "pitch_deg: -50.0\n", (), "does not see the road"),
        ("road.png", CALIBRATION + "yaw_deg: 90.0\n", (), "does not see the road"),
        ("road.png", CALIBRATION + "field_of_view_deg: 90.0\n", (), "field_of_view_deg"),
        ("road.png", CALIBRATION.replace("fy_px: 331.0\n", ""), (), "field_of_view_deg"),
        ("road.png", CALIBRATION + "lens: fisheye\n", (), "must have 4 coefficients"),
        ("road.png", FISHEYE.format("field_of_view_deg: 90.0\ndistortion: [0, 0, 0, 0]"), (), "a fisheye needs fx_px"),
        ("road.png", FISHEYE.format(CAMERA_MATRIX), (), "distortion"),
        ("road.png", CALIBRATION.replace("0.0005", "5e-04"), (), "write 0.0005"),
        ("road.png", CALIBRATION, ("--out", "./road.png"), "road.png"),
        ("road.png", CALIBRATION.replace("x_m: 1.6\n", ""), (), "'x_m' is missing"),
        ("road.png", "camera: 3\n", (), "camera"),
        ("road.png", CALIBRATION, ("--out", "steps.txt"), ".png"),
        ("road.png", CALIBRATION, ("--out", "nowhere/steps.png"), "nowhere"),
    ],
)
def test_bad_input(show: Show, source: str, calibration: str, options: tuple[str, ...], reason: str) -> None:
    """Unusable sources, calibrations and outputs are rejected with the reason, and nothing is written."""
    Path("camera.yaml").write_text(calibration)
    Path("empty.mp4").touch()
    Path("empty_directory").mkdir()
    Path("record.mcap").touch()
    cv2.imwrite("small.png", ROAD[::2, ::2])
    with pytest.raises(UserError) as raised:
        show(source, *options)
    assert reason in str(raised.value)
    assert "Value error" not in str(raised.value)
    assert not list(Path().glob("*steps*"))
    source_picture = cv2.imread("road.png")
    assert source_picture is not None
    assert np.array_equal(source_picture, ROAD)


def test_a_client_uses_a_calibrated_camera(show: Show) -> None:  # noqa: ARG001 (changes the directory)
    """The client uses the calibration file that `camera.calibration` names."""
    config = parse_config(ClientConfig, {"camera": {"calibration": "camera.yaml"}}, "test")
    nodes = build_client(config, MachineClock().now, MachineEntropy())
    assert isinstance(nodes.driver, DriverNode)
    detector = nodes.driver._detector
    assert isinstance(detector, LaneDetector)
    expected = LaneDetector(camera_of_file(Path("camera.yaml")))
    assert np.array_equal(detector.bird_eye.region_from_grid[0], expected.bird_eye.region_from_grid[0])
    assert not np.array_equal(
        detector.bird_eye.region_from_grid[0], LaneDetector(CameraModel()).bird_eye.region_from_grid[0]
    )


@pytest.mark.parametrize(
    ("camera", "reason"),
    [
        ({"calibration": "camera.yaml", "pitch_deg": 3.0}, "leave out camera.pitch_deg"),
        ({"calibration": "camera.yaml", "width_px": 320}, "camera.width_px is 320"),
        ({"calibration": "none.yaml"}, "none.yaml"),
    ],
)
def test_a_contradicted_calibration_is_rejected(show: Show, camera: dict[str, object], reason: str) -> None:  # noqa: ARG001
    """Config values that contradict the calibration file are rejected."""
    with pytest.raises(UserError, match=reason):
        build_client(parse_config(ClientConfig, {"camera": camera}, "test"), MachineClock().now, MachineEntropy())
