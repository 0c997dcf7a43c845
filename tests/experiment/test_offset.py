"""Delta of two hosts whose true clocks are known, from samples and exchanges as they would have been recorded."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.experiment.offset import DRIFT_ALLOWANCE, Exchanges, Offset, by_probe, by_sources, exchanges
from lavt.experiment.table import Table, table_of

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


def errors_ns(offset: Offset, client: Ahead, server: Ahead, *, seconds: int = 29) -> tuple[Any, Any]:
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


def test_being_asked_for_long_matters_only_while_steered() -> None:
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


def probed(
    client: Ahead, server: Ahead, ways_ms: Callable[[int], tuple[float, float]], *, seconds: int = 30
) -> Exchanges:
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
