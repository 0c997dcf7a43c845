from __future__ import annotations

import functools
from typing import Any

import pytest
from benchmarks.mismatch_axes import AXES, CONFIG, axis_tables

from lavt.assembly.simulators import car_of
from lavt.config import SweepConfig
from lavt.config_file import load_config, shipped


def run(kind: str, p95_m: float, route: str = "a_key", **axes: Any) -> dict[str, Any]:
    return {
        "condition": "H2",
        "route": route,
        "valid": True,
        "completed_in_own_lane": p95_m < 1,
        "p95_m": p95_m,
        "lateral_jerk_rms_mps3": 0.2,
        "axes": {"controller.kind": kind, **axes},
    }


@pytest.mark.parametrize("name", AXES)
def test_the_exact_value_of_an_axis_is_the_configured_one(name: str) -> None:
    """Without a change, the config has the value that an axis counts as exact, or the car has it."""
    axis = AXES[name]
    config = load_config(SweepConfig, shipped(CONFIG), axis.changes())
    value: Any = functools.reduce(getattr, axis.key.split("."), config) if axis.key else None
    of_car = {"steering_lag": car_of(config.vehicle).steering_lag_s * 1000}
    of_car["understeer"] = car_of(config.vehicle).front_stiffness_nprad
    if axis.exact:
        assert of_car.get(name, value) == axis.exact
    assert axis.exact not in axis.values
    assert list(config.axes) == ["controller.kind", *([axis.key] if axis.key else [])]


def test_a_table_has_the_exact_value_in_its_place() -> None:
    """The rows are controllers, the columns are sorted values, and a missing cell is a dash."""
    axis = AXES["frame_rate"]
    changed: dict[str, Any] = {axis.key: 10.0}
    runs = [
        run("predictive", 0.1),
        run("smith", 0.2),
        run("predictive", 1.5, **changed),
        run("predictive", 0.3, "b_key", **changed),
        run("smith", 0.4, **changed),
    ]
    assert axis_tables(axis, runs) == [
        "",
        "| H2 | 10 | 30 |",
        "|---|---|---|",
        "| `predictive` | 1/2, 0.90 m, 0.20 m/s3 | 1/1, 0.10 m, 0.20 m/s3 |",
        "| `smith` | 1/1, 0.40 m, 0.20 m/s3 | 1/1, 0.20 m, 0.20 m/s3 |",
        "| `scheduled_lookahead` | – | – |",
        "| `lane_keeper` | – | – |",
    ]
