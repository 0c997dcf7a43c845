"""Tests of the clock offset of two hosts with known true clocks, from samples and exchanges as they are recorded."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.experiment.analysis.clock_offset import (
    DRIFT_ALLOWANCE,
    NO_OFFSET,
    ClockOffset,
    ProbeExchanges,
    follows_peer,
    known_samples,
    offset_from_probe,
    offset_from_sources,
    probe_exchanges,
)
from lavt.recording.table import MISSING, Table, table_of

TRUE_NS = 1_790_000_000 * NS_PER_S
"""The true time at the start; all other true times count from the start."""
ClockError = Callable[[int], int]
"""A function from the true time since the start to the error of a host's wall clock, both in ns."""


def samples(ahead: ClockError, *, begin_ms: int = 0, seconds: int = 30, **fields: Any) -> Table:
    """Return the clock samples of a host whose time source knows the true time."""
    times_ns = range(begin_ms * NS_PER_MS, seconds * NS_PER_S, NS_PER_S)
    rows = [
        {"wall_ns": TRUE_NS + at + ahead(at), "correction_s": -ahead(at) / NS_PER_S, "bound_s": 1e-6, **fields}
        for at in times_ns
    ]
    return table_of(rows, [0] * len(rows), [0] * len(rows))


def errors_ns(offset: ClockOffset, client: ClockError, server: ClockError, *, seconds: int = 29) -> tuple[Any, Any]:
    """Return the absolute error of Delta every 10 ms, and the bound of Delta at the same times."""
    true_ns = np.arange(NS_PER_S, seconds * NS_PER_S, 10 * NS_PER_MS)
    client_wall_ns = np.array([TRUE_NS + at + client(at) for at in true_ns.tolist()])
    truth_ns = np.array([server(at) - client(at) for at in true_ns.tolist()])
    return np.abs(offset.at(client_wall_ns) - truth_ns), offset.bound_at(client_wall_ns)


def drifting(offset_ms: float, ppm: float) -> ClockError:
    return lambda at_ns: round(offset_ms * NS_PER_MS + at_ns * ppm / 1e6)


def steered_clock(offset_ms: float, ppm: float, from_s: float, until_s: float) -> ClockError:
    """Return the error of a clock that is steered by `ppm` between two times."""
    return lambda at_ns: round(
        offset_ms * NS_PER_MS + (np.clip(at_ns / NS_PER_S, from_s, until_s) - from_s) * ppm * 1000
    )


def as_table(rows: list[dict[str, Any]]) -> Table:
    return table_of(rows, [0] * len(rows), [0] * len(rows))


def test_interpolation_of_an_offset() -> None:
    """Delta and its bound are linear between samples; outside, Delta is constant and the bound grows."""
    times_ns = np.array([0, 100, 200])
    offset = ClockOffset(TRUE_NS + times_ns, np.array([10.0, 30.0, 20.0]), np.array([4.0, 8.0, 6.0]), 0.5)
    at_ns = TRUE_NS + np.array([-20, 0, 3, 50, 99, 100, 200, 260])
    assert offset.at(at_ns).tolist() == [10, 10, 11, 20, 30, 30, 20, 20]
    assert offset.bound_at(at_ns).tolist() == pytest.approx([14.0, 4.0, 4.12, 6.0, 7.96, 8.0, 6.0, 36.0])


def test_a_missing_time_stays_missing() -> None:
    """A client time is converted to the server's clock with Delta at this time; a missing time stays missing."""
    offset = ClockOffset(TRUE_NS + np.array([0, 100]), np.array([10.0, 30.0]), np.zeros(2), 0.0)
    client_ns = np.array([TRUE_NS, MISSING, TRUE_NS + 100])
    assert offset.on_server_ns(client_ns).tolist() == [TRUE_NS + 10, MISSING, TRUE_NS + 130]


def test_a_shared_clock_has_no_offset() -> None:
    """Hosts that share a clock have a Delta of 0 with a bound of 0 at every time."""
    at_ns = np.array([0, TRUE_NS])
    assert NO_OFFSET.at(at_ns).tolist() == [0, 0]
    assert NO_OFFSET.bound_at(at_ns).tolist() == [0.0, 0.0]


def test_drifting_clocks_are_interpolated() -> None:
    """Delta of two clocks 250 ms apart that drift by 30 and -7 ppm is exact to 1 us between samples, too."""
    client, server = drifting(0, -7), drifting(250, 30)
    offset = offset_from_sources(samples(server), samples(client, begin_ms=370))
    assert offset is not None
    delta_error_ns, bound_ns = errors_ns(offset, client, server)
    assert delta_error_ns.max() < 1000
    assert (delta_error_ns <= bound_ns).all()
    assert bound_ns.max() < 3000


@given(st.floats(-83_333, 83_333), st.floats(3, 20), st.floats(0, 8), st.sampled_from(["client", "server"]))
@settings(max_examples=30, deadline=None)
def test_delta_of_a_steered_clock_is_within_its_bound(ppm: float, from_s: float, lasts_s: float, side: str) -> None:
    """While chrony steers a clock, at any rate and for any time, the error of Delta is within its bound."""
    clocks = {"client": drifting(0, -7), "server": drifting(250, 30)}
    clocks[side] = steered_clock(100, ppm, from_s, from_s + lasts_s)
    offset = offset_from_sources(samples(clocks["server"]), samples(clocks["client"], begin_ms=370))
    assert offset is not None
    delta_error_ns, bound_ns = errors_ns(offset, clocks["client"], clocks["server"])
    assert (delta_error_ns <= bound_ns + 2).all()


def test_query_time_widens_the_bound_only_while_steered() -> None:
    """A query that takes 100 ms widens the bound by 0.5 ms while the clock is steered by 1 %, and only then."""
    exact, steered = drifting(0, 0), steered_clock(0, 10_000, 0, 100)
    bounds_ms = []
    for server in (exact, steered):
        offset = offset_from_sources(samples(server, asking_s=0.1), samples(exact, asking_s=0.1))
        assert offset is not None
        bounds_ms.append(float(offset.bound_ns.max()) / NS_PER_MS)
    hosts_ms, query_ms = 2 * 0.001, 0.01 * 100 / 2
    assert bounds_ms == pytest.approx([hosts_ms, hosts_ms + query_ms], abs=1e-3)


def test_the_path_bound_replaces_both_root_distances() -> None:
    """If the client follows the server, the path's bound is used if it is smaller than the root distance."""
    client, server = drifting(0, 0), drifting(250, 0)
    path: dict[str, Any] = {
        "follows": "10.9.0.1",
        "peer_delay_s": 0.0004,
        "peer_dispersion_s": 1e-5,
        "skew_ppm": 5.0,
        "age_s": 2.0,
    }
    offset = offset_from_sources(
        samples(server, bound_s=0.1, addresses=["10.9.0.1", "fe80::1"]), samples(client, bound_s=0.05, **path)
    )
    assert offset is not None
    half_delay_ns, dispersion_ns, skew_times_age_ns = 200_000, 10_000, 10_000
    assert offset.bound_ns.max() == pytest.approx(half_delay_ns + dispersion_ns + skew_times_age_ns)


@pytest.mark.parametrize("lacking", ["client", "server"])
def test_delta_needs_the_time_sources_of_both_hosts(lacking: str) -> None:
    """If one host has no sample with a known correction, Delta is unknown."""
    tables = {"client": samples(drifting(0, 0)), "server": samples(drifting(0, 0)), lacking: table_of([], [], [])}
    assert offset_from_sources(tables["server"], tables["client"]) is None


@pytest.mark.parametrize("follower", ["client", "server"])
@pytest.mark.parametrize(
    ("path", "bound_ms"),
    [
        ({"peer_delay_s": 0.4, "peer_dispersion_s": 0.1}, 2.0),
        ({}, 2.0),
        ({"peer_delay_s": 0.001, "peer_dispersion_s": 0.0, "skew_ppm": 0.0, "age_s": 0.0}, 0.5),
        ({"follows": "10.0.0.9", "peer_delay_s": 0.001, "peer_dispersion_s": 0.0}, 5.0),
    ],
)
def test_the_bound_of_a_host_that_follows_the_other(follower: str, path: dict[str, Any], bound_ms: float) -> None:
    """If a host follows the other, the bound is the smaller of its path bound and its root distance.

    If no host follows the other, both root distances add up.
    """
    follower_fields = {"follows": "10.9.0.1", "skew_ppm": 0.0, "age_s": 0.0, "bound_s": 0.002, **path}
    tables = {
        "client": samples(drifting(0, 0), bound_s=0.003, addresses=["10.9.0.1"]),
        "server": samples(drifting(0, 0), bound_s=0.003, addresses=["10.9.0.1"]),
        follower: samples(drifting(0, 0), addresses=None, **follower_fields),
    }
    offset = offset_from_sources(tables["server"], tables["client"])
    assert offset is not None
    assert (offset.bound_ns / NS_PER_MS).tolist() == pytest.approx([bound_ms] * 30)


def test_a_host_follows_any_address_of_the_other() -> None:
    """A host follows the other host if its source has an address from any sample of the other host."""
    followed_host = as_table([{"addresses": None}, {"addresses": ["10.0.0.1", "10.0.0.2"]}, {"addresses": ["fe80::1"]}])
    sources = ["10.0.0.2", "10.0.0.3", "fe80::1", "", None]
    is_followed = follows_peer(as_table([{"follows": source} for source in sources]), followed_host)
    assert is_followed.tolist() == [True, False, True, False, False]


def test_steering_for_a_second_is_in_the_bound_around_it() -> None:
    """Steering by 1 % for a second gives a bound of 10 ms in this and the adjacent seconds.

    At the beginning and the end of the steering the query time adds 0.5 ms.
    """
    server = samples(steered_clock(0, 10_000, 10, 11), asking_s=0.1)
    offset = offset_from_sources(server, samples(drifting(0, 0)))
    assert offset is not None
    expected_ms = [0.002, 10.002, 10.502, 10.502, 0.002]
    assert (offset.bound_ns[8:13] / NS_PER_MS).tolist() == pytest.approx(expected_ms, abs=1e-3)
    assert offset.bound_ns[[0, -1]].max() / NS_PER_MS == pytest.approx(0.002)


def test_steering_in_the_last_interval_is_in_the_bound() -> None:
    """A clock steered by 1 % in the last second has a bound of 10 ms in this second and in the second before."""
    offset = offset_from_sources(samples(steered_clock(0, 10_000, 28, 40)), samples(drifting(0, 0)))
    assert offset is not None
    expected_ms = [0.002, 10.002, 10.002, 10.002]
    assert (offset.bound_ns[-4:] / NS_PER_MS).tolist() == pytest.approx(expected_ms, abs=1e-3)


def samples_with_rates(ppm: list[float]) -> list[dict[str, Any]]:
    """Return the samples of a host whose correction changes at another rate in each second."""
    values_ns = [0.0, *np.cumsum(ppm) * 1000]
    return [
        {"wall_ns": TRUE_NS + second * NS_PER_S - round(at_ns), "correction_s": at_ns / NS_PER_S, "bound_s": 0.0}
        for second, at_ns in enumerate(values_ns)
    ]


def test_each_second_has_the_bound_of_its_own_steering() -> None:
    """The bound at a sample is the bound of the second after it, including the first and the last second."""
    server = as_table(samples_with_rates([15_000, 20_000, 0, 20_000, 15_000]))
    offset = offset_from_sources(server, samples(drifting(0, 0), seconds=6, bound_s=0.0))
    assert offset is not None
    assert (offset.bound_ns / NS_PER_MS).tolist() == pytest.approx([5, 20, 20, 20, 5, 5], abs=1e-3)


def test_a_duplicate_sample_has_no_effect() -> None:
    """A duplicate sample has no effect."""
    rows = samples_with_rates([10.0, 20.0])
    offsets = [
        offset_from_sources(as_table(sample_rows), samples(drifting(0, 0), seconds=3))
        for sample_rows in (rows, rows + rows[1:2])
    ]
    assert offsets[0] is not None
    assert offsets[1] is not None
    assert offsets[1].delta_ns.tolist() == offsets[0].delta_ns.tolist()
    assert np.isfinite(offsets[1].bound_ns).all()


def test_steering_is_detected_from_three_samples_on() -> None:
    """Steering of a clock is detected with three samples, but not with two."""
    for seconds, bound_ms in ((2, 0.002), (3, 10.002)):
        server = samples(steered_clock(0, 10_000, 1, 2), seconds=seconds)
        offset = offset_from_sources(server, samples(drifting(0, 0), seconds=seconds))
        assert offset is not None
        assert offset.bound_ns.max() / NS_PER_MS == pytest.approx(bound_ms, abs=1e-3)


def test_delta_covers_the_time_that_both_hosts_know() -> None:
    """Delta is known at the sample times of both hosts, in the interval in which both hosts have samples.

    Without such an interval, Delta is unknown.
    """
    offset = offset_from_sources(samples(drifting(0, 0), seconds=20), samples(drifting(0, 0), begin_ms=5500))
    assert offset is not None
    times_ms = ((offset.client_wall_ns - TRUE_NS) // NS_PER_MS).tolist()
    assert times_ms == list(range(5500, 19001, 500))
    without_overlap = offset_from_sources(samples(drifting(0, 0), seconds=5), samples(drifting(0, 0), begin_ms=10_000))
    assert without_overlap is None


def test_times_are_on_the_clients_wall_clock() -> None:
    """If both hosts sampled at the same times, the times of Delta are the client's wall times, to a nanosecond."""
    client = samples(lambda at_ns: 250 * NS_PER_MS + at_ns // 3_000_001)
    offset = offset_from_sources(samples(drifting(0, 0)), client)
    assert offset is not None
    assert offset.client_wall_ns.tolist() == client.ints("wall_ns").tolist()


def test_samples_without_a_correction_are_ignored() -> None:
    """Delta begins with the first known corrections; if a host loses its correction later, Delta is unknown."""
    rows = [{"wall_ns": TRUE_NS + at * NS_PER_S, "correction_s": 0.0, "bound_s": 0.0} for at in range(5)]
    unknown = [{**row, "correction_s": None} for row in rows]
    offset = offset_from_sources(as_table(unknown[:2] + rows[2:]), as_table(rows))
    assert offset is not None
    assert offset.client_wall_ns.tolist() == [row["wall_ns"] for row in rows[2:]]
    assert offset_from_sources(as_table(rows[:2] + unknown[2:3] + rows[3:]), as_table(rows)) is None


@pytest.mark.parametrize(
    ("first_ppm", "middle_ppm", "last_ppm"), [(10.0, 50.0, 0.0), (0.0, 50.0, 10.0), (-10.0, 0.0, 5.0), (5.0, 0.0, -10)]
)
def test_the_bound_grows_outside_the_samples(first_ppm: float, middle_ppm: float, last_ppm: float) -> None:
    """Outside the samples, the bound grows at twice the larger of Delta's rates in the first and the last second."""
    rows = samples_with_rates([first_ppm, middle_ppm, middle_ppm, last_ppm])
    values_ns = [row["correction_s"] * NS_PER_S for row in rows]
    for table in (rows, rows[::-1]):
        offset = offset_from_sources(as_table(table), samples(drifting(0, 0), seconds=5))
        assert offset is not None
        assert offset.delta_ns.tolist() == pytest.approx([-value_ns for value_ns in values_ns], abs=1)
        assert offset.drift_outside == pytest.approx(20e-6, rel=0.01)


def test_one_sample_allows_for_any_drift() -> None:
    """With one sample the bound grows by the largest possible drift, with two samples by twice the measured drift."""
    server = drifting(0, 10)
    for seconds, expected in ((1, DRIFT_ALLOWANCE), (2, 20e-6)):
        offset = offset_from_sources(samples(server, seconds=seconds), samples(drifting(0, 0), seconds=seconds))
        assert offset is not None
        assert offset.drift_outside == pytest.approx(expected, rel=0.01)


@pytest.mark.parametrize(
    ("known_flags", "first_used"),
    [("11", 0), ("01", 1), ("0011", 2), ("10", None), ("101", None), ("0101", None), ("00", None), ("", None)],
)
@pytest.mark.parametrize("lacking", [{"correction_s": None}, {"wall_ns": None}])
def test_samples_are_used_from_the_first_known_one_on(
    known_flags: str, first_used: int | None, lacking: dict[str, Any]
) -> None:
    """Samples are used from the first known sample on; if a later sample is unknown, no sample is used."""
    rows = [
        {"wall_ns": index, "correction_s": 0.5, **({} if flag == "1" else lacking)}
        for index, flag in enumerate(known_flags)
    ]
    used = known_samples(as_table(rows)).ints("wall_ns").tolist()
    assert used == ([] if first_used is None else list(range(first_used, len(known_flags))))


def simulated_exchanges(
    client: ClockError, server: ClockError, delays_ms: Callable[[int], tuple[float, float]], *, seconds: int = 30
) -> ProbeExchanges:
    """Return two exchanges per second; `delays_ms` returns the delays (there, back) of an exchange by its number."""
    rows = []
    for number in range(2 * seconds):
        there_ms, back_ms = delays_ms(number)
        sent_ns = number * NS_PER_S // 2
        received_ns = sent_ns + round(there_ms * NS_PER_MS)
        arrived_ns = received_ns + round(back_ms * NS_PER_MS)
        row = {
            "sent_wall_ns": TRUE_NS + sent_ns + client(sent_ns),
            "received_wall_ns": TRUE_NS + received_ns + server(received_ns),
            "answered_wall_ns": TRUE_NS + received_ns + server(received_ns),
            "arrived_wall_ns": TRUE_NS + arrived_ns + client(arrived_ns),
        }
        rows.append(row)
    return probe_exchanges(table_of(rows, [0] * len(rows), [0] * len(rows)))


def test_evaluation_of_an_exchange() -> None:
    """An exchange is assigned to the middle of its times on each clock; its round trip excludes the server's time."""
    names = ("sent_wall_ns", "received_wall_ns", "answered_wall_ns", "arrived_wall_ns")
    exchanges = probe_exchanges(table_of([dict(zip(names, (100, 1030, 1050, 160), strict=True))], [0], [0]))
    assert exchanges.client_wall_ns.tolist() == [130]
    assert exchanges.server_wall_ns.tolist() == [1040]
    assert exchanges.delta_ns.tolist() == [910.0]
    assert exchanges.round_trip_ns.tolist() == [40]
    assert [len(exchanges.within(*interval)) for interval in ((1040, 1040), (1041, 1050), (1030, 1039))] == [1, 0, 0]


@given(st.integers(0, 2**32), st.floats(-240, 240), st.floats(-240, 240))
@settings(max_examples=30, deadline=None)
def test_delta_from_the_probe_is_within_its_bound(seed: int, client_ppm: float, server_ppm: float) -> None:
    """With any path delays and any drift without fast steering, the error of Delta is within its bound."""
    delays_ms = np.random.default_rng(seed).lognormal(-1.0, 1.5, (60, 2))
    client, server = drifting(0, client_ppm), drifting(250, server_ppm)
    offset = offset_from_probe(
        simulated_exchanges(client, server, lambda number: (delays_ms[number][0], delays_ms[number][1]))
    )
    assert offset is not None
    delta_error_ns, bound_ns = errors_ns(offset, client, server)
    assert (delta_error_ns <= bound_ns + 2).all()


def test_the_exchange_with_the_smallest_bound_is_used() -> None:
    """One short round trip among long, asymmetric round trips determines Delta, with a bound that grows with time."""
    client, server = drifting(0, 0), drifting(250, 0)
    offset = offset_from_probe(
        simulated_exchanges(client, server, lambda number: (0.1, 0.1) if number == 20 else (0.1, 8.1))
    )
    assert offset is not None
    at_ns = np.array([TRUE_NS + 10 * NS_PER_S, TRUE_NS + 12 * NS_PER_S])
    assert offset.at(at_ns).tolist() == pytest.approx([250 * NS_PER_MS] * 2, abs=2)
    half_round_trip_ns, drift_in_half_a_gap_ns = 100_000, DRIFT_ALLOWANCE * NS_PER_S / 4
    at_exchange_ns = half_round_trip_ns + drift_in_half_a_gap_ns
    expected = [at_exchange_ns, at_exchange_ns + DRIFT_ALLOWANCE * 2 * NS_PER_S]
    assert offset.bound_at(at_ns).tolist() == pytest.approx(expected, rel=0.01)


def test_the_bound_grows_after_the_last_exchange() -> None:
    """In the 20 s after the last exchange, the bound grows by the largest possible drift."""
    exchanges = simulated_exchanges(drifting(0, 0), drifting(250, 0), lambda _: (0.1, 0.1), seconds=10)
    offset = offset_from_probe(exchanges)
    assert offset is not None
    last_ns = exchanges.client_wall_ns[-1]
    at_ns, late_ns = offset.bound_at(np.array([last_ns, last_ns + 20 * NS_PER_S])).tolist()
    assert late_ns - at_ns == pytest.approx(DRIFT_ALLOWANCE * 20 * NS_PER_S)


def test_an_exchange_with_impossible_times_is_ignored() -> None:
    """An exchange with impossible or missing times is ignored, and without another exchange Delta is unknown.

    An exchange after which the server's clock was set is not ignored.
    """
    exchanges = simulated_exchanges(
        drifting(0, 0), lambda at_ns: -NS_PER_S if at_ns > 5 * NS_PER_S else 0, lambda _: (0.1, 0.1)
    )
    assert len(exchanges) == 60
    impossible = table_of(
        [{"sent_wall_ns": 10, "received_wall_ns": 5, "answered_wall_ns": 5, "arrived_wall_ns": 4}, {"sent_wall_ns": 1}],
        [0, 0],
        [0, 0],
    )
    assert len(probe_exchanges(impossible)) == 0
    assert offset_from_probe(probe_exchanges(impossible)) is None
