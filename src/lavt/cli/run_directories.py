"""The run directories that a command's arguments name: runs themselves, or sweeps."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from lavt.errors import UserError
from lavt.experiment.runs.run import RESULT


def find_runs(directory: Path) -> list[Path]:
    """Return the run directories in `directory`, or the directory itself if it is a run."""
    if (directory / RESULT).is_file():
        return [directory]
    runs = sorted(result.parent for result in directory.glob(f"runs/*/{RESULT}"))
    if not runs:
        raise UserError(f"{directory} has no finished run: name the directory of a run or a sweep")
    return runs


def sweep_names(directories: Sequence[Path]) -> dict[Path, str]:
    """Return a unique name for each sweep: the last parts of its directory, as many as needed.

    A single sweep gets no name. Raises `UserError` for a directory that is named twice, by equal or different paths.
    """
    for resolved, count in Counter(directory.resolve() for directory in directories).items():
        if count > 1:
            raise UserError(f"{resolved} is named {count} times: name each directory once")
    sweeps = [directory for directory in directories if not (directory / RESULT).is_file()]
    if len(sweeps) < 2:
        return {}
    parts = {directory: directory.resolve().parts for directory in sweeps}
    part_count = 1
    while max(Counter(parts[directory][-part_count:] for directory in sweeps).values()) > 1:
        part_count += 1
    return {directory: "/".join(parts[directory][-part_count:]) for directory in sweeps}
