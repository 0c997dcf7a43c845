"""Configuration of all tests: how many run in parallel, the profiles of Hypothesis, and the plugins of `support`."""

from __future__ import annotations

import gc
import os
from pathlib import Path

import hypothesis
import pytest
from tests.lanes import runs_in_parallel

pytest_plugins = ["tests.support.inconclusive", "tests.support.process_state", "tests.support.progress"]

ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "OPENCV_FOR_THREADS_NUM")

hypothesis.settings.register_profile("lavt", deadline=None)
hypothesis.settings.register_profile(  # for benchmarks/mutation.py: reproducible examples without shrinking
    "mutation",
    deadline=None,
    derandomize=True,
    database=None,
    phases=[hypothesis.Phase.explicit, hypothesis.Phase.generate],
    suppress_health_check=[hypothesis.HealthCheck.too_slow],
)
hypothesis.settings.load_profile("lavt")


def pytest_xdist_auto_num_workers(config: pytest.Config) -> int:
    """Return the number of workers: 0 if the tests run in this process, otherwise one more than there are processors.

    Some tests only wait for other processes. Meanwhile the additional worker uses the processor.
    """
    directories = [Path(argument.partition("::")[0]).resolve() for argument in config.args]
    if not runs_in_parallel(config.option.markexpr, directories):
        return 0
    os.environ.update(dict.fromkeys(ONE_THREAD, "1"))
    return len(os.sched_getaffinity(0)) + 1


def pytest_collection_finish() -> None:
    """Exclude all objects so far from garbage collection: thousands of collected tests make each collection slow."""
    gc.collect()
    gc.freeze()
