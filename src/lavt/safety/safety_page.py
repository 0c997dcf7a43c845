"""Generate the states, limits and rejection reasons in `docs/safety.md` from the code.

The page has marked blocks, each between `<!-- drawn: NAME -->` and `<!-- drawn until here -->`. `draw_page` fills the
blocks, and `docs/draw_safety.py` writes the page.
"""

from __future__ import annotations

import ast
import inspect
import re
from collections.abc import Callable
from dataclasses import fields
from itertools import pairwise
from typing import Any, Final

from lavt.control.client_limits import CLIENT_LIMITS
from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.errors import UserError
from lavt.safety.gate import RejectionReason
from lavt.safety.limits import LIMITS
from lavt.safety.speed_limit import SPEED_LIMIT_REASONS
from lavt.safety.state_machine import TRANSITIONS, TRIGGER_MESSAGES, Trigger

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
"""Units by the ending of a limit's name; the first ending that matches decides. Times in nanoseconds are shown in ms or
s."""


def draw_page(page: str) -> str:
    """Return the page with every marked block generated again; raise `UserError` for an unknown block."""

    def block(found: re.Match[str]) -> str:
        draw = GENERATED_BLOCKS.get(found["name"])
        if draw is None:
            raise UserError(f"the page has a block {found['name']!r}: choose one of {', '.join(GENERATED_BLOCKS)}")
        return f"<!-- drawn: {found['name']} -->\n\n{draw()}\n\n<!-- drawn until here -->"

    return _BLOCK.sub(block, page)


def draw_states() -> str:
    """Return states and transitions as a Mermaid diagram, with one arrow from each state to each next state."""
    arrows: dict[tuple[str, str], list[str]] = {}
    for (before, trigger), after in TRANSITIONS.items():
        arrows.setdefault((before, after), []).append(trigger)
    lines = [f"    {before} --> {after}: {', '.join(triggers)}" for (before, after), triggers in arrows.items()]
    return "\n".join(("```mermaid", "stateDiagram-v2", "    [*] --> disarmed", *lines, "```"))


def draw_transitions() -> str:
    """Return the table of transitions with the message of each trigger."""
    rows: dict[tuple[Trigger, str], list[str]] = {}
    for (before, trigger), after in TRANSITIONS.items():
        rows.setdefault((trigger, after), []).append(before)
    return _table(
        ("trigger", "from", "to", "message"),
        [(trigger, ", ".join(befores), after, TRIGGER_MESSAGES[trigger]) for (trigger, after), befores in rows.items()],
    )


def draw_vehicle_limits() -> str:
    """Return the table of the limits that the vehicle enforces."""
    return _limits_table(LIMITS)


def draw_client_limits() -> str:
    """Return the table of the limits that the client enforces on itself."""
    return _limits_table(CLIENT_LIMITS)


def draw_rejections() -> str:
    """Return the list of rejection reasons, in the order of the checks."""
    return "\n".join(f"{number}. {reason}" for number, reason in enumerate(RejectionReason, 1))


def draw_speed_limits() -> str:
    """Return the table of the reasons for which the vehicle limits its speed."""
    return _table(("reason", "meaning"), [(f"`{reason}`", text) for reason, text in SPEED_LIMIT_REASONS.items()])


GENERATED_BLOCKS: Final[dict[str, Callable[[], str]]] = {
    "states": draw_states,
    "transitions": draw_transitions,
    "limits of the vehicle": draw_vehicle_limits,
    "limits of the client": draw_client_limits,
    "reasons of the speed limit": draw_speed_limits,
    "rejections": draw_rejections,
}
"""For each block, the function that generates it."""


def value_with_unit(name: str, value: float) -> str:
    """Return the value of a limit, with the unit that follows from the ending of the limit's name."""
    if name.endswith("_ns"):
        return f"{value / NS_PER_S:g} s" if value >= NS_PER_S else f"{value / NS_PER_MS:g} ms"
    unit = next((unit for end, unit in UNITS.items() if name.endswith(end)), "")
    kmph = f" ({value * 3.6:.3g} km/h)" if unit == "m/s" else ""
    return f"{value:.3g} {unit}{kmph}".strip()


def _limits_table(limits: Any) -> str:
    reasons = _field_docstrings(type(limits))
    return _table(
        ("limit", "value", "reason"),
        [
            (f"`{field.name}`", value_with_unit(field.name, getattr(limits, field.name)), reasons[field.name])
            for field in fields(limits)
        ],
    )


def _field_docstrings(kind: type[Any]) -> dict[str, str]:
    """Return the docstring below each field of a class, by field name."""
    [definition] = (node for node in ast.parse(inspect.getsource(kind)).body if isinstance(node, ast.ClassDef))
    return {
        field.target.id: " ".join(str(docstring.value.value).split())
        for field, docstring in pairwise(definition.body)
        if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name)
        if isinstance(docstring, ast.Expr) and isinstance(docstring.value, ast.Constant)
    }


def _table(heads: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    return "\n".join(f"| {' | '.join(cells)} |" for cells in (heads, ("---",) * len(heads), *rows))
