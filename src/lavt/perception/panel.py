"""The panel: all steps of lane detection in a picture, drawn side by side for inspection."""

from __future__ import annotations

import math
from itertools import pairwise

import cv2
import numpy as np

from lavt.domain import FloatArray, Lane, Picture
from lavt.perception.bird_eye import BirdEye, GroundGrid
from lavt.perception.calibration import CalibratedCamera, ground_to_picture, picture_points
from lavt.perception.detection import TRACK_CONFIDENCE, PictureDetector
from lavt.perception.lane_detector import DetectionTrace, LaneDetector
from lavt.perception.lane_fit import CORRIDOR_M
from lavt.perception.lane_paint import brightness_of, white_paint, yellow_paint, yellowness_of
from lavt.perception.lane_search import WINDOW_M

TILE_PX = (640, 480)
"""Width and height of a step's tile, below a line of text."""
TEXT_WIDTH_PX = 400
"""The width of a tile for which text is drawn at its smallest size; it grows with the tile."""
LABEL_PX = 24
COLUMNS = 4
LEFT, RIGHT, OTHER, CENTRE, EXPECTED = (80, 200, 80), (230, 150, 60), (120, 120, 120), (60, 60, 255), (60, 220, 255)
"""Colours (blue, green, red) of the left and right line's points, other points, the centre, and the expected lines."""


def draw_panel(
    camera: CalibratedCamera,
    detector: PictureDetector,
    picture: Picture,
    lane: Lane,
    tile_px: tuple[int, int] = TILE_PX,
    *,
    lane_confidence: float = TRACK_CONFIDENCE,
) -> Picture:
    """Return a drawing of the steps by which a detector just found a lane: up to 3 rows and 4 columns of tiles.

    A lane with less than `lane_confidence` counts as none.

    Of a detector that is not LAVT's own, only the picture and the lane are known.
    """
    trace = detector.trace if isinstance(detector, LaneDetector) else None
    tiles = {"picture": picture}
    if isinstance(detector, LaneDetector) and trace is not None:
        bird_eye = detector.bird_eye
        view = bird_eye.view_from_above(bird_eye.region(picture))
        tiles["undistorted, with the searched ground"] = _draw_ground_outline(camera, picture, bird_eye.grid)
        tiles["bird's-eye view, far end at the top"] = view
        if detector.finds_paint_itself:
            tiles |= {
                "brightness": _grey_to_colour(brightness_of(view)),
                "white: brighter than both sides": _grey_to_colour(white_paint(view, bird_eye.grid)),
                "yellowness": _grey_to_colour(yellowness_of(view)),
                "yellow: yellower than both sides": _grey_to_colour(yellow_paint(view, bird_eye.grid)),
            }
        tiles |= {
            "paint": _grey_to_colour(trace.mask),
            "points: left, right, other": _draw_points(trace, bird_eye.grid),
            "fitted lane": _draw_fit(trace, lane, bird_eye),
        }
    tiles["lane in the picture"] = draw_lane(camera, picture, lane, lane_confidence)
    tiles["confidence"] = _confidence_text(trace, lane, tile_px, lane_confidence)
    drawn = [_make_tile(f"{number} {label}", tile, tile_px) for number, (label, tile) in enumerate(tiles.items(), 1)]
    columns = min(COLUMNS, len(drawn))
    drawn += [np.zeros_like(drawn[0])] * (-len(drawn) % columns)
    return np.vstack([np.hstack(drawn[start : start + columns]) for start in range(0, len(drawn), columns)])


def _write(drawn: Picture, text: str, at_px: tuple[int, int], colour: tuple[int, int, int], width_px: int) -> None:
    """Write a line of text, at a position for a tile of `TEXT_WIDTH_PX`, onto a tile of `width_px`."""
    scale = width_px / TEXT_WIDTH_PX
    left, base = round(at_px[0] * scale), round(at_px[1] * scale)
    thickness = max(round(scale), 1)
    cv2.putText(drawn, text, (left, base), cv2.FONT_HERSHEY_SIMPLEX, 0.5 * scale, colour, thickness, cv2.LINE_AA)


def _make_tile(label: str, tile: Picture, tile_px: tuple[int, int]) -> Picture:
    """Return a tile with a picture scaled to fit and its label above."""
    width, height = tile_px
    label_px = round(LABEL_PX * width / TEXT_WIDTH_PX)
    factor = min(width / tile.shape[1], height / tile.shape[0])
    scaled_width, scaled_height = max(round(tile.shape[1] * factor), 1), max(round(tile.shape[0] * factor), 1)
    interpolation = cv2.INTER_AREA if factor < 1 else cv2.INTER_NEAREST
    scaled = cv2.resize(tile, (scaled_width, scaled_height), interpolation=interpolation)
    whole = np.full((height + label_px, width, 3), 30, dtype=np.uint8)
    left, top = (width - scaled_width) // 2, label_px + (height - scaled_height) // 2
    whole[top : top + scaled_height, left : left + scaled_width] = scaled
    _write(whole, label, (6, 17), (255, 255, 255), width)
    return whole


def _grey_to_colour(grey: Picture) -> Picture:
    return np.asarray(cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR), dtype=np.uint8)


def _draw_ground_outline(camera: CalibratedCamera, picture: Picture, grid: GroundGrid) -> Picture:
    """Return the undistorted picture with an outline of the grid."""
    undistorted, coefficients = picture.copy(), np.array(camera.distortion)
    if camera.distortion:
        size, matrix = (camera.width_px, camera.height_px), camera.camera_matrix
        make_maps = cv2.fisheye.initUndistortRectifyMap if camera.fisheye else cv2.initUndistortRectifyMap
        maps = make_maps(matrix, coefficients, np.eye(3), matrix, size, cv2.CV_16SC2)
        undistorted = np.asarray(cv2.remap(picture, *maps, cv2.INTER_LINEAR), dtype=np.uint8)
    near, far, side = grid.near_m, grid.far_m, grid.half_width_m
    corners = np.array([[near, side], [far, side], [far, -side], [near, -side], [near, side]])
    rim = np.concatenate([np.linspace(a, b, 60) for a, b in pairwise(corners)])
    outline = np.column_stack([rim, np.ones(len(rim))]) @ ground_to_picture(camera).T
    outline = outline[outline[:, 2] > 0.1]
    _draw_curve(undistorted, outline[:, :2] / outline[:, 2:], EXPECTED)
    return undistorted


def _draw_curve(picture: Picture, pixels: FloatArray, colour: tuple[int, int, int], thickness: int = 2) -> None:
    """Draw a line through the points (n, 2) that are near the picture."""
    limit = 4 * max(picture.shape)
    near = np.isfinite(pixels).all(axis=1) & (np.abs(np.nan_to_num(pixels)) < limit).all(axis=1)
    cv2.polylines(picture, [np.round(pixels[near]).astype(np.int32)], False, colour, thickness, cv2.LINE_AA)


def _cells(points: FloatArray, grid: GroundGrid) -> FloatArray:
    """Return ground points (n, 2) as (column, row) of the grid."""
    columns = (grid.half_width_m - points[:, 1]) / grid.step_y_m - 0.5
    return np.column_stack([columns, (grid.far_m - points[:, 0]) / grid.step_x_m - 0.5])


def _parallel_line(centre: tuple[float, float, float], offset_m: float, near_m: float, far_m: float) -> FloatArray:
    """Return ground points (n, 2) along the parallel of a centre, `offset_m` to its left."""
    c0, c1, c2 = centre
    x = np.linspace(near_m, far_m, 60)
    slope = c1 + 2 * c2 * x
    to_the_left = np.column_stack([-slope, np.ones_like(slope)]) / np.hypot(slope, 1.0)[:, None]
    return np.column_stack([x, c0 + (c1 + c2 * x) * x]) + offset_m * to_the_left


def _draw_points(trace: DetectionTrace, grid: GroundGrid) -> Picture:
    """Return a drawing of the points by side, with the windows or corridors of the search."""
    drawn = np.zeros((*trace.mask.shape, 3), dtype=np.uint8)
    cells = np.round(_cells(np.column_stack([trace.points.x_m, trace.points.y_m]), grid)).astype(int)
    palette = np.array([OTHER, LEFT, RIGHT], dtype=np.uint8)  # by side: 0, 1, -1
    drawn[cells[:, 1], cells[:, 0]] = palette[trace.sides]
    if trace.expected is None:
        return drawn
    if not trace.windows:
        for side in (1, -1):
            for rim_m in (-CORRIDOR_M, CORRIDOR_M):
                line = _parallel_line(
                    trace.expected, side * trace.expected_width_m / 2 + rim_m, grid.near_m, grid.far_m
                )
                _draw_curve(drawn, _cells(line, grid), EXPECTED, 1)
    length_m, half_width_m = WINDOW_M
    c0, c1, c2 = trace.expected
    for low_m, offset_m in trace.windows:
        middle_m = low_m + length_m / 2
        for side in (1, -1):
            y_m = c0 + (c1 + c2 * middle_m) * middle_m + offset_m + side * trace.expected_width_m / 2
            box = np.array([[low_m, y_m + half_width_m], [low_m + length_m, y_m - half_width_m]])
            first, second = np.round(_cells(box, grid)).astype(int).tolist()
            cv2.rectangle(drawn, first, second, EXPECTED, 1)
    return drawn


def _draw_fit(trace: DetectionTrace, lane: Lane, bird_eye: BirdEye) -> Picture:
    """Return a drawing of the marks, the lane fitted to this picture alone, and the centre of the averaged lane."""
    drawn = _grey_to_colour(trace.mask // 2)
    if trace.fit is not None:
        for offset_m, colour in ((trace.fit.width_m / 2, LEFT), (-trace.fit.width_m / 2, RIGHT)):
            line = _parallel_line(trace.fit.centre, offset_m, trace.fit.near_m, trace.fit.far_m)
            _draw_curve(drawn, _cells(line, bird_eye.grid), colour, 1)
    if lane.confidence >= TRACK_CONFIDENCE:
        centre = _parallel_line(lane.centre, 0.0, bird_eye.grid.near_m, bird_eye.grid.far_m)
        _draw_curve(drawn, _cells(centre, bird_eye.grid), CENTRE, 1)
    return drawn


def draw_lane(
    camera: CalibratedCamera, picture: Picture, lane: Lane, lane_confidence: float = TRACK_CONFIDENCE
) -> Picture:
    """Return the picture with the lane drawn through the lens, unless its confidence is too low."""
    drawn = picture.copy()
    if lane.confidence < lane_confidence:
        return drawn
    left, right = (_parallel_line(lane.centre, side * lane.width_m / 2, lane.near_m, lane.far_m) for side in (1, -1))
    rim = picture_points(camera, np.concatenate([left, right[::-1]]))
    rim = rim[np.isfinite(rim).all(axis=1)]
    filled = drawn.copy()
    cv2.fillPoly(filled, [np.round(rim).astype(np.int32)], LEFT)
    cv2.addWeighted(filled, 0.35, drawn, 0.65, 0, drawn)
    for line, colour in ((left, LEFT), (right, RIGHT)):
        _draw_curve(drawn, picture_points(camera, line), colour)
    _draw_curve(drawn, picture_points(camera, _parallel_line(lane.centre, 0.0, lane.near_m, lane.far_m)), CENTRE)
    return drawn


def _confidence_text(
    trace: DetectionTrace | None, lane: Lane, tile_px: tuple[int, int], lane_confidence: float
) -> Picture:
    """Return a tile with the confidence and its components as text."""
    drawn = np.full((tile_px[1], tile_px[0], 3), 30, dtype=np.uint8)
    has_lane = lane.confidence >= lane_confidence
    lines = [f"confidence {lane.confidence:.2f}: " + ("a lane" if has_lane else f"no lane (below {lane_confidence})")]
    if trace is not None:
        lines.append("searched with windows" if trace.is_search else "tracked from the last picture")
    if trace is not None and trace.fit is None:
        lines.append("no two clear parallel lines, or an impossible lane")
    elif trace is not None and trace.fit is not None:
        fit = trace.fit
        lines += [
            f"left line visible {fit.left_visible:.2f}",
            f"right line visible {fit.right_visible:.2f}",
            f"share of paint on the lines {fit.on_line_share:.2f}",
        ]
    if has_lane:
        c0, c1, c2 = lane.centre
        lines += [
            f"width {lane.width_m:.2f} m",
            f"centre {abs(c0):.2f} m to the {'left' if c0 > 0 else 'right'}",
            f"turned {math.degrees(math.atan(c1)):+.1f} deg (left +)",
            f"curvature {2 * c2:+.4f} / m",
            f"visible from {lane.near_m:.1f} to {lane.far_m:.1f} m",
        ]
    for number, line in enumerate(lines):
        colour = (255, 255, 255) if number else ((120, 230, 120) if has_lane else (90, 90, 255))
        _write(drawn, line, (10, 28 + 25 * number), colour, tile_px[0])
    return drawn
