import numpy as np

from lavt.perception.lane_pixels import Mask, edge_pixels, lane_pixels, white_pixels

ROAD = 85


def road() -> Mask:
    return np.full((40, 640, 3), ROAD, dtype=np.uint8)


def test_only_the_white_mark_is_found() -> None:
    """A white stripe that crosses the rows is found, and the road beside the stripe is not."""
    picture = road()
    picture[:, 300:308] = 220
    mask = lane_pixels(picture)
    assert mask[:, 301:307].all()
    assert not mask[:, :298].any()
    assert not mask[:, 310:].any()


def test_a_yellow_mark_is_found() -> None:
    """A yellow mark is found although it is hardly brighter than the road."""
    picture = road()
    picture[:, 300:308] = (30, 95, 130)
    assert not white_pixels(np.asarray(picture @ np.array([0.114, 0.587, 0.299])).astype(np.uint8)).any()
    assert lane_pixels(picture)[:, 301:307].all()


def test_grain_in_bright_light_is_not_paint() -> None:
    """A stripe that is only a fifth (40 grey levels) brighter than a bright road is not paint."""
    picture = road() + np.uint8(115)
    picture[:, 300:308] += np.uint8(40)
    assert not lane_pixels(picture).any()


def test_a_brightness_gradient_is_not_paint() -> None:
    """A road that becomes brighter gradually has no edges and no paint."""
    picture = road()
    picture[:] = np.linspace(60, 250, 640).astype(np.uint8)[None, :, None]
    assert not lane_pixels(picture).any()


def test_a_bright_area_is_not_paint_inside() -> None:
    """Of a bright area wider than a mark, at most the rim is paint."""
    picture = road()
    picture[:, 200:440] = 220
    assert not lane_pixels(picture)[:, 260:380].any()


def test_a_stripe_along_the_rows_is_not_paint() -> None:
    """A bar across the road, such as a stop line, has no vertical edges and is not paint."""
    picture = road()
    picture[20:23] = 220
    assert not lane_pixels(picture).any()
    assert not edge_pixels(picture[..., 1]).any()
