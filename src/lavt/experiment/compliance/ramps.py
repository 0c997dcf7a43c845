"""Quantities that change linearly between known moments, and how long they are above a limit: exact, without sampling.

A quantity that is known only within bounds is a pair of these: one that is nowhere above it, one that is nowhere below.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lavt.domain import FloatArray

Interval = tuple[float, float]
"""Begin and end of a time."""


@dataclass(frozen=True, slots=True)
class Ramps:
    """A quantity over time: in piece i it changes linearly from `first[i]` to `last[i]`.

    `begin` and `end`, each (pieces,), are ascending times in one unit. Pieces do not overlap, but may have gaps between
    them, which count as no time. A value of infinity means that the quantity has no upper bound in this piece; then
    both `first` and `last` are infinite.
    """

    begin: FloatArray
    end: FloatArray
    first: FloatArray
    last: FloatArray

    @property
    def duration(self) -> float:
        """The total time of all pieces."""
        return float(np.sum(self.end - self.begin))

    @property
    def maximum(self) -> float | None:
        """The largest value; None without pieces."""
        return float(np.max(np.maximum(self.first, self.last))) if len(self.begin) else None

    def at(self, index: int, time: float) -> float:
        """Return the value of piece `index` at `time`, which is in the piece."""
        return float(_values_at(self, np.array([index]), np.array([time]))[0])

    def within(self, intervals: Sequence[Interval]) -> Ramps:
        """Return the parts of the pieces that are in one of `intervals`, which are ascending and do not overlap."""
        parts = [self._clipped(begin, end) for begin, end in intervals]
        return joined(parts)

    def split_at(self, times: FloatArray) -> Ramps:
        """Return the same quantity with pieces that also end at `times`."""
        cuts = np.unique(np.concatenate([self.begin, self.end, times]))
        index = np.searchsorted(self.begin, cuts[:-1], "right") - 1
        inside = (index >= 0) & (cuts[1:] <= self.end[index]) if len(self.begin) else np.zeros(len(index), np.bool_)
        begin, end, index = cuts[:-1][inside], cuts[1:][inside], index[inside]
        return Ramps(begin, end, _values_at(self, index, begin), _values_at(self, index, end))

    def time_above(self, limit: float) -> float:
        """Return for how long the quantity is above `limit`."""
        begin, end = _part_above(self, limit)
        return float(np.sum(end - begin))

    def stretches_above(self, limit: float) -> list[Interval]:
        """Return the stretches of time in which the quantity stays above `limit`, in order.

        A stretch does not end where the quantity only touches the limit, or jumps and stays above it.
        """
        begin, end = _part_above(self, limit)
        is_some = end > begin
        begin, end = begin[is_some], end[is_some]
        if not len(begin):
            return []
        starts = np.append(True, begin[1:] > end[:-1])
        return list(zip(begin[starts].tolist(), end[np.append(starts[1:], True)].tolist(), strict=True))

    def percentile(self, share: float) -> float | None:
        """Return the smallest value that the quantity does not exceed for `share` of the time; None without time."""
        total = self.duration
        if total <= 0:
            return None
        low, high = np.minimum(self.first, self.last), np.maximum(self.first, self.last)
        corners = np.unique(np.concatenate([low, high]))
        length = self.end - self.begin
        is_flat = low == high
        # Time per unit of the value, summed over the pieces that contain it; a flat piece adds its time at one value.
        density, jump = np.zeros(len(corners)), np.zeros(len(corners))
        with np.errstate(invalid="ignore"):  # infinite pieces are flat
            rate = np.divide(length, high - low, out=np.zeros(len(length)), where=~is_flat)
        np.add.at(density, np.searchsorted(corners, low[~is_flat]), rate[~is_flat])
        np.add.at(density, np.searchsorted(corners, high[~is_flat]), -rate[~is_flat])
        np.add.at(jump, np.searchsorted(corners, low[is_flat]), length[is_flat])
        with np.errstate(invalid="ignore"):
            risen = np.cumsum(density)[:-1] * np.diff(corners)
        risen = np.where(np.isfinite(risen), risen, 0.0)  # between the largest finite value and infinity there is none
        at_corner = np.append(0.0, np.cumsum(risen)) + np.cumsum(jump)
        before_corner = at_corner - jump
        wanted = share * total
        index = min(int(np.searchsorted(at_corner, wanted * (1 - 1e-12))), len(corners) - 1)
        if index == 0 or wanted >= before_corner[index]:
            return float(corners[index])
        low_time, high_time = at_corner[index - 1], before_corner[index]
        fraction = (wanted - low_time) / (high_time - low_time)
        return float(corners[index - 1] + fraction * (corners[index] - corners[index - 1]))

    def _clipped(self, begin: float, end: float) -> Ramps:
        index = np.flatnonzero((self.end > begin) & (self.begin < end))
        clipped_begin, clipped_end = np.maximum(self.begin[index], begin), np.minimum(self.end[index], end)
        values = _values_at(self, index, clipped_begin), _values_at(self, index, clipped_end)
        return Ramps(clipped_begin, clipped_end, *values)


EMPTY_RAMPS = Ramps(*(np.zeros(0) for _ in range(4)))


def joined(parts: Sequence[Ramps]) -> Ramps:
    """Return the pieces of all parts, which must be in the order of time, or of different drives."""
    if not parts:
        return EMPTY_RAMPS
    names = ("begin", "end", "first", "last")
    return Ramps(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


def longest(stretches: Sequence[Interval]) -> Interval | None:
    """Return the longest stretch, the first of equal ones; None without stretches."""
    return max(stretches, key=lambda stretch: stretch[1] - stretch[0], default=None)


def _values_at(ramps: Ramps, index: np.ndarray, times: FloatArray) -> FloatArray:
    """Return the values of the pieces `index` at `times`, each in its piece."""
    first, last = ramps.first[index], ramps.last[index]
    begin, length = ramps.begin[index], ramps.end[index] - ramps.begin[index]
    share = np.divide(times - begin, length, out=np.zeros(len(times)), where=length > 0)
    slope = np.subtract(last, first, out=np.zeros(len(times)), where=first != last)
    return np.asarray(np.where(share >= 1, last, first + slope * share), np.float64)


def _part_above(ramps: Ramps, limit: float) -> tuple[FloatArray, FloatArray]:
    """Return the part of each piece in which it is above `limit`; begin and end are equal for a piece that is not."""
    first, last = ramps.first, ramps.last
    length = ramps.end - ramps.begin
    change = np.subtract(last, first, out=np.zeros(len(first)), where=first != last)
    share = np.divide(limit - first, change, out=np.zeros(len(first)), where=change != 0)
    crossing = np.clip(ramps.begin + share * length, ramps.begin, ramps.end)
    begin = np.where(first > limit, ramps.begin, np.where(last > limit, crossing, ramps.end))
    end = np.where(last > limit, ramps.end, np.where(first > limit, crossing, ramps.end))
    return begin, end
