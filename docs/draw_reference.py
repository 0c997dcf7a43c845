"""Write `docs/commands.md` and `docs/configs.md`: all commands from Typer, and all keys of configs from Pydantic.

python docs/draw_reference.py
"""

from __future__ import annotations

import ast
import inspect
import re
import textwrap
import types
import typing
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

from typer.models import OptionInfo

from lavt.cli.main import GROUPS, build_app
from lavt.config import (
    BoundaryConfig,
    CalibrationConfig,
    ClientConfig,
    Condition,
    Costs,
    RelayConfig,
    RendezvousConfig,
    RunConfig,
    Section,
    ServerConfig,
    StudyConfig,
    SweepConfig,
)
from lavt.config.dbw import ProfileConfig
from lavt.config.perception import NeuralNetworkConfig

FOLDER = Path(__file__).resolve().parent
SOURCE = "`python docs/draw_reference.py` writes this page from the code."

COMMANDS_HEAD = f"""\
# Commands

This page is for looking up a command, its arguments and its options. The [tutorials](tutorials/demo.md) show the most
important ones at work. {SOURCE}

- `lavt COMMAND --help` prints the same.
- Results go to standard output or to files, messages to standard error.
- The exit code is 0 when the job is done, 2 when the input is wrong, and 1 when the work failed.
- After Ctrl-C it is 0 for a command that runs until Ctrl-C, 1 for runs that were stopped, and 130 otherwise.
- `--set a.b=c` replaces a value of the config, such as `--set network.condition=L2` ([configs.md](configs.md)).
"""

CONFIGS_HEAD = f"""\
# Configs

This page is for looking up a key of a config: its type, unit, default and meaning. {SOURCE}

A config is a YAML file. Every key with a default can be left out. An unknown key, a wrong type or a value out of range
is rejected, with one sentence and exit code 2. `--set a.b=c` replaces a value from the command line. A key of a
quantity ends with its unit. Coordinates: x ahead, y to the left, z up; angles and steering are positive to the left.
"""

UNITS = {
    "_mps2": "m/s²",
    "_degps": "°/s",
    "_per_s": "1/s",
    "_mps": "m/s",
    "_bps": "bit/s",
    "_ppm": "ppm",
    "_hz": "Hz",
    "_px": "px",
    "_deg": "°",
    "_rad": "rad",
    "_ms": "ms",
    "_us": "µs",
    "_mb": "MB",
    "_m": "m",
    "_s": "s",
}
"""The unit of a key, by the end of its name."""

TOPS: dict[str, tuple[type[Section], str]] = {
    "a run": (RunConfig, "for `lavt run`, such as `configs/demo.yaml`"),
    "a sweep": (SweepConfig, "for `lavt sweep`, such as `configs/sweep.yaml` ([sweeps.md](sweeps.md))"),
    "a boundary search": (BoundaryConfig, "for `lavt boundary`: `configs/boundary.yaml` ([boundary.md](boundary.md))"),
    "a study": (StudyConfig, "for `lavt study`: `configs/study.yaml` ([studies.md](studies.md))"),
    "a server": (ServerConfig, "for `lavt server`, such as `configs/server.yaml`"),
    "a client": (ClientConfig, "for `lavt client`, such as `configs/client.yaml`"),
    "a relay": (RelayConfig, "for `lavt relay`: `configs/relay.yaml`"),
    "a rendezvous": (RendezvousConfig, "for `lavt rendezvous`: `configs/rendezvous.yaml`"),
    "a calibration": (CalibrationConfig, "a file that `camera.calibration` names ([camera.md](camera.md))"),
    "a neural network": (
        NeuralNetworkConfig,
        "a file that `perception.file` names for the detector `onnx` ([perception.md](perception.md#a-neural-network))",
    ),
    "a condition": (Condition, "an entry of `netem/conditions.yaml` ([network.md](network.md))"),
    "a by-wire profile": (ProfileConfig, "a file that `vehicle.dbw.profile` names ([by_wire.md](by_wire.md))"),
    "costs": (Costs, "`configs/costs.yaml` ([virtual_time.md](virtual_time.md))"),
}
"""All configs: what each describes, its schema, and where it is used. [roads.md](roads.md) describes road files."""


def link_pages(text: str) -> str:
    """Turn the names of pages, such as docs/netem.md, into links."""
    return re.sub(r"`?\bdocs/([a-z_]+\.md)`?", r"[\1](\1)", text)


def table_cell(text: str) -> str:
    """Return a text as a cell of a table."""
    return link_pages(" ".join(text.split())).replace("|", "\\|")


def table(columns: tuple[str, ...], rows: Sequence[tuple[str, ...]]) -> str:
    """Return a table in Markdown."""
    lines = [columns, tuple("---" for _ in columns), *rows]
    return "\n".join("| " + " | ".join(table_cell(cell) for cell in line) + " |" for line in lines)


def draw_commands() -> str:
    """Return the page of commands."""
    app = build_app()
    callbacks = {info.name or "": info.callback for info in app.registered_commands if info.callback}
    groups = {info.name or "": info.typer_instance for info in app.registered_groups}
    parts = [COMMANDS_HEAD]
    for title, commands in GROUPS.items():
        rows = [(f"[`lavt {name}`](#{slug(f'lavt {name}')})", summary) for name, summary in commands.items()]
        parts += [f"## {title}\n", table(("command", "what it does"), rows) + "\n"]
        for name in commands:
            parts += (
                _group_parts(name, groups[name]) if name in groups else _command_parts(f"lavt {name}", callbacks[name])
            )
    return "\n".join(parts)


def slug(heading: str) -> str:
    """Return the anchor of a heading, as GitHub computes it."""
    return re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-")


def _group_parts(name: str, group: Any) -> Iterator[str]:
    """Yield the sections of a command with subcommands."""
    yield f"### lavt {name}\n"
    yield f"{link_pages(str(group.info.help or inspect.getdoc(group.registered_callback.callback)))}\n"
    for info in group.registered_commands:
        yield from _command_parts(f"lavt {name} {info.name}", info.callback)


def _command_parts(name: str, function: Callable[..., Any]) -> Iterator[str]:
    """Yield the section of a command."""
    yield f"### {name}\n"
    for paragraph in (inspect.getdoc(function) or "").split("\n\n"):
        text = " ".join(paragraph.split())
        yield (f"    {text.removeprefix('Example: ')}\n" if text.startswith("Example: ") else f"{link_pages(text)}\n")
    hints = typing.get_type_hints(function, include_extras=True)
    rows = [
        _parameter_row(parameter, hints[name]) for name, parameter in inspect.signature(function).parameters.items()
    ]
    yield table(("argument or option", "value", "default", "meaning"), rows) + "\n"


def _parameter_row(parameter: inspect.Parameter, hint: Any) -> tuple[str, ...]:
    """Return the row of an argument or option."""
    annotation, info = typing.get_args(hint)
    is_option = isinstance(info, OptionInfo)
    declared = [name for name in (info.default, *(info.param_decls or ())) if isinstance(name, str) and name[:1] == "-"]
    own = f"--{parameter.name.replace('_', '-')}" if is_option else info.metavar or parameter.name.upper()
    names = declared or [own.strip("[]")]
    value, is_required = parameter.default, parameter.default is inspect.Parameter.empty
    if isinstance(info.show_default, str):
        default_text = info.show_default
    else:
        is_nothing = value in (None, False, "")
        default_text = "required" if is_required else "" if is_nothing else f"`{value}`"
    kind = "" if annotation is bool else type_text(annotation).removesuffix(" or null")
    if kind.startswith("list of "):
        kind = f"{kind.removeprefix('list of ')}; repeatable"
    kind += _range_text(info.min, info.max)
    return ", ".join(f"`{name}`" for name in names), kind, default_text, info.help or ""


def _range_text(smallest: Any, largest: Any, *, is_above: bool = False, is_below: bool = False) -> str:
    """Return a range of values, to follow the name of a type."""
    if smallest is None and largest is None:
        return ""
    parts = []
    if smallest is not None:
        parts.append(f"above {number(smallest)}" if is_above else f"from {number(smallest)}")
    if largest is not None:
        parts.append(f"below {number(largest)}" if is_below else f"to {number(largest)}")
    return " " + " ".join(parts)


def number(value: float) -> str:
    """Return a number, without a fraction if it has none."""
    if value == 2**63:
        return "2^63"
    return str(int(value)) if value == int(value) else f"{value:.6g}"


def draw_configs() -> str:
    """Return the page of configs."""
    parts = [CONFIGS_HEAD]
    rows = [(f"[{title}](#{slug(title)})", use) for title, (_, use) in TOPS.items()]
    parts.append(table(("config of", "use"), rows) + "\n")
    places: dict[type[Section], str] = {}
    for title, (kind, _) in TOPS.items():
        parts += _config_parts(title, title, kind, "", places)
    return "\n".join(parts)


def _config_parts(
    heading: str, top: str, kind: type[Section], path: str, places: dict[type[Section], str]
) -> Iterator[str]:
    """Yield the section of a config or of a part of it, and those of its parts that have no section yet."""
    places[kind] = heading
    yield f"##{'#' if path else ''} {heading[0].upper()}{heading[1:]}\n"
    yield link_pages(" ".join((kind.__doc__ or "").split())) + "\n"
    parent = next((base for base in kind.__mro__[1:] if base in places), None)
    fields = dict(kind.model_fields)
    if parent is not None:
        yield f"It has the keys of [{places[parent]}](#{slug(places[parent])}), and these:\n"
        inherited = parent.model_fields
        fields = {name: field for name, field in fields.items() if _differs(field, inherited.get(name))}
    inner: dict[str, type[Section]] = {}
    rows = []
    for name, field in fields.items():
        key = f"{path}.{name}" if path else name
        section = field.annotation
        if isinstance(section, type) and issubclass(section, Section):
            place = places.get(section) or f"`{key}` of {top}"
            if section not in places:
                places[section] = place
                inner[key] = section
            rows.append((f"`{key}`", f"[section](#{slug(place)})", "", "", meaning(kind, name)))
        else:
            kind_text = type_text(section, field.metadata)
            rows.append((f"`{key}`", kind_text, unit(name), default(field), meaning(kind, name)))
    yield table(("key", "type", "unit", "default", "meaning"), rows) + "\n"
    for key, section in inner.items():
        yield from _config_parts(places[section], top, section, key, places)


def _differs(field: Any, inherited: Any) -> bool:
    """Return whether a subclass has another field than its parent."""
    parts = ("annotation", "default", "metadata")
    return inherited is None or any(getattr(field, part) != getattr(inherited, part) for part in parts)


def unit(name: str) -> str:
    """Return the unit of a key; empty for a key without one."""
    return next((text for suffix, text in UNITS.items() if name.endswith(suffix)), "")


def default(field: Any) -> str:
    """Return the default of a key as it is written in YAML."""
    if field.is_required():
        return "required"
    value = field.default_factory() if field.default_factory is not None else field.default
    return f"`{yaml_text(value)}`"


def yaml_text(value: Any) -> str:
    """Return a value in YAML, in one line."""
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    if isinstance(value, int | float):
        return number(value)
    if isinstance(value, tuple | list):
        return "[" + ", ".join(map(yaml_text, value)) + "]"
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{key}: {yaml_text(entry)}" for key, entry in value.items()) + "}"
    return str(value) or '""'


def type_text(annotation: Any, metadata: typing.Iterable[Any] = ()) -> str:
    """Return the type of a key and its range."""
    origin, arguments = typing.get_origin(annotation), typing.get_args(annotation)
    if origin is typing.Annotated:
        inner = [*annotation.__metadata__[0].metadata] if hasattr(annotation.__metadata__[0], "metadata") else []
        return type_text(annotation.__origin__, [*inner, *metadata])
    if origin in (typing.Union, types.UnionType):
        texts = [type_text(part, metadata) for part in arguments if part is not type(None)]
        return " or ".join([*texts, *(["null"] if type(None) in arguments else [])])
    if origin is typing.Literal:
        return " or ".join(f"`{yaml_text(value)}`" for value in arguments)
    if origin in (tuple, list):
        return f"list of {type_text(arguments[0])}"
    if origin is dict:
        return f"mapping of {type_text(arguments[0])} to {type_text(arguments[1])}"
    simple = {bool: "`true` or `false`", int: "integer", float: "number", str: "text", Path: "path", Any: "any value"}
    names = ("ge", "gt", "le", "lt")
    limits = {name: getattr(entry, name) for entry in metadata for name in names if hasattr(entry, name)}
    smallest, largest = limits.get("ge", limits.get("gt")), limits.get("le", limits.get("lt"))
    text = simple[annotation]
    return text + _range_text(smallest, largest, is_above="gt" in limits, is_below="lt" in limits)


def meaning(kind: type[Section], name: str) -> str:
    """Return the docstring of a key; of a section without one, the first sentence of its class."""
    for base in kind.__mro__:
        if base is not Section and issubclass(base, Section) and name in _docstrings(base):
            return _docstrings(base)[name]
    section = kind.model_fields[name].annotation
    if isinstance(section, type) and issubclass(section, Section):
        return (section.__doc__ or "").split("\n\n")[0]
    raise LookupError(f"{kind.__name__}.{name} has no docstring: write one below it")


@cache
def _docstrings(kind: type[Section]) -> dict[str, str]:
    """Return the docstrings of a class's attributes."""
    body = typing.cast(ast.ClassDef, ast.parse(textwrap.dedent(inspect.getsource(kind))).body[0]).body
    return {
        attribute.target.id: str(text.value.value)
        for attribute, text in pairwise(body)
        if isinstance(attribute, ast.AnnAssign)
        and isinstance(attribute.target, ast.Name)
        and isinstance(text, ast.Expr)
        and isinstance(text.value, ast.Constant)
    }


PAGES: dict[str, Callable[[], str]] = {"commands.md": draw_commands, "configs.md": draw_configs}
"""The generated pages."""


def main() -> None:
    """Write the pages."""
    for name, draw in PAGES.items():
        (FOLDER / name).write_text(draw(), encoding="utf-8")


if __name__ == "__main__":
    main()
