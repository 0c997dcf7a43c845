"""Times of two hosts on one scale, from the clock samples of a run's records.

Reference time is a host's wall clock plus its correction, so Delta = t_server - t_client = correction_client -
correction_server. Both hosts sample their correction at least once a second; between samples it is interpolated.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lavt.domain import NS_PER_S, FloatArray
from lavt.experiment.table import MISSING, IntArray, Table


@dataclass(frozen=True, slots=True)
class Correction:
    """What must be added to one host's wall clock: samples in order of `wall_ns`."""

    wall_ns: IntArray
    correction_ns: FloatArray

    def at(self, wall_ns: IntArray) -> IntArray:
        """Correction in ns at wall times of this host: linear between samples, constant before and after them."""
        origin_ns = self.wall_ns[0]  # floats hold differences of wall times exactly, wall times themselves not
        between = np.interp(wall_ns - origin_ns, self.wall_ns - origin_ns, self.correction_ns)
        return np.asarray(np.rint(between), np.int64)

    def reference_ns(self, wall_ns: IntArray) -> IntArray:
        """Turn wall times of this host into reference time; what is missing stays missing."""
        known = wall_ns != MISSING
        reference = np.full(len(wall_ns), MISSING, np.int64)
        reference[known] = wall_ns[known] + self.at(wall_ns[known])
        return reference


@dataclass(frozen=True, slots=True)
class Clocks:
    """The corrections of both hosts, and how wrong their difference can be at most (None: nobody knows)."""

    server: Correction
    client: Correction
    bound_s: float | None


_SAME = Correction(np.zeros(1, np.int64), np.zeros(1))


def clocks(server: Table, client: Table) -> Clocks | None:
    """Put two hosts on one scale, from their channels `clock`; None where one of them gave no sample.

    Hosts that report the same name share a kernel, and so a clock: Delta is 0 and so is its bound. Otherwise the bound
    is the largest of the server's plus the largest of the client's over the run.
    """
    if len(server) == 0 or len(client) == 0:
        return None
    hosts = set(server.texts("host")) | set(client.texts("host"))
    if len(hosts) == 1 and "" not in hosts:
        return Clocks(_SAME, _SAME, 0.0)
    corrections = (_correction(server), _correction(client))
    if corrections[0] is None or corrections[1] is None:
        return None
    bounds_s = (_largest(server.floats("bound_s")), _largest(client.floats("bound_s")))
    known = bounds_s[0] is not None and bounds_s[1] is not None
    return Clocks(corrections[0], corrections[1], (bounds_s[0] or 0.0) + (bounds_s[1] or 0.0) if known else None)


def _correction(samples: Table) -> Correction | None:
    wall_ns = samples.ints("wall_ns")
    correction_s = samples.floats("correction_s")
    known = (wall_ns != MISSING) & np.isfinite(correction_s)
    if not known.any():
        return None
    order = np.argsort(wall_ns[known], kind="stable")
    return Correction(wall_ns[known][order], correction_s[known][order] * NS_PER_S)


def _largest(bound_s: FloatArray) -> float | None:
    """Largest bound; None as soon as one sample has none, because then the run has times without a bound."""
    return None if len(bound_s) == 0 or np.isnan(bound_s).any() else float(bound_s.max())
