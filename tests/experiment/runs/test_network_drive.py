"""Test of a drive with the detector `onnx` and a tiny network, for which paint is whatever is bright."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml
from tests.support.onnx_model import write_pixel_model

from lavt.config import RunConfig
from lavt.config_file import load_config, shipped
from lavt.experiment.runs.plan import plan_run
from lavt.experiment.runs.run import run_once

SIZE = (320, 240)
BRIGHT = 0.6
"""The brightness between that of asphalt, 0.4, and that of paint, 0.8."""


@pytest.mark.full
def test_a_route_is_driven_with_a_neural_network(tmp_path: Path) -> None:
    """With paint from a network, route a_key is completed in virtual time, in its own lane, without delay."""
    write_pixel_model(tmp_path / "bright.onnx", [[0.0] * 3, [1 / 3] * 3], [BRIGHT, 0.0], SIZE)
    keys = {
        "model": "bright.onnx",
        "input": {"width_px": SIZE[0], "height_px": SIZE[1]},
        "output": {"name": "lanes"},
    }
    file = tmp_path / "bright.yaml"
    file.write_text(yaml.safe_dump(keys))
    changes = ("fidelity=pixels", "vehicle.scenery=none", "perception.detector=onnx", f"perception.file={file}")
    result = run_once(plan_run(load_config(RunConfig, shipped("configs/demo.yaml"), changes)), tmp_path / "run")
    assert (result["ending"], result["valid"], result["lane_invasions"]) == ("completed", True, 0)
    assert result["detector"] == f"onnx {file}"
    assert result["p95_m"] < 0.2
