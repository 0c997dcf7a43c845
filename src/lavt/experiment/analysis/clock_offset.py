"""The clock offset Delta = t_server - t_client during a run, with its error bound, from time sources or the probe."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lavt.domain import NS_PER_S, FloatArray
from lavt.recording.table import MISSING, BoolArray, IntArray, Table

DRIFT_ALLOWANCE = 500e-6
"""The assumed largest rate of unreported changes of Delta. 500 ppm is the largest frequency correction of a Linux
kernel (`MAXFREQ`) and the rate of its adjtime() (`MAX_TICKADJ`); the rates of two crystals differ by a smaller amount.
Chrony can steer faster, but reports its corrections. `docs/metrics.md` says when the assumption is wrong."""


@dataclass(frozen=True, slots=True)
class ClockOffset:
    """Delta at ascending times of the client's wall clock.

    Between these times Delta is interpolated linearly. `bound_ns` is the largest possible error of the result; NaN:
    unknown. Before the first and after the last time the bound grows by `drift_outside` (ns per ns).
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

    def to_server_ns(self, client_wall_ns: IntArray) -> IntArray:
        """Convert wall times of the client to the server's wall clock; `MISSING` remains `MISSING`."""
        known = client_wall_ns != MISSING
        server_ns = np.full(len(client_wall_ns), MISSING, np.int64)
        server_ns[known] = client_wall_ns[known] + self.at(client_wall_ns[known])
        return server_ns


NO_OFFSET = ClockOffset(np.zeros(1, np.int64), np.zeros(1), np.zeros(1), 0.0)
"""The clock offset between two hosts that share a clock."""


def _interpolate(at_times: IntArray, times: IntArray, values: FloatArray) -> FloatArray:
    origin = times[0]  # floats are exact for differences of wall times, but not for wall times
    return np.asarray(np.interp((at_times - origin).astype(float), (times - origin).astype(float), values), np.float64)


# From the hosts' own time sources.


@dataclass(frozen=True, slots=True)
class _Correction:
    """The correction of one host's wall clock (reference minus wall clock) at reference times, in ns."""

    reference_ns: IntArray
    correction_ns: FloatArray
    own_bound_ns: FloatArray
    """The error bound relative to the reference. For NTP, this is the root distance, which covers the whole path to the
    reference; chrony computes it from the best samples."""
    peer_bound_ns: FloatArray
    """The error bound relative to the other host's clock, if the time source follows that host; otherwise NaN.

    This is the smaller of two valid bounds. One is `own_bound_ns`. The other is computed from peer delay and dispersion
    of the last sample, which cover only the path to the other host.
    """
    query_ns: FloatArray
    """The largest possible change of the correction during the query of the time source."""

    def interpolate(self, reference_ns: IntArray, values: FloatArray) -> FloatArray:
        """Return `values`, which belong to the samples, at other times: linear between samples, constant outside."""
        return _interpolate(reference_ns, self.reference_ns, values)


def offset_from_sources(server: Table, client: Table) -> ClockOffset | None:
    """Return Delta from the time sources of both hosts (their channels `clock`).

    The result is None if the correction of a host is unknown, or if the samples of the two hosts do not overlap in
    time. Otherwise, its times are the times of all samples in the interval that the samples of both hosts cover.
    Outside this interval, the assumed largest rate of change of Delta is twice its rate at the start or at the end of
    the interval, whichever is higher.

    Where one host follows the other, the bound is the follower's bound relative to that host, otherwise the sum of both
    hosts' own bounds. The possible error of the interpolation between two samples is added (`docs/metrics.md`).
    """
    server_correction, client_correction = _correction(server, client), _correction(client, server)
    if server_correction is None or client_correction is None:
        return None
    corrections = (server_correction, client_correction)
    times = np.union1d(server_correction.reference_ns, client_correction.reference_ns)
    first_ns = max(correction.reference_ns[0] for correction in corrections)
    last_ns = min(correction.reference_ns[-1] for correction in corrections)
    times = times[(times >= first_ns) & (times <= last_ns)]
    if len(times) == 0:
        return None
    own_bounds_ns = [correction.interpolate(times, correction.own_bound_ns) for correction in corrections]
    bound_ns = np.sum(own_bounds_ns, axis=0)
    for follower in corrections:
        peer_bound_ns = follower.interpolate(times, follower.peer_bound_ns)
        bound_ns = np.where(np.isfinite(peer_bound_ns), peer_bound_ns, bound_ns)
    for correction in corrections:
        query_ns = correction.interpolate(times, correction.query_ns)
        bound_ns = bound_ns + query_ns + _interpolation_error_ns(times, correction)
    client_correction_ns = client_correction.interpolate(times, client_correction.correction_ns)
    delta_ns = client_correction_ns - server_correction.interpolate(times, server_correction.correction_ns)
    drift_outside = 2 * float(np.max(np.abs(_rates(times, delta_ns))[[0, -1]])) if len(times) > 1 else DRIFT_ALLOWANCE
    return ClockOffset(times - np.rint(client_correction_ns).astype(np.int64), delta_ns, bound_ns, drift_outside)


def known_samples(samples: Table) -> Table:
    """Return the samples from the first known correction on; no samples if a later correction is unknown."""
    known = np.isfinite(samples.floats("correction_s")) & (samples.ints("wall_ns") != MISSING)
    is_complete = known.any() and known[np.argmax(known) :].all()
    return samples.where(known if is_complete else np.zeros(len(samples), np.bool_))


def follows_peer(samples: Table, other_samples: Table) -> BoolArray:
    """Return for each of a host's samples whether its time source follows the other host."""
    addresses = {address for entry in other_samples.objects("addresses") for address in entry or ()}
    return np.array([address in addresses for address in samples.texts("follows")], np.bool_)


def _correction(samples: Table, other_samples: Table) -> _Correction | None:
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
    peer_bound_s = np.where(follows_peer(samples, other_samples), np.fmin(path_s, own_bound_s), np.nan)
    return _Correction(reference_ns, correction_ns, own_bound_s * NS_PER_S, peer_bound_s * NS_PER_S, query_ns)


def _rates(times: IntArray, values: FloatArray) -> FloatArray:
    """Return the slope of the line from each sample to the next."""
    return np.diff(values) / np.maximum(np.diff(times), 1)


def _interpolation_error_ns(times: IntArray, samples: _Correction) -> FloatArray:
    """Return the largest error of the linear interpolation between two samples, at each of `times`.

    The rate of a clock can change at any moment between two samples. The bound assumes the worst: a single change, as
    large as the whole difference between the slopes of neighbouring intervals.
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

    def select_interval(self, began_wall_ns: int, ended_wall_ns: int) -> ProbeExchanges:
        """Return the exchanges in an interval of the server's wall clock."""
        return self.where((self.server_wall_ns >= began_wall_ns) & (self.server_wall_ns <= ended_wall_ns))

    def where(self, chosen: BoolArray | IntArray) -> ProbeExchanges:
        """Return the exchanges for which `chosen` is true, or the exchanges with the indexes in `chosen`."""
        return ProbeExchanges(
            self.client_wall_ns[chosen], self.server_wall_ns[chosen], self.delta_ns[chosen], self.round_trip_ns[chosen]
        )


def probe_exchanges(probes: Table) -> ProbeExchanges:
    """Return the exchanges of the channel `clock_probe`, without incomplete ones and ones with a negative round trip.

    A round trip is negative if a clock was set during the exchange.
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

    At each time, Delta comes from the exchange that has the smallest bound at this time: half its round trip, plus the
    possible drift of the clocks between the exchange and this time. Because Delta is interpolated between exchanges,
    the possible drift in half of the longer gap to a neighbouring exchange is added to the bound.
    """
    if len(exchanges) == 0:
        return None
    times_ns = (exchanges.client_wall_ns - exchanges.client_wall_ns[0]).astype(float)
    half_ns = exchanges.round_trip_ns / 2
    best_before = _running_argmin(half_ns - DRIFT_ALLOWANCE * times_ns)
    best_after = len(exchanges) - 1 - _running_argmin((half_ns + DRIFT_ALLOWANCE * times_ns)[::-1])[::-1]
    bound_before_ns, bound_after_ns = (
        half_ns[best] + DRIFT_ALLOWANCE * np.abs(times_ns - times_ns[best]) for best in (best_before, best_after)
    )
    delta_ns = exchanges.delta_ns[np.where(bound_before_ns <= bound_after_ns, best_before, best_after)]
    gaps_ns = np.diff(times_ns)
    interpolation_ns = DRIFT_ALLOWANCE * np.maximum(np.append(gaps_ns, 0.0), np.append(0.0, gaps_ns)) / 2
    bound_ns = np.minimum(bound_before_ns, bound_after_ns) + interpolation_ns
    return ClockOffset(exchanges.client_wall_ns, delta_ns, bound_ns, DRIFT_ALLOWANCE)


def _running_argmin(values: FloatArray) -> IntArray:
    """Return for each position the index of the smallest value up to this position."""
    return np.maximum.accumulate(np.where(values == np.minimum.accumulate(values), np.arange(len(values)), 0))
