"""The lanes: which tests there are, what belongs to which, and the command that runs each.

A test belongs to the lane of its folder (`tests/field`, `tests/interop`, `tests/kernel`, `tests/realtime`); elsewhere
to `full` or `realtime` where it is marked so, and to `quick` otherwise. `python -m pytest` runs `quick`;
`python -m tests.lanes` runs all of them, `python -m tests.lanes NAME...` some.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

TESTS = Path(__file__).resolve().parent
REPOSITORY = TESTS.parent

FOLDERS = ("field", "interop", "kernel", "realtime")
"""Their tests run one after the other, and nothing runs beside them: they judge times, or they own a network."""
QUICK = "not full and not realtime"
"""The marker expression of `python -m pytest`."""
SIDE_BY_SIDE = (QUICK, "full")
"""With these marker expressions tests use all processors."""


SLOWEST = ("--durations=12", "--durations-min=5")


@dataclass(frozen=True)
class Lane:
    """One command, or several, that have to pass."""

    name: str
    commands: tuple[tuple[str, ...], ...]
    limit_min: float
    """What takes longer is ended and has failed."""
    meanwhile: Lane | None = None
    """Runs at the same time, at the lowest priority."""


def pytest(*arguments: str) -> tuple[str, ...]:
    """Return the command for some tests; it lists the slowest at the end."""
    return (sys.executable, "-m", "pytest", *arguments, *SLOWEST)


def program(name: str, *arguments: str) -> tuple[str, ...]:
    """Return the command of a program of this Python's environment."""
    return (str(Path(sys.executable).with_name(name)), *arguments)


FULL = Lane("full", (pytest("-m", "full"),), 40)
LINTERS = (program("ruff", "check"), program("ruff", "format", "--check"), program("mypy"), program("lint-imports"))
LANES = (
    Lane("linters", LINTERS, 10),
    Lane("quick", (pytest(),), 15),
    Lane("interop", (pytest("tests/interop"),), 5),
    Lane("realtime", (pytest("-m", "realtime"),), 35),
    Lane("field", (pytest("tests/field"),), 35),
    Lane("kernel", ((sys.executable, "tests/kernel/run", *SLOWEST),), 25, meanwhile=FULL),
)


def runs_side_by_side(markers: str, arguments: Iterable[Path]) -> bool:
    """Return whether pytest, asked for these markers and paths, may run tests on all processors at once.

    Single files and the folders of lanes run one after the other.
    """
    apart = {TESTS / folder for folder in FOLDERS}
    return markers in SIDE_BY_SIDE and all(
        path.is_dir() and not apart & {path, *path.parents} for path in map(Path.resolve, arguments)
    )


def say(text: str) -> None:
    """Print at once."""
    sys.stdout.write(text)
    sys.stdout.flush()


def chosen(names: Sequence[str]) -> list[Lane]:
    """Return the lanes of some names, to run one after the other in this order; all lanes where none is named."""
    alone = {lane.name: replace(lane, meanwhile=None) for lane in (*LANES, FULL)}
    return [alone[name] for name in names] if names else list(LANES)


def main() -> int:
    """Run all lanes, or those named."""
    from tests.support.lane_runner import run_lanes

    parser = argparse.ArgumentParser(prog="python -m tests.lanes", description="Run the lanes of tests.")
    parser.add_argument("names", nargs="*", metavar="NAME", help="linters, quick, full, ...; all where none is given")
    names = parser.parse_args().names
    known = [lane.name for lane in (*LANES, FULL)]
    if unknown := [name for name in names if name not in known]:
        parser.error(f"there is no lane {unknown[0]!r}: name some of {', '.join(known)}")
    return run_lanes(chosen(names), tell=say)


if __name__ == "__main__":
    sys.exit(main())
