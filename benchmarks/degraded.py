"""Degraded pictures with ground truth, for which perception was not designed.

A picture is rendered from a place on a road. Its kind tells what is changed: the marks on the road (`ROADS`), paint on
the ground (`PAINT`), or the rendered picture (`DEGRADED`). Only `kerb only`, `diagonal only` and `crosswalk only` have
two changes: paint on a road without marks. The true position of the lane's centre is computed from the road, in the
vehicle's coordinates.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import pairwise

import cv2
import numpy as np

from lavt.domain import CameraModel, FloatArray, Picture, Pose
from lavt.perception.calibration import calibrated_pinhole_camera, picture_points
from lavt.streams import stream
from lavt.transport.video.h264 import Decoder, Encoder
from lavt.vehicle.sim.rendering.renderer import Renderer
from lavt.vehicle.sim.road.cross_section import RoadMark
from lavt.vehicle.sim.road.road import Road, load_road

MODEL = CameraModel()
AHEAD_M = np.array([5.0, 10.0, 15.0])
"""Distances ahead of the rear axle at which the lane's centre is compared."""
AT_10_M = AHEAD_M.tolist().index(10.0)
"""Index of 10 m in `AHEAD_M`."""

RIGHT_LINE_M = -1.75
"""Offset of the driven lane's right line from the lane's centre."""

Degradation = Callable[[Picture, np.random.Generator], Picture]
"""A function that paints on a picture or degrades it."""

TAR, WORN_WHITE, WHITE, YELLOW, CONCRETE = (
    (38, 38, 40),
    (135, 136, 138),
    (205, 208, 210),
    (40, 150, 190),
    (140, 145, 148),
)


@dataclass(frozen=True, slots=True)
class DegradedCase:
    """A picture and its ground truth."""

    kind: str
    before: Picture
    """A picture of the unchanged road from the same place."""
    picture: Picture
    centre_m: FloatArray | None
    """y of the lane's centre at the distances `AHEAD_M`; None if the picture has no lane."""
    lane_width_m: float


# Changed marks on the road.


def _with_marks(change: Callable[[RoadMark], RoadMark | None]) -> Callable[[Road], Road]:
    """Return a function that changes the marks of a road; `change` returns None for a mark to be removed."""
    return lambda road: replace(road, marks=tuple(new for mark in road.marks if (new := change(mark)) is not None))


ROADS: dict[str, Callable[[Road], Road]] = {
    "as it is": lambda road: road,
    "one line only": _with_marks(lambda mark: replace(mark, kind="solid") if mark.offset_m == RIGHT_LINE_M else None),
    "left line missing": _with_marks(lambda mark: None if mark.offset_m > 0 else mark),
    "right line missing": _with_marks(lambda mark: None if mark.offset_m < 0 else mark),
    "all marks missing": _with_marks(lambda _: None),
    "solid lines": _with_marks(lambda mark: replace(mark, kind="solid")),
}
"""Changes of a road's marks, by kind of picture."""
NO_LANE = {
    "all marks missing",
    "kerb only",
    "diagonal only",
    "crosswalk only",
    "upside-down",
    "noise only",
    "coarse blocks",
    "grey",
    "blackout",
}
"""Kinds of pictures in which no lane can be recognised."""


# Paint on the ground.

SUBPIXEL_BITS = 4
"""Number of fractional bits in the integer coordinates that are passed to OpenCV."""


def _strip(picture: Picture, line: list[tuple[float, float]], width_m: float, colour: tuple[int, int, int]) -> None:
    """Paint a strip along a line of ground points (x, y), antialiased."""
    points = np.array(line)
    dense = np.concatenate([np.linspace(begin, end, 40) for begin, end in pairwise(points)])
    along = np.gradient(dense, axis=0)
    across = np.column_stack([-along[:, 1], along[:, 0]]) / np.maximum(np.hypot(*along.T), 1e-9)[:, None]
    outline = np.concatenate([dense + across * width_m / 2, (dense - across * width_m / 2)[::-1]])
    outline = outline[outline[:, 0] > MODEL.x_m + 0.6]  # points behind the camera have no place in the picture
    if len(outline) > 2:
        pixels = picture_points(calibrated_pinhole_camera(MODEL), outline) * 2**SUBPIXEL_BITS
        cv2.fillPoly(picture, [np.round(pixels).astype(np.int32)], colour, cv2.LINE_AA, SUBPIXEL_BITS)


def tar_seams(picture: Picture, generator: np.random.Generator) -> Picture:
    """Paint dark repaired cracks along and across the lane."""
    for _ in range(6):
        x, y = generator.uniform(3, 15), generator.uniform(-3, 3)
        _strip(picture, [(x, y), (x + 3, y + generator.normal(0, 0.5)), (x + 7, y + generator.normal(0, 1))], 0.09, TAR)
    return picture


def old_yellow_line(picture: Picture, generator: np.random.Generator) -> Picture:
    """Paint one yellow roadworks line that crosses the lane at an angle."""
    y, slope = generator.uniform(-2, 2), generator.uniform(0.1, 0.25) * generator.choice([-1, 1])
    _strip(picture, [(3, y), (25, y + 22 * slope)], 0.12, YELLOW)
    return picture


def yellow_diversion(picture: Picture, generator: np.random.Generator) -> Picture:
    """Paint two yellow roadworks lines, 3 m apart; they look like a second lane that crosses the true one."""
    y, slope = generator.uniform(-2, 2), generator.uniform(0.1, 0.25) * generator.choice([-1, 1])
    for offset in (0.0, 3.0):
        _strip(picture, [(3, y + offset), (25, y + offset + 22 * slope)], 0.12, YELLOW)
    return picture


def old_white_line(picture: Picture, generator: np.random.Generator) -> Picture:
    """Paint one worn white line that crosses the lane."""
    y, slope = generator.uniform(-2, 2), generator.choice([-0.12, 0.12])
    _strip(picture, [(3, y), (25, y + 22 * slope)], 0.12, WORN_WHITE)
    return picture


def diagonal(picture: Picture, generator: np.random.Generator) -> Picture:
    """Paint a bright line across the road, at 30 degrees to it."""
    x, side = generator.uniform(4, 8), generator.choice([-1, 1])
    _strip(picture, [(x, -4.0 * side), (x + 14, 4.0 * side)], 0.15, WHITE)
    return picture


def crosswalk(picture: Picture, generator: np.random.Generator) -> Picture:
    """Paint bars along the road, 3 m long, half a metre wide and half a metre apart."""
    x = generator.uniform(5, 11)
    for y in np.arange(-5.0, 5.0, 1.0):
        _strip(picture, [(x, y), (x + 3, y)], 0.5, WHITE)
    return picture


def arrow(picture: Picture, generator: np.random.Generator) -> Picture:
    """Paint an arrow in the middle of the lane: a shaft of 5 m and a head."""
    x = generator.uniform(4, 9)
    _strip(picture, [(x, 0), (x + 4, 0)], 0.15, WHITE)
    _strip(picture, [(x + 4, -0.5), (x + 5, 0)], 0.2, WHITE)
    _strip(picture, [(x + 4, 0.5), (x + 5, 0)], 0.2, WHITE)
    return picture


def kerb(picture: Picture, generator: np.random.Generator) -> Picture:
    """Paint a concrete kerb on the right, with its top and a dark gutter."""
    y = generator.uniform(-3.5, -2.0)
    _strip(picture, [(3, y - 0.15), (30, y - 0.15)], 0.3, CONCRETE)
    _strip(picture, [(3, y + 0.06), (30, y + 0.06)], 0.12, (50, 50, 50))
    return picture


def tree_shadows(picture: Picture, generator: np.random.Generator) -> Picture:
    """Paint shadows of trunks and leaves over the road."""
    shade = np.full(picture.shape, 255, dtype=np.uint8)
    for _ in range(4):
        x, slope = generator.uniform(3, 20), generator.uniform(-0.5, 0.5)
        _strip(shade, [(x, -8), (x + 16 * slope, 8)], generator.uniform(0.3, 1.2), (110, 110, 110))
    for _ in range(150):
        x, y = generator.uniform(3, 22), generator.uniform(-7, 7)
        _strip(shade, [(x, y), (x + generator.uniform(0.1, 0.5), y)], generator.uniform(0.1, 0.6), (120, 120, 120))
    return np.asarray(picture * (cv2.GaussianBlur(shade, (5, 5), 0) / 255.0), dtype=np.uint8)


PAINT: dict[str, Degradation] = {
    paint.__name__.replace("_", " "): paint
    for paint in (
        tar_seams,
        old_yellow_line,
        yellow_diversion,
        old_white_line,
        diagonal,
        crosswalk,
        arrow,
        tree_shadows,
    )
}
"""Paint on the ground, by kind of picture."""


# Light, lens, noise, codec.


def _worn(picture: Picture, share: float) -> Picture:
    """Reduce the contrast of pixels that are brighter than their surroundings, in the lower half of the picture."""
    surroundings = cv2.medianBlur(picture, 31)
    ground, around = picture[240:].astype(np.float32), surroundings[240:].astype(np.float32)
    worn = np.where(ground > around + 8, around + (ground - around) * (1 - share), ground)
    result = picture.copy()
    result[240:] = worn.astype(np.uint8)
    return result


def _gamma(picture: Picture, power: float) -> Picture:
    return np.asarray(255 * (picture / 255.0) ** power, dtype=np.uint8)


def _noisy(picture: Picture, generator: np.random.Generator, deviation: float) -> Picture:
    return np.clip(picture + generator.normal(0, deviation, picture.shape), 0, 255).astype(np.uint8)


def _salt_and_pepper(picture: Picture, generator: np.random.Generator, share: float) -> Picture:
    result, chance = picture.copy(), generator.random(picture.shape[:2])
    result[chance < share / 2], result[chance > 1 - share / 2] = 0, 255
    return result


def _glare(picture: Picture, generator: np.random.Generator) -> Picture:
    """Add a low sun ahead: a bloom over the picture, and a bright streak on the road."""
    rows, columns = np.indices(picture.shape[:2])
    u, v = generator.uniform(200, 440), generator.uniform(120, 200)
    bloom = 190 * np.exp(-(((columns - u) / 150) ** 2 + ((rows - v) / 130) ** 2))
    streak = 110 * np.exp(-(((columns - u) / (15 + np.maximum(rows - 240, 0) * 0.2)) ** 2)) * (rows > 240)
    return np.asarray(np.clip(picture * 0.75 + (bloom + streak)[..., None], 0, 255), dtype=np.uint8)


def _rain(picture: Picture, generator: np.random.Generator) -> Picture:
    """Add streaks, lower contrast and a blur, as through a wet windscreen."""
    streaks = np.zeros(picture.shape[:2], dtype=np.uint8)
    for _ in range(350):
        u, v = generator.integers(0, 640), generator.integers(0, 480)
        length = int(generator.integers(10, 40))
        cv2.line(
            streaks, (int(u), int(v)), (int(u) + length // 6, int(v) + length), int(generator.integers(60, 140)), 1
        )
    soft = cv2.GaussianBlur(picture, (5, 5), 0).astype(np.float32)
    veil = cv2.GaussianBlur(streaks, (3, 3), 0)[..., None]
    return np.asarray(np.clip(soft * 0.7 + 50 + veil, 0, 255), dtype=np.uint8)


def _low_rate(picture: Picture, _generator: np.random.Generator) -> Picture:
    """Return the tenth frame of H.264 at 200 kbit/s, which has block artefacts."""
    encoder = Encoder(640, 480, rate_hz=30.0, bit_rate_bps=200_000, gop_frames=300)
    decoder, shown = Decoder(), picture
    for number in range(10):  # the picture moves like a road, because the codec would make a still one sharp
        moved = np.roll(picture, (9 - number) * 3, axis=0)
        decoded = decoder.decode(encoder.encode(moved))
        shown = decoded.picture if decoded is not None else shown
    return shown


def blocks(generator: np.random.Generator, side_px: int) -> Picture:
    """Return random black and white squares, without a road."""
    squares = generator.integers(0, 2, (480 // side_px, 640 // side_px, 1)).astype(np.uint8) * 255
    return squares.repeat(side_px, 0).repeat(side_px, 1).repeat(3, 2)


DEGRADED: dict[str, Degradation] = {
    "worn by half": lambda picture, _: _worn(picture, 0.5),
    "worn by 80 %": lambda picture, _: _worn(picture, 0.8),
    "dark": lambda picture, generator: _noisy((picture * 0.2).astype(np.uint8), generator, 4),
    "very dark": lambda picture, generator: _noisy((picture * 0.08).astype(np.uint8), generator, 4),
    "glare": _glare,
    "overcast": lambda picture, _: (picture * 0.55 + 60).astype(np.uint8),
    "fog": lambda picture, _: (picture * 0.25 + 140).astype(np.uint8),
    "gamma 0.5": lambda picture, _: _gamma(picture, 0.5),
    "gamma 2": lambda picture, _: _gamma(picture, 2.0),
    "blur": lambda picture, _: np.asarray(cv2.GaussianBlur(picture, (0, 0), 2.5), dtype=np.uint8),
    "strong blur": lambda picture, _: np.asarray(cv2.GaussianBlur(picture, (0, 0), 6), dtype=np.uint8),
    "rain": _rain,
    "noise 15": lambda picture, generator: _noisy(picture, generator, 15),
    "noise 40": lambda picture, generator: _noisy(picture, generator, 40),
    "salt and pepper 2 %": lambda picture, generator: _salt_and_pepper(picture, generator, 0.02),
    "salt and pepper 10 %": lambda picture, generator: _salt_and_pepper(picture, generator, 0.10),
    "h264 200 kbit/s": _low_rate,
    "grey": lambda picture, _: np.full_like(picture, 128),
    "blackout": lambda picture, generator: _noisy(np.full_like(picture, 8), generator, 3),
    "upside-down": lambda picture, _: np.ascontiguousarray(picture[::-1]),
    "noise only": lambda _, generator: generator.integers(0, 256, (480, 640, 3)).astype(np.uint8),
    "coarse blocks": lambda _, generator: blocks(generator, int(generator.choice([2, 4, 8, 16, 32]))),
}
"""Degradations of the whole picture, by kind of picture."""


@lru_cache(maxsize=16)
def _renderer(route: str, marks: str) -> tuple[Road, Renderer]:
    road = ROADS[marks](load_road(route))
    return road, Renderer(road, MODEL, seed=1, scenery="full")


def _truth(road: Road, s_m: float, offset_m: float, turned_rad: float) -> FloatArray:
    """Return y of the lane's centre at the distances `AHEAD_M`, in the car's coordinates.

    The car is at the station `s_m`, `offset_m` left of the lane's centre, and turned left by `turned_rad`.
    """
    x_m, y_m, heading_rad, _ = (float(value) for value in road.centre_at(s_m))
    heading = heading_rad + turned_rad
    place = np.array([x_m - offset_m * np.sin(heading_rad), y_m + offset_m * np.cos(heading_rad)])
    stations = np.arange(s_m - 5, s_m + 30, 0.1)
    centre = road.centre_at(stations)
    points = np.column_stack([centre.x_m, centre.y_m]) - place
    ahead = points @ [np.cos(heading), np.sin(heading)]
    left = points @ [-np.sin(heading), np.cos(heading)]
    return np.asarray(np.interp(AHEAD_M, ahead, left), dtype=np.float64)


def cases(count: int, seed: int = 1, routes: tuple[str, ...] = ("a_key",)) -> Iterator[DegradedCase]:
    """Yield `count` pictures of every kind from random places of random routes; the seed determines all of them."""
    kinds: list[tuple[str, str, Degradation | None]] = [(kind, kind, None) for kind in ROADS]
    kinds += [(kind, "as it is", paint) for kind, paint in PAINT.items()]
    kinds += [(f"{paint.__name__} only", "all marks missing", paint) for paint in (kerb, diagonal, crosswalk)]
    kinds += [(kind, "as it is", degrade) for kind, degrade in DEGRADED.items()]
    for kind, marks, degrade in kinds:
        for number in range(count):
            generator = stream(seed, f"degraded {kind}", number)
            route = str(generator.choice(routes))
            road, renderer = _renderer(route, marks)
            s_m = float(generator.uniform(0, road.route_length_m - 25))
            offset_m, turned_rad = float(generator.normal(0, 0.3)), float(generator.normal(0, 0.03))
            x_m, y_m = road.point_at(s_m, offset_m)
            heading_rad = float(road.centre_at(s_m).heading_rad) + turned_rad
            pose = Pose(0, float(x_m), float(y_m), heading_rad)
            before = _renderer(route, "as it is")[1].render(pose, number)
            picture = before.copy() if marks == "as it is" else renderer.render(pose, number)
            if degrade is not None:
                picture = degrade(picture, generator)
            centre_m = None if kind in NO_LANE else _truth(road, s_m, offset_m, turned_rad)
            yield DegradedCase(kind, before, picture, centre_m, road.lanes.widths_m[road.lanes.driven])
