from pathlib import Path

import cv2
import numpy as np
import pytest
from tests.support.command_line import Run

from lavt.config import RunConfig, VehicleConfig
from lavt.domain import CameraModel
from lavt.errors import UserError
from lavt.experiment.runs.plan import plan_run
from lavt.vehicle.sim.rendering.drawing import VIEWS, draw_road
from lavt.vehicle.sim.road.road import load_road

BEND = """
title: Test bend
segments: [{length_m: 20}, {length_m: 30, end_curvature_per_m: 0.02}]
rails: [{offset_m: -4, kind: barrier, to_m: 30}]
"""


ASPHALT_BGR, GRASS_BGR = (0x96, 0x90, 0x8D), (0xD5, 0xE8, 0xDF)


@pytest.fixture
def bend(tmp_path: Path) -> Path:
    path = tmp_path / "bend.yaml"
    path.write_text(BEND)
    return path


def test_a_custom_road_is_drawn(run: Run, bend: Path, tmp_path: Path) -> None:
    """`lavt road draw FILE --out PNG` writes a picture with asphalt and grass, and prints its path."""
    out = tmp_path / "new" / "bend.png"
    code, printed, _ = run("road", "draw", str(bend), "--out", str(out))
    assert (code, str(out) in printed) == (0, True)
    picture = cv2.imread(str(out))
    assert picture is not None
    for colour in (ASPHALT_BGR, GRASS_BGR):
        assert (np.abs(picture.astype(int) - colour).max(axis=-1) < 3).sum() > 1000


def test_a_drawing_has_a_map_the_curvature_and_views() -> None:
    """The map is to scale and shows the whole road, the curvature is the road's, and the views are camera pictures."""
    road = load_road("a_key")
    figure = draw_road(road, model=CameraModel(), scenery="none")
    overview, detail, curvature, *views = figure.axes
    assert overview.get_aspect() == detail.get_aspect() == 1.0
    (low_x, high_x), (low_y, high_y) = overview.get_xlim(), overview.get_ylim()
    centre_points = road.point_at(np.linspace(0.0, road.route_length_m, 50), 0.0)
    assert ((centre_points > (low_x, low_y)) & (centre_points < (high_x, high_y))).all()
    (stations_m, curvatures_per_m) = curvature.lines[0].get_data(orig=True)
    assert np.asarray(curvatures_per_m) == pytest.approx(road.centre_at(np.asarray(stations_m)).curvature_per_m)
    assert len(views) == VIEWS
    assert [axes.images[0].get_size() for axes in views] == [(480, 640)] * VIEWS


@pytest.mark.parametrize(("arguments", "reason"), [(["nowhere"], "'nowhere'"), (["a_key", "--out", "x.jpg"], ".png")])
def test_bad_input(run: Run, arguments: list[str], reason: str) -> None:
    """An unknown road, or an output file that is not a PNG, is rejected."""
    assert reason in run("road", "draw", *arguments).rejection()


def test_a_run_accepts_the_path_of_a_road(bend: Path) -> None:
    """`vehicle.route` may be a path, and a file that is not a road is rejected before the run starts."""
    planned = plan_run(RunConfig(vehicle=VehicleConfig(route=str(bend))))
    assert planned.identity["route"] == str(bend)
    bend.write_text("title: x")
    with pytest.raises(UserError, match="'segments'"):
        plan_run(RunConfig(vehicle=VehicleConfig(route=str(bend), scenery="none")))
