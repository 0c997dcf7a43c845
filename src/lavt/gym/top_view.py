"""A view from above: the true lane, the car, and the lane that the client saw, where the client believes it to be."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from lavt.domain import FloatArray, GroundTruth, Lane
from lavt.nodes.payloads import Route
from lavt.vehicle.sim.dynamics import LINCOLN_MKZ

SIZE_PX = 400
PX_PER_M = 8.0
CAR_PX = (200.0, 320.0)
"""Where the rear axle is in the picture, from the left and from the top; the car looks up."""
SHOWN_M = 60.0
LANE_M = 3.5
GRASS, ROAD, CAR, SEEN = (88, 124, 70), (96, 96, 96), (235, 235, 235), (255, 176, 0)
"""The colours: red, green, blue."""


def draw_top_view(route: Route | None, truth: GroundTruth | None, lane: Lane) -> NDArray[np.uint8]:
    """Return the view as (400, 400, 3): red, green, blue.

    The seen lane is drawn in the frame of the car's present pose. So its distance from the true lane shows by how much
    the car has moved since the picture.
    """
    picture = np.full((SIZE_PX, SIZE_PX, 3), GRASS, np.uint8)
    if route is not None and truth is not None:
        points_m = np.array(route.points) - (truth.x_m, truth.y_m)
        cosine, sine = np.cos(truth.heading_rad), np.sin(truth.heading_rad)
        ahead_m, left_m = points_m @ (cosine, sine), points_m @ (-sine, cosine)
        shown = np.hypot(ahead_m, left_m) < SHOWN_M
        for part in np.split(np.flatnonzero(shown), np.flatnonzero(np.diff(np.flatnonzero(shown)) > 1) + 1):
            _draw_line(picture, ahead_m[part], left_m[part], ROAD, LANE_M)
    car = LINCOLN_MKZ
    middle_m = (car.rear_axle_to_front_m - car.rear_axle_to_rear_m) / 2
    half_m = (car.rear_axle_to_front_m + car.rear_axle_to_rear_m - car.body_width_m) / 2
    ends_m = np.array([middle_m - half_m, middle_m + half_m])
    _draw_line(picture, ends_m, np.zeros(2), CAR, car.body_width_m)
    x_m = np.linspace(lane.near_m, lane.far_m, 20)
    c0, c1, c2 = lane.centre
    _draw_line(picture, x_m, c0 + (c1 + c2 * x_m) * x_m, SEEN, 0.25)
    return picture


def _draw_line(
    picture: NDArray[np.uint8], ahead_m: FloatArray, left_m: FloatArray, colour: tuple[int, int, int], width_m: float
) -> None:
    """Draw a line through points that are given as metres ahead of the rear axle and to its left."""
    points_px = np.stack([CAR_PX[0] - left_m * PX_PER_M, CAR_PX[1] - ahead_m * PX_PER_M], axis=1)
    if len(points_px) and np.isfinite(points_px).all():
        corners = np.rint(np.clip(points_px, -2000, 2000)).astype(np.int32)
        cv2.polylines(picture, [corners], False, colour, max(1, round(width_m * PX_PER_M)), cv2.LINE_AA)
