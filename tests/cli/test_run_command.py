from __future__ import annotations

from tests.support.command_line import Run

from lavt.config_file import shipped


def test_the_result_names_the_seed_of_the_config(run: Run) -> None:
    """`lavt run` prints the seed that the user has set, not the one derived from it for this run."""
    result = run("run", str(shipped("configs/demo.yaml")), "--set", "seed=7", "--set", "fidelity=geometry")
    assert result.code == 0
    assert "a_key under L0, seed 7: completed" in result.out
