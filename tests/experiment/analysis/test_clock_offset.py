"""Delta of two hosts whose true clocks are known, from samples and exchanges as they would have been recorded."""

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
    by_probe,
    by_sources,
    exchanges,
    follows,
    known_samples,
)
from lavt.recording.table import MISSING, Table, table_of

TRUE_NS = 1_790_000_000 * NS_PER_S
Ahead = Callable[[int], int]
"""How far a host's wall clock is ahead of the truth, of the true time since the begin, both in ns."""


def samples(ahead: Ahead, *, begin_ms: int = 0, seconds: int = 30, **fields: Any) -> Table:
    """Make the clock samples of a host whose source of time knows the truth."""
    times_ns = range(begin_ms * NS_PER_MS, seconds * NS_PER_S, NS_PER_S)
    rows = [
        {"wall_ns": TRUE_NS + at + ahead(at), "correction_s": -ahead(at) / NS_PER_S, "bound_s": 1e-6, **fields}
        for at in times_ns
    ]
    return table_of(rows, [0] * len(rows), [0] * len(rows))


def errors_ns(offset: ClockOffset, client: Ahead, server: Ahead, *, seconds: int = 29) -> tuple[Any, Any]:
    """Give how wrong Delta is every 10 ms, and how wrong it says it can be."""
    true_ns = np.arange(NS_PER_S, seconds * NS_PER_S, 10 * NS_PER_MS)
    client_wall_ns = np.array([TRUE_NS + at + client(at) for at in true_ns.tolist()])
    truth_ns = np.array([server(at) - client(at) for at in true_ns.tolist()])
    return np.abs(offset.at(client_wall_ns) - truth_ns), offset.bound_at(client_wall_ns)


def drifting(offset_ms: float, ppm: float) -> Ahead:
    return lambda at_ns: round(offset_ms * NS_PER_MS + at_ns * ppm / 1e6)


def slewed(offset_ms: float, ppm: float, from_s: float, until_s: float) -> Ahead:
    """A clock that is steered at a rate between two times."""
    return lambda at_ns: round(
        offset_ms * NS_PER_MS + (np.clip(at_ns / NS_PER_S, from_s, until_s) - from_s) * ppm * 1000
    )


def rows_of(rows: list[dict[str, Any]]) -> Table:
    return table_of(rows, [0] * len(rows), [0] * len(rows))


def test_an_offset_by_hand() -> None:
    """Delta is linear between moments and constant outside of them; its bound is linear too, and grows outside."""
    times_ns = np.array([0, 100, 200])
    offset = ClockOffset(TRUE_NS + times_ns, np.array([10.0, 30.0, 20.0]), np.array([4.0, 8.0, 6.0]), 0.5)
    at_ns = TRUE_NS + np.array([-20, 0, 3, 50, 99, 100, 200, 260])
    assert offset.at(at_ns).tolist() == [10, 10, 11, 20, 30, 30, 20, 20]
    assert offset.bound_at(at_ns).tolist() == pytest.approx([14.0, 4.0, 4.12, 6.0, 7.96, 8.0, 6.0, 36.0])


def test_a_missing_time_stays_missing() -> None:
    """Times of the client become times of the server by Delta at their own moments; a missing one stays missing."""
    offset = ClockOffset(TRUE_NS + np.array([0, 100]), np.array([10.0, 30.0]), np.zeros(2), 0.0)
    client_ns = np.array([TRUE_NS, MISSING, TRUE_NS + 100])
    assert offset.on_server_ns(client_ns).tolist() == [TRUE_NS + 10, MISSING, TRUE_NS + 130]


def test_one_clock_has_no_offset() -> None:
    """Hosts that share a clock have a Delta of 0 with a bound of 0 at every time."""
    at_ns = np.array([0, TRUE_NS])
    assert NO_OFFSET.at(at_ns).tolist() == [0, 0]
    assert NO_OFFSET.bound_at(at_ns).tolist() == [0.0, 0.0]


def test_drifting_clocks() -> None:
    """Two clocks 250 ms apart that drift by 30 and -7 ppm are known to a microsecond between samples too."""
    client, server = drifting(0, -7), drifting(250, 30)
    offset = by_sources(samples(server), samples(client, begin_ms=370))
    assert offset is not None
    wrong_ns, bound_ns = errors_ns(offset, client, server)
    assert wrong_ns.max() < 1000
    assert (wrong_ns <= bound_ns).all()
    assert bound_ns.max() < 3000


@given(st.floats(-83_333, 83_333), st.floats(3, 20), st.floats(0, 8), st.sampled_from(["client", "server"]))
@settings(max_examples=30, deadline=None)
def test_a_clock_that_is_being_steered_is_known_within_its_bound(
    ppm: float, from_s: float, lasts_s: float, side: str
) -> None:
    """However fast chrony steers a clock, and whenever it begins and ends, Delta is within its bound of the truth."""
    clocks = {"client": drifting(0, -7), "server": drifting(250, 30)}
    clocks[side] = slewed(100, ppm, from_s, from_s + lasts_s)
    offset = by_sources(samples(clocks["server"]), samples(clocks["client"], begin_ms=370))
    assert offset is not None
    wrong_ns, bound_ns = errors_ns(offset, clocks["client"], clocks["server"])
    assert (wrong_ns <= bound_ns + 2).all()


def test_being_requested_for_long_matters_only_while_steered() -> None:
    """An answer that took 100 ms leaves open what was steered meanwhile, and nothing where nothing was."""
    still, steered = drifting(0, 0), slewed(0, 10_000, 0, 100)
    bounds_ms = []
    for server in (still, steered):
        offset = by_sources(samples(server, asking_s=0.1), samples(still, asking_s=0.1))
        assert offset is not None
        bounds_ms.append(float(offset.bound_ns.max()) / NS_PER_MS)
    assert bounds_ms == pytest.approx([0.002, 0.502], abs=1e-3)


def test_what_is_known_of_the_path_replaces_both_bounds() -> None:
    """Where the client follows the server and the path is better than the root distance, the path's bound counts."""
    client, server = drifting(0, 0), drifting(250, 0)
    path: dict[str, Any] = {
        "follows": "10.9.0.1",
        "peer_delay_s": 0.0004,
        "peer_dispersion_s": 1e-5,
        "skew_ppm": 5.0,
        "age_s": 2.0,
    }
    offset = by_sources(
        samples(server, bound_s=0.1, addresses=["10.9.0.1", "fe80::1"]), samples(client, bound_s=0.05, **path)
    )
    assert offset is not None
    assert offset.bound_ns.max() == pytest.approx(200_000 + 10_000 + 10_000)


@pytest.mark.parametrize("lacking", ["client", "server"])
def test_one_source_is_not_enough(lacking: str) -> None:
    """Where one host has no sample that knows its correction nobody knows Delta."""
    of = {"client": samples(drifting(0, 0)), "server": samples(drifting(0, 0)), lacking: table_of([], [], [])}
    assert by_sources(of["server"], of["client"]) is None


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
    """The bound is the follower's: of the path, or its own where that is less or the only one; else it is the sum."""
    own = {"follows": "10.9.0.1", "skew_ppm": 0.0, "age_s": 0.0, "bound_s": 0.002, **path}
    tables = {
        "client": samples(drifting(0, 0), bound_s=0.003, addresses=["10.9.0.1"]),
        "server": samples(drifting(0, 0), bound_s=0.003, addresses=["10.9.0.1"]),
        follower: samples(drifting(0, 0), addresses=None, **own),
    }
    offset = by_sources(tables["server"], tables["client"])
    assert offset is not None
    assert (offset.bound_ns / NS_PER_MS).tolist() == pytest.approx([bound_ms] * 30)


def test_following_is_by_any_address_of_the_other() -> None:
    """A host follows the other where its source has an address of the other, in whichever sample that was recorded."""
    other = rows_of([{"addresses": None}, {"addresses": ["10.0.0.1", "10.0.0.2"]}, {"addresses": ["fe80::1"]}])
    sources = ["10.0.0.2", "10.0.0.3", "fe80::1", "", None]
    assert follows(rows_of([{"follows": each} for each in sources]), other).tolist() == [
        True,
        False,
        True,
        False,
        False,
    ]


def test_steering_for_a_second_is_in_the_bound_around_it() -> None:
    """A clock steered by 1 % for a second has a bound of 10 ms in that second and beside it, and more by asking."""
    server = samples(slewed(0, 10_000, 10, 11), asking_s=0.1)
    offset = by_sources(server, samples(drifting(0, 0)))
    assert offset is not None
    expected_ms = [0.002, 10.002, 10.502, 10.502, 0.002]
    assert (offset.bound_ns[8:13] / NS_PER_MS).tolist() == pytest.approx(expected_ms, abs=1e-3)
    assert offset.bound_ns[[0, -1]].max() / NS_PER_MS == pytest.approx(0.002)


def test_steering_in_the_last_interval_is_in_the_bound() -> None:
    """A clock steered by 1 % in the last second has a bound of 10 ms there, and in the second before."""
    offset = by_sources(samples(slewed(0, 10_000, 28, 40)), samples(drifting(0, 0)))
    assert offset is not None
    expected_ms = [0.002, 10.002, 10.002, 10.002]
    assert (offset.bound_ns[-4:] / NS_PER_MS).tolist() == pytest.approx(expected_ms, abs=1e-3)


def stepwise(ppm: list[float]) -> list[dict[str, Any]]:
    """Make the samples of a host whose correction changes at another rate in each second."""
    values_ns = [0.0, *np.cumsum(ppm) * 1000]
    return [
        {"wall_ns": TRUE_NS + second * NS_PER_S - round(at_ns), "correction_s": at_ns / NS_PER_S, "bound_s": 0.0}
        for second, at_ns in enumerate(values_ns)
    ]


def test_each_second_has_the_bound_of_its_own_steering() -> None:
    """The bound at a time is that of the second which begins there, in the first and the last second too."""
    server = rows_of(stepwise([15_000, 20_000, 0, 20_000, 15_000]))
    offset = by_sources(server, samples(drifting(0, 0), seconds=6, bound_s=0.0))
    assert offset is not None
    assert (offset.bound_ns / NS_PER_MS).tolist() == pytest.approx([5, 20, 20, 20, 5, 5], abs=1e-3)


def test_two_samples_of_one_time() -> None:
    """A sample that is there twice changes nothing."""
    rows = stepwise([10.0, 20.0])
    offsets = [by_sources(rows_of(each), samples(drifting(0, 0), seconds=3)) for each in (rows, rows + rows[1:2])]
    assert offsets[0] is not None
    assert offsets[1] is not None
    assert offsets[1].delta_ns.tolist() == offsets[0].delta_ns.tolist()
    assert np.isfinite(offsets[1].bound_ns).all()


def test_three_samples_show_steering_and_two_do_not() -> None:
    """Where a clock has two samples only nothing shows that it was steered; the third shows it."""
    for seconds, bound_ms in ((2, 0.002), (3, 10.002)):
        server = samples(slewed(0, 10_000, 1, 2), seconds=seconds)
        offset = by_sources(server, samples(drifting(0, 0), seconds=seconds))
        assert offset is not None
        assert offset.bound_ns.max() / NS_PER_MS == pytest.approx(bound_ms, abs=1e-3)


def test_only_what_both_hosts_know_counts() -> None:
    """Delta has the moments of both hosts' samples from the later beginning to the earlier end, these included."""
    offset = by_sources(samples(drifting(0, 0), seconds=20), samples(drifting(0, 0), begin_ms=5500))
    assert offset is not None
    times_ms = ((offset.client_wall_ns - TRUE_NS) // NS_PER_MS).tolist()
    assert times_ms == list(range(5500, 19001, 500))
    apart = by_sources(samples(drifting(0, 0), seconds=5), samples(drifting(0, 0), begin_ms=10_000))
    assert apart is None


def test_moments_are_on_the_clients_wall_clock() -> None:
    """Where both hosts sampled at the same times the moments of Delta are the client's wall times, to a nanosecond."""
    client = samples(lambda at_ns: 250 * NS_PER_MS + at_ns // 3_000_001)
    offset = by_sources(samples(drifting(0, 0)), client)
    assert offset is not None
    assert offset.client_wall_ns.tolist() == client.ints("wall_ns").tolist()


def test_samples_that_know_nothing_do_not_count() -> None:
    """Delta begins with the first samples that know their correction; of a host that loses it no Delta is known."""
    rows = [{"wall_ns": TRUE_NS + at * NS_PER_S, "correction_s": 0.0, "bound_s": 0.0} for at in range(5)]
    unknown = [{**row, "correction_s": None} for row in rows]
    offset = by_sources(rows_of(unknown[:2] + rows[2:]), rows_of(rows))
    assert offset is not None
    assert offset.client_wall_ns.tolist() == [row["wall_ns"] for row in rows[2:]]
    assert by_sources(rows_of(rows[:2] + unknown[2:3] + rows[3:]), rows_of(rows)) is None


@pytest.mark.parametrize(
    ("first_ppm", "middle_ppm", "last_ppm"), [(10.0, 50.0, 0.0), (0.0, 50.0, 10.0), (-10.0, 0.0, 5.0), (5.0, 0.0, -10)]
)
def test_outside_of_the_samples_delta_changes_twice_as_fast(
    first_ppm: float, middle_ppm: float, last_ppm: float
) -> None:
    """Outside of its moments the bound grows twice as fast as Delta changed at the faster of its two ends."""
    rows = stepwise([first_ppm, middle_ppm, middle_ppm, last_ppm])
    values_ns = [row["correction_s"] * NS_PER_S for row in rows]
    for table in (rows, rows[::-1]):
        offset = by_sources(rows_of(table), samples(drifting(0, 0), seconds=5))
        assert offset is not None
        assert offset.delta_ns.tolist() == pytest.approx([-each for each in values_ns], abs=1)
        assert offset.outside == pytest.approx(20e-6, rel=0.01)


def test_outside_of_one_sample_clocks_may_drift_as_any() -> None:
    """One moment does not say how fast Delta changes: any drift is allowed for; two say it."""
    server = drifting(0, 10)
    for seconds, expected in ((1, DRIFT_ALLOWANCE), (2, 20e-6)):
        offset = by_sources(samples(server, seconds=seconds), samples(drifting(0, 0), seconds=seconds))
        assert offset is not None
        assert offset.outside == pytest.approx(expected, rel=0.01)


@pytest.mark.parametrize(
    ("known", "first"),
    [("11", 0), ("01", 1), ("0011", 2), ("10", None), ("101", None), ("0101", None), ("00", None), ("", None)],
)
@pytest.mark.parametrize("lacking", [{"correction_s": None}, {"wall_ns": None}])
def test_samples_count_from_the_first_that_is_known(known: str, first: int | None, lacking: dict[str, Any]) -> None:
    """Samples count from the first on that has its correction and its time; where one is lacking later none counts."""
    rows = [
        {"wall_ns": index, "correction_s": 0.5, **({} if each == "1" else lacking)} for index, each in enumerate(known)
    ]
    found = known_samples(rows_of(rows)).ints("wall_ns").tolist()
    assert found == ([] if first is None else list(range(first, len(known))))


def probed(
    client: Ahead, server: Ahead, ways_ms: Callable[[int], tuple[float, float]], *, seconds: int = 30
) -> ProbeExchanges:
    """Make two exchanges a second with given times there and back."""
    rows = []
    for number in range(2 * seconds):
        there_ms, back_ms = ways_ms(number)
        sent_ns = number * NS_PER_S // 2
        received_ns = sent_ns + round(there_ms * NS_PER_MS)
        arrived_ns = received_ns + round(back_ms * NS_PER_MS)
        rows.append({
            "sent_wall_ns": TRUE_NS + sent_ns + client(sent_ns),
            "received_wall_ns": TRUE_NS + received_ns + server(received_ns),
            "answered_wall_ns": TRUE_NS + received_ns + server(received_ns),
            "arrived_wall_ns": TRUE_NS + arrived_ns + client(arrived_ns),
        })  # fmt: skip
    return exchanges(table_of(rows, [0] * len(rows), [0] * len(rows)))


def test_an_exchange_by_hand() -> None:
    """An exchange counts at the middle of its times on each clock, without the server's time in the round trip."""
    names = ("sent_wall_ns", "received_wall_ns", "answered_wall_ns", "arrived_wall_ns")
    found = exchanges(table_of([dict(zip(names, (100, 1030, 1050, 160), strict=True))], [0], [0]))
    assert found.client_wall_ns.tolist() == [130]
    assert found.server_wall_ns.tolist() == [1040]
    assert found.delta_ns.tolist() == [910.0]
    assert found.round_trip_ns.tolist() == [40]
    assert [len(found.within(*interval)) for interval in ((1040, 1040), (1041, 1050), (1030, 1039))] == [1, 0, 0]


@given(st.integers(0, 2**32), st.floats(-240, 240), st.floats(-240, 240))
@settings(max_examples=30, deadline=None)
def test_delta_by_the_probe_is_within_its_bound(seed: int, client_ppm: float, server_ppm: float) -> None:
    """Whatever each way takes, and however two clocks drift that nobody steers fast, the truth is inside the bound."""
    ways_ms = np.random.default_rng(seed).lognormal(-1.0, 1.5, (60, 2))
    client, server = drifting(0, client_ppm), drifting(250, server_ppm)
    offset = by_probe(probed(client, server, lambda number: (ways_ms[number][0], ways_ms[number][1])))
    assert offset is not None
    wrong_ns, bound_ns = errors_ns(offset, client, server)
    assert (wrong_ns <= bound_ns + 2).all()


def test_the_exchange_that_says_most_counts() -> None:
    """One short round trip among long and lopsided ones is what Delta goes by, as far as drift may have come."""
    client, server = drifting(0, 0), drifting(250, 0)
    offset = by_probe(probed(client, server, lambda number: (0.1, 0.1) if number == 20 else (0.1, 8.1)))
    assert offset is not None
    at_ns = np.array([TRUE_NS + 10 * NS_PER_S, TRUE_NS + 12 * NS_PER_S])
    assert offset.at(at_ns).tolist() == pytest.approx([250 * NS_PER_MS] * 2, abs=2)
    between_ns = DRIFT_ALLOWANCE * NS_PER_S / 4
    expected = [100_000 + between_ns, 100_000 + DRIFT_ALLOWANCE * 2 * NS_PER_S + between_ns]
    assert offset.bound_at(at_ns).tolist() == pytest.approx(expected, rel=0.01)


def test_a_time_far_from_any_exchange_is_known_less() -> None:
    """Asked for a time 20 s after the last exchange, the bound grows by what clocks may drift in that time."""
    every = probed(drifting(0, 0), drifting(250, 0), lambda _: (0.1, 0.1), seconds=10)
    offset = by_probe(every)
    assert offset is not None
    last_ns = every.client_wall_ns[-1]
    at_ns, late_ns = offset.bound_at(np.array([last_ns, last_ns + 20 * NS_PER_S])).tolist()
    assert late_ns - at_ns == pytest.approx(DRIFT_ALLOWANCE * 20 * NS_PER_S)


def test_a_clock_set_during_an_exchange_spoils_that_one() -> None:
    """An exchange whose times cannot be, because a clock was set in between, is left out; none at all know nothing."""
    every = probed(drifting(0, 0), lambda at_ns: -NS_PER_S if at_ns > 5 * NS_PER_S else 0, lambda _: (0.1, 0.1))
    assert len(every) == 60
    torn = table_of(
        [{"sent_wall_ns": 10, "received_wall_ns": 5, "answered_wall_ns": 5, "arrived_wall_ns": 4}, {"sent_wall_ns": 1}],
        [0, 0],
        [0, 0],
    )
    assert len(exchanges(torn)) == 0
    assert by_probe(exchanges(torn)) is None
