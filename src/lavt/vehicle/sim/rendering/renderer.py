"""The renderer of a road for a camera on a car, on the CPU.

The ground is warped from top-view tiles, in five bands of picture rows; nearer bands use finer scales (a clipmap). Sky
and hills are cropped from a panorama, upright objects are drawn from far to near, and sensor noise is added. A frame
depends only on the poses, the frame number and the seed. With the same versions of the libraries and the same processor
features it is byte-for-byte reproducible.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from lavt.domain import CameraModel, FloatArray, Picture, Pose
from lavt.streams import IndexedStream, stream
from lavt.vehicle.sim.rendering.ground import TILE_M, Ground
from lavt.vehicle.sim.rendering.light import Colour, LightName
from lavt.vehicle.sim.rendering.panorama import Panorama
from lavt.vehicle.sim.rendering.pinhole import (
    CameraPlacement,
    level_model,
    place_camera,
    principal_point,
    roll_matrix,
    row_of_depth,
)
from lavt.vehicle.sim.rendering.roadside_objects import place_roadside_objects
from lavt.vehicle.sim.rendering.scenery import Scenery
from lavt.vehicle.sim.rendering.shadows import Shadows
from lavt.vehicle.sim.rendering.textures import SCALES_M
from lavt.vehicle.sim.rendering.weather import HAZE_BEGIN_M, HAZE_M, WEATHERS, Weather, WeatherName
from lavt.vehicle.sim.rendering.weather_optics import Headlights, WaterFilm, Windscreen, slant_distance_m
from lavt.vehicle.sim.road.road import Road

SceneryKind = Literal["full", "light", "none"]
"""full: everything; light: without trees, lamp posts, buildings and clouds; none: also without rails and shadows."""

MAX_PARTS, MAX_INSTANTS = 8, 16
"""The largest number of parts of an exposure, and of instants in a part at which the near ground is drawn."""

BAND_FAR_M = (5.0, 11.0, 26.0, 60.0, 160.0)
"""The distance ahead of the camera that each scale of the ground reaches."""

_MAX_LINES = 6
_TEXELS_PER_LINE = 2.5
"""A picture row is drawn as the mean of up to `_MAX_LINES` lines, each of which covers about `_TEXELS_PER_LINE` texels.
"""

_MAX_STEP_PX = 3.0
"""The picture moves at most this far between two instants of an exposure, unless their largest number is reached."""

_NEAR_BANDS = 2
"""The number of bands that are near ground, which is drawn at several instants for motion blur."""

_NOISE_DEVIATION = 2.2
_NOISE_MARGIN_PX = 64
_FINEST_PREPARED_LEVEL = 2
"""`prepare` paints this scale and the coarser scales; the finer scales are painted during the drive."""

_PREPARED_SWERVE_M = 6.0
_PREPARED_SWERVE_RAD = 0.6
"""`prepare` paints the ground visible to cars on the route and this far beside it, without and with this turn."""


class Band:
    """The rows of a level camera's picture that show ground of one scale, and the square of tiles visible in them.

    A distant row covers a long piece of ground. Such a row is drawn as the mean of `lines` finer rows, so that dashes
    of marks do not flicker.
    """

    def __init__(self, model: CameraModel, level: int) -> None:
        far_m = BAND_FAR_M[level]
        near_m = BAND_FAR_M[level - 1] if level else 0.0
        self.level = level
        self.first_row = row_of_depth(model, far_m)
        self.end_row = row_of_depth(model, near_m) if level else model.height_px
        self._tile_m = TILE_M[level]
        # The square is centred on a point ahead of the camera and contains everything visible in the rows.
        self._ahead_m = (near_m + far_m) / 2
        half_width_m = far_m * model.width_px / 2 / model.focal_px * math.hypot(1.0, math.tan(model.pitch_rad))
        reach_m = math.hypot(far_m - self._ahead_m, half_width_m)
        self._tiles_around = math.ceil(reach_m / self._tile_m)
        middle_m = math.sqrt(max(near_m, 2.0) * far_m)
        row_m = middle_m**2 / (model.focal_px * model.z_m)
        self.lines = min(max(round(row_m / (SCALES_M[level] * _TEXELS_PER_LINE)), 1), _MAX_LINES)

    @property
    def tiles(self) -> int:
        """The number of tiles along an edge of the square."""
        return 2 * self._tiles_around + 1

    @property
    def picture_from_lines(self) -> FloatArray:
        """The 3 x 3 matrix from (column, line, 1) of the band to picture coordinates (u, v, 1)."""
        first = self.first_row + 0.5 / self.lines - 0.5
        return np.array([[1.0, 0.0, 0.0], [0.0, 1.0 / self.lines, first], [0.0, 0.0, 1.0]])

    def first_tile(self, placement: CameraPlacement) -> tuple[int, int]:
        """Return the index (x, y) of the square's first tile."""
        x_m = placement.x_m + self._ahead_m * math.cos(placement.heading_rad)
        y_m = placement.y_m + self._ahead_m * math.sin(placement.heading_rad)
        return math.floor(x_m / self._tile_m) - self._tiles_around, math.floor(y_m / self._tile_m) - self._tiles_around

    def texel_from_ground(self, first_tile: tuple[int, int]) -> FloatArray:
        """Return the 3 x 3 matrix from the world's ground to texels of the square of tiles."""
        scale_m, (first_x, first_y) = SCALES_M[self.level], first_tile
        return np.array(
            [
                [1 / scale_m, 0.0, -first_x * self._tile_m / scale_m - 0.5],
                [0.0, 1 / scale_m, -first_y * self._tile_m / scale_m - 0.5],
                [0.0, 0.0, 1.0],
            ]
        )


class Renderer:
    """A renderer of one road in one light and one weather for one camera model."""

    def __init__(
        self,
        road: Road,
        model: CameraModel,
        *,
        seed: int,
        scenery: SceneryKind,
        light: LightName = "noon",
        weather: WeatherName = "clear",
    ) -> None:
        cv2.setNumThreads(1)  # with more threads the division of work, and so the last bit, could vary
        self._road, self._model = road, model
        self._level_model = level_model(model)
        self._ground, self._scenery = world(road, scenery, light, weather)
        self._bands = tuple(Band(self._level_model, level) for level in range(len(SCALES_M)))
        air = WEATHERS[weather]
        sky = air.light(light)
        self._panorama = Panorama(self._level_model, self._bands[-1].first_row, sky, plain=scenery != "full")
        self._last_squares: list[tuple[tuple[int, int], Picture] | None] = [None] * len(self._bands)
        """The square of tiles that each band used last: the index of the square's first tile, and its texels."""
        self._canvas = np.empty((self._level_model.height_px, self._level_model.width_px, 4), dtype=np.uint8)
        self._haze_factor, self._haze = _haze(self._level_model, self._bands, sky.haze, air)
        self._haze_colour = np.array([*sky.haze, 0.0])
        self._far_clearness = math.exp(-air.extinction_per_m * BAND_FAR_M[-1])
        """How much of the panorama, which is farther than the ground that is drawn, rain or fog leave."""
        self._film = WaterFilm(self._level_model, air.film) if air.film else None
        self._headlights = Headlights(self._level_model) if air.headlights else None
        self._windscreen = Windscreen(model, air.rain_mmph, seed) if air.rain_mmph else None
        self._positive_noise, self._negative_noise = _noise(model)
        self._noise_places = IndexedStream(seed, "sensor noise")

    def prepare(self) -> None:
        """Fill the caches whose first use would delay a frame: coarse ground along the route, textures and sprites."""
        for s_m in np.arange(0.0, self._road.route_length_m + 16.0, 16.0):
            heading_rad = float(self._road.centre_at(s_m).heading_rad)
            for lateral_m in (-_PREPARED_SWERVE_M, 0.0, _PREPARED_SWERVE_M):
                x_m, y_m = self._road.point_at(s_m, lateral_m).tolist()
                for turned_rad in (-_PREPARED_SWERVE_RAD, 0.0, _PREPARED_SWERVE_RAD):
                    self._prepare_ground(place_camera(self._level_model, Pose(0, x_m, y_m, heading_rad + turned_rad)))
        if self._scenery is not None:
            self._scenery.prepare()
        self.render(Pose(0, *self._road.start), 0)

    def render(self, pose: Pose, number: int) -> Picture:
        """Return frame `number` for a vehicle at `pose`, without motion blur, in a new array."""
        return self._finish(self._draw_world(pose), pose, number)

    def render_exposed(self, begin: Pose, end: Pose, number: int) -> Picture:
        """Return frame `number` for a vehicle that moves from `begin` to `end` during the exposure.

        The exposure is divided into parts. A part is so short that only the near ground moves much during it. So the
        near ground is drawn at several instants of each part.
        """
        parts = _part_count(self._motion_px(begin, end, self._bands[_NEAR_BANDS].end_row), MAX_PARTS)
        instants = _part_count(self._motion_px(begin, end, self._level_model.height_px - 1) / parts, MAX_INSTANTS)
        total = np.zeros((self._model.height_px, self._model.width_px, 3), dtype=np.uint16)
        for part in range(parts):
            shares = (part + (np.arange(instants) + 0.5) / instants) / parts
            near_poses = [_interpolate_pose(begin, end, share) for share in shares.tolist()]
            total += self._draw_world(_interpolate_pose(begin, end, (part + 0.5) / parts), near_poses)
        return self._finish(((total + parts // 2) // parts).astype(np.uint8), end, number)

    def _finish(self, picture: Picture, pose: Pose, number: int) -> Picture:
        """Return frame `number` with the drops on the windscreen at the pose's time, and with the sensor's noise."""
        if self._windscreen is not None:
            picture = self._windscreen.add_drops(picture, pose.mono_ns)
        self._add_noise(picture, number)
        return picture

    def _draw_world(self, pose: Pose, near_poses: Sequence[Pose] = ()) -> Picture:
        """Return the world seen from `pose`, without noise.

        With several `near_poses` the near ground is the mean of the views from them.
        """
        placement = place_camera(self._level_model, pose)
        background = self._canvas[: self._bands[-1].first_row]
        self._panorama.crop(placement.heading_rad, background)
        if self._far_clearness < 1:
            air = (1 - self._far_clearness) * self._haze_colour
            background[:] = np.rint(self._far_clearness * background + air)
        blurred = len(near_poses) > 1
        homography = placement.ground_from_picture()
        for band in self._bands[_NEAR_BANDS if blurred else 0 :]:
            self._warp(band, placement, homography)
        if blurred:
            self._blur_near([place_camera(self._level_model, near_pose) for near_pose in near_poses])
        if self._film is not None:
            self._film.reflect(self._canvas, self._bands[-1].first_row)
        self._add_haze()
        picture = np.asarray(cv2.cvtColor(self._canvas, cv2.COLOR_BGRA2BGR), dtype=np.uint8)
        if self._scenery is not None:
            self._scenery.draw(placement, picture)
        if self._headlights is not None:
            picture = self._headlights.illuminate(picture)
        return picture if self._level_model is self._model else self._apply_roll(picture)

    def _warp(self, band: Band, placement: CameraPlacement, homography: FloatArray) -> None:
        rows = self._canvas[band.first_row : band.end_row]
        if not len(rows):
            return
        first_tile = band.first_tile(placement)
        matrix = band.texel_from_ground(first_tile) @ homography @ band.picture_from_lines
        flags, size = cv2.WARP_INVERSE_MAP | cv2.INTER_LINEAR, (rows.shape[1], rows.shape[0] * band.lines)
        texels = self._square_of_tiles(band, first_tile)
        if band.lines == 1:
            cv2.warpPerspective(texels, matrix, size, rows, flags, cv2.BORDER_REPLICATE)
            return
        lines = cv2.warpPerspective(texels, matrix, size, flags=flags, borderMode=cv2.BORDER_REPLICATE)
        # The mean is taken by NumPy, because OpenCV's reduction by area takes longer than the warp.
        total = np.add.reduce(lines.reshape(len(rows), band.lines, -1), axis=1, dtype=np.uint16)
        rows.reshape(len(rows), -1)[:] = (total + band.lines // 2) // band.lines

    def _square_of_tiles(self, band: Band, first_tile: tuple[int, int]) -> Picture:
        """Return the texels of a band's square of tiles, from the cache if the square is the last one."""
        last = self._last_squares[band.level]
        if last is not None:
            last_first_tile, texels = last
            if last_first_tile == first_tile:
                return texels
        texels = self._ground.assemble(band.level, first_tile, band.tiles)
        self._last_squares[band.level] = (first_tile, texels)
        return texels

    def _prepare_ground(self, placement: CameraPlacement) -> None:
        for band in self._bands[_FINEST_PREPARED_LEVEL:]:
            first_x, first_y = band.first_tile(placement)
            for index in range(band.tiles**2 if self._ground.has_room(band.level) else 0):
                self._ground.tile(band.level, first_x + index % band.tiles, first_y + index // band.tiles)

    def _add_haze(self) -> None:
        rows = self._canvas[self._bands[-1].first_row :][: len(self._haze_factor)]
        if len(rows):
            cv2.multiply(rows, self._haze_factor, rows, 1 / 255)
            cv2.add(rows, self._haze, rows)

    def _apply_roll(self, level_picture: Picture) -> Picture:
        model = self._model
        level_from_picture = np.empty((2, 3))
        level_from_picture[:, :2] = roll_matrix(-model.roll_rad)
        level_from_picture[:, 2] = np.array(principal_point(self._level_model)) - level_from_picture[:, :2] @ np.array(
            principal_point(model)
        )
        flags = cv2.WARP_INVERSE_MAP | cv2.INTER_LINEAR
        rolled = cv2.warpAffine(level_picture, level_from_picture, (model.width_px, model.height_px), flags=flags)
        return np.asarray(rolled, dtype=np.uint8)

    def _blur_near(self, placements: Sequence[CameraPlacement]) -> None:
        rows = self._canvas[self._bands[_NEAR_BANDS].end_row :]
        total = np.zeros(rows.shape, dtype=np.uint16)
        for placement in placements:
            homography = placement.ground_from_picture()
            for band in self._bands[:_NEAR_BANDS]:
                self._warp(band, placement, homography)
            total += rows
        rows[:] = (total + len(placements) // 2) // len(placements)

    def _motion_px(self, begin: Pose, end: Pose, row: int) -> float:
        """Return the movement in the picture of the ends of a row, or that of the horizon if it is larger."""
        model = self._level_model
        first, last = place_camera(model, begin), place_camera(model, end)
        pixels = np.array([[0.0, row, 1.0], [model.width_px - 1.0, row, 1.0]])
        ground = pixels @ first.ground_from_picture().T
        turned_px = model.focal_px * abs(math.remainder(end.heading_rad - begin.heading_rad, 2 * math.pi))
        if (ground[:, 2] <= 0.0).any():
            return turned_px  # the row is above the horizon
        points_m = np.column_stack([ground[:, :2] / ground[:, 2:], np.zeros(2)])
        return max(float(np.hypot(*(last.project(points_m) - pixels)[:, :2].T).max()), turned_px)

    def _add_noise(self, picture: Picture, number: int) -> None:
        down, right = self._noise_places.at(number).integers(0, _NOISE_MARGIN_PX, 2).tolist()
        part = np.s_[down : down + self._model.height_px, right : right + self._model.width_px]
        if self._headlights is not None:
            deviation = self._headlights.noise_deviation(_NOISE_DEVIATION)[picture]
            noise = _unit_noise(self._model)[part] * deviation
            picture[:] = np.clip(np.rint(picture + noise), 0, 255)
            return
        cv2.add(picture, self._positive_noise[part], picture)
        cv2.subtract(picture, self._negative_noise[part], picture)


@lru_cache(maxsize=1)  # the tiles of one road take up to 394 MB
def world(
    road: Road, scenery: SceneryKind, light_name: LightName, weather_name: WeatherName
) -> tuple[Ground, Scenery | None]:
    """Return a road's ground and scenery, cached for consecutive runs of a sweep."""
    weather = WEATHERS[weather_name]
    light = weather.light(light_name)
    if scenery == "none":
        return Ground(road, light, None, weather), None
    objects = place_roadside_objects(road, full_scenery=scenery == "full")
    shadows = Shadows(objects, light, clouds=scenery == "full" and light.clouds_shade) if light.shadows else None
    return Ground(road, light, shadows, weather), Scenery(objects, light, weather.haze_m)


def _part_count(moved_px: float, limit: int) -> int:
    return min(max(math.ceil(moved_px / _MAX_STEP_PX), 1), limit)


def _interpolate_pose(begin: Pose, end: Pose, share: float) -> Pose:
    turn_rad = math.remainder(end.heading_rad - begin.heading_rad, 2 * math.pi)
    return Pose(
        begin.mono_ns + round((end.mono_ns - begin.mono_ns) * share),
        begin.x_m + (end.x_m - begin.x_m) * share,
        begin.y_m + (end.y_m - begin.y_m) * share,
        begin.heading_rad + turn_rad * share,
    )


def _haze(model: CameraModel, bands: tuple[Band, ...], colour: Colour, weather: Weather) -> tuple[Picture, Picture]:
    """Return the haze of the ground's first rows: factor of colours (255ths) and added colour, (rows, columns, 4) each.

    In rain and fog these are all rows of the ground.
    """
    if weather.extinction_per_m:
        distance_m = slant_distance_m(model)[bands[-1].first_row :]
        return _haze_of_shares(1.0 - np.exp(-distance_m / weather.haze_m), colour)
    rows = np.arange(bands[-1].first_row, bands[1].first_row)
    angle_rad = np.arctan((rows - (model.height_px - 1) / 2) / model.focal_px) + model.pitch_rad
    depth_m = model.z_m / np.maximum(np.tan(angle_rad), 1e-6)
    shares = 1.0 - np.exp(-np.maximum(depth_m - HAZE_BEGIN_M, 0.0) / HAZE_M)
    return _haze_of_shares(np.broadcast_to(shares[:, None], (len(rows), model.width_px)), colour)


def _haze_of_shares(shares: FloatArray, colour: Colour) -> tuple[Picture, Picture]:
    """Return the factor of colours (255ths) and the added colour, (rows, columns, 4) each, of shares of haze."""
    share = np.repeat(shares[..., None], 4, axis=2)
    added = share * np.array([*colour, 0.0])
    return np.rint(255.0 * (1 - share)).astype(np.uint8), np.rint(added).astype(np.uint8)


@lru_cache(maxsize=1)
def _noise(model: CameraModel) -> tuple[Picture, Picture]:
    """Return positive and negative sensor noise, both larger than a picture. Each frame uses a random part of them."""
    noise = np.rint(_standard_normal(model) * _NOISE_DEVIATION)
    return np.clip(noise, 0, 255).astype(np.uint8), np.clip(-noise, 0, 255).astype(np.uint8)


@lru_cache(maxsize=1)
def _unit_noise(model: CameraModel) -> NDArray[np.float32]:
    """Return noise of deviation 1, larger than a picture, for noise that depends on the brightness."""
    return _standard_normal(model).astype(np.float32)


def _standard_normal(model: CameraModel) -> FloatArray:
    size = (model.height_px + _NOISE_MARGIN_PX, model.width_px + _NOISE_MARGIN_PX, 3)
    return stream(0, "sensor noise bank").standard_normal(size)
