from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.transport.emulation.delay_line import DelayLine, DelayModel, Lognormal

WIFI = Lognormal(median_ms=12.0, sigma=0.668)


@pytest.mark.parametrize(("constant_ms", "delay_ns"), [(0.0, 0), (75.0, 75_000_000), (0.25, 250_000), (-3.0, 0)])
def test_constant_delay_is_exact(constant_ms: float, delay_ns: int) -> None:
    """A constant delay is exact to the nanosecond, the same for every index, and never negative."""
    assert {DelayModel(constant_ms).delay_ns(index) for index in (0, 1, 2**32 - 1)} == {delay_ns}


def test_lognormal_jitter_has_its_median_and_p95() -> None:
    """The jitter of the paper's WiFi adds 12 ms in the median and 36 ms at the 95th percentile to the constant."""
    delay = DelayModel(50.0, WIFI, seed=1, name="video")
    added_ms = np.array([delay.delay_ns(index) for index in range(20_000)]) / NS_PER_MS - 50.0
    assert np.median(added_ms) == pytest.approx(12.0, abs=0.3)
    assert np.percentile(added_ms, 95) == pytest.approx(36.0, abs=1.2)
    assert np.log(added_ms).std() == pytest.approx(0.668, abs=0.01)
    assert added_ms.min() > 0


def test_delay_depends_only_on_the_index() -> None:
    """The delay of an index depends neither on earlier calls nor on the `DelayModel` object."""
    ascending = [DelayModel(0.0, WIFI, 5, "video").delay_ns(index) for index in range(1000)]
    delay = DelayModel(0.0, WIFI, 5, "video")
    descending = [delay.delay_ns(index) for index in reversed(range(1000))]
    assert ascending == descending[::-1]


@pytest.mark.parametrize("other", [DelayModel(0.0, WIFI, 2, "video"), DelayModel(0.0, WIFI, 1, "control")])
def test_seeds_and_names_are_independent(other: DelayModel) -> None:
    """Another seed or another name gives independent delays."""
    delay = DelayModel(0.0, WIFI, 1, "video")
    delays, other_delays = (np.log([model.delay_ns(index) for index in range(5_000)]) for model in (delay, other))
    assert abs(float(np.corrcoef(delays, other_delays)[0, 1])) < 0.05


def test_consecutive_indices_are_independent() -> None:
    """The delays of consecutive indices are independent."""
    delay = DelayModel(0.0, WIFI, 1, "video")
    delays = np.log([delay.delay_ns(index) for index in range(5_000)])
    assert abs(float(np.corrcoef(delays[:-1], delays[1:])[0, 1])) < 0.05


def test_constant_does_not_change_the_jitter() -> None:
    """The jitter does not depend on the constant delay, so that runs under two conditions can be paired."""
    undelayed, delayed = DelayModel(0.0, WIFI, 1, "video"), DelayModel(75.0, WIFI, 1, "video")
    differences_ns = {delayed.delay_ns(index) - undelayed.delay_ns(index) for index in range(200)}
    assert max(abs(difference_ns - 75 * NS_PER_MS) for difference_ns in differences_ns) <= 1


@given(
    st.lists(st.tuples(st.integers(0, 50 * NS_PER_MS), st.integers(0, 2**32 - 1)), max_size=40),
    st.integers(0, 3),
)
def test_items_leave_in_order(arrivals: list[tuple[int, int]], seed: int) -> None:
    """Every item leaves a line once, in order, at the time that `push` returned, and not before its delay is over."""
    delay = DelayModel(5.0, WIFI, seed, "line")
    line = DelayLine(delay)
    now_ns = 0
    due: list[int] = []
    earliest: list[int] = []
    for number, (pause_ns, index) in enumerate(arrivals):
        now_ns += pause_ns
        due_ns = line.push(number, now_ns, index)
        assert due_ns is not None
        due.append(due_ns)
        earliest.append(now_ns + delay.delay_ns(index))
    assert due == sorted(due)
    assert all(due_ns >= earliest_ns for due_ns, earliest_ns in zip(due, earliest, strict=True))
    assert due == np.maximum.accumulate(np.array(earliest, dtype=np.int64)).tolist()
    out = []
    while (next_ns := line.next_due_ns()) is not None:
        assert line.pop_due(next_ns - 1) == []
        popped = line.pop_due(next_ns)
        assert [due[number] for number in popped] == [next_ns] * len(popped)
        out += popped
    assert out == list(range(len(arrivals)))
    assert line.pop_due(now_ns + NS_PER_S * 1000) == []


def test_packets_with_one_index_stay_together() -> None:
    """Packets that arrive together with one index, like those of one frame, leave together."""
    line = DelayLine(DelayModel(50.0, WIFI, 1, "video"))
    due = {line.push(packet, 0, 90_000) for packet in range(10)}
    assert due == {line.next_due_ns()}
    assert line.pop_due(line.next_due_ns() or 0) == list(range(10))
