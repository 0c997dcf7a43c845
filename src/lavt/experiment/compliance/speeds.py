"""The speed of a drive between two reports of it, the distance driven blind, and the speed that latency allowed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lavt.domain import NS_PER_S, FloatArray
from lavt.experiment.compliance.ramps import Interval, Ramps
from lavt.recording.record import Record
from lavt.recording.table import MISSING
from lavt.safety.limits import LIMITS

LARGEST_ACCELERATION_MPS2 = 10.0
"""Between two reports, the speed is assumed to change by at most this rate, in both directions. This is about 1 g, the
limit of tyres on a dry road; only a collision exceeds it, and then the speed lies between the reports."""

SOURCES = {"truth": ("mono_ns", "the simulator's true speed"), "state": ("state_mono_ns", "the vehicle's own report")}
"""For each channel that has speeds, in order of preference: the field with their time, and what they are."""


@dataclass(frozen=True, slots=True)
class SpeedReports:
    """The absolute speed in m/s at ascending times, in ns since the start of the drive; both arrays are (reports,)."""

    time_ns: FloatArray
    speed_mps: FloatArray
    source: str
    """What the speeds are; empty if there are none."""

    def bounds(self, begin_ns: FloatArray, end_ns: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the lowest and the highest possible speed in pieces of time that contain no report inside.

        Without reports, these are 0 and infinity.
        """
        if not len(self.time_ns):
            return np.zeros(len(begin_ns)), np.full(len(begin_ns), np.inf)
        after = np.searchsorted(self.time_ns, (begin_ns + end_ns) / 2)
        before = np.clip(after - 1, 0, len(self.time_ns) - 1)
        after = np.clip(after, 0, len(self.time_ns) - 1)
        outside_ns = np.maximum(self.time_ns[0] - begin_ns, 0.0) + np.maximum(end_ns - self.time_ns[-1], 0.0)
        gap_ns = self.time_ns[after] - self.time_ns[before] + 2 * outside_ns  # outside, the speed need not return
        ends = np.array([self.speed_mps[before], self.speed_mps[after]])
        reach_mps = LARGEST_ACCELERATION_MPS2 * gap_ns / NS_PER_S / 2
        low = np.minimum(ends.min(axis=0), ends.mean(axis=0) - reach_mps)
        return np.maximum(low, 0.0), np.maximum(ends.max(axis=0), ends.mean(axis=0) + reach_mps)

    def at(self, time_ns: float) -> float | None:
        """Return the speed at a moment, interpolated linearly; None without reports."""
        return float(np.interp(time_ns, self.time_ns, self.speed_mps)) if len(self.time_ns) else None

    def standstill_ns(self, since_ns: float) -> Interval | None:
        """Return between which times the vehicle became stationary after `since_ns`; None: not while it was recorded.

        It is stationary at the first report below the limit of the safety gate.
        """
        stationary = np.flatnonzero((self.time_ns >= since_ns) & (self.speed_mps < LIMITS.standstill_mps))
        if not len(stationary):
            return None
        first = int(stationary[0])
        return max(since_ns, float(self.time_ns[first - 1]) if first else since_ns), float(self.time_ns[first])

    def distance_m(self, begin_ns: float, end_ns: float) -> tuple[float, float] | None:
        """Return the bounds of the distance driven between two times; None without reports.

        The middle is the trapezoid rule. Its largest error is that of a speed that rises and falls, or falls and rises,
        at the largest rate between two reports.
        """
        if not len(self.time_ns) or end_ns <= begin_ns:
            return (0.0, 0.0) if len(self.time_ns) else None
        inside = self.time_ns[(self.time_ns > begin_ns) & (self.time_ns < end_ns)]
        times_ns = np.concatenate([[begin_ns], inside, [end_ns]])
        speeds = np.interp(times_ns, self.time_ns, self.speed_mps)
        seconds = np.diff(times_ns) / NS_PER_S
        middle = float(np.sum(seconds * (speeds[1:] + speeds[:-1]) / 2))
        largest = LARGEST_ACCELERATION_MPS2
        error = np.maximum((largest * seconds) ** 2 - np.diff(speeds) ** 2, 0.0) / (4 * largest)
        return max(middle - float(np.sum(error)), 0.0), middle + float(np.sum(error))


def speed_reports(server: Record, began_ns: int) -> SpeedReports:
    """Return the speeds in the server's record, from the ground truth or, of a real vehicle, from its own reports."""
    for channel, (time, source) in SOURCES.items():
        table = server.table(channel)
        times_ns, speeds = table.ints(time), np.abs(table.floats("speed_mps"))
        is_known = (times_ns != MISSING) & np.isfinite(speeds)
        if is_known.any():
            unique_ns, first = np.unique(times_ns[is_known], return_index=True)
            return SpeedReports((unique_ns - began_ns).astype(np.float64), speeds[is_known][first], source)
    return SpeedReports(np.zeros(0), np.zeros(0), "")


def blind_distance(age_ns: tuple[Ramps, Ramps], speeds: SpeedReports) -> tuple[Ramps, Ramps]:
    """Return the lower and upper bound of speed x frame age in m: how far the vehicle drove since it saw the scene."""
    low, high = (ramps.split_at(speeds.time_ns) for ramps in age_ns)
    slowest, _ = speeds.bounds(low.begin, low.end)
    _, fastest = speeds.bounds(high.begin, high.end)
    return _scaled(low, slowest / NS_PER_S), _scaled(high, fastest / NS_PER_S)


def excess(blind_m: tuple[Ramps, Ramps], speeds: SpeedReports, nominal_mps: float) -> tuple[Ramps, Ramps]:
    """Return the blind distance, but infinite where the speed alone exceeds the nominal speed, by both bounds.

    So it is above nominal speed x latency limit exactly where the speed is above the one that the latency allowed.
    """
    low, high = blind_m
    slowest, _ = speeds.bounds(low.begin, low.end)
    _, fastest = speeds.bounds(high.begin, high.end)
    return _infinite_where(low, slowest > nominal_mps), _infinite_where(high, fastest > nominal_mps)


def _scaled(ramps: Ramps, factors: FloatArray) -> Ramps:
    with np.errstate(invalid="ignore"):  # an unknown age of a vehicle that is certainly stationary
        first, last = (np.where(factors > 0, values * factors, 0.0) for values in (ramps.first, ramps.last))
    is_infinite = ~np.isfinite(first) | ~np.isfinite(last)
    return Ramps(ramps.begin, ramps.end, np.where(is_infinite, np.inf, first), np.where(is_infinite, np.inf, last))


def _infinite_where(ramps: Ramps, is_infinite: np.ndarray) -> Ramps:
    values = (np.where(is_infinite, np.inf, values) for values in (ramps.first, ramps.last))
    return Ramps(ramps.begin, ramps.end, *values)
