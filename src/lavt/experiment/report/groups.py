"""Groups of a summary: the settings of each group, and the settings in which groups differ.

A group consists of the runs in virtual time with the same settings. These runs differ in route, condition and
repetition only.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

Group = Mapping[str, Any]
"""An entry of a summary's `groups`: settings by name, and statistics."""

STATISTICS = ("conditions", "contrasts")
"""The keys of a group that are not settings."""

COMMON_SETTINGS = ("fidelity", "inherent", "controller", "preset", "driver", "changes", "sweep")
"""The settings that every run has. Any other setting is an axis of the sweep."""


def settings_of(group: Group) -> dict[str, Any]:
    """Return the settings that the runs of a group share."""
    return {name: value for name, value in group.items() if name not in STATISTICS}


def axes_of(groups: Sequence[Group]) -> list[str]:
    """Return the names of the sweep's axes that have more than one value, in the order of the axes."""
    names = dict.fromkeys(name for group in groups for name in settings_of(group) if name not in COMMON_SETTINGS)
    return [name for name in names if len({str(group.get(name)) for group in groups}) > 1]


def sort_groups(groups: Sequence[Group]) -> list[Group]:
    """Return the groups sorted by the values of their axes; groups with equal values keep their order."""
    axes = axes_of(groups)
    return sorted(groups, key=lambda group: [_sort_key(group.get(name)) for name in axes])


def _sort_key(value: Any) -> tuple[bool, float, str]:
    is_number = isinstance(value, int | float)
    return not is_number, float(value) if is_number else 0.0, str(value)


def differing_settings(groups: Sequence[Group]) -> list[str]:
    """Return the names of settings that together distinguish the groups; axes come first.

    A setting is included only if it distinguishes groups that have the same values of all settings before it.
    """
    names: list[str] = []
    for name in (*axes_of(groups), *COMMON_SETTINGS):
        if len(_combinations(groups, [*names, name])) > len(_combinations(groups, names)):
            names.append(name)
    return names


def _combinations(groups: Sequence[Group], names: Sequence[str]) -> set[tuple[str, ...]]:
    """Return the different combinations of values that the settings `names` have in the groups."""
    return {tuple(str(group.get(name)) for name in names) for group in groups}


def title_of(group: Group, names: Sequence[str]) -> str:
    """Return a title of the group from the settings `names`."""
    return ", ".join(f"{short_name(name)} {'none' if group.get(name) is None else group[name]}" for name in names)


def short_name(name: str) -> str:
    """Return the last two parts of a dotted name in words: "video delay ms" for "network.video.delay_ms"."""
    return " ".join(name.split(".")[-2:]).replace("_", " ")


def is_in_group(run: Mapping[str, Any], group: Group) -> bool:
    """Return whether a run belongs to a group."""
    axes = run.get("axes") or {}
    return all(
        str(axes[name] if name in axes else run.get(name)) == str(value) for name, value in settings_of(group).items()
    )
