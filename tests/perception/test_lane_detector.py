from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from tests.perception.conftest import (
    BROKEN_LANE,
    FOUR_LANES,
    LANE,
    MARK_WIDTH_M,
    ROAD_GREY,
    Line,
    Scene,
    centre_y_m,
    on_road,
)
from tests.perception.lens import ground_points

from lavt.domain import CameraModel, Lane, Picture, SeenLane
from lavt.perception.bird_eye import STAMP_SIDE_PX
from lavt.perception.calibration import CalibratedCamera, calibrated_pinhole_camera
from lavt.perception.detection import TRACK_CONFIDENCE
from lavt.perception.lane_detector import (
    FORGET_AFTER_PICTURES,
    SMOOTHING,
    GroundTruthLaneDetector,
    LaneDetector,
)

MODEL = CameraModel()
GREY = np.full((480, 640, 3), 128, dtype=np.uint8)


def centre_at(lane: Lane, x_m: float) -> float:
    return lane.centre[0] + lane.centre[1] * x_m + lane.centre[2] * x_m**2


def detect(picture: Picture) -> Lane:
    return LaneDetector(MODEL).detect(picture)


@pytest.mark.parametrize("curvature_per_m", [0.0, 1 / 87, -1 / 87, 1 / 42, -1 / 42])
@pytest.mark.parametrize("lines", [LANE, BROKEN_LANE, FOUR_LANES], ids=["solid", "broken", "four lanes"])
def test_the_centre_is_found_on_every_curve(scene: Scene, lines: tuple[Line, ...], curvature_per_m: float) -> None:
    """From one picture, the centre between 4 and 18 m ahead is found within 5 cm, down to a radius of 42 m."""
    lane = detect(scene.render(lines, curvature_per_m))
    for x_m in (4.0, 8.0, 12.0, 18.0):
        assert centre_at(lane, x_m) == pytest.approx(centre_y_m(x_m, curvature_per_m), abs=0.05)
    assert lane.confidence > 0.8


@pytest.mark.parametrize(
    ("offset_m", "heading_rad"), [(0.25, 0.026), (-0.25, -0.026), (0.8, 0.0), (-0.8, 0.1), (0.0, 0.2)]
)
def test_the_lane_is_in_the_vehicles_frame(scene: Scene, offset_m: float, heading_rad: float) -> None:
    """For a car left of the centre and turned left, the centre is on the right and leads to the right."""
    lane = detect(scene.render(FOUR_LANES, offset_m=offset_m, heading_rad=heading_rad))
    for x_m in (5.0, 9.0):
        assert centre_at(lane, x_m) == pytest.approx(
            -offset_m / np.cos(heading_rad) - x_m * np.tan(heading_rad), abs=0.05
        )
    assert lane.width_m == pytest.approx(3.5, abs=0.06)


def test_a_mirrored_picture_has_the_mirrored_lane(scene: Scene) -> None:
    """The lane in a mirrored picture is the mirrored lane."""
    picture = scene.render(BROKEN_LANE, 1 / 42, offset_m=0.2)
    lane, mirrored = detect(picture), detect(np.ascontiguousarray(picture[:, ::-1]))
    assert mirrored.centre == pytest.approx([-value for value in lane.centre], abs=0.01)


@pytest.mark.parametrize("phase_m", np.arange(0.0, 9.0, 1.5))
def test_a_lane_with_aligned_gaps_is_found(scene: Scene, phase_m: float) -> None:
    """A lane whose two broken lines have their gaps side by side is found, wherever the dashes are."""
    lines = [Line(side * 1.75, dash_m=3.0, phase_m=phase_m) for side in (1, -1)]
    lane = detect(scene.render(lines, 1 / 87))
    assert centre_at(lane, 8.0) == pytest.approx(centre_y_m(8.0, 1 / 87), abs=0.1)
    assert lane.confidence > 0.5


@pytest.mark.parametrize("light", [0.45, 1.1])
def test_the_lane_does_not_depend_on_the_light(scene: Scene, light: float) -> None:
    """In darker or brighter light the lane is the same and the confidence remains high."""
    picture = scene.render(FOUR_LANES, 1 / 87)
    original, relit = detect(picture), detect((picture * light).astype(np.uint8))
    assert relit.centre == pytest.approx(original.centre, abs=0.02)
    assert relit.confidence > 0.8


def test_a_yellow_line_is_a_line(scene: Scene) -> None:
    """A lane between a yellow and a white line is found."""
    yellow = (60, 170, 200)
    assert detect(scene.render((Line(1.75, yellow), Line(-1.75)))).confidence > 0.9


def test_an_empty_picture_has_no_confidence(scene: Scene) -> None:
    """Empty pictures have confidence 0 and keep the last lane, but a lane found after many of them is not averaged."""
    detector = LaneDetector(MODEL)
    assert detector.detect(GREY).confidence == 0
    last_lane = detector.detect(scene.render(LANE, 1 / 87))
    for _ in range(FORGET_AFTER_PICTURES + 2):
        empty = detector.detect(GREY)
        assert empty.confidence == 0
        assert empty.centre == last_lane.centre
    assert detector.detect(scene.render(LANE, -1 / 42)).centre == detect(scene.render(LANE, -1 / 42)).centre


def test_noise_is_not_a_lane() -> None:
    """Black and white noise has too little confidence for driving."""
    noise = np.random.Generator(np.random.Philox(5)).integers(0, 2, (120, 160, 1)).astype(np.uint8) * 255
    assert detect(noise.repeat(4, 0).repeat(4, 1).repeat(3, 2)).confidence < TRACK_CONFIDENCE


def test_lanes_are_averaged_after_the_first(scene: Scene) -> None:
    """The average starts with the first lane, and each newer lane has the weight `SMOOTHING`."""
    detector = LaneDetector(MODEL)
    first_picture, second_picture = scene.render(), scene.render(offset_m=0.3)
    first, second = detector.detect(first_picture), detector.detect(second_picture)
    assert first.centre == detect(first_picture).centre
    assert second.centre[0] == pytest.approx((1 - SMOOTHING) * first.centre[0] + SMOOTHING * -0.3, abs=0.01)


def test_the_lane_is_kept_while_the_car_leaves_it(scene: Scene) -> None:
    """While a car drifts into the next lane, the detector keeps tracking the lane from which the car came."""
    detector = LaneDetector(MODEL)
    for offset_m in np.arange(0.0, 3.01, 0.3):
        lane = detector.detect(scene.render(FOUR_LANES, offset_m=float(offset_m)))
    assert centre_at(lane, 8.0) == pytest.approx(-3.0, abs=0.3)  # the average lags by 0.2 m


@pytest.mark.parametrize(
    ("shift_m", "heading_rad", "is_tracked"),
    [(0.3, 0.0, True), (-0.3, 0.0, True), (0.0, 0.04, True), (0.6, 0.0, False), (-0.6, 0.0, False), (0.0, 0.08, False)],
)
def test_a_single_line_elsewhere_is_another_line(
    scene: Scene, shift_m: float, heading_rad: float, *, is_tracked: bool
) -> None:
    """If one line vanishes at once and the other one is elsewhere, as a kerb would be, there is no lane any more."""
    detector = LaneDetector(MODEL)
    before = detector.detect(scene.render(LANE))
    picture = scene.render((Line(-1.75 + shift_m),), heading_rad=heading_rad)
    lane = detector.detect(picture)
    assert (lane.confidence > 0.4) == is_tracked
    assert (lane.confidence == 0.0) == (not is_tracked)
    assert (lane.centre == before.centre) == (not is_tracked)
    assert (detector.detect(picture).confidence > 0.4) == is_tracked


def test_a_line_that_was_alone_before_may_move(scene: Scene) -> None:
    """A single line that is tracked for longer is tracked over a jump of 0.6 m, as after lost pictures."""
    detector = LaneDetector(MODEL)
    for lines in (LANE, LANE[1:], (Line(-2.35),)):
        lane = detector.detect(scene.render(lines))
    assert lane.confidence > 0.4


def test_two_lines_may_jump(scene: Scene) -> None:
    """A lane of which both lines are seen is tracked over a jump of 0.6 m, as after lost pictures."""
    detector = LaneDetector(MODEL)
    detector.detect(scene.render(LANE))
    assert detector.detect(scene.render(LANE, offset_m=0.6)).confidence > 0.8


@pytest.mark.parametrize("direction", [1, -1])
def test_a_lane_is_dropped_one_width_away(scene: Scene, direction: int) -> None:
    """When a car reaches the middle of the next lane, the detector changes to that lane."""
    detector = LaneDetector(MODEL)
    centres_m = [
        detector.detect(scene.render(FOUR_LANES, offset_m=float(offset_m))).centre[0]
        for offset_m in np.arange(0.0, direction * 4.2, direction * 0.1)
    ]
    offsets = np.arange(0.0, 4.2, 0.1)
    in_old_lane, in_new_lane = (np.array(centres_m)[selected] for selected in (offsets < 3.2, offsets > 4.0))
    assert np.abs(in_old_lane + direction * offsets[offsets < 3.2]).max() < 0.2
    assert np.abs(in_new_lane + direction * (offsets[offsets > 4.0] - 3.5)).max() < 0.2


@pytest.mark.parametrize(
    "offset_m",
    [-3.0, -2.5, -1.0, -0.5, 0.0, 0.5, 1.0, 2.5, 3.0],  # not on a line, where either lane would be right
)
@pytest.mark.parametrize("curvature_per_m", [0.0, 1 / 42])
def test_after_forget_the_cars_lane_is_found(scene: Scene, offset_m: float, curvature_per_m: float) -> None:
    """After `forget`, the detector finds the lane in which the car is now."""
    six_lanes = (*FOUR_LANES, Line(-8.75, dash_m=3.0))
    detector = LaneDetector(MODEL)
    detector.detect(scene.render(six_lanes))
    detector.forget()
    lane = detector.detect(scene.render(six_lanes, curvature_per_m, offset_m=float(offset_m)))
    expected_m = -float(np.remainder(offset_m + 1.75, 3.5) - 1.75)
    assert centre_at(lane, 5.0) == pytest.approx(expected_m + centre_y_m(5.0, curvature_per_m), abs=0.15)


def test_the_trace_contains_windows_only_for_a_search(scene: Scene) -> None:
    """The trace of a search contains windows; the trace of a tracked picture contains none."""
    detector = LaneDetector(MODEL)
    detector.detect(scene.render())
    assert detector.trace is not None
    assert detector.trace.windows
    detector.detect(scene.render())
    assert not detector.trace.windows
    assert detector.trace.fit is not None
    assert detector.trace.mask.shape == (164, 280)


@pytest.mark.parametrize(
    "lens",
    [
        {"distortion": (-0.25, 0.06, 0.0, 0.0, 0.0)},
        {"distortion": (0.02, -0.01, 0.0, 0.0), "fisheye": True},
        {"roll_rad": 0.06, "yaw_rad": -0.08, "y_m": 0.4, "pitch_rad": 0.08},
    ],
    ids=["barrel", "fisheye", "askew"],
)
def test_the_lane_is_found_through_any_lens(lens: dict[str, Any]) -> None:
    """With a distorting lens or a tilted camera the centre is found within 10 cm."""
    camera = replace(calibrated_pinhole_camera(CameraModel(320, 240)), **lens)
    picture = picture_through_lens(camera, 1 / 87, 0.4)
    lane = LaneDetector(camera, stamped=False).detect(picture)
    assert lane.confidence > 0.7
    for x_m in (5.0, 10.0, 15.0):
        assert centre_at(lane, x_m) == pytest.approx(centre_y_m(x_m, 1 / 87) - 0.4, abs=0.1)


def picture_through_lens(camera: CalibratedCamera, curvature_per_m: float, offset_m: float) -> Picture:
    """Return the picture of a road of four lanes, computed for each pixel of a calibrated camera."""
    columns, rows = np.meshgrid(np.arange(camera.width_px), np.arange(camera.height_px))
    ground = ground_points(camera, np.stack([columns, rows], axis=-1).reshape(-1, 2).astype(np.float64))
    is_visible = np.isfinite(ground).all(axis=1) & (np.hypot(*np.nan_to_num(ground).T) < 60)
    x_m, y_m = np.where(is_visible[:, None], ground, 0.0).T
    along, across = on_road(x_m, y_m, curvature_per_m, offset_m, 0.0)
    shades = np.full((len(ground), 3), ROAD_GREY, dtype=np.uint8)
    for line in FOUR_LANES:
        is_painted = np.abs(across - line.offset_m) < MARK_WIDTH_M / 2
        is_painted &= np.mod(along - line.phase_m, 9.0) < line.dash_m
        shades[is_visible & is_painted] = line.colour_bgr
    return shades.reshape(camera.height_px, camera.width_px, 3)


def test_the_stamp_does_not_affect_the_lane(scene: Scene) -> None:
    """The lane does not depend on the content of the top left corner."""
    picture = scene.render(FOUR_LANES)
    stamped = picture.copy()
    stamped[:STAMP_SIDE_PX, :STAMP_SIDE_PX] = np.kron(np.indices((8, 8)).sum(0) % 2, np.ones((8, 8)))[..., None] * 255
    assert detect(stamped) == detect(picture)


def test_a_picture_of_another_size_is_an_error() -> None:
    """A picture of another size than the camera's raises `ValueError`."""
    with pytest.raises(ValueError, match="480, 640, 3"):
        detect(np.zeros((240, 320, 3), dtype=np.uint8))


def test_a_small_camera_finds_the_lane() -> None:
    """At 320 x 240 pixels the centre is found within 10 cm."""
    model = CameraModel(320, 240)
    lane = LaneDetector(model).detect(Scene(model).render(FOUR_LANES, 1 / 87))
    assert centre_at(lane, 8.0) == pytest.approx(centre_y_m(8.0, 1 / 87), abs=0.1)


def test_forget_makes_the_detector_take_the_nearest_lane(scene: Scene) -> None:
    """After a car has slid into the next lane, the detector tracks the old lane until `forget` is called."""
    detector = LaneDetector(MODEL)
    for offset_m in np.arange(0.0, 3.51, 0.25):
        lane = detector.detect(scene.render(FOUR_LANES, offset_m=float(offset_m)))
    assert lane.centre[0] == pytest.approx(-3.5, abs=0.3)
    detector.forget()
    assert detector.detect(scene.render(FOUR_LANES, offset_m=3.5)).centre[0] == pytest.approx(0.0, abs=0.1)


def true_lane(offset_m: float, confidence: float = 1.0) -> SeenLane:
    return SeenLane(1, 2, Lane((offset_m, 0.0, 0.0), 3.5, 3.6, 20.0, confidence))


def test_true_lanes_are_averaged_as_by_the_lane_detector() -> None:
    """The average starts with the first lane, and each newer lane has the weight `SMOOTHING`."""
    detector = GroundTruthLaneDetector()
    assert detector.detect(true_lane(1.0)).centre[0] == 1.0
    assert detector.detect(true_lane(2.0)).centre[0] == pytest.approx(1.0 + SMOOTHING)


def test_the_last_lane_is_kept_with_low_confidence() -> None:
    """A lane of low confidence changes only the confidence; after several, or after `forget`, the average restarts."""
    detector = GroundTruthLaneDetector()
    detector.detect(true_lane(1.0))
    lost = [detector.detect(true_lane(5.0, confidence=0.1)) for _ in range(FORGET_AFTER_PICTURES)]
    assert [(lane.centre[0], lane.confidence) for lane in lost] == [(1.0, 0.1)] * FORGET_AFTER_PICTURES
    assert detector.detect(true_lane(3.0)).centre[0] == 3.0
    detector.forget()
    assert detector.detect(true_lane(7.0)).centre[0] == 7.0
