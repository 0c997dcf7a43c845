"""Trials of mutants: tests run in a copy of the repository in which one module is mutated."""

from __future__ import annotations

import os
import re
import resource
import shutil
import signal
import subprocess
import sys
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from benchmarks.mutating.modules import SOURCES
from benchmarks.mutating.sites import Mutation

from lavt.clock import MachineClock
from lavt.domain import NS_PER_S

COPIED: Final = ("src", "tests", "benchmarks")
"""The folders of the repository that are copied to a tree. All other entries are linked, because tests only read them,
or excluded."""
EXCLUDED: Final = (
    ".git",
    ".hypothesis",
    ".kernel",
    ".mypy_cache",
    ".pytest_cache",
    ".ruff_cache",
    ".venv",
    "out",
    "output.txt",
    "temporary",
)
MEMORY_BYTES: Final = 8 * 2**30
"""Limit of a process's address space, which ends mutants that allocate memory endlessly."""
OPTIONS: Final = (
    "-x",
    "--timeout=120",
    "-q",
    "-n",
    "0",
    "-p",
    "no:cacheprovider",
    "--tb=no",
    "--hypothesis-profile=mutation",
    "--basetemp=temporary",
)
ENDLESS: Final = "timeout"
"""The result of a mutant whose tests exceed the time limit."""
_CLOCK = MachineClock()


@dataclass(frozen=True)
class Trial:
    """The result of a run of tests."""

    passed: bool
    failed_test: str
    """The first test that failed, `timeout`, or pytest's exit status; empty if all tests passed."""
    took_s: float


class WorkTree:
    """A copy of a repository's sources and tests, with links to the repository's other files."""

    def __init__(self, directory: Path, repository: Path) -> None:
        self.directory = directory
        directory.mkdir(parents=True)
        for path in repository.iterdir():
            if path.name in COPIED:
                shutil.copytree(path, directory / path.name)
            elif path.name not in EXCLUDED:
                (directory / path.name).symlink_to(path.resolve())

    def source(self, module: str) -> Path:
        """Return the path of a module's copy."""
        return self.directory / SOURCES / module

    def run(self, tests: Sequence[str], limit_s: float, *, unchanged: bool = False) -> Trial:
        """Run the tests in the tree. With `unchanged`, the compiled files are kept for later runs."""
        with (self.directory / "output.txt").open("w+") as output:
            begin_ns = _CLOCK.now().mono_ns
            process = subprocess.Popen(
                [sys.executable, "-m", "pytest", *OPTIONS, *tests],
                cwd=self.directory,
                env=self._environment(unchanged),
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )
            resource.prlimit(process.pid, resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))
            try:
                status: int | None = process.wait(timeout=limit_s)
            except subprocess.TimeoutExpired:
                status = None
            finally:
                with suppress(ProcessLookupError):
                    os.killpg(process.pid, signal.SIGKILL)  # also kills the children
                process.wait()
            took_s = (_CLOCK.now().mono_ns - begin_ns) / NS_PER_S
            output.seek(0)
            output_text = output.read()
        return Trial(status == 0, "" if status == 0 else _failure(status, output_text), took_s)

    def run_mutated(self, mutation: Mutation, tests: Sequence[str], limit_s: float) -> Trial:
        """Run the tests on a mutated module, and restore the module."""
        path = self.source(mutation.module)
        source = path.read_text()
        cached = path.parent / "__pycache__" / f"{path.stem}.{sys.implementation.cache_tag}.pyc"
        # Otherwise Python would not compile a mutant of the same length that is written in the same second.
        cached.unlink(missing_ok=True)
        try:
            path.write_text(mutation.apply_to(source))
            return self.run(tests, limit_s)
        finally:
            path.write_text(source)

    def _environment(self, unchanged: bool) -> dict[str, str]:
        variables = {"PYTHONPATH": str(self.directory / "src"), "PYTHONDONTWRITEBYTECODE": "" if unchanged else "1"}
        return {name: value for name, value in os.environ.items() if not name.startswith("PYTEST")} | variables


def _failure(status: int | None, output_text: str) -> str:
    if status is None:
        return ENDLESS
    failed = re.search(r"^(?:FAILED|ERROR) (.+?)(?: - .*)?$", output_text, re.MULTILINE)
    return failed[1] if failed else f"exit status {status}"
