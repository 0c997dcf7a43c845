"""Lanes agree with `carla.Map` of the genuine wheel."""

from __future__ import annotations

import importlib.util
import os
from pathlib import Path

import pytest
from tests.opendrive.carla_comparison import compare
from tests.require import need

MAPS = [
    Path(__file__).parent / "data" / "hamlet.xodr",
    *sorted(Path(os.environ.get("LAVT_MAPS", "/none")).glob("*.xodr")),
]
TOLERANCE_M = 0.05


@pytest.mark.parametrize("path", MAPS, ids=lambda path: path.stem)
def test_driving_lanes_agree_with_carla(path: Path) -> None:
    """At steps of 0.5 m, the centre and the width of every driving lane are within 5 cm of CARLA's."""
    if importlib.util.find_spec("carla") is None:
        need("carla", "needs the wheel carla: pip install carla==0.9.16 (Python 3.11 or 3.12)")
    differences = list(compare(str(path)))
    assert differences
    assert max(differences, key=lambda item: item.centre_m).centre_m < TOLERANCE_M
    assert max(differences, key=lambda item: item.width_m).width_m < TOLERANCE_M
