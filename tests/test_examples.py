from __future__ import annotations

import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).parents[1] / "examples"

EXPECTED_OUTPUT = {
    "compare_delays.py": ("L0: completed", "L3: "),
    "gym_lane_keeping.py": ("generation 1: return", "pure pursuit: 5 of 5 routes completed"),
    "my_controller.py": ("lane_keeper under L1: completed", "stanley under L1: completed"),
    "my_vehicle.py": ("simulator: completed", "pulling_car: completed"),
}
"""Text that each example must print."""

ARGUMENTS = {"gym_lane_keeping.py": ("--generations", "1", "--video-ms", "100")}
"""Arguments that make an example shorter, or its result independent of chance."""
NEEDED_PACKAGES = {"gym_lane_keeping.py": "gymnasium"}


def test_every_example_is_tested() -> None:
    """The test below runs each program in examples/."""
    assert {path.name for path in EXAMPLES.glob("*.py")} == set(EXPECTED_OUTPUT)


@pytest.mark.full
@pytest.mark.parametrize("name", EXPECTED_OUTPUT)
def test_examples_run(name: str, tmp_path: Path) -> None:
    """Each example runs and prints its expected output."""
    if find_spec(NEEDED_PACKAGES.get(name, "lavt")) is None:  # an import would change this process's environment
        pytest.skip(f"the example needs {NEEDED_PACKAGES[name]}")
    completed = subprocess.run(
        [sys.executable, EXAMPLES / name, str(tmp_path), *ARGUMENTS.get(name, ())],
        capture_output=True,
        text=True,
        check=True,
        timeout=900,
    )
    for text in EXPECTED_OUTPUT[name]:
        assert text in completed.stdout
