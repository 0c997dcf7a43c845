"""Lanes of OpenDRIVE maps become roads."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from lavt.errors import UserError
from lavt.opendrive.reader import parse_map, read_map
from lavt.opendrive.road_map import OpenDriveMap
from lavt.vehicle.sim.road.lane_import import ImportedRoad, import_lanes, sample_path

HAMLET = read_map(str(Path(__file__).parents[3] / "opendrive" / "data" / "hamlet.xodr"))
LANES = '<right><lane id="-1" type="driving"><width sOffset="0" a="3.5" b="0" c="0" d="0"/></lane></right>'


def make_map(*geometries: tuple[str, float, float, float, float], lanes: str = LANES) -> OpenDriveMap:
    """Return a map of one road of shapes, each with its length and the pose at its beginning."""
    plan, s_m = "", 0.0
    for shape, length_m, x_m, y_m, heading_rad in geometries:
        plan += f'<geometry s="{s_m}" x="{x_m}" y="{y_m}" hdg="{heading_rad}" length="{length_m}">{shape}</geometry>'
        s_m += length_m
    text = f"""<OpenDRIVE><road id="1" length="{s_m}"><planView>{plan}</planView>
        <lanes><laneSection s="0">{lanes}</laneSection></lanes></road></OpenDRIVE>"""
    return parse_map(text.encode(), "m.xodr")


def import_only_road(road_map: OpenDriveMap, lane: int = -1) -> ImportedRoad:
    return import_lanes(road_map, ("1", lane), ("1", lane))


def test_lines_and_arcs_stay_lines_and_arcs() -> None:
    """The lane beside a line and an arc is a line and an arc of the lane's own radius and length."""
    road = import_only_road(
        make_map(("<line/>", 30.0, 5.0, 6.0, 0.0), ('<arc curvature="-0.02"/>', 40.0, 35.0, 6.0, 0.0))
    ).road
    _, line, arc, _ = road.segments
    assert (line.length_m, line.curvature_per_m) == pytest.approx((30.0, 0.0), abs=1e-5)
    radius_m = 50.0 - 1.75
    assert arc.length_m == pytest.approx(40.0 * radius_m / 50.0, abs=1e-5)
    assert (arc.curvature_per_m, arc.end_curvature_per_m) == pytest.approx((-1 / radius_m,) * 2, abs=1e-8)
    assert road.start == pytest.approx((5.0, 4.25, 0.0), abs=1e-5)
    assert road.lanes.widths_m == (3.5,)


@pytest.mark.parametrize(("start", "goal"), [(("1", -1), ("3", 1)), (("2", 1), ("1", 1)), (("1", -1), ("2", -1))])
def test_the_road_follows_the_lanes(start: tuple[str, int], goal: tuple[str, int]) -> None:
    """Through every shape of a plan view, with lane offsets and against the reference line, the road's centre is the
    lanes'.
    """
    imported = import_lanes(HAMLET, start, goal)
    near_m = 0.0
    for at_m in sample_path(imported.path):
        pose = imported.path.pose(at_m)
        near_m, offset_m, heading_rad = imported.road.project(pose.x_m, pose.y_m, near_m)
        assert abs(offset_m) < 0.02
        assert abs(math.remainder(heading_rad - pose.heading_rad, 2 * math.pi)) < 0.03
    assert near_m == pytest.approx(imported.road.route_length_m, abs=0.01)
    assert imported.deviation_m < 0.02


def test_large_coordinates_are_shifted() -> None:
    """A map in coordinates of a whole country gives a road at the origin, and a sentence about it."""
    imported = import_only_road(make_map(("<line/>", 30.0, 500_000.0, 5_000_000.0, 0.0)))
    assert imported.road.start[:2] == (0.0, 0.0)
    assert "500000.0000, 4999998.2500 m was subtracted" in imported.notes[-1]


@pytest.mark.parametrize(
    ("geometries", "message"),
    [
        ([("<line/>", 5.0, 0.0, 0.0, 0.0)], "only 5.0 m long"),
        ([("<line/>", 21_000.0, 0.0, 0.0, 0.0)], "name fewer lanes"),
        (
            [("<line/>", 20.0, 0.0, 0.0, 0.0), ("<line/>", 20.0, 20.2, 0.3, 0.0)],
            r"near s=(19\.[5-9]|20\.[0-5]) m: .* gap",
        ),
        ([("<line/>", 20.0, 0.0, 0.0, 0.0), ("<line/>", 20.0, 20.0, 0.0, 0.5)], "gap or a kink"),
        ([("<line/>", 20.0, 0.0, 0.0, 0.0), ('<arc curvature="-0.2"/>', 5.0, 20.0, 0.0, 0.0)], r"radius of 3\.2 m"),
    ],
)
def test_lanes_that_cannot_be_a_road_are_rejected(
    geometries: list[tuple[str, float, float, float, float]], message: str
) -> None:
    """Lanes that are too short or long, have gaps or kinks, or curve too tightly raise UserError with the place."""
    with pytest.raises(UserError, match=message):
        import_only_road(make_map(*geometries))
