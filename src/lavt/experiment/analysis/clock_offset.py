"""The clock offset Delta = t_server - t_client during a run, with its error bound, from time sources or the probe."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lavt.domain import NS_PER_S, FloatArray
from lavt.recording.table import MISSING, BoolArray, IntArray, Table

DRIFT_ALLOWANCE = 500e-6
"""The assumed largest rate at which Delta changes without a report of it. 500 ppm is the largest frequency correction
of a Linux kernel (`MAXFREQ`) and its rate for adjtime() (`MAX_TICKADJ`); two crystals differ by less. Chrony can steer
faster, and reports its corrections. `docs/metrics.md` says when the assumption is wrong."""


@dataclass(frozen=True, slots=True)
class ClockOffset:
    """Delta at ascending times of the client's wall clock.

    Between these times Delta is interpolated linearly, and `bound_ns` limits the error of the result, or is NaN where
    no limit is known. Before the first and after the last time the bound grows by `drift_outside` (ns per ns).
    """

    client_wall_ns: IntArray
    delta_ns: FloatArray
    bound_ns: FloatArray
    drift_outside: float

    def at(self, client_wall_ns: IntArray) -> IntArray:
        """Return Delta in ns at wall times of the client: interpolated linearly, constant outside the known times."""
        return np.asarray(np.rint(_interpolate(client_wall_ns, self.client_wall_ns, self.delta_ns)), np.int64)

    def bound_at(self, client_wall_ns: IntArray) -> FloatArray:
        """Return the error bound of Delta in ns at wall times of the client."""
        nearest_ns = np.clip(client_wall_ns, self.client_wall_ns[0], self.client_wall_ns[-1])
        outside_ns = self.drift_outside * np.abs(client_wall_ns - nearest_ns)
        return np.asarray(_interpolate(nearest_ns, self.client_wall_ns, self.bound_ns) + outside_ns, np.float64)

    def on_server_ns(self, client_wall_ns: IntArray) -> IntArray:
        """Convert wall times of the client to the server's wall clock; `MISSING` remains `MISSING`."""
        known = client_wall_ns != MISSING
        server_ns = np.full(len(client_wall_ns), MISSING, np.int64)
        server_ns[known] = client_wall_ns[known] + self.at(client_wall_ns[known])
        return server_ns


NO_OFFSET = ClockOffset(np.zeros(1, np.int64), np.zeros(1), np.zeros(1), 0.0)
"""The clock offset between two hosts that share a clock."""


def _interpolate(at_times: IntArray, times: IntArray, values: FloatArray) -> FloatArray:
    origin = times[0]  # a float represents differences of wall times exactly, but not wall times
    return np.asarray(np.interp((at_times - origin).astype(float), (times - origin).astype(float), values), np.float64)


# From the hosts' own time sources.


@dataclass(frozen=True, slots=True)
class _Correction:
    """The correction of one host's wall clock (reference minus wall clock) at reference times, in ns."""

    reference_ns: IntArray
    correction_ns: FloatArray
    own_bound_ns: FloatArray
    """The bound relative to the reference: NTP's root distance, which covers the whole path, from the best samples."""
    peer_bound_ns: FloatArray
    """The bound relative to the other host's clock where the time source follows that host; NaN elsewhere.

    It is the smaller of two valid bounds: `own_bound_ns`, and the bound from the peer delay and dispersion, which cover
    only the path to the other host, from the last sample.
    """
    query_ns: FloatArray
    """The largest possible change of the correction during the query of the time source."""

    def at(self, reference_ns: IntArray, values: FloatArray) -> FloatArray:
        """Return a quantity of the samples at other times: interpolated linearly, constant outside the samples."""
        return _interpolate(reference_ns, self.reference_ns, values)


def offset_from_sources(server: Table, client: Table) -> ClockOffset | None:
    """Return Delta from the time sources of both hosts (their channels `clock`).

    None if the correction of a host is unknown, or if the samples of the two hosts do not overlap in time.

    The times of the result are those of the samples of both hosts, in the interval that the samples of both hosts
    cover. Outside this interval Delta is assumed to change at most twice as fast as at that end of the interval where
    it changes faster. Where one host follows the other, the bound is that of the follower, otherwise the sum of both
    hosts' own bounds. The possible error of the interpolation between two samples is added (`docs/metrics.md`).
    """
    of_server, of_client = _correction(server, client), _correction(client, server)
    if of_server is None or of_client is None:
        return None
    times = np.union1d(of_server.reference_ns, of_client.reference_ns)
    first_ns = max(of_server.reference_ns[0], of_client.reference_ns[0])
    last_ns = min(of_server.reference_ns[-1], of_client.reference_ns[-1])
    times = times[(times >= first_ns) & (times <= last_ns)]
    if len(times) == 0:
        return None
    bound_ns = of_server.at(times, of_server.own_bound_ns) + of_client.at(times, of_client.own_bound_ns)
    for follower in (of_server, of_client):
        peer_bound_ns = follower.at(times, follower.peer_bound_ns)
        bound_ns = np.where(np.isfinite(peer_bound_ns), peer_bound_ns, bound_ns)
    for correction in (of_server, of_client):
        query_ns = correction.at(times, correction.query_ns)
        bound_ns = bound_ns + query_ns + _interpolation_error_ns(times, correction)
    correction_ns = of_client.at(times, of_client.correction_ns)
    delta_ns = correction_ns - of_server.at(times, of_server.correction_ns)
    drift_outside = 2 * float(np.max(np.abs(_rates(times, delta_ns))[[0, -1]])) if len(times) > 1 else DRIFT_ALLOWANCE
    return ClockOffset(times - np.rint(correction_ns).astype(np.int64), delta_ns, bound_ns, drift_outside)


def known_samples(samples: Table) -> Table:
    """Return the samples from the first one with a known correction to the end.

    Return none of them where the correction is unknown in a later sample.
    """
    known = np.isfinite(samples.floats("correction_s")) & (samples.ints("wall_ns") != MISSING)
    is_complete = known.any() and known[np.argmax(known) :].all()
    return samples.where(known if is_complete else np.zeros(len(samples), np.bool_))


def follows_peer(samples: Table, other: Table) -> BoolArray:
    """Return for each of a host's samples whether its time source follows the other host."""
    addresses = {address for entry in other.objects("addresses") for address in entry or ()}
    return np.array([address in addresses for address in samples.texts("follows")], np.bool_)


def _correction(samples: Table, other: Table) -> _Correction | None:
    samples = known_samples(samples)
    if len(samples) == 0:
        return None
    correction_ns = samples.floats("correction_s") * NS_PER_S
    reference_ns = samples.ints("wall_ns") + np.rint(correction_ns).astype(np.int64)
    order = np.argsort(reference_ns, kind="stable")
    reference_ns, correction_ns, samples = reference_ns[order], correction_ns[order], samples.where(order)
    half_query_ns = np.nan_to_num(samples.floats("asking_s")) * NS_PER_S / 2
    rates = np.abs(_rates(reference_ns, correction_ns))
    query_ns = half_query_ns * np.maximum(np.append(rates, 0.0), np.append(0.0, rates))
    drift_s = samples.floats("skew_ppm") / 1e6 * samples.floats("age_s")
    path_s = samples.floats("peer_delay_s") / 2 + samples.floats("peer_dispersion_s") + drift_s
    own_bound_s = samples.floats("bound_s")
    peer_bound_s = np.where(follows_peer(samples, other), np.fmin(path_s, own_bound_s), np.nan)
    return _Correction(reference_ns, correction_ns, own_bound_s * NS_PER_S, peer_bound_s * NS_PER_S, query_ns)


def _rates(times: IntArray, values: FloatArray) -> FloatArray:
    """Return the slope of the line from each sample to the next."""
    return np.diff(values) / np.maximum(np.diff(times), 1)


def _interpolation_error_ns(times: IntArray, samples: _Correction) -> FloatArray:
    """Return the largest error of the linear interpolation between two samples, at each of `times`.

    The steering of a clock may begin or end at any moment between two samples. The bound assumes that the whole change
    of slope to a neighbouring interval occurred at once.
    """
    if len(samples.reference_ns) < 3:
        return np.zeros(len(times))
    rates = _rates(samples.reference_ns, samples.correction_ns)
    slope_changes = np.abs(np.diff(rates))
    largest_changes = np.maximum(np.append(slope_changes, 0.0), np.append(0.0, slope_changes))
    error_ns = largest_changes * np.diff(samples.reference_ns)
    interval = np.clip(np.searchsorted(samples.reference_ns, times, "right") - 1, 0, len(error_ns) - 1)
    return np.asarray(error_ns[interval], np.float64)


# From the probe.


@dataclass(frozen=True, slots=True)
class ProbeExchanges:
    """Exchanges of the clock probe, in order of time.

    Each has its time on both wall clocks, the measured Delta, and the round trip.
    """

    client_wall_ns: IntArray
    server_wall_ns: IntArray
    delta_ns: FloatArray
    round_trip_ns: IntArray

    def __len__(self) -> int:
        return len(self.client_wall_ns)

    def within(self, began_wall_ns: int, ended_wall_ns: int) -> ProbeExchanges:
        """Return the exchanges in an interval of the server's wall clock."""
        return self.where((self.server_wall_ns >= began_wall_ns) & (self.server_wall_ns <= ended_wall_ns))

    def where(self, chosen: BoolArray | IntArray) -> ProbeExchanges:
        """Return the exchanges for which `chosen` is true, or those with the indexes `chosen`."""
        return ProbeExchanges(
            self.client_wall_ns[chosen], self.server_wall_ns[chosen], self.delta_ns[chosen], self.round_trip_ns[chosen]
        )


def probe_exchanges(probes: Table) -> ProbeExchanges:
    """Return the exchanges of the channel `clock_probe`, except incomplete ones and those with a negative round trip.

    A round trip is negative where a clock was set during the exchange.
    """
    names = ("sent_wall_ns", "received_wall_ns", "answered_wall_ns", "arrived_wall_ns")
    sent, received, answered, arrived = (probes.ints(name) for name in names)
    exchanges = ProbeExchanges(
        sent + (arrived - sent) // 2,
        received + (answered - received) // 2,
        ((received - sent) + (answered - arrived)) / 2,
        (arrived - sent) - (answered - received),
    )
    is_valid = np.all([times != MISSING for times in (sent, received, answered, arrived)], axis=0)
    is_valid &= exchanges.round_trip_ns >= 0
    order = np.argsort(exchanges.client_wall_ns[is_valid], kind="stable")
    return exchanges.where(np.flatnonzero(is_valid)[order])


def offset_from_probe(exchanges: ProbeExchanges) -> ClockOffset | None:
    """Return Delta from the probe alone, at the time of each exchange; None without exchanges.

    The value at a time is that of the exchange with the smallest bound at that time. The bound of an exchange is half
    its round trip, plus the possible drift of the clocks between the exchange and that time. The drift in half of the
    longer gap to a neighbouring exchange is added, because Delta is interpolated between the exchanges.
    """
    if len(exchanges) == 0:
        return None
    times_ns = (exchanges.client_wall_ns - exchanges.client_wall_ns[0]).astype(float)
    half_ns = exchanges.round_trip_ns / 2
    best_before = _running_argmin(half_ns - DRIFT_ALLOWANCE * times_ns)
    best_after = len(exchanges) - 1 - _running_argmin((half_ns + DRIFT_ALLOWANCE * times_ns)[::-1])[::-1]
    bounds_ns = [
        half_ns[best] + DRIFT_ALLOWANCE * np.abs(times_ns - times_ns[best]) for best in (best_before, best_after)
    ]
    delta_ns = exchanges.delta_ns[np.where(bounds_ns[0] <= bounds_ns[1], best_before, best_after)]
    gaps_ns = np.diff(times_ns)
    interpolation_ns = DRIFT_ALLOWANCE * np.maximum(np.append(gaps_ns, 0.0), np.append(0.0, gaps_ns)) / 2
    return ClockOffset(exchanges.client_wall_ns, delta_ns, np.minimum(*bounds_ns) + interpolation_ns, DRIFT_ALLOWANCE)


def _running_argmin(values: FloatArray) -> IntArray:
    """Return for each position the index of the smallest value up to it."""
    return np.maximum.accumulate(np.where(values == np.minimum.accumulate(values), np.arange(len(values)), 0))
