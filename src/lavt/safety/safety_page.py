"""Draws what `docs/safety.md` says of states, limits and refusals from the code itself.

The page has marked blocks, `<!-- drawn: NAME -->` to `<!-- drawn until here -->`; `drawn` puts what the code says into
each. `docs/draw_safety.py` rewrites the page.
"""

from __future__ import annotations

import ast
import inspect
import re
from collections.abc import Callable
from dataclasses import fields
from itertools import pairwise
from typing import Any, Final

from lavt.control import driver_limits
from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.errors import UserError
from lavt.safety import gate, limits

_BLOCK: Final = re.compile(r"<!-- drawn: (?P<name>[a-z ]+) -->\n(?P<drawn>.*?)<!-- drawn until here -->", re.DOTALL)

UNITS: Final[dict[str, str]] = {
    "_mps2": "m/s2",
    "_mps": "m/s",
    "_radps": "rad/s",
    "_rad": "rad",
    "_m": "m",
    "_s": "s",
    "_frames": "frames",
    "brake": "of the pedal",
}
"""By the end of a limit's name; the first one that fits counts. Times in nanoseconds are told in ms or s."""


def drawn(page: str) -> str:
    """Give the page with every marked block drawn anew; raises `UserError` for a block that nobody can draw."""

    def block(found: re.Match[str]) -> str:
        draw = DRAWINGS.get(found["name"])
        if draw is None:
            raise UserError(f"the page has a block {found['name']!r}: choose one of {', '.join(DRAWINGS)}")
        return f"<!-- drawn: {found['name']} -->\n\n{draw()}\n\n<!-- drawn until here -->"

    return _BLOCK.sub(block, page)


def states() -> str:
    """Draw states and transitions as a Mermaid diagram; what leads from one to another is on one arrow."""
    arrows: dict[tuple[str, str], list[str]] = {}
    for (before, trigger), after in gate.TRANSITIONS.items():
        arrows.setdefault((before, after), []).append(trigger)
    lines = [f"    {before} --> {after}: {', '.join(triggers)}" for (before, after), triggers in arrows.items()]
    return "\n".join(("```mermaid", "stateDiagram-v2", "    [*] --> disarmed", *lines, "```"))


def transitions() -> str:
    """Draw the table of transitions, with the words in which each is told."""
    rows: dict[tuple[gate.Trigger, str], list[str]] = {}
    for (before, trigger), after in gate.TRANSITIONS.items():
        rows.setdefault((trigger, after), []).append(before)
    return _table(
        ("what happens", "in", "leads to", "told as"),
        [(trigger, ", ".join(befores), after, gate.REASONS[trigger]) for (trigger, after), befores in rows.items()],
    )


def vehicle_limits() -> str:
    """Draw the limits that the vehicle holds."""
    return _limits(limits.LIMITS)


def client_limits() -> str:
    """Draw the limits that the client holds itself to."""
    return _limits(driver_limits.CLIENT_LIMITS)


def rejections() -> str:
    """Draw the reasons for which a command is refused, in the order in which they are looked at."""
    returns = [node for node in ast.walk(_definition(gate, "rejection_reason")) if isinstance(node, ast.Return)]
    said = [_said(node.value) for node in sorted(returns, key=lambda node: node.lineno)]
    return "\n".join(f"{place}. {reason}" for place, reason in enumerate(filter(None, said), 1))


DRAWINGS: Final[dict[str, Callable[[], str]]] = {
    "states": states,
    "transitions": transitions,
    "limits of the vehicle": vehicle_limits,
    "limits of the client": client_limits,
    "rejections": rejections,
}
"""What can be drawn, by the name of its block."""


def value_with_unit(name: str, value: float) -> str:
    """Give a limit's value with the unit that its name ends with."""
    if name.endswith("_ns"):
        return f"{value / NS_PER_S:g} s" if value >= NS_PER_S else f"{value / NS_PER_MS:g} ms"
    unit = next((unit for end, unit in UNITS.items() if name.endswith(end)), "")
    kmph = f" ({value * 3.6:.3g} km/h)" if unit == "m/s" else ""
    return f"{value:.3g} {unit}{kmph}".strip()


def _limits(held: Any) -> str:
    reasons = _reasons(type(held))
    return _table(
        ("limit", "value", "reason"),
        [
            (f"`{field.name}`", value_with_unit(field.name, getattr(held, field.name)), reasons[field.name])
            for field in fields(held)
        ],
    )


def _reasons(kind: type[Any]) -> dict[str, str]:
    """Read the docstrings that stand below the fields of a class."""
    body = _definition(limits, kind.__name__).body
    return {
        field.target.id: _one_line(said.value.value)
        for field, said in pairwise(body)
        if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name)
        if isinstance(said, ast.Expr) and isinstance(said.value, ast.Constant)
    }


def _definition(module: Any, name: str) -> ast.ClassDef | ast.FunctionDef:
    """Find a class or function in a module's source."""
    for node in ast.walk(ast.parse(inspect.getsource(module))):
        if isinstance(node, ast.ClassDef | ast.FunctionDef) and node.name == name:
            return node
    raise LookupError(f"{module.__name__} has no {name}")


def _said(returned: ast.expr | None) -> str:
    """Give the text that a `return` of the safety module gives: it is there itself, or by the name of a constant."""
    if isinstance(returned, ast.Name):
        return str(getattr(gate, returned.id))
    if isinstance(returned, ast.Constant):
        return str(returned.value)
    raise LookupError("a command is refused for a reason that is neither a text nor the name of one")


def _one_line(text: Any) -> str:
    return " ".join(str(text).split())


def _table(heads: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    return "\n".join(f"| {' | '.join(cells)} |" for cells in (heads, ("---",) * len(heads), *rows))
