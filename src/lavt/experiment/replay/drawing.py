"""The drawing of a moment of a drive: the driver's picture, the road from above, and the cross-track error."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import cv2
import numpy as np

from lavt.domain import NS_PER_S, FloatArray, Lane, Picture
from lavt.experiment.replay.drive import ReplayDrive, Scene
from lavt.perception.calibration import CalibratedCamera
from lavt.perception.detection import TRACK_CONFIDENCE
from lavt.perception.panel import CENTRE, LEFT, draw_lane

Colour = tuple[int, int, int]
"""Blue, green, red."""

WIDTH_PX = 640
HEADER_PX, STATUS_PX, LOWER_PX = 60, 34, 220
MAP_PX = 260
"""Width of the road from above; the plot has the rest."""
GAP_PX = 8
FINER = 2
"""Maps and plots are drawn this many times larger and then scaled down, which makes their lines smooth."""

BACKGROUND, TILE, WHITE, GREY = (30, 27, 24), (46, 42, 38), (245, 245, 245), (160, 160, 160)
ROAD, LINE, TRAIL, CAR, RED, GREEN = (
    (84, 80, 76),
    (215, 215, 215),
    (80, 200, 255),
    (245, 245, 245),
    (90, 90, 255),
    (120, 210, 120),
)
KEY = (
    (LEFT, "the lane that the driver detected"),
    (CENTRE, "its centre, which the driver steers to"),
    (ROAD, "the lane of the route"),
    (TRAIL, "where the rear axle was"),
    (CAR, "the car now"),
)
"""The colours of a replay with their meanings."""
SHOWN_M = 55.0
"""Length of the road that the map shows."""
BEHIND_SHARE = 0.3
LANE_WIDTH_M = 3.5
"""Drawn if the run does not show the width of its lanes."""
CAR_M = (3.6, 0.9, 0.9)
"""Distance from the rear axle to the front and to the rear of the drawn car, and half its width."""
NO_LANE, SIGN_SIZE = "no lane detected", 1.5
EASY_STATES = {"driving", "completed"}


class Seen(NamedTuple):
    """What the driver saw at a moment: the picture, and the lane that it detected in this picture of this camera."""

    picture: Picture | None
    lane: Lane | None
    camera: CalibratedCamera | None


@dataclass(frozen=True, slots=True)
class ReplayLayout:
    """The panels and scales that all drives of a replay share."""

    has_pictures: bool
    has_truth: bool
    longest_s: float
    largest_error_m: float

    @property
    def height_px(self) -> int:
        """Height of a column."""
        picture_px = WIDTH_PX * 3 // 4 + GAP_PX if self.has_pictures else 0
        return HEADER_PX + picture_px + STATUS_PX + (LOWER_PX + GAP_PX if self.has_truth else 0)


def draw_columns(columns: Sequence[Picture], width_px: int | None = None) -> Picture:
    """Return columns of equal height side by side, with even sides, scaled to a width if one is given."""
    gap = _blank(columns[0].shape[0], GAP_PX, BACKGROUND)
    drawn = np.hstack([part for column in columns for part in (column, gap)][:-1])
    height, width, _ = drawn.shape
    factor = 1.0 if width_px is None else width_px / width
    size = (round(width * factor) // 2 * 2, round(height * factor) // 2 * 2)
    return np.asarray(cv2.resize(drawn, size, interpolation=cv2.INTER_AREA), np.uint8)


def draw_scene(drive: ReplayDrive, scene: Scene, layout: ReplayLayout, seen: Seen) -> Picture:
    """Return the column of one drive at one moment."""
    canvas = _blank(layout.height_px, WIDTH_PX, BACKGROUND)
    _write_header(canvas, drive, scene)
    top = HEADER_PX
    if layout.has_pictures:
        height = WIDTH_PX * 3 // 4
        canvas[top : top + height] = _picture_tile(seen, height)
        top += height + GAP_PX
    _write_status(canvas, drive, scene, top)
    top += STATUS_PX
    if layout.has_truth:
        canvas[top : top + LOWER_PX, :MAP_PX] = _draw_map(drive, scene)
        canvas[top : top + LOWER_PX, MAP_PX + GAP_PX :] = _draw_error(drive, scene, layout)
    return canvas


@cache
def _blank_original(height: int, width: int, colour: Colour) -> Picture:
    return np.full((height, width, 3), colour, np.uint8)


def _blank(height: int, width: int, colour: Colour) -> Picture:
    """Return a picture of one colour. Copying it is much faster than filling one (measured: 56 times)."""
    return _blank_original(height, width, colour).copy()


def _text(
    canvas: Picture,
    text: str,
    position: tuple[int, int],
    size: float = 0.6,
    colour: Colour = WHITE,
    *,
    right: bool = False,
) -> None:
    """Write a line of text; `position` is where its baseline begins or, with `right`, where it ends."""
    x, y = position
    weight = 2 if size > 0.7 else 1
    if right:
        x -= cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, size, weight)[0][0]
    cv2.putText(canvas, text, (x, y), cv2.FONT_HERSHEY_SIMPLEX, size, colour, weight, cv2.LINE_AA)


def _write_header(canvas: Picture, drive: ReplayDrive, scene: Scene) -> None:
    """Write the condition and its delays, and the age of the picture."""
    injected = drive.result.get("injected_ms") or {}
    _text(canvas, str(drive.result["condition"]), (10, 40), 1.1)
    _text(canvas, f"video + {injected.get('video', 0):g} ms", (84, 24), 0.55, GREY)
    _text(canvas, f"control + {injected.get('control', 0):g} ms", (84, 48), 0.55, GREY)
    age = "no command yet" if scene.frame_age_ms is None else f"{scene.frame_age_ms:.0f} ms"
    _text(canvas, "frame age", (WIDTH_PX - 10, 20), 0.5, GREY, right=True)
    _text(canvas, age, (WIDTH_PX - 10, 50), 0.9, right=True)


def _write_status(canvas: Picture, drive: ReplayDrive, scene: Scene, top: int) -> None:
    """Write the time, the speed, the cross-track error and the state."""
    _text(canvas, f"{scene.time_s:5.1f} s", (10, top + 22), 0.6, GREY)
    if scene.truth_index is not None:
        speed_mps = drive.truth.floats("speed_mps")[scene.truth_index]
        error_m = drive.truth.floats("cross_track_m")[scene.truth_index]
        _text(canvas, f"{speed_mps * 3.6:.0f} km/h", (110, top + 22), 0.6, GREY)
        side, colour = "left" if error_m >= 0 else "right", RED if abs(error_m) > lane_width_m(drive) / 2 else WHITE
        _text(canvas, f"{abs(error_m):.2f} m {side} of lane centre", (210, top + 22), 0.6, colour)
    colour = GREEN if scene.state in EASY_STATES else RED
    _text(canvas, scene.state, (WIDTH_PX - 10, top + 22), 0.6, colour, right=True)


def _picture_tile(seen: Seen, height: int) -> Picture:
    """Return the driver's picture with the detected lane, scaled to fit."""
    tile = _blank(height, WIDTH_PX, TILE)
    picture, lane, camera = seen
    if picture is None:
        _text(tile, "no picture", (WIDTH_PX // 2 - 50, height // 2), 0.6, GREY)
        return tile
    if lane is not None and camera is not None and picture.shape[:2] == (camera.height_px, camera.width_px):
        picture = draw_lane(camera, picture, lane)
    factor = min(WIDTH_PX / picture.shape[1], height / picture.shape[0])
    size = (round(picture.shape[1] * factor), round(picture.shape[0] * factor))
    scaled = picture if factor == 1 else cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
    left, top = (WIDTH_PX - size[0]) // 2, (height - size[1]) // 2
    tile[top : top + size[1], left : left + size[0]] = scaled
    if lane is not None and lane.confidence < TRACK_CONFIDENCE:
        _write_sign(tile, NO_LANE)
    return tile


def _write_sign(tile: Picture, text: str) -> None:
    """Write a large text on a dark ground near the lower edge of a tile."""
    (width, height), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, SIGN_SIZE, 2)
    x, y = (tile.shape[1] - width) // 2, tile.shape[0] - 40
    cv2.rectangle(tile, (x - 14, y - height - 14), (x + width + 14, y + 16), BACKGROUND, -1)
    _text(tile, text, (x, y), SIGN_SIZE, RED)


def lane_width_m(drive: ReplayDrive) -> float:
    """Return the width of the lanes of the drive's road, as its driver saw it."""
    kept = drive.result.get("lane_kept")
    return float(kept["lane_width_m"]) if kept else LANE_WIDTH_M


def _draw_map(drive: ReplayDrive, scene: Scene) -> Picture:
    """Return the road from above, with the direction of the road upwards, the car and where it has been."""
    width, height = MAP_PX * FINER, LOWER_PX * FINER
    tile = _blank(height, width, TILE)
    if scene.truth_index is None:
        return _smooth(tile)
    truth, now = drive.truth, scene.truth_index
    x_m, y_m, heading_rad = (truth.floats(name) for name in ("x_m", "y_m", "heading_rad"))
    up_rad = heading_rad[now] - np.nan_to_num(truth.floats("heading_error_rad")[now])
    ahead, left = np.array([np.cos(up_rad), np.sin(up_rad)]), np.array([-np.sin(up_rad), np.cos(up_rad)])
    scale = height / SHOWN_M
    origin_px = np.array([width / 2, height * (1 - BEHIND_SHARE)])
    position_m = np.array([x_m[now], y_m[now]])

    def pixels(points_m: FloatArray) -> FloatArray:
        relative_m = points_m - position_m
        return origin_px + np.column_stack([-(relative_m @ left), -(relative_m @ ahead)]) * scale

    near = np.hypot(*(drive.reference_m - position_m).T) < 2 * SHOWN_M
    lane_px = max(round(lane_width_m(drive) * scale), 1)
    _polyline(tile, pixels(drive.reference_m[near]), ROAD, lane_px)
    _polyline(tile, pixels(drive.reference_m[near]), GREY, 1)
    past = np.column_stack([x_m[: now + 1], y_m[: now + 1]])
    _polyline(tile, pixels(past[np.hypot(*(past - position_m).T) < 2 * SHOWN_M]), TRAIL, 2 * FINER)
    front_m, rear_m, side_m = CAR_M
    nose = np.array([np.cos(heading_rad[now]), np.sin(heading_rad[now])])
    side = np.array([-nose[1], nose[0]])
    corners = [
        position_m + along * nose + across * side_m * side
        for along, across in ((front_m, 1), (front_m, -1), (-rear_m, -1), (-rear_m, 1))
    ]
    cv2.fillPoly(tile, [np.round(pixels(np.array(corners))).astype(np.int32)], CAR, cv2.LINE_AA)
    return _smooth(tile)


def _draw_error(drive: ReplayDrive, scene: Scene, layout: ReplayLayout) -> Picture:
    """Return the plot of the cross-track error over the time of the drive, up to now; left is up."""
    width, height = (WIDTH_PX - MAP_PX - GAP_PX) * FINER, LOWER_PX * FINER
    tile = _blank(height, width, TILE)
    error_m = drive.truth.floats("cross_track_m")
    half_lane_m = lane_width_m(drive) / 2
    most_m = max(1.3 * half_lane_m, 1.1 * layout.largest_error_m)
    left_px, right_px, top_px, bottom_px = 14 * FINER, width - 14 * FINER, 30 * FINER, height - 14 * FINER

    def row(value_m: float | FloatArray) -> FloatArray:
        return np.asarray((top_px + bottom_px) / 2 - np.asarray(value_m) / most_m * (bottom_px - top_px) / 2)

    upper, lower = int(row(half_lane_m)), int(row(-half_lane_m))
    cv2.rectangle(tile, (left_px, upper), (right_px, lower), ROAD, -1)
    cv2.line(tile, (left_px, int(row(0.0))), (right_px, int(row(0.0))), GREY, 1)
    if scene.truth_index is not None:
        shown = np.arange(0, scene.truth_index + 1)
        time_s = (drive.truth.ints("mono_ns")[shown] - drive.began_ns) / NS_PER_S
        columns = left_px + time_s / layout.longest_s * (right_px - left_px)
        curve = np.column_stack([columns, row(error_m[shown])])
        _polyline(tile, curve, TRAIL, 2 * FINER)
        cv2.circle(tile, tuple(np.round(curve[-1]).astype(int).tolist()), 4 * FINER, CAR, -1, cv2.LINE_AA)
    small = _smooth(tile)
    _text(small, "distance from lane centre; grey: the lane", (12, 19), 0.45, GREY)
    return small


def _polyline(tile: Picture, pixels: FloatArray, colour: Colour, thickness: int) -> None:
    finite = pixels[np.isfinite(pixels).all(axis=1)]
    if len(finite) > 1:
        cv2.polylines(tile, [np.round(finite).astype(np.int32)], False, colour, thickness, cv2.LINE_AA)


def _smooth(tile: Picture) -> Picture:
    """Return a tile at its final size."""
    size = (tile.shape[1] // FINER, tile.shape[0] // FINER)
    return np.asarray(cv2.resize(tile, size, interpolation=cv2.INTER_AREA), np.uint8)
