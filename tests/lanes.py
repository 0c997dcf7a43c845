"""The lanes of tests: which tests each lane has, and the command that runs it.

A test belongs to the lane of its folder (`tests/browser`, `tests/field`, `tests/interop`, `tests/kernel`,
`tests/realtime`); elsewhere to `full` or `realtime` if it has that marker, and to `quick` otherwise. `python -m pytest`
runs `quick`; `python -m tests.lanes` runs all lanes, `python -m tests.lanes NAME...` the named ones.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

TESTS = Path(__file__).resolve().parent
REPOSITORY = TESTS.parent

SEQUENTIAL_FOLDERS = ("browser", "field", "interop", "kernel", "realtime")
"""Tests in these folders run sequentially and alone, because they judge times or need a separate network."""
QUICK = "not full and not realtime"
"""The marker expression of `python -m pytest`."""
PARALLEL = (QUICK, "full")
"""Marker expressions with which tests use all processors."""
SHOW_SLOWEST = ("--durations=12", "--durations-min=5")


@dataclass(frozen=True)
class LaneSpec:
    """A lane: one or more commands that must pass."""

    name: str
    commands: tuple[tuple[str, ...], ...]
    limit_min: float
    """A lane that takes longer is killed and has failed."""
    meanwhile: LaneSpec | None = None
    """Another lane that starts with the last command, at the lowest priority, and goes on beside the lanes after it."""


def pytest(*arguments: str) -> tuple[str, ...]:
    """Return the pytest command for these arguments; it lists the slowest tests at the end."""
    return (sys.executable, "-m", "pytest", *arguments, *SHOW_SLOWEST)


def program(name: str, *arguments: str) -> tuple[str, ...]:
    """Return the command of a program in this Python's environment."""
    return (str(Path(sys.executable).with_name(name)), *arguments)


CAN_DRIVES = "tests/kernel/test_can.py"
"""These tests run alone, because other work slows the machines, and one machine's only processor is just fast enough
for the drives of these tests."""
KERNEL = (sys.executable, "tests/kernel/run", *SHOW_SLOWEST)
FULL = LaneSpec("full", (pytest("-m", "full", "--timeout=1800"),), 40)
"""A test has more time here, because the lane runs at the lowest priority beside others."""
LINTERS = LaneSpec(
    "linters",
    (
        program("ruff", "check"),
        program("ruff", "format", "--check"),
        program("mypy"),
        program("lint-imports"),
        ("env", "NO_MKDOCS_2_WARNING=1", *program("mkdocs", "build", "--strict", "--quiet")),
    ),
    15,
)
LANES = (
    LaneSpec("quick", (pytest(),), 15),
    LaneSpec("realtime", (pytest("-m", "realtime"),), 35),
    LaneSpec("field", (pytest("tests/field"),), 35),
    LaneSpec("kernel", ((*KERNEL, CAN_DRIVES), (*KERNEL, f"--ignore={CAN_DRIVES}")), 30, meanwhile=FULL),
    LaneSpec("interop", (pytest("tests/interop"),), 5),
    LaneSpec("browser", (pytest("tests/browser"),), 10, meanwhile=LINTERS),
)
ALL_LANES = (*LANES, *(lane.meanwhile for lane in LANES if lane.meanwhile is not None))


def runs_in_parallel(marker_expression: str, arguments: Iterable[Path]) -> bool:
    """Return whether pytest runs tests in parallel for this marker expression and these paths.

    Single files and `SEQUENTIAL_FOLDERS` run sequentially.
    """
    lane_folders = {TESTS / folder for folder in SEQUENTIAL_FOLDERS}
    return marker_expression in PARALLEL and all(
        path.is_dir() and not lane_folders & {path, *path.parents} for path in map(Path.resolve, arguments)
    )


def write(text: str) -> None:
    """Write to standard output without delay."""
    sys.stdout.write(text)
    sys.stdout.flush()


def select_lanes(names: Sequence[str]) -> list[LaneSpec]:
    """Return the named lanes, to run sequentially in this order, or all lanes if no lane is named."""
    lanes = {lane.name: replace(lane, meanwhile=None) for lane in ALL_LANES}
    return [lanes[name] for name in names] if names else list(LANES)


def main() -> int:
    """Run all lanes, or the named ones."""
    from tests.support.lane_runner import run_lanes

    parser = argparse.ArgumentParser(prog="python -m tests.lanes", description="Run the lanes of tests.")
    parser.add_argument("names", nargs="*", metavar="NAME", help="linters, quick, full, ...; by default all")
    names = parser.parse_args().names
    known = [lane.name for lane in ALL_LANES]
    if unknown := [name for name in names if name not in known]:
        parser.error(f"there is no lane {unknown[0]!r}: name some of {', '.join(known)}")
    return run_lanes(select_lanes(names), write=write)


if __name__ == "__main__":
    sys.exit(main())
