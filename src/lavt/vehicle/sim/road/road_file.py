"""Read road files; each fault of a file gives a sentence. `docs/roads.md` describes road files for users."""

from __future__ import annotations

import difflib
import functools
from collections.abc import Mapping
from typing import Any

import yaml
from pydantic import BaseModel, ValidationError

from lavt.errors import UserError
from lavt.vehicle.sim.road.road_checks import find_problems
from lavt.vehicle.sim.road.road_keys import (
    ChangeKeys,
    LaneKeys,
    MarkKeys,
    OriginKeys,
    PartFile,
    PavedKeys,
    RailKeys,
    RoadFile,
    SegmentKeys,
    ShoulderKeys,
)


@functools.lru_cache(maxsize=32)  # a sweep loads the same roads repeatedly, and parsing YAML takes 7 ms
def read_road_file(text: str, source: str) -> RoadFile | PartFile:
    """Parse a road file. If it is invalid, raise a `UserError` that names `source` and the problems."""
    try:
        data = yaml.safe_load(text)
    except (yaml.YAMLError, ValueError, AttributeError, RecursionError) as error:
        raise UserError(f"{source} is not YAML: {' '.join(str(error).split())}") from error
    if not isinstance(data, dict):
        kind_name = type(data).__name__
        raise UserError(f"{source} must have keys and values, not a {kind_name}: write them as in docs/roads.md")
    kind = PartFile if "part_of" in data else RoadFile
    try:
        road_file = kind.model_validate(data)
    except ValidationError as error:
        problems = "; ".join(_describe_error(kind, problem) for problem in error.errors())
        raise UserError(f"{source} is not a road: {problems}") from error
    if isinstance(road_file, RoadFile):
        for problem in find_problems(road_file):
            raise UserError(f"{source} is not a road: {problem}")
    return road_file


def _describe_error(kind: type[BaseModel], problem: Mapping[str, Any]) -> str:
    """Return a sentence about one invalid value."""
    location = [str(part)[:60] for part in problem["loc"]]
    key = ".".join(location)
    if problem["type"] == "extra_forbidden":
        known = _known_keys(kind, problem["loc"][:-1])
        near = difflib.get_close_matches(location[-1], known, n=1, cutoff=0.4)
        hint = f"did you mean {near[0]!r}?" if near else f"the known keys are {', '.join(sorted(known))}"
        return f"unknown key {key!r}: {hint}"
    if problem["type"] == "missing":
        return f"{key!r} is missing: add it"
    if problem["type"] == "model_type":
        return f"{key!r} must contain keys and values, not {_format_value(problem['input'])}"
    return f"{key!r}: {problem['msg']}, not {_format_value(problem['input'])}"


def _format_value(value: Any) -> str:
    """Return a value as text, or only its type: lists can contain themselves, and integers can be huge."""
    if not isinstance(value, str | int | float | None) or (isinstance(value, int) and value.bit_length() > 64):
        return f"this {type(value).__name__}"
    shown = repr(value)
    return shown if len(shown) <= 60 else shown[:57] + "..."


_SECTION_MODELS: dict[str, type[BaseModel]] = {
    "origin": OriginKeys,
    "segments": SegmentKeys,
    "lanes": LaneKeys,
    "shoulders": ShoulderKeys,
    "paved": PavedKeys,
    "marks": MarkKeys,
    "rails": RailKeys,
}


def _known_keys(kind: type[BaseModel], location: tuple[Any, ...]) -> list[str]:
    inner = _SECTION_MODELS[location[0]] if location else kind
    if location[:2] == ("lanes", "changes"):
        inner = ChangeKeys
    return [field.alias or name for name, field in inner.model_fields.items()]
