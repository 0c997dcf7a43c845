"""Tests of the clock offset from probe exchanges, with values calculated by hand."""

from __future__ import annotations

from typing import Any

import pytest

from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.experiment.analysis.clock_offset import DRIFT_ALLOWANCE, offset_from_probe, probe_exchanges
from lavt.recording.table import Table, table_of

TRUE_NS = 1_790_000_000 * NS_PER_S


def as_table(rows: list[dict[str, Any]]) -> Table:
    return table_of(rows, [0] * len(rows), [0] * len(rows))


def exchange(client_ns: int, half_round_trip_ns: int, delta_ns: int) -> dict[str, Any]:
    """Return an exchange at a time of the client's clock with a given Delta; the server takes 100 ns."""
    received_ns = client_ns + delta_ns - 50
    return {
        "sent_wall_ns": client_ns - 50 - half_round_trip_ns,
        "received_wall_ns": received_ns,
        "answered_wall_ns": received_ns + 100,
        "arrived_wall_ns": client_ns + 50 + half_round_trip_ns,
    }


TIME_FIELDS = ("sent_wall_ns", "received_wall_ns", "answered_wall_ns", "arrived_wall_ns")


def test_evaluation_of_an_exchange() -> None:
    """An exchange is assigned to the middle of its times on each clock; its round trip excludes the server's time."""
    row = dict(zip(TIME_FIELDS, (TRUE_NS, TRUE_NS + 4300, TRUE_NS + 4400, TRUE_NS + 301), strict=True))
    exchanges = probe_exchanges(as_table([row]))
    assert (exchanges.client_wall_ns - TRUE_NS).tolist() == [150]
    assert (exchanges.server_wall_ns - TRUE_NS).tolist() == [4350]
    assert (exchanges.delta_ns.tolist(), exchanges.round_trip_ns.tolist()) == ([4199.5], [201])


def test_exchanges_are_sorted_and_checked() -> None:
    """Exchanges are sorted by the client's clock; those with a missing time or a negative round trip are ignored."""
    good = [
        exchange(TRUE_NS + second * NS_PER_S, half_round_trip_ns, 7)
        for second, half_round_trip_ns in ((3, 10), (1, 0), (2, 10))
    ]
    bad = [{**good[0], name: None} for name in TIME_FIELDS]
    bad.append({**good[1], "arrived_wall_ns": good[1]["arrived_wall_ns"] - 1})
    exchanges = probe_exchanges(as_table([*good, *bad]))
    assert ((exchanges.client_wall_ns - TRUE_NS) // NS_PER_S).tolist() == [1, 2, 3]
    assert exchanges.round_trip_ns.tolist() == [0, 20, 20]
    assert exchanges.delta_ns.tolist() == [7.0, 7.0, 7.0]


def test_exchanges_of_an_interval() -> None:
    """An interval of the server's clock includes the exchanges from its first to its last nanosecond."""
    exchanges = probe_exchanges(as_table([exchange(1000 * number, 10, 50_000) for number in range(1, 6)]))
    included = exchanges.within(52_000, 54_000)
    assert included.client_wall_ns.tolist() == [2000, 3000, 4000]
    assert len(included) == 3
    assert len(exchanges.within(52_001, 53_999)) == 1


def test_the_shortest_exchange_determines_delta() -> None:
    """The shortest exchange is also used at other times, where its bound has grown by 500 ppm of the difference.

    In addition, each bound contains 500 ppm of half the longer of the two adjacent gaps.
    """
    rows = [
        exchange(TRUE_NS + at_ms * NS_PER_MS, half_round_trip_us * 1000, delta_us * 1000)
        for at_ms, half_round_trip_us, delta_us in ((0, 200, 1), (100, 50, 2), (300, 400, 3), (10_300, 400, 4))
    ]
    offset = offset_from_probe(probe_exchanges(as_table(rows)))
    assert offset is not None
    assert (offset.client_wall_ns - TRUE_NS).tolist() == [time_ms * NS_PER_MS for time_ms in (0, 100, 300, 10_300)]
    assert (offset.delta_ns / 1000).tolist() == [2.0, 2.0, 2.0, 4.0]
    at_exchanges_us, half_gaps_us = [50 + 50, 50, 50 + 100, 400], [25, 50, 2500, 2500]
    expected_us = [at_us + half_gap_us for at_us, half_gap_us in zip(at_exchanges_us, half_gaps_us, strict=True)]
    assert (offset.bound_ns / 1000).tolist() == pytest.approx(expected_us)
    assert offset.drift_outside == DRIFT_ALLOWANCE


def test_the_bound_of_one_exchange_is_half_its_round_trip() -> None:
    """With one exchange, Delta is that of the exchange, and its bound is half the round trip."""
    offset = offset_from_probe(probe_exchanges(as_table([exchange(TRUE_NS, 300, 9000)])))
    assert offset is not None
    assert (offset.delta_ns.tolist(), offset.bound_ns.tolist()) == ([9000.0], [300.0])


def test_of_two_exchanges_with_equal_bounds_the_earlier_is_used() -> None:
    """Between two exchanges with equal bounds, the earlier one is used."""
    gap_ns, half_round_trip_ns = 100 * NS_PER_MS, 1000
    rows = [
        exchange(TRUE_NS + gap_ns * index, half, index)
        for index, half in enumerate((half_round_trip_ns, 900_000, half_round_trip_ns))
    ]
    offset = offset_from_probe(probe_exchanges(as_table(rows)))
    assert offset is not None
    assert offset.delta_ns.tolist() == [0.0, 0.0, 2.0]
