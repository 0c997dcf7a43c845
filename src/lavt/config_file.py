"""Reading of configs from YAML files and `--set` changes; each error is one sentence."""

from __future__ import annotations

import difflib
import functools
import math
import os
import typing
from collections.abc import Iterable, Mapping
from importlib import resources
from pathlib import Path
from typing import Any, TypeVar

import yaml
from pydantic import BaseModel, ValidationError

from lavt.config import (
    BoundaryConfig,
    ClientConfig,
    Condition,
    RelayConfig,
    RendezvousConfig,
    RunConfig,
    Section,
    ServerConfig,
    StudyConfig,
    SweepConfig,
)
from lavt.errors import UserError

USES: dict[str, type[Section]] = {
    "run": RunConfig,
    "sweep": SweepConfig,
    "boundary": BoundaryConfig,
    "study": StudyConfig,
    "server": ServerConfig,
    "client": ClientConfig,
    "relay": RelayConfig,
    "rendezvous": RendezvousConfig,
}
"""The schema of the config of each command."""
MAX_PROBLEMS = 5
"""A message describes at most so many errors of a config."""


def shipped(name: str) -> Path:
    """Return the path of a shipped file, such as `configs/costs.yaml`, in the package or in the source tree."""
    packaged = Path(str(resources.files("lavt"))) / "data" / name
    return packaged if _exists(packaged) else Path(__file__).parents[2] / name


Config = TypeVar("Config", bound=Section)


def find_file(file: Path) -> Path:
    """Return `file` if it exists or no file of that name is shipped, otherwise the shipped file."""
    return next((path for path in (file, shipped(str(file))) if _exists(path)), file)


def _exists(path: Path) -> bool:
    return os.path.exists(path)  # noqa: PTH110 (`Path.exists` raises for a name that is too long)


def load_config(kind: type[Config], path: Path, changes: Iterable[str] = ()) -> Config:
    """Read a YAML file and `--set` changes (`a.b=value`, the value in YAML) into a config of class `kind`.

    Without such a file, read the shipped file of that name.

    Raises `UserError` for values that are missing, unknown, of the wrong type or out of range.
    """
    path = find_file(path)
    return build_config(kind, read_yaml(path), changes, str(path))


def build_config(kind: type[Config], data: dict[str, Any], changes: Iterable[str], source: str) -> Config:
    """Return the config of class `kind` with the values in `data` and `--set` changes; otherwise like `load_config`."""
    for change in changes:
        _apply_change(data, change)
    return parse_config(kind, data, source)


def read_yaml(path: Path) -> dict[str, Any]:
    """Read a YAML file that contains a mapping; raise `UserError` for any other file."""
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise UserError(f"{path} cannot be read ({error.strerror}): name an existing file") from error
    except UnicodeDecodeError as error:
        raise UserError(f"{path} is not YAML, because it is not text ({error}): name a YAML file") from error
    data = parse_yaml(text, str(path))
    if data is None:
        raise UserError(f"{path} has no keys: write at least one, for example `seed: 7`")
    if not isinstance(data, dict):
        kind = type(data).__name__
        raise UserError(f"{path} must have keys and values, not a {kind}: write, for example, `seed: 7`")
    return data


def parse_yaml(text: str, source: str) -> Any:
    """Parse YAML; for invalid text raise `UserError`, whose sentence names `source`, the origin of the text."""
    try:
        return yaml.safe_load(text)
    except (yaml.YAMLError, ValueError, AttributeError, RecursionError) as error:
        # besides its own error, the library raises others for impossible dates, bad numbers and deep nesting
        reason = " ".join(str(error).replace('in "<unicode string>", ', "in ").split())
        raise UserError(f"{source} is not YAML: {reason}: correct it there") from error


def split_change(change: str) -> tuple[list[str], Any]:
    """Parse a `--set` change, `a.b=value` with the value in YAML, into the parts of its key and its value."""
    key, equals, text = change.partition("=")
    parts = key.split(".")
    if not equals or not all(parts):
        raise UserError(f"--set {change!r} is not of the form a.b=value: write, for example, --set seed=7")
    return parts, parse_yaml(text, f"--set {change!r}: the value")


def parse_config(kind: type[Config], data: Mapping[str, Any], source: str) -> Config:
    """Validate `data` against the schema of `kind`; the message of an error names `source`, the origin of the data."""
    try:
        return kind.model_validate(_with_tuples(kind, data))
    except ValidationError as error:
        if other := _other_use(kind, data):
            raise UserError(f"{source}: {other}") from error
        problems = [_describe(kind, problem) for problem in error.errors()]
        if len(problems) > MAX_PROBLEMS:
            problems[MAX_PROBLEMS:] = [f"and {len(problems) - MAX_PROBLEMS} more errors"]
        raise UserError(f"{source}: {'; '.join(problems)}") from error


@functools.cache
def conditions() -> Mapping[str, Condition]:
    """Return all network conditions by name, from `netem/conditions.yaml`; the file is read once."""
    path = shipped("netem/conditions.yaml")
    return {name: parse_config(Condition, entry, f"{path}: {name}") for name, entry in read_yaml(path).items()}


def condition(name: str) -> Condition:
    """Return the network condition `name`; if it is unknown, raise `UserError` with the known names."""
    known = conditions()
    if name not in known:
        raise UserError(f"unknown condition {name!r}: choose one of {', '.join(known)}")
    return known[name]


def _apply_change(data: dict[str, Any], change: str) -> None:
    (*sections, last), value = split_change(change)
    for depth, section in enumerate(sections, start=1):
        data = data.setdefault(section, {})
        if not isinstance(data, dict):
            key = ".".join(sections[:depth])
            raise UserError(f"--set {change!r}: {key} is not a section: write --set {key}=value")
    data[last] = value


def _with_tuples(kind: type[BaseModel], data: Mapping[str, Any]) -> dict[str, Any]:
    """Convert lists to tuples where the schema has tuples, because YAML has lists only and the schema is strict."""
    converted = dict(data)
    for name, field in kind.model_fields.items():
        value = converted.get(name)
        annotation = field.annotation
        if isinstance(value, dict) and isinstance(annotation, type) and issubclass(annotation, BaseModel):
            converted[name] = _with_tuples(annotation, value)
        elif isinstance(value, list) and typing.get_origin(annotation) is tuple:
            are_lists = typing.get_origin(typing.get_args(annotation)[0]) is tuple
            converted[name] = tuple(tuple(part) if are_lists and isinstance(part, list) else part for part in value)
    return converted


def _other_use(kind: type[BaseModel], data: Mapping[str, Any]) -> str:
    """Return what is wrong if the keys of `data` are those of another command's config; otherwise an empty text."""
    this = next((name for name, schema in USES.items() if schema is kind), None)
    foreign = [repr(key) for key in data if key not in kind.model_fields]
    other = next((name for name, schema in USES.items() if data.keys() <= schema.model_fields.keys()), None)
    if this is None or other is None or not foreign:
        return ""
    keys = "is a key" if len(foreign) == 1 else "are keys"
    return f"{', '.join(foreign)} {keys} of a config for `lavt {other}`, not for `lavt {this}`: use another config"


def _describe(kind: type[BaseModel], problem: Any) -> str:
    """Describe one validation error, and suggest a fix."""
    location = [str(part) for part in problem["loc"]]
    key = ".".join(location)
    if problem["type"] == "extra_forbidden":
        known = _keys(kind, location[:-1])
        similar = [name for name in known if name.startswith(location[-1])]  # the user left out the unit
        similar = similar or difflib.get_close_matches(location[-1], known, n=1, cutoff=0.4)
        hint = f"did you mean {similar[0]!r}?" if similar else f"known keys are {', '.join(sorted(known))}"
        return f"unknown key {key!r}: {hint}"
    if problem["type"] == "missing":
        return f"{key!r} is missing: add it"
    if problem["type"] == "model_type" and (known := _keys(kind, location)):
        return f"{key!r} is a section, not a value such as {problem['input']!r}: set its keys, such as {key}.{known[0]}"
    if problem["type"] == "tuple_type":
        return f"{key!r}: write a list, such as [a, b], not {problem['input']!r}"
    if problem["type"] == "float_type" and (number := _parse_float(problem["input"])) is not None:
        return f"{key!r}: YAML reads {problem['input']} as text: write {_yaml_float(number)}"
    # Pydantic puts "Value error, " before the messages of LAVT's validators.
    message = str(problem["msg"]).removeprefix("Value error, ")
    if not key:  # a validator that checks several keys together
        return message
    return f"{key!r}: {message}, not {problem['input']!r}"


def _parse_float(value: Any) -> float | None:
    """Return the finite number in a text such as "1e-05"; None for any other value.

    YAML reads such a number as text, because it has no decimal point.
    """
    try:
        number = float(value) if isinstance(value, str) else math.nan
    except ValueError:
        return None
    return number if math.isfinite(number) else None


def _yaml_float(number: float) -> str:
    """Return a number as YAML reads it: with a decimal point."""
    digits, exponent_sign, exponent = repr(number).partition("e")
    return digits + ("" if "." in digits else ".0") + exponent_sign + exponent


def _keys(kind: type[BaseModel], location: Iterable[str]) -> list[str]:
    """Return the keys of the section at `location`."""
    for part in location:
        section = kind.model_fields[part].annotation
        if not (isinstance(section, type) and issubclass(section, BaseModel)):
            return []
        kind = section
    return list(kind.model_fields)
