"""Tests of pictures in the three lights: noon, low sun and overcast."""

from __future__ import annotations

import subprocess
import sys
from functools import cache

import numpy as np
import pytest
from tests.vehicle.sim.rig import MODEL, camera_on, digest, picture_of, pose_at

from lavt.domain import FloatArray, Picture
from lavt.vehicle.sim.rendering import renderer
from lavt.vehicle.sim.rendering.light import LIGHTS, LightName
from lavt.vehicle.sim.rendering.pinhole import place_camera
from lavt.vehicle.sim.road.road import Road, load_road

LIGHT_NAMES: tuple[LightName, ...] = ("noon", "low_sun", "overcast")
RAIL_OFFSET_M, RAIL_HEIGHT_M = -9.15, 0.76


@pytest.fixture(scope="module")
def road() -> Road:
    return load_road("a_key")


@cache
def asphalt(light: LightName) -> FloatArray:
    """Return the mean colour (n, 3) of the driven lane just ahead of the car, for n positions of the car."""
    road = load_road("a_key")
    camera = camera_on(road, light=light)
    pictures = [picture_of(camera, pose_at(road, s_m)) for s_m in np.arange(2.0, road.route_length_m, 24.0)]
    return np.array([picture[420:470, 300:340].reshape(-1, 3).mean(axis=0) for picture in pictures])


def redness(colour_bgr: FloatArray) -> float:
    blue, _, red = colour_bgr.tolist()
    return float(red / blue)


def test_the_low_sun_is_warm_and_dark() -> None:
    """A low sun makes the road darker and redder than at noon; under clouds the road is not reddish."""
    noon, low, clouds = (np.median(asphalt(light), axis=0) for light in LIGHT_NAMES)
    assert low.mean() < 0.9 * noon.mean()
    assert redness(low) > 1.2 * redness(noon)
    assert redness(clouds) <= 1.0


def test_only_the_sun_casts_shadows() -> None:
    """With a low sun parts of the lane are in shade, about half as bright as the rest; under clouds no part is."""
    low, clouds = asphalt("low_sun").mean(axis=1), asphalt("overcast").mean(axis=1)
    assert low.min() < 0.55 * np.median(low)
    assert clouds.min() > 0.8 * np.median(clouds)


def grey_at(picture: Picture, road: Road, *, station_m: float, lateral_m: float, camera_station_m: float) -> float:
    """Return the brightness of a point of the ground in a picture that was taken at `camera_station_m`."""
    u_px, v_px, _ = place_camera(MODEL, pose_at(road, camera_station_m)).project(
        np.append(road.point_at(station_m, lateral_m), 0.0)
    )
    return float(picture[round(v_px) - 1 : round(v_px) + 2, round(u_px) - 2 : round(u_px) + 3].mean())


def test_a_rails_shadow_falls_away_from_the_sun(road: Road) -> None:
    """The ground beside the right rail is dark up to the shadow of the rail's top, and bright beyond."""
    camera = camera_on(road, light="low_sun", scenery="light")  # little scenery: neither trees nor buildings
    camera_station_m, station_m = 80.0, 88.0
    picture = picture_of(camera, pose_at(road, camera_station_m))
    centre, left_of_centre = road.point_at(station_m, [0.0, 1.0])
    left = left_of_centre - centre  # a unit vector, because the points are 1 m apart
    reach_m = RAIL_HEIGHT_M * float(LIGHTS["low_sun"].shadow_per_height @ left)
    assert reach_m > 3.0  # to the left: the sun is to the right here

    def grey_beside_rail(distance_m: float) -> float:
        lateral_m = RAIL_OFFSET_M + distance_m
        return grey_at(picture, road, station_m=station_m, lateral_m=lateral_m, camera_station_m=camera_station_m)

    assert grey_beside_rail(0.85 * reach_m) < 0.7 * grey_beside_rail(1.5 * reach_m)


@pytest.mark.parametrize("light", LIGHT_NAMES)
def test_marks_stand_out_in_every_light(road: Road, light: LightName) -> None:
    """In every light a solid mark is at least 1.5 times as bright as the asphalt beside it."""
    picture = picture_of(camera_on(road, light=light), pose_at(road, 0.0)).astype(np.uint8)
    mark_grey, asphalt_grey = (
        grey_at(picture, road, station_m=7.0, lateral_m=lateral_m, camera_station_m=0.0) for lateral_m in (-1.75, -1.2)
    )
    assert mark_grey > 1.5 * asphalt_grey


DIGEST = """
from tests.vehicle.sim.rig import camera_on, digest, picture_of, pose_at
from lavt.vehicle.sim.road.road import load_road
road = load_road("a_key")
print(digest(picture_of(camera_on(road, light="{light}"), pose_at(road, 70.0, 0.3, 0.1), 5)))
"""


@pytest.mark.full
@pytest.mark.parametrize("light", LIGHT_NAMES)
def test_a_frame_is_byte_for_byte_reproducible(road: Road, light: LightName) -> None:
    """Equal pose, number and seed give equal bytes with cold and warm caches, and in another process."""
    renderer.world.cache_clear()
    cold = digest(picture_of(camera_on(road, light=light), pose_at(road, 70.0, 0.3, 0.1), 5))
    warm_camera = camera_on(road, light=light)
    warm_camera.prepare()
    for s_m in (20.0, 95.0, 66.0):
        picture_of(warm_camera, pose_at(road, s_m, -2.0, -0.4))
    warm = digest(picture_of(warm_camera, pose_at(road, 70.0, 0.3, 0.1), 5))
    command = [sys.executable, "-c", DIGEST.format(light=light)]
    other_process = subprocess.run(command, capture_output=True, text=True, check=True, timeout=280).stdout.strip()
    assert cold == warm == other_process
