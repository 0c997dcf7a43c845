"""Groups of a summary: what the runs of one have in common, and in what the groups differ."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

Group = Mapping[str, Any]
"""An entry of a summary's `groups`: settings by name, and statistics."""

STATISTICS = ("conditions", "contrasts")
"""The keys of a group that are not settings."""

USUAL = ("fidelity", "inherent", "controller", "preset", "driver", "changes", "sweep")
"""Settings that every run has; any other is an axis of the sweep."""


def settings_of(group: Group) -> dict[str, Any]:
    """Give what the runs of a group have in common."""
    return {name: value for name, value in group.items() if name not in STATISTICS}


def axes_of(groups: Sequence[Group]) -> list[str]:
    """Name the further axes of a sweep that were driven at more than one value, in their order."""
    names = dict.fromkeys(name for group in groups for name in settings_of(group) if name not in USUAL)
    return [name for name in names if len({str(group.get(name)) for group in groups}) > 1]


def in_order(groups: Sequence[Group]) -> list[Group]:
    """Put groups into the order of their axes' values; what axes do not tell apart keeps its order."""
    axes = axes_of(groups)
    return sorted(groups, key=lambda group: [_place(group.get(name)) for name in axes])


def _place(value: Any) -> tuple[bool, float, str]:
    is_number = isinstance(value, int | float)
    return not is_number, float(value) if is_number else 0.0, str(value)


def differing(groups: Sequence[Group]) -> list[str]:
    """Name the fewest settings that tell the groups apart: further axes first, then what those do not tell."""
    told: list[str] = []
    for name in (*axes_of(groups), *USUAL):
        if len(_values(groups, [*told, name])) > len(_values(groups, told)):
            told.append(name)
    return told


def _values(groups: Sequence[Group], names: Sequence[str]) -> set[tuple[str, ...]]:
    return {tuple(str(group.get(name)) for name in names) for group in groups}


def title_of(group: Group, names: Sequence[str]) -> str:
    """Say which group it is by the settings `names`."""
    return ", ".join(f"{short(name)} {'none' if group.get(name) is None else group[name]}" for name in names)


def short(name: str) -> str:
    """Give the last two words of a dotted name: which flow, and what of it."""
    return " ".join(name.split(".")[-2:]).replace("_", " ")


def is_of(run: Mapping[str, Any], group: Group) -> bool:
    """Tell whether a run is one of a group."""
    axes = run.get("axes") or {}
    return all(
        str(axes[name] if name in axes else run.get(name)) == str(value) for name, value in settings_of(group).items()
    )
