"""Lanes agree with `carla.Map` of the genuine wheel."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from tests.carla.stand_in import need_carla
from tests.opendrive.carla_comparison import Difference, compare, compare_import

from lavt.vehicle.sim.road.opendrive_export import export_road
from lavt.vehicle.sim.road.road import load_road

HAMLET = Path(__file__).parent / "data" / "hamlet.xodr"
MAPS = [
    HAMLET,
    *sorted(Path(os.environ.get("LAVT_MAPS", "/none")).glob("*.xodr")),
]
TOLERANCE_M = 0.05


@pytest.mark.parametrize("path", MAPS, ids=lambda path: path.stem)
def test_driving_lanes_agree_with_carla(path: Path) -> None:
    """At steps of 0.5 m, the centre and the width of every driving lane are within 5 cm of CARLA's."""
    need_carla()
    check_differences(list(compare(str(path))))


def test_an_imported_road_agrees_with_carla() -> None:
    """At steps of 0.5 m, the centre and the width of an imported road are within 5 cm of CARLA's, both ways."""
    need_carla()
    for start, goal in ((("1", -1), ("3", 1)), (("2", 1), ("1", 1))):
        check_differences(list(compare_import(str(HAMLET), start, goal)))


def test_carla_reads_an_exported_road(tmp_path: Path) -> None:
    """CARLA's lanes of an exported road are where LAVT reads them."""
    need_carla()
    path = tmp_path / "b.xodr"
    path.write_text(export_road(load_road("b")).text)
    check_differences(list(compare(str(path))))


def check_differences(differences: list[Difference]) -> None:
    assert differences
    assert max(differences, key=lambda item: item.centre_m).centre_m < TOLERANCE_M
    assert max(differences, key=lambda item: item.width_m).width_m < TOLERANCE_M
