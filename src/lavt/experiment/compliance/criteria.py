"""The criteria of the compliance report: what is compared with a limit, and the verdict by the bounds of the value."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

from lavt.domain import NS_PER_MS
from lavt.errors import UserError
from lavt.safety.limits import LIMITS

Verdict = Literal["within", "above", "not decided"]
Bounds = tuple[float, float]
"""The lowest and the highest possible value; infinity: no upper bound."""


class Criterion(NamedTuple):
    """A value of a drive that has a threshold; `default` is its largest allowed value."""

    default: float
    title: str
    unit: str
    """`share` (0 to 1), `s` or empty for a number."""


CRITERIA: Mapping[str, Criterion] = {
    "above_share": Criterion(0.0, "share of time with the frame age above the limit", "share"),
    "longest_above_s": Criterion(0.0, "longest stretch with the frame age above the limit", "s"),
    "two_way_above_share": Criterion(0.0, "share of time with the two-way latency above the limit", "share"),
    "outages": Criterion(0.0, "number of outages", ""),
    "manoeuvres": Criterion(0.0, "number of minimal-risk manoeuvres", ""),
    "longest_manoeuvre_s": Criterion(5.0, "longest minimal-risk manoeuvre", "s"),
    "too_fast_share": Criterion(0.0, "share of time faster than the latency allowed", "share"),
}
"""All criteria by the key of their value in a drive's entry. From 40 km/h, a safe stop is planned to take 3.3 s: the
threshold of 5 s leaves room for a slope or weak brakes."""


MAX_MS = 1e6
"""The largest limit: no picture of a drive is older."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ComplianceLimits:
    """What drives are compared with. Raises `UserError` for a limit that is not a positive number, and so on."""

    latency_ms: float = 200.0
    outage_ms: float = LIMITS.degraded_after_ns / NS_PER_MS
    """The longest time without a command from a newer frame that is no outage: the gate's limit for `degraded`."""
    nominal_mps: float | None = None
    """The speed that is allowed while the latency is within its limit; None: the speed limit of each run's config."""
    camera_ms: float | None = None
    """The largest time from exposure to stamp of a camera that does not report it; None: unknown."""
    thresholds: Mapping[str, float] = field(default_factory=dict)
    """Thresholds other than the default, by criterion."""

    def __post_init__(self) -> None:
        for name, value in (("--limit-ms", self.latency_ms), ("--outage-ms", self.outage_ms)):
            _check(name, value, 0 < value <= MAX_MS, f"a positive number of ms, at most {MAX_MS:g}")
        if self.nominal_mps is not None:
            is_valid = math.isfinite(self.nominal_mps) and self.nominal_mps > 0
            _check("--nominal-kmh", self.nominal_mps * 3.6, is_valid, "a positive speed in km/h")
        if self.camera_ms is not None:
            is_valid = math.isfinite(self.camera_ms) and self.camera_ms >= 0
            _check("--camera-ms", self.camera_ms, is_valid, "a number of ms that is not negative")

    def threshold(self, criterion: str) -> float:
        """Return the largest allowed value of a criterion."""
        return self.thresholds.get(criterion, CRITERIA[criterion].default)


def _check(option: str, value: float, is_valid: bool, expected: str) -> None:
    if not is_valid:
        raise UserError(f"{option} is {value:g}: give {expected}")


def parse_thresholds(words: Iterable[str]) -> dict[str, float]:
    """Return the thresholds by criterion from words such as `above_share=0.05`; raise `UserError` for others."""
    thresholds = {}
    for word in words:
        name, equals, text = word.partition("=")
        if not equals or name not in CRITERIA:
            raise UserError(f"--threshold {word} names no criterion: give a number for one of {'=, '.join(CRITERIA)}=")
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not (math.isfinite(value) and value >= 0):
            raise UserError(f"--threshold {word} has no valid number: give one that is not negative")
        thresholds[name] = value
    return thresholds


def as_bounds(value: Bounds | float) -> Bounds:
    """Return the bounds of a value: those of a pair, or an exact number twice."""
    return value if isinstance(value, tuple) else (float(value), float(value))


def verdict_of(value: Bounds, threshold: float) -> Verdict:
    """Return whether a value is within a threshold, above it, or possibly either."""
    low, high = value
    return "within" if high <= threshold else "above" if low > threshold else "not decided"


def worst_of(verdicts: Sequence[Verdict]) -> Verdict:
    """Return `above` if any verdict is that, `within` if all are, and otherwise `not decided`."""
    if "above" in verdicts:
        return "above"
    return "within" if verdicts and all(verdict == "within" for verdict in verdicts) else "not decided"
