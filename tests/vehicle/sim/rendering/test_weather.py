"""Tests of pictures in every weather."""

from __future__ import annotations

import math

import numpy as np
import pytest
from tests.vehicle.sim.rig import MODEL, camera_on, digest, picture_of, pose_at

from lavt.domain import NS_PER_S, CameraModel, FloatArray, Picture
from lavt.perception.lane_detector import LaneDetector
from lavt.vehicle.sim.rendering.pinhole import place_camera
from lavt.vehicle.sim.rendering.weather import (
    FOG_VISIBILITY_M,
    RAIN_MMPH,
    WEATHERS,
    WeatherName,
    rain_extinction_per_m,
    worn_paint,
)
from lavt.vehicle.sim.rendering.weather_optics import (
    WIPE_NS,
    Headlights,
    Windscreen,
    fresnel,
    lamp_lux,
    slant_distance_m,
)
from lavt.vehicle.sim.road.road import Road, load_road

WEATHER_NAMES: tuple[WeatherName, ...] = ("clear", "wet", "rain", "fog", "night", "worn")
AT_NS = NS_PER_S // 2


@pytest.fixture(scope="module")
def road() -> Road:
    return load_road("a_key")


@pytest.fixture(scope="module")
def pictures(road: Road) -> dict[str, Picture]:
    """Return the view from the start in each weather."""
    pose = pose_at(road, 0.0, mono_ns=AT_NS)
    return {
        weather: picture_of(camera_on(road, light="overcast", scenery="none", weather=weather), pose, 5)
        for weather in WEATHER_NAMES
    }


def ground_grey(picture: Picture, road: Road, ahead_m: float, left_m: float) -> float:
    """Return the mean grey of a piece of ground, ahead of the car's start and left of the lane's centre."""
    place = place_camera(MODEL, pose_at(road, 0.0))
    stations_m = np.linspace(ahead_m - 0.4, ahead_m + 0.4, 9)
    points_m = road.point_at(stations_m, left_m)
    u_px, v_px, _ = place.project(np.column_stack([points_m, np.zeros(len(points_m))])).T
    columns, rows = np.rint(u_px).astype(int), np.rint(v_px).astype(int)
    return float(
        np.mean([picture[row, column - 3 : column + 4].mean() for row, column in zip(rows, columns, strict=True)])
    )


def test_the_default_is_clear_weather(road: Road, pictures: dict[str, Picture]) -> None:
    """Without a weather, a camera's pictures are byte-for-byte those of clear weather."""
    camera = camera_on(road, light="overcast", scenery="none")
    assert digest(picture_of(camera, pose_at(road, 0.0, mono_ns=AT_NS), 5)) == digest(pictures["clear"])


@pytest.mark.parametrize("weather", WEATHER_NAMES[1:])
def test_a_picture_in_bad_weather_is_reproducible(road: Road, pictures: dict[str, Picture], weather: str) -> None:
    """A camera that has seen other places gives the same picture of a weather again, which is not the clear one."""
    camera = camera_on(road, light="overcast", scenery="none", weather=weather)
    picture_of(camera, pose_at(road, 60.0, 0.4, 0.1, mono_ns=9 * NS_PER_S), 77)
    again = picture_of(camera, pose_at(road, 0.0, mono_ns=AT_NS), 5)
    assert digest(again) == digest(pictures[weather])
    assert digest(again) != digest(pictures["clear"])


def test_fog_hides_the_road_as_koschmieder_says(road: Road, pictures: dict[str, Picture]) -> None:
    """Fog multiplies the difference between asphalt and air by exp(-3.912 distance / visibility)."""
    air = pictures["fog"][100:200].mean()
    for ahead_m in (6.0, 12.0):
        seen_m = math.hypot(ahead_m - MODEL.x_m, MODEL.z_m)
        clear, fog = (air - ground_grey(pictures[name], road, ahead_m, 0.0) for name in ("clear", "fog"))
        assert fog / clear == pytest.approx(math.exp(-3.912 * seen_m / FOG_VISIBILITY_M), abs=0.04)


def test_no_mark_is_visible_far_beyond_the_visibility(pictures: dict[str, Picture]) -> None:
    """In fog, the picture above the horizon is of one colour, apart from the sensor's noise."""
    assert pictures["fog"][60:230].std(axis=(0, 1)).max() < 3.0


def test_wet_asphalt_is_dark_near_the_car_and_mirrors_the_sky(road: Road, pictures: dict[str, Picture]) -> None:
    """Wet asphalt is darker than dry asphalt near the car, and brighter far away, where the water mirrors the sky."""
    ratios = [
        ground_grey(pictures["wet"], road, m, 0.0) / ground_grey(pictures["clear"], road, m, 0.0) for m in (4.0, 20.0)
    ]
    assert ratios[0] < 0.75
    assert ratios[1] > 1.0


def test_water_reflects_as_fresnel_says() -> None:
    """Water reflects 2 % of perpendicular light and all of grazing light."""
    assert fresnel(np.array([1.0, 0.0])) == pytest.approx([0.0204, 1.0], abs=1e-3)


def test_heavy_rain_hardly_hides_the_road() -> None:
    """The drops in the air of heavy rain take less than a twentieth of the contrast at 15 m."""
    assert 0.95 < math.exp(-rain_extinction_per_m(RAIN_MMPH) * 15.0) < 0.97


def test_the_wiper_removes_drops() -> None:
    """Drops collect on the windscreen until the wiper removes them; other seeds give other drops."""
    screen = Windscreen(MODEL, RAIN_MMPH, seed=1)
    just_wiped, half, full = (screen.cover(NS_PER_S + ns).mean() for ns in (0, NS_PER_S // 2, NS_PER_S - 1))
    assert just_wiped < 0.1 < half < full
    other = Windscreen(MODEL, RAIN_MMPH, seed=2)
    assert (other.cover(AT_NS) != screen.cover(AT_NS)).any()


def test_a_picture_in_rain_shows_the_drops(road: Road) -> None:
    """Two pictures from one place with the same noise differ where drops have arrived in the meantime."""
    camera = camera_on(road, light="overcast", scenery="none", weather="rain")
    wiped, later = (
        picture_of(camera, pose_at(road, 0.0, mono_ns=at_ns), 5).astype(int) for at_ns in (WIPE_NS, 2 * WIPE_NS - 1)
    )
    assert (wiped != later).any()


def test_headlights_fade_with_the_distance_and_to_the_sides() -> None:
    """The lamps' light on the ground falls with the distance and with the angle, and is 0 behind them."""

    def lux(ahead_m: float, left_m: float = 0.0) -> float:
        return float(lamp_lux(np.array([ahead_m, left_m])))

    assert lux(10.0) > lux(20.0) > lux(40.0) > 0
    assert lux(10.0) > lux(10.0, 3.0) == pytest.approx(lux(10.0, -3.0))
    assert lux(-2.0) == lux(100.0) == 0  # behind the lamps, and above the cut-off
    # At 21.7 m the light falls by 1.72 degrees, where each lamp has 2500 cd.
    assert lux(0.65 / math.tan(math.radians(1.72))) == pytest.approx(2 * 2500 / 21.66**2, rel=0.01)


def test_night_is_dark_and_noisy(pictures: dict[str, Picture]) -> None:
    """At night everything above the horizon is dark, and the noise grows with the signal."""
    assert pictures["night"][:200].mean() < 3.0
    deviation = Headlights(MODEL).noise_deviation(2.2)
    assert deviation[0] == pytest.approx(2.2)
    assert deviation[200] > 2 * deviation[0]


def test_worn_marks_have_lost_half_of_their_paint() -> None:
    """The pattern of worn paint has the configured share at every scale."""
    for pattern in worn_paint(0.5):
        assert float(pattern.mean()) == pytest.approx(127.5, abs=2.0)


@pytest.mark.parametrize("weather", ["clear", "wet", "rain", "worn"])
def test_the_lane_is_found_in_weather_that_does_not_matter(pictures: dict[str, Picture], weather: str) -> None:
    """Rain, water and worn paint leave enough of the marks for the detector."""
    assert LaneDetector(MODEL).detect(pictures[weather]).confidence > 0.4


def test_distances_to_the_ground_are_those_of_a_pinhole() -> None:
    """The distance of a pixel is that to the ground it shows, and infinite above the horizon."""
    pitched = CameraModel(pitch_rad=0.05)
    distance_m: FloatArray = slant_distance_m(pitched)
    place = place_camera(pitched, pose_at(load_road("straight"), 0.0))
    ground = place.ground_from_picture() @ np.array([100.0, 400.0, 1.0])
    x_m, y_m = ground[:2] / ground[2]
    expected_m = math.hypot(x_m - place.x_m, y_m - place.y_m, pitched.z_m)
    assert distance_m[400, 100] == pytest.approx(expected_m)
    assert np.isinf(distance_m[0]).all()


def test_all_weathers_are_tested() -> None:
    """This file tests every weather of the table."""
    assert set(WEATHERS) == set(WEATHER_NAMES)
