"""Lanes of OpenDRIVE maps become roads."""

from __future__ import annotations

import contextlib
import math
import re
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lavt.errors import UserError
from lavt.opendrive.lanes import lane_point
from lavt.opendrive.reader import parse_map, read_map
from lavt.opendrive.road_map import OpenDriveMap
from lavt.vehicle.sim.road.lane_import import ImportedRoad, import_lanes, sample_path

HAMLET_FILE = Path(__file__).parents[3] / "opendrive" / "data" / "hamlet.xodr"
HAMLET = read_map(str(HAMLET_FILE))
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


def test_the_lanes_beside_the_driven_lane_are_imported() -> None:
    """A turn lane that opens to the right is a lane that widens from 0 m, within 2 cm of the map."""
    imported = import_lanes(HAMLET, ("1", -1), ("2", -1))
    road = imported.road
    assert road.lanes.driven == 0
    map_road = HAMLET.road("1")
    for s_m in (45.0, 50.0, 55.0, 60.0, 68.0):
        near_m, offset_m, _ = road.project(*lane_point(map_road, -2, s_m)[:2], s_m)
        right_m, line_m, left_m = road.lanes.edges_at(near_m)
        assert (right_m + line_m) / 2 == pytest.approx(offset_m, abs=0.02)
        assert line_m - right_m == pytest.approx(lane_point(map_road, -2, s_m).width_m, abs=0.02)
        assert left_m - line_m == pytest.approx(3.5, abs=0.02)
    assert road.lanes.edges_at(20.0)[:2] == pytest.approx((-1.75, -1.75), abs=0.01)


def test_marks_and_asphalt_are_imported() -> None:
    """Marks keep kind, colour and place; there is none where the map has none; asphalt lies under all lanes."""
    road = import_lanes(HAMLET, ("1", -1), ("2", -1)).road

    def marks_at(s_m: float) -> list[tuple[float, str, str]]:
        there = [mark for mark in road.marks if mark.from_m <= s_m <= mark.to_m]
        return sorted((round(float(mark.offset_at(s_m)), 1), mark.kind, mark.colour) for mark in there)

    # The offsets are those of the marks, 1.75 m from the centre, and of the next lanes' edges at 5.25 m.
    yellow = (1.8, "broken", "yellow")
    assert marks_at(20.0) == [(-1.8, "solid", "white"), yellow, (5.2, "solid", "white")]
    assert marks_at(66.0) == [(-5.2, "solid", "white"), (-1.8, "broken", "white"), yellow, (5.2, "solid", "white")]
    assert marks_at(80.0) == [yellow], "within the junction, only the middle is marked"
    for s_m, right_m in ((20.0, -1.8), (66.0, -5.2), (120.0, -5.2)):
        for offset_m, is_asphalt in ((5.2, True), (5.4, False), (right_m, True), (right_m - 0.3, False)):
            assert any(strip.contains(s_m, offset_m) for strip in road.paved) == is_asphalt, (s_m, offset_m)


def test_a_driven_lane_of_changing_width_is_imported() -> None:
    """A driven lane that narrows has the map's width, and its centre is the middle of the lane."""
    lanes = LANES.replace('a="3.5" b="0"', 'a="3.5" b="-0.025"')
    road = import_only_road(make_map(("<line/>", 40.0, 0.0, 0.0, 0.0), lanes=lanes)).road
    assert [road.lanes.driven_width_at(s_m) for s_m in (0.0, 20.0, 40.0)] == pytest.approx([3.5, 3.0, 2.5], abs=0.01)
    assert road.centre_at(40.0).y_m == pytest.approx(-1.25, abs=0.001)


def test_lanes_on_the_inside_of_a_tight_turn_are_limited() -> None:
    """Lanes beyond the middle of a turn's circle are cut off, so that the road is valid."""
    lanes = "".join(LANES.replace("-1", str(-lane))[7:-8] for lane in (1, 2, 3, 4))
    road_map = make_map(('<arc curvature="-0.08"/>', 15.0, 0.0, 0.0, 0.0), lanes=f"<right>{lanes}</right>")
    road = import_only_road(road_map).road
    radius_m = 12.5 - 1.75
    assert -road.lanes.edges_at(5.0)[0] == pytest.approx(0.85 * radius_m, abs=0.05)


def test_a_driven_lane_without_width_is_rejected() -> None:
    """A driven lane that begins at a point raises UserError with the place."""
    lanes = LANES.replace('a="3.5" b="0"', 'a="0" b="0.1"')
    with pytest.raises(UserError, match=r"road 1 lane -1 is 0\.00 m wide at s=0\.0 m"):
        import_only_road(make_map(("<line/>", 40.0, 0.0, 0.0, 0.0), lanes=lanes))


NUMBERS = re.findall(rb'="(-?[0-9][0-9.e-]*)"', HAMLET_FILE.read_bytes())


@given(
    index=st.integers(0, len(NUMBERS) - 1),
    value=st.sampled_from([b"0", b"-1", b"1e9", b"-1e9", b"1e-9", b"nan", b"3", b"1000", b"0.3"]),
    goal=st.sampled_from([("3", 1), ("2", -1)]),
)
@settings(max_examples=25)
def test_maps_with_a_wrong_number_raise_nothing_but_user_errors(
    index: int, value: bytes, goal: tuple[str, int]
) -> None:
    """A map in which one number is replaced is imported as a valid road, or raises UserError."""
    matches = list(re.finditer(rb'="(-?[0-9][0-9.e-]*)"', HAMLET_FILE.read_bytes()))
    begin, end = matches[index].span(1)
    content = HAMLET_FILE.read_bytes()
    with contextlib.suppress(UserError):
        import_lanes(parse_map(content[:begin] + value + content[end:], "m.xodr"), ("1", -1), goal)
