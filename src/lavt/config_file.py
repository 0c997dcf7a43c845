"""Configs as people write them: YAML files and `--set` changes; what is wrong in them is said in a sentence."""

from __future__ import annotations

import difflib
import functools
import typing
from collections.abc import Iterable, Mapping
from importlib import resources
from pathlib import Path
from typing import Any, TypeVar

import yaml
from pydantic import BaseModel, ValidationError

from lavt.config import Condition, Section
from lavt.errors import UserError


def shipped(name: str) -> Path:
    """Path of a file that comes with LAVT, such as `configs/costs.yaml`: inside the package, or in the source tree."""
    packaged = Path(str(resources.files("lavt"))) / "data" / name
    return packaged if packaged.exists() else Path(__file__).parents[2] / name


Config = TypeVar("Config", bound=Section)


def load_config(kind: type[Config], path: Path, changes: Iterable[str] = ()) -> Config:
    """Read a YAML file and `--set` changes (`a.b=value`, the value in YAML) into a config of class `kind`.

    Raises `UserError` for what is missing, unknown, of the wrong type or out of range.
    """
    data = read_yaml(path)
    for change in changes:
        _set(data, change)
    return parse_config(kind, data, str(path))


def read_yaml(path: Path) -> dict[str, Any]:
    """Read a YAML file that holds a mapping; raises `UserError` where it does not."""
    try:
        text = path.read_text()
    except OSError as error:
        raise UserError(f"{path} cannot be read ({error.strerror}): name an existing file") from error
    except UnicodeDecodeError as error:
        raise UserError(f"{path} is not YAML: {error}") from error
    data = parse_yaml(text, str(path))
    if data is None:
        return {}
    if not isinstance(data, dict):
        raise UserError(f"{path} must hold keys and values, not a {type(data).__name__}")
    return data


def parse_yaml(text: str, where: str) -> Any:
    """Read YAML; raises `UserError`, which names `where` the text is from, for everything that is not."""
    try:
        return yaml.safe_load(text)
    except (yaml.YAMLError, ValueError, AttributeError, RecursionError) as error:
        # a date that no calendar has, a number that is none, a thousand brackets: the library lets these through
        raise UserError(f"{where} is not YAML: {' '.join(str(error).split())}") from error


def split_change(change: str) -> tuple[list[str], Any]:
    """Read a `--set` change, `a.b=value` with the value in YAML, as the parts of its key and its value."""
    key, equals, text = change.partition("=")
    parts = key.split(".")
    if not equals or not all(parts):
        raise UserError(f"--set {change!r} is not of the form a.b=value")
    return parts, parse_yaml(text, f"--set {change!r}: the value")


def parse_config(kind: type[Config], data: Mapping[str, Any], where: str) -> Config:
    """Check `data` against the schema; `where` names its source in the error."""
    try:
        return kind.model_validate(_tuples(kind, data))
    except ValidationError as error:
        raise UserError(f"{where}: " + "; ".join(_sentence(kind, problem) for problem in error.errors())) from error


@functools.cache
def conditions() -> Mapping[str, Condition]:
    """Read all conditions of `netem/conditions.yaml`, once: a sweep asks for each of its runs."""
    path = shipped("netem/conditions.yaml")
    return {name: parse_config(Condition, entry, f"{path}: {name}") for name, entry in read_yaml(path).items()}


def condition(name: str) -> Condition:
    """Give the condition of a name; raises `UserError` naming the known ones."""
    known = conditions()
    if name not in known:
        raise UserError(f"there is no condition {name!r}: the known ones are {', '.join(known)}")
    return known[name]


def _set(data: dict[str, Any], change: str) -> None:
    (*sections, last), value = split_change(change)
    for section in sections:
        data = data.setdefault(section, {})
        if not isinstance(data, dict):
            raise UserError(f"--set {change!r}: {section} is not a section")
    data[last] = value


def _tuples(kind: type[BaseModel], data: Mapping[str, Any]) -> dict[str, Any]:
    """YAML knows lists and integers only where the schema has tuples and floats; everything else stays strict."""
    converted = dict(data)
    for name, field in kind.model_fields.items():
        value = converted.get(name)
        section = field.annotation
        if isinstance(value, dict) and isinstance(section, type) and issubclass(section, BaseModel):
            converted[name] = _tuples(section, value)
        elif isinstance(value, list) and typing.get_origin(section) is tuple:
            converted[name] = tuple(value)
    return converted


def _sentence(kind: type[BaseModel], problem: Any) -> str:
    """Say in words what is wrong with one value, and what would be right."""
    location = [str(part) for part in problem["loc"]]
    where = ".".join(location)
    if problem["type"] == "extra_forbidden":
        known = _keys(kind, location[:-1])
        near = [key for key in known if key.startswith(location[-1])]  # a unit left out
        near = near or difflib.get_close_matches(location[-1], known, n=1, cutoff=0.4)
        hint = f"did you mean {near[0]!r}?" if near else f"known here: {', '.join(sorted(known))}"
        return f"unknown key {where!r}: {hint}"
    if problem["type"] == "missing":
        return f"{where!r} is missing: give it"
    if problem["type"] == "float_type" and (number := _meant(problem["input"])) is not None:
        return f"{where!r}: YAML takes {problem['input']} for text: write {problem['input']} as {number!r}"
    said = str(problem["msg"]).removeprefix("Value error, ")  # pydantic's, before what a check of ours says
    if not where:  # about several keys at once
        return said
    return f"{where!r}: {said}, not {problem['input']!r}"


def _meant(value: Any) -> float | None:
    """Give the number that a text stands for, such as 1e-05, which YAML takes for one only with a point in it."""
    try:
        return float(value) if isinstance(value, str) else None
    except ValueError:
        return None


def _keys(kind: type[BaseModel], location: Iterable[str]) -> list[str]:
    for part in location:
        section = kind.model_fields[part].annotation
        if not (isinstance(section, type) and issubclass(section, BaseModel)):
            return []
        kind = section
    return list(kind.model_fields)
