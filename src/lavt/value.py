"""Classes of plain values that nobody changes, made hundreds of times for each second of a drive."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar, dataclass_transform

Value = TypeVar("Value")


@dataclass_transform(frozen_default=True)
def value(kind: type[Value]) -> type[Value]:
    """Make a class a dataclass with slots whose fields are set once.

    To the type checker it is frozen. At run time it is not: making a frozen one takes four times as long, which was a
    tenth of all that virtual time costs without pixels (docs/speed.md).
    """
    return dataclass(slots=True, unsafe_hash=True)(kind)
