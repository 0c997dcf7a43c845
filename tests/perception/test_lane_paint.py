import numpy as np
import pytest

from lavt.domain import Picture
from lavt.perception.bird_eye import GroundGrid
from lavt.perception.lane_paint import lane_paint, white_paint, yellow_paint

GRID = GroundGrid()
ROAD = 85
MARK = slice(139, 142)
"""Columns of a mark of 0.15 m."""


def road(grey: int = ROAD) -> Picture:
    return np.full((GRID.rows, GRID.columns, 3), grey, dtype=np.uint8)


def test_only_the_white_mark_is_found() -> None:
    """A white stripe along the road is found, and the road beside the stripe is not."""
    view = road()
    view[:, MARK] = 220
    mask = lane_paint(view, GRID)
    assert mask[:, MARK].all()
    assert not mask[:, :138].any()
    assert not mask[:, 143:].any()


@pytest.mark.parametrize("contrast", [14, 20])
def test_a_faint_mark_is_found(contrast: int) -> None:
    """A stripe that is only a sixth brighter than the road, as in fog or dusk, is paint."""
    view = road()
    view[:, MARK] += np.uint8(contrast)
    assert lane_paint(view, GRID)[:, 140].all()


def test_yellow_on_concrete_is_found() -> None:
    """A yellow stripe is found although it is not brighter than the concrete beside it."""
    view = road(170)
    view[:, MARK] = (90, 175, 215)
    assert not white_paint(view, GRID).any()
    assert yellow_paint(view, GRID)[:, 140].all()
    assert lane_paint(view, GRID)[:, 140].all()


def test_grain_in_bright_light_is_not_paint() -> None:
    """A stripe that is only a twelfth (17 grey levels) brighter than a bright road is not paint."""
    view = road(200)
    view[:, MARK] = 217
    assert not lane_paint(view, GRID).any()


@pytest.mark.parametrize("dark_side", [slice(0, 140), slice(140, None)], ids=["left", "right"])
def test_a_step_is_not_paint(dark_side: slice) -> None:
    """The sunny side of a shadow's edge, or of the foot of a dark wall, is not paint."""
    view = road(200)
    view[:, dark_side] = 40
    assert not lane_paint(view, GRID).any()


def test_a_seam_between_two_surfaces_is_not_paint() -> None:
    """Dark asphalt, a strip of grey concrete and light concrete, side by side, have no paint."""
    view = road()
    view[:, 139:143] = 120
    view[:, 143:] = 180
    assert not lane_paint(view, GRID).any()


def test_a_brightness_gradient_is_not_paint() -> None:
    """A road that becomes brighter gradually has no paint."""
    view = road()
    view[:] = np.linspace(60, 250, GRID.columns).astype(np.uint8)[None, :, None]
    assert not lane_paint(view, GRID).any()


def test_a_bright_area_is_not_paint() -> None:
    """A bright area that is wider than a mark is not paint."""
    view = road()
    view[:, 100:160] = 220
    assert not lane_paint(view, GRID).any()


def test_a_double_line_is_paint() -> None:
    """Both stripes of a double line, 0.1 m wide and 0.15 m apart, are paint."""
    view = road()
    view[:, 139:141] = view[:, 144:146] = 220
    mask = lane_paint(view, GRID)
    assert mask[:, 139:141].all()
    assert mask[:, 144:146].all()


def test_a_stop_line_and_specks_are_not_paint() -> None:
    """A bar across the road and single bright cells are not paint."""
    view = road()
    view[60:65] = 220
    view[100::7, 3::9] = 255
    assert not lane_paint(view, GRID).any()
