"""Checks of the environment's parameters; each error is a sentence that says what to write."""

from __future__ import annotations

import math
from collections.abc import Iterable
from numbers import Integral, Real
from os import PathLike
from pathlib import Path
from typing import Any

from lavt.errors import UserError


def is_number(value: Any, least: float = -math.inf) -> bool:
    """Return whether a value is a finite number, also of numpy, not a truth value, and at least `least`."""
    if not isinstance(value, Real) or isinstance(value, bool):
        return False
    try:
        return least <= float(value) < math.inf
    except OverflowError:  # an integer beyond the largest float
        return False


def check_positive(name: str, value: Any) -> None:
    """Raise `UserError` unless the value is a finite number above 0."""
    if not is_number(value, 0.0) or value == 0:
        raise UserError(f"{name} is {value!r}: give a finite number above 0")


def check_count(name: str, value: Any, most: int) -> None:
    """Raise `UserError` unless the value is a whole number from 0 to `most`."""
    if not isinstance(value, Integral) or not is_number(value, 0) or int(value) > most:
        raise UserError(f"{name} is {value!r}: give a whole number from 0 to {most}")


def parse_path(name: str, value: Any) -> Path | None:
    """Return a text or a path as a path; None for None."""
    if value is None:
        return None
    if not isinstance(value, str | PathLike):
        raise UserError(f"{name} is {value!r}: give the path of a file or directory")
    return Path(value)


def parse_changes(changes: Any) -> tuple[str, ...]:
    """Return the changes of a config, which are an iterable of texts and not a text."""
    is_list = isinstance(changes, Iterable) and not isinstance(changes, str)
    listed = tuple(changes) if is_list else (None,)
    if not all(isinstance(change, str) for change in listed):
        raise UserError(f"changes is {changes!r}: give a list of texts, such as ('vehicle.scenery=none',)")
    return listed


def parse_names(option: str, names: Any, default: str) -> tuple[str, ...]:
    """Return the names in a name or a list of names; `default` for None."""
    if names is None:
        return (default,)
    result = (names,) if isinstance(names, str) else tuple(names) if isinstance(names, list | tuple) else ()
    if not result or not all(isinstance(name, str) for name in result):
        raise UserError(f"{option} is {names!r}: give a name or a list of names")
    return result


def parse_range_ms(option: str, delay: Any) -> tuple[float, float] | None:
    """Return the smallest and the largest delay in a delay or a pair of delays, in ms; None for None."""
    if delay is None:
        return None
    limits = tuple(delay) if isinstance(delay, list | tuple) else (delay, delay)
    if len(limits) != 2 or not all(is_number(limit, 0.0) for limit in limits) or limits[0] > limits[1]:
        raise UserError(f"{option} is {delay!r}: give a delay in ms, or the smallest and the largest, such as (0, 300)")
    return float(limits[0]), float(limits[1])
