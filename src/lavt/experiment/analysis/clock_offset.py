"""Delta = t_server - t_client at any moment of a run, and how wrong it can be: by clock samples or by probes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lavt.domain import NS_PER_S, FloatArray
from lavt.recording.table import MISSING, BoolArray, IntArray, Table

DRIFT_ALLOWANCE = 500e-6
"""How fast Delta may change without anybody saying so: a kernel's own steering (ntpd, timesyncd) goes up to 500 ppm,
two crystals differ by less. Only chrony may be faster, and says by how much it corrects."""


@dataclass(frozen=True, slots=True)
class ClockOffset:
    """Delta at moments of the client's wall clock, in order, and how far from the truth the line between them can be.

    `bound_ns` is NaN where nobody knows. Before the first and after the last moment it grows by `outside` nanoseconds
    in each.
    """

    client_wall_ns: IntArray
    delta_ns: FloatArray
    bound_ns: FloatArray
    outside: float

    def at(self, client_wall_ns: IntArray) -> IntArray:
        """Delta in ns at wall times of the client: linear between moments, constant before and after them."""
        return np.asarray(np.rint(_between(client_wall_ns, self.client_wall_ns, self.delta_ns)), np.int64)

    def bound_at(self, client_wall_ns: IntArray) -> FloatArray:
        """How wrong Delta can be then, in ns."""
        nearest = np.clip(client_wall_ns, self.client_wall_ns[0], self.client_wall_ns[-1])
        beyond_ns = self.outside * np.abs(client_wall_ns - nearest)
        return np.asarray(_between(nearest, self.client_wall_ns, self.bound_ns) + beyond_ns, np.float64)

    def on_server_ns(self, client_wall_ns: IntArray) -> IntArray:
        """Turn wall times of the client into those of the server; what is missing stays missing."""
        known = client_wall_ns != MISSING
        server_ns = np.full(len(client_wall_ns), MISSING, np.int64)
        server_ns[known] = client_wall_ns[known] + self.at(client_wall_ns[known])
        return server_ns


NO_OFFSET = ClockOffset(np.zeros(1, np.int64), np.zeros(1), np.zeros(1), 0.0)
"""That of two hosts which share a clock."""


def _between(wanted: IntArray, moments: IntArray, values: FloatArray) -> FloatArray:
    origin = moments[0]  # floats hold differences of wall times exactly, wall times themselves not
    return np.asarray(np.interp((wanted - origin).astype(float), (moments - origin).astype(float), values), np.float64)


# By the hosts' own sources of time.


@dataclass(frozen=True, slots=True)
class _Correction:
    """What must be added to one host's wall clock, at moments of reference time, in ns."""

    reference_ns: IntArray
    correction_ns: FloatArray
    own_bound_ns: FloatArray
    peer_bound_ns: FloatArray
    """That of the correction against the other host's reference, where the source follows that host; else NaN.

    The root distance reaches over the path to that host and beyond, and goes by the best samples; what is told of the
    path goes by the last one: both hold, and the smaller counts.
    """
    requested_ns: FloatArray
    """What the correction can have changed by while the source was asked for it."""

    def at(self, reference_ns: IntArray, values: FloatArray) -> FloatArray:
        """Give a quantity of the samples at other moments: linear between them, constant before and after."""
        return _between(reference_ns, self.reference_ns, values)


def by_sources(server: Table, client: Table) -> ClockOffset | None:
    """Delta by what both hosts' sources of time say, from their channels `clock`; None where one of them cannot tell.

    Its moments are those of the samples of both, as long as both know theirs; beyond them it is taken to go on changing
    at most twice as fast as it did there. The bound is that of the host
    which follows the other where one does, else the sum of both hosts' own, and what the line between two samples can
    miss (`docs/metrics.md`).
    """
    hosts = [_correction(server, client), _correction(client, server)]
    if hosts[0] is None or hosts[1] is None:
        return None
    of_server, of_client = hosts[0], hosts[1]
    moments = np.union1d(of_server.reference_ns, of_client.reference_ns)
    first, last = (pick(each.reference_ns[at] for each in (of_server, of_client)) for pick, at in ((max, 0), (min, -1)))
    moments = moments[(moments >= first) & (moments <= last)]
    if len(moments) == 0:
        return None
    bound_ns = of_server.at(moments, of_server.own_bound_ns) + of_client.at(moments, of_client.own_bound_ns)
    for follower in (of_server, of_client):
        peer_bound_ns = follower.at(moments, follower.peer_bound_ns)
        bound_ns = np.where(np.isfinite(peer_bound_ns), peer_bound_ns, bound_ns)
    for each in (of_server, of_client):
        bound_ns = bound_ns + each.at(moments, each.requested_ns) + _missed_ns(moments, each)
    correction_ns = of_client.at(moments, of_client.correction_ns)
    delta_ns = correction_ns - of_server.at(moments, of_server.correction_ns)
    outside = 2 * float(np.max(np.abs(_rates(moments, delta_ns))[[0, -1]])) if len(moments) > 1 else DRIFT_ALLOWANCE
    return ClockOffset(moments - np.rint(correction_ns).astype(np.int64), delta_ns, bound_ns, outside)


def known_samples(samples: Table) -> Table:
    """Samples from the first that knows the correction on; none where a later one does not."""
    known = np.isfinite(samples.floats("correction_s")) & (samples.ints("wall_ns") != MISSING)
    whole = known.any() and known[np.argmax(known) :].all()
    return samples.where(known if whole else np.zeros(len(samples), np.bool_))


def follows(samples: Table, other: Table) -> BoolArray:
    """Tell for each of a host's samples whether its source follows the other host."""
    addresses = {address for entry in other.objects("addresses") for address in entry or ()}
    return np.array([each in addresses for each in samples.texts("follows")], np.bool_)


def _correction(samples: Table, other: Table) -> _Correction | None:
    samples = known_samples(samples)
    if len(samples) == 0:
        return None
    correction_ns = samples.floats("correction_s") * NS_PER_S
    reference_ns = samples.ints("wall_ns") + np.rint(correction_ns).astype(np.int64)
    order = np.argsort(reference_ns, kind="stable")
    reference_ns, correction_ns, samples = reference_ns[order], correction_ns[order], _ordered(samples, order)
    half_asking_ns = np.nan_to_num(samples.floats("asking_s")) * NS_PER_S / 2
    rates = np.abs(_rates(reference_ns, correction_ns))
    requested_ns = half_asking_ns * np.maximum(np.append(rates, 0.0), np.append(0.0, rates))
    drift_s = samples.floats("skew_ppm") / 1e6 * samples.floats("age_s")
    path_s = samples.floats("peer_delay_s") / 2 + samples.floats("peer_dispersion_s") + drift_s
    own_bound_s = samples.floats("bound_s")
    following_s = np.where(follows(samples, other), np.fmin(path_s, own_bound_s), np.nan)
    return _Correction(reference_ns, correction_ns, own_bound_s * NS_PER_S, following_s * NS_PER_S, requested_ns)


def _ordered(samples: Table, order: IntArray) -> Table:
    columns = {name: column[order] for name, column in samples.columns.items()}
    return Table(samples.mono_ns[order], samples.wall_ns[order], columns)


def _rates(moments: IntArray, values: FloatArray) -> FloatArray:
    """Slope of each line from a sample to the next."""
    return np.diff(values) / np.maximum(np.diff(moments), 1)


def _missed_ns(moments: IntArray, samples: _Correction) -> FloatArray:
    """How far the truth can be from the line between two samples.

    Nobody sees when between them a clock began or ceased to be steered: what a line rises more or less than its
    neighbours may have come all at once.
    """
    if len(samples.reference_ns) < 3:
        return np.zeros(len(moments))
    rates = _rates(samples.reference_ns, samples.correction_ns)
    bends = np.abs(np.diff(rates))
    missed_ns = np.maximum(np.append(bends, 0.0), np.append(0.0, bends)) * np.diff(samples.reference_ns)
    interval = np.clip(np.searchsorted(samples.reference_ns, moments, "right") - 1, 0, len(missed_ns) - 1)
    return np.asarray(missed_ns[interval], np.float64)


# By the probe.


@dataclass(frozen=True, slots=True)
class ProbeExchanges:
    """Exchanges of the probe, in order: when, on both wall clocks, and what each says of Delta, in ns."""

    client_wall_ns: IntArray
    server_wall_ns: IntArray
    delta_ns: FloatArray
    round_trip_ns: IntArray

    def __len__(self) -> int:
        return len(self.client_wall_ns)

    def within(self, began_wall_ns: int, ended_wall_ns: int) -> ProbeExchanges:
        """Those of an interval of the server's wall clock."""
        chosen = (self.server_wall_ns >= began_wall_ns) & (self.server_wall_ns <= ended_wall_ns)
        return self.where(chosen)

    def where(self, chosen: BoolArray | IntArray) -> ProbeExchanges:
        """Choose some."""
        return ProbeExchanges(
            self.client_wall_ns[chosen], self.server_wall_ns[chosen], self.delta_ns[chosen], self.round_trip_ns[chosen]
        )


def exchanges(probes: Table) -> ProbeExchanges:
    """Read the channel `clock_probe`; a clock that was set in the middle of an exchange spoils it, where that shows."""
    names = ("sent_wall_ns", "received_wall_ns", "answered_wall_ns", "arrived_wall_ns")
    sent, received, answered, arrived = (probes.ints(name) for name in names)
    found = ProbeExchanges(
        sent + (arrived - sent) // 2,
        received + (answered - received) // 2,
        ((received - sent) + (answered - arrived)) / 2,
        (arrived - sent) - (answered - received),
    )
    good = np.all([times != MISSING for times in (sent, received, answered, arrived)], axis=0)
    good &= found.round_trip_ns >= 0
    order = np.argsort(found.client_wall_ns[good], kind="stable")
    return found.where(np.flatnonzero(good)[order])


def by_probe(every: ProbeExchanges) -> ClockOffset | None:
    """Delta by the probe alone: at the time of each exchange by the one, of all, that says most of it.

    An exchange says Delta to half its round trip, and later or earlier to as much more as clocks may drift apart.
    """
    if len(every) == 0:
        return None
    when_ns = (every.client_wall_ns - every.client_wall_ns[0]).astype(float)
    half_ns = every.round_trip_ns / 2
    before = _running_least(half_ns - DRIFT_ALLOWANCE * when_ns)
    after = len(every) - 1 - _running_least((half_ns + DRIFT_ALLOWANCE * when_ns)[::-1])[::-1]
    bounds_ns = [half_ns[each] + DRIFT_ALLOWANCE * np.abs(when_ns - when_ns[each]) for each in (before, after)]
    delta_ns = every.delta_ns[np.where(bounds_ns[0] <= bounds_ns[1], before, after)]
    gaps_ns = np.diff(when_ns)
    between_ns = DRIFT_ALLOWANCE * np.maximum(np.append(gaps_ns, 0.0), np.append(0.0, gaps_ns)) / 2
    return ClockOffset(every.client_wall_ns, delta_ns, np.minimum(*bounds_ns) + between_ns, DRIFT_ALLOWANCE)


def _running_least(values: FloatArray) -> IntArray:
    """Where the least of all values up to each is."""
    return np.maximum.accumulate(np.where(values == np.minimum.accumulate(values), np.arange(len(values)), 0))
