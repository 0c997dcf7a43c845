"""Roads become OpenDRIVE maps."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

from lavt.opendrive.lanes import lane_point
from lavt.opendrive.reader import parse_map
from lavt.opendrive.road_map import MapRoad
from lavt.vehicle.sim.road.lane_import import import_lanes
from lavt.vehicle.sim.road.opendrive_export import ExportedRoad, export_road
from lavt.vehicle.sim.road.road import Road, load_road, parse_road

WIDENING = """
title: "\\"widening\\" & <bending>\\a"
segments:
  - {length_m: 15, end_curvature_per_m: 0.05}
  - {length_m: 20, curvature_per_m: 0.05}
  - {length_m: 40, curvature_per_m: 0.01, end_curvature_per_m: -0.02}
lanes: {widths_m: [3.5, 3, 0], driven: 1, changes: [{from_m: 10, to_m: 30, widths_m: [2.5, 3.25, 3]}]}
shoulders: {left_m: 0, right_m: 0.75}
"""


def export(road: Road) -> tuple[ExportedRoad, MapRoad]:
    exported = export_road(road)
    return exported, parse_map(exported.text.encode(), "x.xodr").road("1")


@pytest.mark.parametrize("road", [load_road("b"), parse_road(WIDENING, "x.yaml")], ids=["b", "widening"])
def test_the_lanes_of_the_map_are_those_of_the_road(road: Road) -> None:
    """At every station, the centre and the width of every lane of the map are the road's."""
    exported, map_road = export(road)
    assert exported.lane == -1 - road.lanes.driven
    for s_m in np.arange(road.first_m, road.last_m, 2.5).tolist():
        edges_m = road.lanes.edges_at(s_m)[::-1]
        for lane, (left_m, right_m) in enumerate(itertools.pairwise(edges_m)):
            point = lane_point(map_road, -1 - lane, s_m + exported.start_m)
            x_m, y_m = road.point_at(s_m, (left_m + right_m) / 2).tolist()
            assert math.hypot(point.x_m - x_m, point.y_m - y_m) < 1e-6
            assert point.width_m == pytest.approx(left_m - right_m, abs=1e-6)


def test_marks_and_shoulders_are_exported() -> None:
    """Marks on edges of lanes become road marks with gaps, and asphalt beyond the lanes becomes shoulders."""
    exported, map_road = export(load_road("a"))
    (section,) = map_road.sections
    assert [(mark.offset_m, mark.kind, mark.colour) for mark in section.lanes[0].marks] == [(0.0, "solid", "yellow")]
    assert [(mark.offset_m, mark.kind) for mark in section.lanes[-4].marks] == [(0.0, "none"), (20.73, "solid")]
    assert [section.lanes[lane].kind for lane in (1, -1, -5)] == ["shoulder", "driving", "shoulder"]
    assert [lane_point(map_road, lane, 50.0).width_m for lane in (1, -5)] == pytest.approx([24.5, 3.5])
    assert exported.notes == (
        "marks that are not on an edge of a lane are left out: 5",
        "rails and barriers are left out: 4",
    )


def test_an_exported_road_is_imported_again() -> None:
    """The road that is imported from an exported road has the same centre, widths and marks."""
    road = parse_road(WIDENING, "x.yaml")
    exported = export_road(road)
    again = import_lanes(parse_map(exported.text.encode(), "x.xodr"), ("1", -2), ("1", -2)).road
    for s_m in np.arange(0.0, road.route_length_m, 5.0).tolist():
        x_m, y_m = road.point_at(s_m, 0.0).tolist()
        station_m, offset_m, _ = again.project(x_m, y_m, s_m + exported.start_m)
        assert (station_m, offset_m) == pytest.approx((s_m + exported.start_m, 0.0), abs=0.01)
        assert again.lanes.edges_at(station_m) == pytest.approx(road.lanes.edges_at(s_m), abs=0.03)
