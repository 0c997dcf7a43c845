"""What all tests share: on how many processors they run, and what becomes of those that the host stalled."""

from __future__ import annotations

import os
from pathlib import Path

import hypothesis
import pytest
from tests.lanes import runs_side_by_side

pytest_plugins = ["tests.support.inconclusive", "tests.support.process_state", "tests.support.progress"]

ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "OPENCV_FOR_THREADS_NUM")

hypothesis.settings.register_profile("lavt", deadline=None)
hypothesis.settings.register_profile(  # of benchmarks/mutation.py: the same examples each time, and none made smaller
    "mutation", deadline=None, derandomize=True, database=None,
    phases=[hypothesis.Phase.explicit, hypothesis.Phase.generate],
    suppress_health_check=[hypothesis.HealthCheck.too_slow],
)  # fmt: skip
hypothesis.settings.load_profile("lavt")


def pytest_xdist_auto_num_workers(config: pytest.Config) -> int:
    """Use every processor for tests that judge no times; 0 runs them here, one after the other."""
    directories = [Path(argument.partition("::")[0]).resolve() for argument in config.args]
    if not runs_side_by_side(config.option.markexpr, directories):
        return 0
    os.environ.update(dict.fromkeys(ONE_THREAD, "1"))
    return len(os.sched_getaffinity(0))
