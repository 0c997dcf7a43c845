import numpy as np
import pytest

from lavt.perception.bird_eye import GroundGrid
from lavt.perception.lane_fit import (
    LaneFit,
    Points,
    Sides,
    fit_lane,
    mark_points,
    sides_near,
)
from lavt.perception.lane_paint import Mask
from lavt.perception.lane_search import StartLane, has_parallel, sides_by_windows, start_lanes
from lavt.streams import stream

GRID = GroundGrid()
CURVE = (0.2, -0.03, 0.012)


def points_on_parallels(
    centre: tuple[float, float, float], offsets_m: tuple[float, ...], x_m: np.ndarray | None = None
) -> Points:
    """Return the points of painted lines, 8 cm wide, at exact distances `offsets_m` to the left of a curved centre."""
    x = np.arange(3.65, 20.0, 0.1) if x_m is None else x_m
    slope = centre[1] + 2 * centre[2] * x
    y = centre[0] + centre[1] * x + centre[2] * x * x
    across = np.repeat(offsets_m, 3) + np.tile([-0.04, 0.0, 0.04], len(offsets_m))
    slant = np.sqrt(1 + slope**2)
    return Points(
        np.concatenate([x - slope / slant * offset for offset in across]),
        np.concatenate([y + offset / slant for offset in across]),
    )


def mask_of(points: Points) -> Mask:
    """Return the mask whose painted cells contain the points on the grid."""
    mask = np.zeros((GRID.rows, GRID.columns), dtype=np.uint8)
    row = np.rint((GRID.far_m - points.x_m) / GRID.step_x_m - 0.5).astype(int)
    column = np.rint((GRID.half_width_m - points.y_m) / GRID.step_y_m - 0.5).astype(int)
    inside = (row >= 0) & (row < GRID.rows) & (column >= 0) & (column < GRID.columns)
    mask[row[inside], column[inside]] = 255
    return mask


def lanes_of(points: Points, count: int = 1, width_m: float = 3.5) -> list[StartLane]:
    return start_lanes(mask_of(points), GRID, width_m, count)


def search_and_fit(points: Points, width_m: float = 3.5) -> tuple[Sides, LaneFit | None]:
    (start,) = lanes_of(points)
    sides, _ = sides_by_windows(points, GRID, start.centre, start.width_m)
    return sides, fit_lane(points, sides, GRID, width_m)


def largest_error_m(fit: LaneFit | None, centre: tuple[float, float, float]) -> float:
    assert fit is not None
    x = np.linspace(4, 19, 16)
    return float(np.max(np.abs(np.polyval(fit.centre[::-1], x) - np.polyval(centre[::-1], x))))


def test_mask_cells_are_converted_to_ground_points() -> None:
    """The first cell of a mask is the farthest and leftmost point on the ground."""
    mask = np.zeros((GRID.rows, GRID.columns), dtype=np.uint8)
    mask[0, 0] = 255
    points = mark_points(mask, GRID)
    assert points.x_m.tolist() == pytest.approx([19.95])
    assert points.y_m.tolist() == pytest.approx([6.975])


def test_a_curved_lane_is_found_and_fitted() -> None:
    """Windows follow a curve of 42 m radius, and the fit is within 3 cm of the lane's centre."""
    _, fit = search_and_fit(points_on_parallels(CURVE, (1.75, -1.75)))
    assert largest_error_m(fit, CURVE) < 0.03
    assert fit is not None
    assert fit.width_m == pytest.approx(3.5, abs=0.03)
    assert fit.confidence > 0.95


def test_marks_of_adjacent_lanes_are_ignored() -> None:
    """Of six lines the windows select the two next to the car, even if the car is 0.6 m off the centre."""
    points = points_on_parallels((0.6, 0.0, 0.0), (8.75, 5.25, 1.75, -1.75, -5.25, -8.75))
    sides, fit = search_and_fit(points)
    assert largest_error_m(fit, (0.6, 0.0, 0.0)) < 0.02
    assert set(np.round(points.y_m[sides > 0] - 0.6, 1)) == {1.7, 1.8}, "the left line, at 1.75 m"


def test_points_near_a_known_lane_are_assigned_to_it() -> None:
    """A point half a metre from an expected line is assigned to this line; a point one metre away is not."""
    points = Points(np.full(4, 10.0), np.array([2.25, 2.75, -1.3, -0.75]))
    assert sides_near(points, (0.0, 0.0, 0.0), 3.5).tolist() == [1, 0, -1, 0]


def test_one_line_is_enough() -> None:
    """With one line, the centre is half the expected width beside this line, and the confidence is about 0.5."""
    points = points_on_parallels(CURVE, (-1.75,))
    fit = fit_lane(points, sides_near(points, CURVE, 3.5), GRID, 3.5)
    assert largest_error_m(fit, CURVE) < 0.03
    assert fit is not None
    assert fit.left_visible == 0
    assert fit.confidence == pytest.approx(0.5, abs=0.05)


def test_an_implausible_width_is_not_used() -> None:
    """When two lines are not a lane's width apart, only the line with more points is used."""
    long_line, short_line = (
        points_on_parallels((0.0, 0.0, 0.0), (1.75,)),
        points_on_parallels((0.0, 0.0, 0.0), (-0.5,), np.arange(4, 9, 0.1)),
    )
    points = Points(np.concatenate([long_line.x_m, short_line.x_m]), np.concatenate([long_line.y_m, short_line.y_m]))
    sides = np.concatenate([np.full(len(long_line.x_m), 1), np.full(len(short_line.x_m), -1)]).astype(np.int8)
    fit = fit_lane(points, sides, GRID, 3.5)
    assert largest_error_m(fit, (0.0, 0.0, 0.0)) < 0.02


def test_a_short_stretch_is_fitted_straight() -> None:
    """A visible lane shorter than 6 m is fitted without curvature."""
    points = points_on_parallels(CURVE, (1.75, -1.75), np.arange(5.0, 10.0, 0.1))
    fit = fit_lane(points, sides_near(points, CURVE, 3.5), GRID, 3.5)
    assert fit is not None
    assert fit.centre[2] == 0.0


def test_a_patch_beside_the_line_does_not_bend_the_fit() -> None:
    """Spots half a metre from a line do not bend the fit; they lower the share of paint that is on the lines."""
    clean = points_on_parallels(CURVE, (1.75, -1.75))
    spots = points_on_parallels(CURVE, (1.2,), np.arange(12.0, 14.0, 0.1))
    points = Points(np.concatenate([clean.x_m, spots.x_m]), np.concatenate([clean.y_m, spots.y_m]))
    fit = fit_lane(points, sides_near(points, CURVE, 3.5), GRID, 3.5)
    assert largest_error_m(fit, CURVE) < 0.04
    assert fit is not None
    assert fit.on_line_share < 0.97


def test_too_few_points_are_no_lane() -> None:
    """No points, or a handful of points, have no fit and raise no error."""
    nothing = Points(np.empty(0), np.empty(0))
    assert lanes_of(nothing) == []
    assert fit_lane(nothing, np.empty(0, dtype=np.int8), GRID, 3.5) is None
    few = points_on_parallels((0.0, 0.0, 0.0), (1.75, -1.75), np.arange(5.0, 5.5, 0.1))
    assert fit_lane(few, sides_near(few, (0.0, 0.0, 0.0), 3.5), GRID, 3.5) is None


def test_speckle_has_little_confidence() -> None:
    """Random points have no lane, or one with very little confidence."""
    generator = stream(1, "speckle")
    points = Points(generator.uniform(3.6, 20, 3000), generator.uniform(-7, 7, 3000))
    fit = fit_lane(points, sides_near(points, (0.0, 0.0, 0.0), 3.5), GRID, 3.5)
    assert fit is None or fit.confidence < 0.1


def test_a_solid_wall_does_not_hide_two_broken_lines() -> None:
    """Two broken lines a lane's width apart are among the candidates, although a wall beside them has more paint."""
    dashes_m = np.concatenate([np.arange(4.0, 7.0, 0.1), np.arange(13.0, 16.0, 0.1)])
    lines = points_on_parallels((0.2, 0.0, 0.0), (1.75, -1.75), dashes_m)
    wall = points_on_parallels((0.2, 0.0, 0.0), (3.0,))
    points = Points(np.concatenate([lines.x_m, wall.x_m]), np.concatenate([lines.y_m, wall.y_m]))
    assert any(abs(start.centre[0] - 0.2) < 0.1 and abs(start.width_m - 3.5) < 0.3 for start in lanes_of(points, 3))
    assert not any(abs(start.centre[0] - 0.2) < 0.1 for start in lanes_of(points, 1)), "the wall wins"


def test_candidates_are_different_lanes_around_the_car() -> None:
    """With three lines, the candidates differ, each has the car in it, and one of them has each spacing."""
    points = points_on_parallels((0.0, 0.0, 0.0), (2.0, -1.2, -2.2))
    starts = lanes_of(points, count=3)
    assert len(starts) == 3
    assert all(abs(start.centre[0]) <= start.width_m / 2 + 0.25 for start in starts)
    assert {round(start.centre[0], 1) for start in starts} >= {0.4, -0.1}


@pytest.mark.parametrize(("width_m", "expected_m"), [(4.2, 3.5), (3.0, 3.5), (2.7, 2.7)])
def test_a_lane_of_another_width_is_found(width_m: float, expected_m: float) -> None:
    """A lane that is wider or narrower than expected is the first candidate, with about its own width."""
    points = points_on_parallels((0.0, 0.0, 0.0), (width_m / 2, -width_m / 2))
    (start,) = lanes_of(points, width_m=expected_m)
    assert start.width_m == pytest.approx(width_m, abs=0.21)


def test_a_scattered_line_is_visible_but_not_clear() -> None:
    """A ragged edge, such as that of a reflection, is visible like a line, but has little clearness."""
    clean = points_on_parallels((0.0, 0.0, 0.0), (1.75, -1.75))
    generator = stream(1, "ragged")
    ragged = Points(clean.x_m, clean.y_m + generator.normal(0.0, 0.11, len(clean.y_m)))
    fits = [fit_lane(points, sides_near(points, (0, 0, 0), 3.5), GRID, 3.5) for points in (clean, ragged)]
    assert fits[0] is not None
    assert fits[1] is not None
    assert fits[0].clearness > 0.9
    assert fits[1].confidence > 0.9
    assert fits[1].clearness < 0.7 * fits[1].confidence


def test_a_parallel_is_a_line_of_this_lane_or_of_the_next() -> None:
    """Two lines of the lane are parallels, one line and the next lane's are, too, but one line alone is not."""
    for offsets_m, expected in (((1.75, -1.75), True), ((1.75, 5.25), True), ((1.75,), False)):
        points = points_on_parallels((0.0, 0.0, 0.0), offsets_m)
        fit = fit_lane(points, sides_near(points, (0, 0, 0), 3.5), GRID, 3.5)
        assert fit is not None
        assert has_parallel(points, fit, GRID) is expected
