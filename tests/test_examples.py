from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).parents[1] / "examples"

SAYS = {
    "compare_delays.py": ("L0: completed", "L3: "),
    "my_controller.py": ("lane_keeper under L1: completed", "stanley under L1: completed"),
}
"""What each example must print."""


def test_every_example_is_known() -> None:
    """Each program in examples/ is run by the test below."""
    assert {path.name for path in EXAMPLES.glob("*.py")} == set(SAYS)


@pytest.mark.full
@pytest.mark.parametrize("name", SAYS)
def test_the_examples_run(name: str, tmp_path: Path) -> None:
    """Each example runs and prints what it promises."""
    done = subprocess.run(
        [sys.executable, EXAMPLES / name, str(tmp_path)], capture_output=True, text=True, check=True, timeout=120
    )
    for text in SAYS[name]:
        assert text in done.stdout
