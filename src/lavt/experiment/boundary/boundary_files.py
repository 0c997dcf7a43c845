"""The files of a boundary search: `boundary.yaml` with the config; `boundary.json` and `boundary.csv` with the results.

Both results are written again after each search, so that a killed search can be resumed.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from lavt.config import BoundaryConfig
from lavt.errors import WorkError
from lavt.experiment.analysis.results import read_json, write_json
from lavt.experiment.statistics.boundary_summary import CRITERIA, summarize_groups

BOUNDARY_CONFIG = "boundary.yaml"
"""The file with the complete config of the search."""
BOUNDARY = "boundary.json"
CSV_COLUMNS = ("route", "preset", "seed", "repetition", *(f"{name}_ms" for name in CRITERIA), "theory_ms")

SearchKey = tuple[Any, ...]
"""The route, the preset and the repetition of a search."""


def search_key(entry: Mapping[str, Any]) -> SearchKey:
    """Return the key of a search, from its identity or from its entry of `runs` in `boundary.json`."""
    return entry["route"], entry["preset"], entry["repetition"]


def write_results(
    config: BoundaryConfig, found: Sequence[dict[str, Any]], failed: Sequence[dict[str, Any]], out: Path
) -> dict[str, Any]:
    """Write the found boundaries and the failed searches, and return the content of `boundary.json`."""
    content = {
        "schema": 1,
        "config": config.model_dump(mode="json"),
        "runs": found,
        "groups": summarize_groups(found),
        "failed": failed,
    }
    write_json(out / BOUNDARY, content)
    with (out / "boundary.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, CSV_COLUMNS, extrasaction="ignore")
        writer.writeheader()
        writer.writerows(found)
    return content


def read_results(directory: Path) -> dict[str, Any]:
    """Return the content of `boundary.json`; raise `WorkError` if the file has no lists of runs and groups."""
    content: Any = read_json(directory / BOUNDARY)
    if not isinstance(content, dict) or not all(_is_list_of_objects(content.get(key)) for key in ("runs", "groups")):
        raise WorkError(f"{directory / BOUNDARY} has no runs or groups: search again with `lavt boundary`")
    return content


def read_found(directory: Path) -> dict[SearchKey, dict[str, Any]]:
    """Return the entries of the finished searches by key; none if there is no `boundary.json` yet."""
    if not (directory / BOUNDARY).is_file():
        return {}
    try:
        return {search_key(entry): entry for entry in read_results(directory)["runs"]}
    except KeyError as error:
        raise WorkError(f"{directory / BOUNDARY} has a run without {error}: search again without --resume") from error


def _is_list_of_objects(value: Any) -> bool:
    return isinstance(value, list) and all(isinstance(entry, dict) for entry in value)
