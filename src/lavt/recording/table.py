"""One channel of a record as columns."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lavt.domain import FloatArray

IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

MISSING = int(np.iinfo(np.int64).min)
"""Null in a column of integers. Such a column cannot have floats and NaN instead, because wall clock times exceed
2^60 ns, where the resolution of floats is 256 ns."""


@dataclass(frozen=True, slots=True)
class Table:
    """The messages of one channel, in the order in which they were recorded.

    `columns` has an array per field of the payload: int64 (null is `MISSING`), float64 (null is NaN), bool, or objects.
    `mono_ns` and `wall_ns` are the times of recording on the clocks of the recording host. If the payload itself has
    fields named `mono_ns` or `wall_ns`, those are in `columns`.
    """

    mono_ns: IntArray
    wall_ns: IntArray
    columns: Mapping[str, NDArray[Any]] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.mono_ns)

    def ints(self, name: str) -> IntArray:
        """Return a column of integers: `MISSING` for null, for a missing column, and for more than 64 bits."""
        column = self.columns.get(name)
        if column is None or column.dtype != np.int64:
            return _ints_of(column, len(self))
        return column

    def floats(self, name: str) -> FloatArray:
        """Return a column of numbers: NaN for null and for a missing column."""
        column = self.columns.get(name)
        if column is None:
            return np.full(len(self), np.nan)
        if column.dtype == np.int64:
            return np.where(column == MISSING, np.nan, column.astype(np.float64))
        if column.dtype == object:
            return np.array([value if isinstance(value, int | float) else np.nan for value in column], np.float64)
        return column.astype(np.float64)

    def flags(self, name: str) -> BoolArray:
        """Return a column of booleans: False for null and for a missing column."""
        column = self.columns.get(name)
        if column is None:
            return np.zeros(len(self), np.bool_)
        return np.array([value is True or value is np.True_ for value in column], np.bool_)

    def texts(self, name: str) -> list[str]:
        """Return a column of texts: "" for null and for a missing column."""
        column = self.columns.get(name)
        if column is None:
            return [""] * len(self)
        values = column.tolist()
        if set(map(type, values)) <= {str}:  # nearly always true, and ten times as fast
            return list(values)
        return [value if isinstance(value, str) else "" for value in values]

    def objects(self, name: str) -> list[Any]:
        """Return a column as plain Python values: None for null and for a missing column."""
        column = self.columns.get(name)
        if column is None:
            return [None] * len(self)
        values = column.tolist()
        if set(map(type, values)) <= {str, list, type(None)}:  # such a column has no null other than None
            return list(values)
        return [None if _is_null(value) else value for value in values]

    def where(self, selection: BoolArray | IntArray) -> Table:
        """Return the rows for which `selection` is true, or the rows with the indexes in `selection`, in that order."""
        return Table(
            self.mono_ns[selection],
            self.wall_ns[selection],
            _Columns(self.columns, lambda name: self.columns[name][selection]),
        )


def _is_null(value: Any) -> bool:
    return value is None or value == MISSING or (isinstance(value, float) and math.isnan(value))


def _ints_of(column: NDArray[Any] | None, length: int) -> IntArray:
    ints = np.full(length, MISSING, np.int64)
    if column is not None and column.dtype == object:
        for index, value in enumerate(column):
            if isinstance(value, int) and not isinstance(value, bool) and MISSING <= value <= -(MISSING + 1):
                ints[index] = value
    elif column is not None:
        known = np.abs(column.astype(np.float64)) < 2.0**63  # false for NaN
        ints[known] = column[known].astype(np.int64)
    return ints


EMPTY = Table(np.zeros(0, np.int64), np.zeros(0, np.int64))


def table_of(rows: Sequence[Mapping[str, Any]], mono_ns: Sequence[int], wall_ns: Sequence[int]) -> Table:
    """Return a table of `rows`; a field that a row does not have is null in that row."""
    names = dict.fromkeys(name for fields in {tuple(row): None for row in rows} for name in fields)
    columns = _Columns(names, lambda name: _column([row.get(name) for row in rows]))
    return Table(np.array(mono_ns, np.int64), np.array(wall_ns, np.int64), columns)


class _Columns(Mapping[str, NDArray[Any]]):
    """Columns, each of which is built on first access, because most channels have columns that nobody reads."""

    def __init__(self, names: Iterable[str], build: Callable[[str], NDArray[Any]]) -> None:
        self._columns: dict[str, NDArray[Any] | None] = dict.fromkeys(names)
        self._build = build

    def __getitem__(self, name: str) -> NDArray[Any]:
        column = self._columns[name]
        if column is None:
            column = self._columns[name] = self._build(name)
        return column

    def __iter__(self) -> Iterator[str]:
        return iter(self._columns)

    def __len__(self) -> int:
        return len(self._columns)


def _column(values: list[Any]) -> NDArray[Any]:
    kinds = set(map(type, values))
    has_null = type(None) in kinds
    kinds.discard(type(None))
    if kinds == {bool} and not has_null:
        return np.array(values, np.bool_)
    if kinds == {int} and max(abs(value) for value in values if value is not None) <= -(MISSING + 1):
        return np.array([MISSING if value is None else value for value in values] if has_null else values, np.int64)
    if kinds <= {int, float} and kinds != {int}:  # integers that need more than 64 bits remain objects
        return np.array(values, np.float64)
    column = np.empty(len(values), object)
    column[:] = values
    return column
