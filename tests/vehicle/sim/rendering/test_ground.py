from __future__ import annotations

import numpy as np
import pytest

from lavt.domain import FloatArray
from lavt.vehicle.sim.rendering.ground import TILE_M, Ground
from lavt.vehicle.sim.rendering.light import LIGHTS
from lavt.vehicle.sim.rendering.textures import SCALES_M
from lavt.vehicle.sim.road.road import Road, parse_road

BEND = """
title: a bend
segments: [{length_m: 70, curvature_per_m: 0.02}]
lanes: {widths_m: [8]}
marks: [{offset_m: 2, kind: broken, dash_m: 60, gap_m: 10, width_m: WIDTH}]
"""


def brightness(road: Road, s_m: FloatArray, offset_m: float, level: int) -> FloatArray:
    """Return the brightness of the texels at stations and an offset."""
    ground = Ground(road, LIGHTS["noon"], None)
    brightnesses = []
    for x_m, y_m in road.point_at(s_m, offset_m).tolist():
        column, row = int(x_m // TILE_M[level]), int(y_m // TILE_M[level])
        tile = ground.tile(level, column, row)
        texel = tile[int(y_m % TILE_M[level] / SCALES_M[level]), int(x_m % TILE_M[level] / SCALES_M[level])]
        brightnesses.append(float(texel.mean()))
    return np.array(brightnesses)


def test_a_long_dash_bends_with_the_road() -> None:
    """A dash of 60 m in a bend of 50 m radius is painted at the mark's offset along its whole length."""
    road = parse_road(BEND.replace("WIDTH", "0.3"), source="x")
    s_m = np.arange(2.0, 58.0, 0.5)
    painted, bare = brightness(road, s_m, 2.0, 1), brightness(road, s_m, 0.0, 1)
    assert np.mean(painted > bare + 40) > 0.95


@pytest.mark.parametrize(("width_m", "share"), [(0.125, 0.125 * 1.3 / 0.32), (1.2, 1.0)])
def test_a_distant_mark_fades_with_its_width(width_m: float, share: float) -> None:
    """At 32 cm per texel a line thinner than a texel is fainter in proportion; a wide line keeps its brightness."""
    road = parse_road(BEND.replace("WIDTH", str(width_m)), source="x")
    s_m = np.arange(2.0, 58.0, 0.5)
    near, far = (
        np.median(brightness(road, s_m, 2.0, level)) - np.median(brightness(road, s_m, 0.0, level)) for level in (0, 4)
    )
    assert far / near == pytest.approx(share, abs=0.15)


def test_a_mark_follows_its_changing_offset() -> None:
    """A mark whose offset changes from 2 to 0 m is painted half-way at 1 m, and asphalt ends where it narrows."""
    text = """
title: taper
segments: [{length_m: 60}]
paved: [{left_m: 6, right_m: -2, from_m: -20, to_m: 60, to_left_m: 2}, {left_m: 2, right_m: -2, from_m: 60}]
marks: [{offset_m: 2, from_m: 10, to_m: 50, to_offset_m: 0, width_m: 0.3}]
"""
    road = parse_road(text, source="x")
    there, before, after = (brightness(road, np.array([s_m]), 1.0, 1)[0] for s_m in (30.0, 20.0, 40.0))
    assert there > max(before, after) + 40
    strip = road.paved[0]
    assert [strip.contains(20.0, offset_m) for offset_m in (3.9, 4.1)] == [True, False]
