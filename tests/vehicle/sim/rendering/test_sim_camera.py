import msgspec
import numpy as np
import pytest
from tests.vehicle.sim.rig import MODEL, camera_on, digest, picture_of, pose_at

from lavt.domain import CameraModel, FloatArray, Picture, Pose
from lavt.vehicle.camera import Camera
from lavt.vehicle.sim.rendering.ground import Ground
from lavt.vehicle.sim.rendering.pinhole import horizon_row, place_camera, row_of_depth
from lavt.vehicle.sim.rendering.renderer import SceneryKind
from lavt.vehicle.sim.road.cross_section import DASH_M, GAP_M
from lavt.vehicle.sim.road.road import Road, load_road
from lavt.vehicle.sim.road.strips import Square


@pytest.fixture(scope="module")
def road() -> Road:
    return load_road("a_key")


def test_a_frame_has_the_requested_number_and_time(road: Road) -> None:
    """A frame has the requested number and time, and a picture of the model's size."""
    camera: Camera = camera_on(road, scenery="none")
    frame = camera.capture(3, 1234, pose_at(road, 0.0))
    assert frame is not None
    assert (frame.number, frame.capture_ns, frame.picture.shape) == (3, 1234, (480, 640, 3))
    assert (camera.rate_hz, camera.phase_ns, camera.model) == (30.0, 5, MODEL)


def test_there_is_no_picture_without_a_pose(road: Road) -> None:
    """There is no frame before the first pose."""
    assert camera_on(road, scenery="none").capture(0, 0, None) is None


@pytest.mark.parametrize("scenery", ["full", "light", "none"])
def test_frames_do_not_depend_on_history(road: Road, scenery: SceneryKind) -> None:
    """A prepared camera and a fresh camera give equal bytes for equal poses in any order."""
    prepared, fresh = camera_on(road, scenery=scenery), camera_on(road, scenery=scenery)
    prepared.prepare()
    poses = [pose_at(road, s_m, 0.4, -0.1) for s_m in (90.0, 12.0, 55.0, 12.0)]
    first = [digest(picture_of(prepared, pose, number)) for number, pose in enumerate(poses)]
    second = [digest(picture_of(fresh, pose, number)) for number, pose in reversed(list(enumerate(poses)))]
    assert first == second[::-1]
    assert first[1] != first[3]  # the same pose, but the noise of a frame with another number


def test_the_seed_changes_only_the_sensor_noise(road: Road) -> None:
    """Pictures of one pose with two seeds differ only by noise."""
    pose = pose_at(road, 30.0)
    one, other = (picture_of(camera_on(road, seed=seed), pose).astype(int) for seed in (1, 2))
    difference = np.abs(one - other)
    assert 0 < difference.mean() < 4
    assert difference.max() < 30


def marks_in_view(road: Road, pose: Pose, model: CameraModel, offset_m: float, stations: FloatArray) -> FloatArray:
    """Return the projections (n, 3) of those points of a mark at `stations` that are in the picture."""
    ground = road.point_at(stations, offset_m)
    points = place_camera(model, pose).project(np.column_stack([ground, np.zeros(len(ground))]))
    inside = (points[:, 0] > 4) & (points[:, 0] < model.width_px - 5) & (points[:, 1] < model.height_px - 2)
    assert inside.sum() >= 3
    return points[inside]


@pytest.mark.parametrize("turned_rad", [-0.2, 0.0, 0.15])
@pytest.mark.parametrize("pitch_rad", [0.0, 0.12])
def test_marks_are_at_their_projection(road: Road, turned_rad: float, pitch_rad: float) -> None:
    """A solid mark up to 30 m away is within a pixel of its projection."""
    model = msgspec.structs.replace(MODEL, pitch_rad=pitch_rad)
    pose = pose_at(road, 2.0, 0.3, turned_rad)
    picture = picture_of(camera_on(road, scenery="none", model=model), pose).astype(float).mean(axis=2)
    stations = np.arange(30.0, 43.0, 1.5)
    for u_px, v_px, _ in marks_in_view(road, pose, model, -5.25, stations):
        row, column = round(v_px), round(u_px)
        # The row is v_px rounded, so the expected column is that of the mark's point nearest to the row.
        mark_points = marks_in_view(road, pose, model, -5.25, np.arange(25.0, 50.0, 0.02))
        expected_column = mark_points[np.argmin(np.abs(mark_points[:, 1] - row)), 0]
        near_columns = np.arange(max(column - 14, 0), min(column + 15, model.width_px))
        bright = np.clip(picture[row, near_columns] - np.median(picture[row, near_columns]) - 18.0, 0.0, None)
        assert bright.sum() > 20
        assert (bright * near_columns).sum() / bright.sum() == pytest.approx(expected_column, abs=1.0)


def test_dashes_are_bright_and_gaps_are_not(road: Road) -> None:
    """On a broken line the middle of a dash is much brighter than its surroundings, and the middle of a gap is not."""
    pose = pose_at(road, 0.0)
    picture = picture_of(camera_on(road, scenery="none"), pose).astype(float).mean(axis=2)
    dash_middle_m = 9.0 + DASH_M / 2
    gap_middle_m = dash_middle_m + (DASH_M + GAP_M) / 2
    for station, is_dash in [(dash_middle_m, True), (gap_middle_m, False)]:
        ground = np.append(road.point_at(station, 1.75), 0.0)
        u_px, v_px, _ = place_camera(MODEL, pose).project(ground)
        around = picture[round(v_px), round(u_px) - 25 : round(u_px) + 26]
        assert (picture[round(v_px), round(u_px)] - np.median(around) > 60) == is_dash


def test_marks_have_their_colours(road: Road) -> None:
    """The mark at the median is yellow (red far above blue), and the mark at the shoulder is white."""
    pose = pose_at(road, 0.0, 6.0)
    picture = picture_of(camera_on(road, scenery="none"), pose).astype(int)
    u_px, v_px, _ = place_camera(MODEL, pose).project(np.append(road.point_at(10.0, 8.75), 0.0))
    blue, _, red = picture[round(v_px), round(u_px)]
    assert red - blue > 60
    pose = pose_at(road, 0.0, -3.0)
    picture = picture_of(camera_on(road, scenery="none"), pose).astype(int)
    u_px, v_px, _ = place_camera(MODEL, pose).project(np.append(road.point_at(10.0, -5.25), 0.0))
    blue, _, red = picture[round(v_px), round(u_px)]
    assert abs(red - blue) < 25
    assert blue > 140


def test_the_row_of_a_depth_is_the_projection_of_its_ground() -> None:
    """The row of a depth contains the projection of the ground at that depth, even for a pitched camera."""
    for pitch_rad in (0.0, 0.2):
        model = msgspec.structs.replace(MODEL, pitch_rad=pitch_rad)
        placement = place_camera(model, Pose(0, 0.0, 0.0, 0.0))
        _, v_px, _ = placement.project(np.array([model.x_m + 10.0, 0.0, 0.0]))
        assert row_of_depth(model, 10.0) - 1 < v_px <= row_of_depth(model, 10.0)


def test_the_homography_is_the_inverse_of_the_projection() -> None:
    """The ground point of a pixel projects back to the pixel."""
    placement = place_camera(msgspec.structs.replace(MODEL, pitch_rad=0.1), Pose(0, 30.0, -7.0, 2.0))
    ground = placement.ground_from_picture() @ np.array([123.0, 400.0, 1.0])
    assert placement.project(np.append(ground[:2] / ground[2], 0.0))[:2] == pytest.approx([123.0, 400.0])


def test_rails_are_drawn_only_with_scenery(road: Road) -> None:
    """The barrier is drawn with scenery `light` and `full`, and left out with `none`."""
    pose = pose_at(road, 60.0)
    pictures = {
        kind: picture_of(camera_on(road, scenery=kind), pose).astype(float) for kind in ("full", "light", "none")
    }
    point = np.append(road.point_at(84.0, 12.25), 0.5)
    u_px, v_px, _ = place_camera(MODEL, pose).project(point)
    area = np.s_[round(v_px) - 1 : round(v_px) + 2, round(u_px) - 3 : round(u_px) + 4]
    assert np.abs(pictures["light"][area].mean() - pictures["none"][area].mean()) > 25
    assert pictures["full"][area].mean() == pytest.approx(pictures["light"][area].mean(), abs=3)


def test_another_camera_model_is_drawn(road: Road) -> None:
    """The picture of a small, wide-angle, high and pitched camera has the camera's size and no empty rows."""
    model = CameraModel(width_px=320, height_px=200, field_of_view_rad=2.0, z_m=2.0, pitch_rad=0.15)
    picture = picture_of(camera_on(road, model=model), pose_at(road, 40.0))
    assert picture.shape == (200, 320, 3)
    assert picture.reshape(200, -1).mean(axis=1).min() > 40


def test_a_camera_that_sees_no_sky_is_drawn(road: Road) -> None:
    """The picture of a camera that looks down shows ground in all rows."""
    picture = picture_of(camera_on(road, model=CameraModel(pitch_rad=1.2)), pose_at(road, 40.0))
    assert picture.reshape(len(picture), -1).std(axis=1).min() > 1


TURNED = CameraModel(x_m=1.2, y_m=0.5, z_m=1.6, pitch_rad=0.1, yaw_rad=0.3, roll_rad=-0.2)


def test_the_homography_inverts_the_projection_for_every_pose() -> None:
    """For a turned, rolled and offset camera the ground point of a pixel projects back to the pixel."""
    placement = place_camera(TURNED, Pose(0, 30.0, -7.0, 2.0))
    for pixel in ([123.0, 400.0], [600.0, 300.0], [320.0, 470.0]):
        ground = placement.ground_from_picture() @ np.array([*pixel, 1.0])
        assert placement.project(np.append(ground[:2] / ground[2], 0.0))[:2] == pytest.approx(pixel)


def test_yaw_offset_and_roll_have_their_signs() -> None:
    """A camera turned or moved left sees the road on the right; a camera rolled right has a higher right horizon."""
    pose, ahead = Pose(0, 0.0, 0.0, 0.0), np.array([40.0, 0.0, 1.4])
    for model in (CameraModel(yaw_rad=0.1), CameraModel(y_m=0.5)):
        assert place_camera(model, pose).project(ahead)[0] > MODEL.width_px / 2
    leaning = place_camera(CameraModel(roll_rad=0.1), pose)
    right, left = (leaning.project(np.array([40.0, side, 1.4]))[1] for side in (-20.0, 20.0))
    assert right < horizon_row(MODEL) < left


@pytest.mark.parametrize("scenery", ["full", "none"])
def test_a_turned_camera_has_marks_at_their_projection(road: Road, scenery: SceneryKind) -> None:
    """For a camera with yaw, pitch, roll and offset, marks are within 1.5 pixels of their projection."""
    pose = pose_at(road, 0.0)
    picture = picture_of(camera_on(road, scenery=scenery, model=TURNED), pose).astype(float).mean(axis=2)
    for u_px, v_px, _ in marks_in_view(road, pose, TURNED, -1.75, np.arange(4.0, 9.0, 0.5)):
        row, column = round(v_px), round(u_px)
        mark_points = marks_in_view(road, pose, TURNED, -1.75, np.arange(3.0, 10.0, 0.005))
        expected_column = mark_points[np.argmin(np.abs(mark_points[:, 1] - row)), 0]
        near_columns = np.arange(max(column - 30, 0), min(column + 31, TURNED.width_px))
        bright = np.clip(picture[row, near_columns] - np.median(picture[row, near_columns]) - 40.0, 0.0, None)
        assert (bright * near_columns).sum() / bright.sum() == pytest.approx(expected_column, abs=1.5)


def test_far_dashes_do_not_flicker(road: Road) -> None:
    """If a car moves by 0.1 m, each pixel of a broken line farther than 40 m changes by less than 12 grey levels."""
    camera = camera_on(road, scenery="none")
    rows = np.arange(round(horizon_row(MODEL)) + 4, row_of_depth(MODEL, 40.0))
    offset_px = 1.75 / MODEL.z_m * (rows - horizon_row(MODEL))
    columns = np.rint((MODEL.width_px - 1) / 2 + np.array([[-1.0], [1.0]]) * offset_px).astype(int)
    brightness = []
    for number in range(30):
        picture = picture_of(camera, pose_at(road, 90.0 + 0.1 * number), number).astype(float).mean(axis=2)
        brightness.append(np.mean([picture[rows, columns + shift_px] for shift_px in (-1, 0, 1)], axis=0))
    assert np.abs(np.diff(brightness, axis=0)).max() < 12.0


@pytest.mark.parametrize("route", ["a_key", pytest.param("b", marks=pytest.mark.full)])
def test_a_prepared_camera_paints_few_tiles_while_driving(monkeypatch: pytest.MonkeyPatch, route: str) -> None:
    """A car that swerves by 6 m and 0.6 rad needs no new coarse tiles, and at most 10 new fine tiles per frame."""
    whole_road = load_road(route)
    camera = camera_on(whole_road)
    camera.prepare()
    painted: list[int] = []
    paint = Ground._paint

    def counted_paint(ground: Ground, level: int, square: Square) -> Picture:
        painted.append(level)
        return paint(ground, level, square)

    monkeypatch.setattr(Ground, "_paint", counted_paint)
    for s_m in np.arange(0.0, whole_road.route_length_m, 2.5):
        painted.clear()
        picture_of(camera, pose_at(whole_road, s_m, 6.0 * np.sin(s_m / 9), 0.6 * np.cos(s_m / 9)))
        assert len(painted) <= 10
        assert all(level < 2 for level in painted)
