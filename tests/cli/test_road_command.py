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


HAMLET = Path(__file__).parents[1] / "opendrive" / "data" / "hamlet.xodr"


def test_a_road_is_imported_and_exported(run: Run, tmp_path: Path) -> None:
    """`lavt road import` writes a road file that can be loaded, and `lavt road export` writes it as a map again."""
    road, map_file = tmp_path / "new" / "hamlet.yaml", tmp_path / "hamlet.xodr"
    code, printed, notes = run("road", "import", str(HAMLET), "--from", "1,-1", "--to", "3,1", "--out", str(road))
    assert (code, notes) == (0, "")
    assert f"the road is {road}: 149.9 m" in printed
    assert load_road(str(road)).route_length_m == pytest.approx(149.9, abs=0.1)
    code, printed, _ = run("road", "export", str(road), "--out", str(map_file))
    assert (code, "road 1, lane -1, from s=20 m" in printed) == (0, True)
    assert run("road", "import", str(map_file), "--from", "1,-1", "--to", "1,-1", "--out", str(road)).code == 0


def test_ignored_content_of_a_map_is_named(run: Run, tmp_path: Path) -> None:
    """What an import ignores is said on standard error and in the road file."""
    path = tmp_path / "hills.xodr"
    hill = '<elevationProfile><elevation s="0" a="1" b="0" c="0" d="0"/></elevationProfile><lanes>'
    path.write_text(HAMLET.read_text().replace("<lanes>", hill, 1))
    out = tmp_path / "road.yaml"
    result = run("road", "import", str(path), "--from", "1,-1", "--to", "1,-1", "--out", str(out))
    assert (result.code, result.err) == (0, "elevation is ignored (1 of 5 roads have it): all roads are read as flat\n")
    assert "# elevation is ignored" in out.read_text()


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (["import", "none.xodr", "--from", "1,-1", "--to", "2,-1"], "cannot be read"),
        (["import", "HAMLET", "--from", "1", "--to", "2,-1"], "--from 1: write the id of a road, a comma"),
        (["import", "HAMLET", "--from", "1,-1", "--to", "2,x"], "--to 2,x: write"),
        (["import", "HAMLET", "--from", "1,-+1", "--to", "2,-1"], "--from 1,-+1: write"),
        (["import", "HAMLET", "--from", "1,-1", "--to", "9,-1"], "no road 9"),
        (["import", "HAMLET", "--from", "1,-9", "--to", "2,-1"], "no lane -9"),
        (["import", "HAMLET", "--from", "2,-1", "--to", "1,-1"], "no way leads"),
        (["import", "HAMLET", "--from", "1,-2", "--to", "2,-2"], "is 0.00 m wide"),
        (["import", "HAMLET", "--from", "1,-1", "--to", "2,-1", "--out", "x.txt"], "must end with .yaml"),
        (["export", "nowhere"], "'nowhere'"),
        (["export", "a", "--out", "a.xml"], "must end with .xodr"),
        (["export", "a", "--out", "/dev/null/a.xodr"], "cannot be written"),
    ],
)
def test_bad_input_of_import_and_export(run: Run, arguments: list[str], reason: str) -> None:
    """A bad file, lane or output name gives one sentence and exit code 2."""
    assert reason in run("road", *(str(HAMLET) if word == "HAMLET" else word for word in arguments)).rejection()
