from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace
from numpy.typing import NDArray

from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.errors import UserError
from lavt.transport.emulation.delay_line import DelayLine, DelayModel
from lavt.transport.emulation.impairment import DISTRIBUTIONS, Distribution, Impairment, burst_probabilities
from lavt.transport.emulation.link import HEADER_BYTES, EmulatedLink, LinkInjection, check_injection
from lavt.transport.emulation.random_process import LARGEST_QUANTILE, LossProcess, quantiles
from lavt.transport.emulation.trace import Trace, parse_delays, parse_mahimahi

MS = NS_PER_MS
COUNT = 40_000
ISOLATED_NS = NS_PER_S
"""The period of packets that never wait for each other in these tests."""
TABLES = Path("/usr/lib/x86_64-linux-gnu/tc")


def link(
    impairment: Impairment, *, seed: int = 1, name: str = "video", trace: Trace | None = None, **options: Any
) -> EmulatedLink:
    return EmulatedLink(LinkInjection(impairment, seed, name, trace, **options))


def delays_ns(
    emulated_link: EmulatedLink, *, count: int = COUNT, period_ns: int = ISOLATED_NS, size_bytes: int = 1000
) -> list[int | None]:
    """Return the delay of each packet of a steady flow; None for a lost packet."""
    departures_ns = [emulated_link.departure_ns(number * period_ns, 0, size_bytes) for number in range(count)]
    return [
        None if departed_ns is None else departed_ns - number * period_ns
        for number, departed_ns in enumerate(departures_ns)
    ]


def delays_ms(emulated_link: EmulatedLink, **options: Any) -> NDArray[np.float64]:
    """Return the delays in milliseconds of the packets that were not lost."""
    return np.array([delay_ns for delay_ns in delays_ns(emulated_link, **options) if delay_ns is not None]) / MS


def test_no_impairment_adds_no_delay() -> None:
    """Without an impairment a packet has only its inherent delay, and a constant delay is exact."""
    assert set(delays_ns(link(Impairment()), count=1000)) == {0}
    assert link(Impairment()).departure_ns(5, 7, 1000) == 12
    assert set(delays_ns(link(Impairment(delay_ms=0.25)), count=1000)) == {250_000}


@pytest.mark.parametrize("loss", [0.01, 0.1, 0.5])
def test_losses_are_independent_with_the_requested_share(loss: float) -> None:
    """The requested share of packets is lost, and losses do not depend on each other."""
    emulated_link = link(Impairment(loss=loss))
    lost = np.array([delay_ns is None for delay_ns in delays_ns(emulated_link)])
    assert lost.mean() == pytest.approx(loss, abs=4 * (loss * (1 - loss) / COUNT) ** 0.5)
    both = (lost[:-1] & lost[1:]).mean()
    assert both == pytest.approx(loss**2, abs=4 * (loss**2 / COUNT) ** 0.5)
    assert emulated_link.counts == {"packets": COUNT, "lost": int(lost.sum()), "dropped": 0, "overtook": 0}


@pytest.mark.parametrize("burst", [0.0, 5.0])
def test_higher_loss_includes_the_losses_of_lower_loss(burst: float) -> None:
    """With the same seed every packet lost at 1 % loss is lost at 5 %, and every packet lost at 5 % is lost at 10 %."""
    shares = [0.01, 0.05, 0.1]
    lost = [
        np.array([delay_ns is None for delay_ns in delays_ns(link(Impairment(loss=share, loss_burst_packets=burst)))])
        for share in shares
    ]
    assert 100 < lost[0].sum() < lost[1].sum() < lost[2].sum()
    assert not any((at_lower & ~at_higher).any() for at_lower, at_higher in itertools.pairwise(lost))


def burst_lengths(lost: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return the length of each burst of lost packets."""
    edges = np.flatnonzero(np.diff(np.concatenate(([False], lost, [False])).astype(np.int8)))
    return edges[1::2] - edges[::2]


@pytest.mark.parametrize(("loss", "burst"), [(0.02, 5.0), (0.1, 5.0), (0.1, 2.0), (0.3, 20.0)])
def test_bursts_have_the_requested_share_and_mean_length(loss: float, burst: float) -> None:
    """Burst loss has the requested share and mean length of a burst, and the lengths are geometrically distributed."""
    lost = np.array(
        [
            delay_ns is None
            for delay_ns in delays_ns(link(Impairment(loss=loss, loss_burst_packets=burst)), count=5 * COUNT)
        ]
    )
    lengths = burst_lengths(lost)
    deviation = (burst * (burst - 1)) ** 0.5
    assert lengths.mean() == pytest.approx(burst, abs=4 * deviation / len(lengths) ** 0.5)
    assert lengths.std() == pytest.approx(deviation, rel=0.15)
    burst_end_probability, burst_begin_probability = 1 / burst, loss / burst / (1 - loss)
    # Two losses n packets apart have the correlation decay**n, which makes the variance of the share larger.
    decay = 1 - burst_end_probability - burst_begin_probability
    variance = loss * (1 - loss) / len(lost) * (1 + decay) / (1 - decay)
    assert lost.mean() == pytest.approx(loss, abs=4 * variance**0.5)


MEANS_AND_DEVIATIONS = {
    "normal": (0.0, 1.0),
    "uniform": (0.0, 3**-0.5),
    "pareto": (-0.0335, 0.8197),
    "paretonormal": (-0.0253, 0.8339),
}
"""Mean and standard deviation of tc's distributions (iproute2 6.1) for a jitter of 1; uniform is between -1 and 1."""


@pytest.mark.parametrize("distribution", DISTRIBUTIONS)
def test_jitter_has_the_distribution_of_netem(distribution: Distribution) -> None:
    """The delays of packets far apart have the mean and deviation of netem's distribution."""
    delays = (delays_ms(link(Impairment(delay_ms=100, jitter_ms=10, jitter_distribution=distribution))) - 100) / 10
    mean, deviation = MEANS_AND_DEVIATIONS[distribution]
    assert delays.mean() == pytest.approx(mean, abs=4 * deviation / COUNT**0.5 + 5e-4)
    assert delays.std() == pytest.approx(deviation, rel=0.03)
    assert np.abs(delays).max() <= LARGEST_QUANTILE
    assert abs(float(np.corrcoef(delays[:-1], delays[1:])[0, 1])) < 4 / COUNT**0.5


@pytest.mark.skipif(not (TABLES / "pareto.dist").is_file(), reason="tc's tables are not installed")
@pytest.mark.parametrize("distribution", ["normal", "pareto", "paretonormal"])
def test_distributions_match_the_tables_of_tc(distribution: Distribution) -> None:
    """99 % of the quantiles of each distribution differ from tc's table by less than 0.01 standard deviations."""
    lines = [line for line in (TABLES / f"{distribution}.dist").read_text().splitlines() if not line.startswith("#")]
    tc_values = np.sort([int(number) / 8192 for line in lines for number in line.split()])
    assert np.quantile(np.abs(np.sort(quantiles(distribution)) - tc_values), 0.99) < 0.01


def test_jitter_correlation_decays_as_requested() -> None:
    """Correlated jitter has the requested deviation; its correlation falls by the requested factor every 20 ms."""
    impairment = Impairment(delay_ms=1000, jitter_ms=1, jitter_correlation=0.8)
    delays = delays_ms(link(impairment), count=5 * COUNT, period_ns=20 * MS) - 1000
    assert delays.std() == pytest.approx(1, rel=0.03)
    for steps in (1, 2, 3):
        correlation = float(np.corrcoef(delays[:-steps], delays[steps:])[0, 1])
        assert correlation == pytest.approx(0.8**steps, abs=0.02)


def test_correlated_jitter_changes_with_time_not_packets() -> None:
    """Correlated jitter changes every 20 ms, however many packets arrive in this time."""
    impairment = Impairment(delay_ms=1000, jitter_ms=1, jitter_correlation=0.8)
    every_4_ms = delays_ms(link(impairment), count=1000, period_ns=4 * MS).reshape(200, 5)
    every_20_ms = delays_ms(link(impairment), count=200, period_ns=20 * MS)
    assert (every_4_ms[:, 0] == every_20_ms).all()
    assert (np.ptp(every_4_ms, axis=1) == 0).all()


def test_negative_delays_are_cut_off() -> None:
    """Jitter can shorten the inherent delay, but not below 0."""
    emulated_link = link(Impairment(jitter_ms=10))
    delays = delays_ms(emulated_link)
    assert delays.min() == 0
    assert (delays == 0).mean() == pytest.approx(0.5, abs=0.01)
    inherent_link = link(Impairment(jitter_ms=10))
    departures_ns = [inherent_link.departure_ns(number * ISOLATED_NS, 50 * MS, 0) for number in range(1000)]
    total_delays_ns = [(departed_ns or 0) - number * ISOLATED_NS for number, departed_ns in enumerate(departures_ns)]
    assert 10 * MS < min(total_delays_ns) < 50 * MS


def test_rate_serialises_packets() -> None:
    """Packets that arrive together leave one after the other at the rate, headers included."""
    emulated_link = link(Impairment(delay_ms=5, rate_bps=2_000_000))
    serialisation_ns = round(8 * (1000 + HEADER_BYTES) * NS_PER_S / 2_000_000)
    assert [emulated_link.departure_ns(0, 0, 1000) for _ in range(4)] == [
        5 * MS + serialisation_ns * (number + 1) for number in range(4)
    ]
    assert set(delays_ns(link(Impairment(rate_bps=2_000_000)), count=100)) == {serialisation_ns}


def test_throughput_is_the_rate() -> None:
    """An overloaded link passes exactly its rate."""
    emulated_link = link(Impairment(rate_bps=1_000_000), queue_packets=20)
    departures_ns = [
        departed_ns
        for departed_ns in (emulated_link.departure_ns(number * MS, 0, 958) for number in range(20_000))
        if departed_ns is not None
    ]
    assert 8000 * (len(departures_ns) - 1) / ((departures_ns[-1] - departures_ns[0]) / NS_PER_S) == pytest.approx(
        1_000_000, rel=1e-6
    )
    assert emulated_link.dropped == 20_000 - len(departures_ns) > 0


def test_full_queue_drops_packets() -> None:
    """A queue for three packets, including the one being sent, drops and counts the fourth."""
    emulated_link = link(Impairment(rate_bps=8000), queue_packets=3)  # 1 s for 1000 bytes
    size_bytes = 1000 - HEADER_BYTES
    assert [emulated_link.departure_ns(0, 0, size_bytes) for _ in range(5)] == [
        NS_PER_S,
        2 * NS_PER_S,
        3 * NS_PER_S,
        None,
        None,
    ]
    assert emulated_link.departure_ns(NS_PER_S, 0, size_bytes) == 4 * NS_PER_S
    assert emulated_link.departure_ns(NS_PER_S, 0, size_bytes) is None
    assert emulated_link.counts == {"packets": 7, "lost": 0, "dropped": 3, "overtook": 0}


def test_delayed_packets_are_not_in_the_queue() -> None:
    """A packet whose delay has not passed takes no room in the queue."""
    emulated_link = link(Impairment(delay_ms=5000, rate_bps=8000), queue_packets=1)
    departures_ns = [emulated_link.departure_ns(number * NS_PER_S, 0, 1000 - HEADER_BYTES) for number in range(5)]
    assert departures_ns == [(6 + number) * NS_PER_S for number in range(5)]


@pytest.mark.parametrize("reorder", [0.05, 0.25])
def test_requested_share_is_reordered(reorder: float) -> None:
    """The requested share of packets is not delayed and overtakes delayed packets, which all have the same delay."""
    emulated_link = link(Impairment(delay_ms=75, reorder=reorder))
    delays = delays_ms(emulated_link, period_ns=3 * MS)
    not_delayed = delays == 0
    assert set(delays) == {0.0, 75.0}
    assert not_delayed.mean() == pytest.approx(reorder, abs=4 * (reorder * (1 - reorder) / COUNT) ** 0.5)
    # A packet that is not delayed overtakes, unless none of the 24 packets before it was delayed.
    assert emulated_link.overtook == pytest.approx(not_delayed.sum(), abs=1)
    isolated_flow = link(Impairment(delay_ms=75, reorder=reorder))
    delays_ms(isolated_flow)
    assert isolated_flow.overtook == 0


def test_capacity_is_used_byte_by_byte() -> None:
    """A capacity trace sends 1500 bytes at each opportunity, of one packet or of several packets that wait."""
    trace = parse_mahimahi("10\n20\n20\n30\n", "t")
    emulated_link = link(Impairment(), trace=trace)

    def send(at_ms: float, size_bytes: int) -> float:
        departure_ns = emulated_link.departure_ns(round(at_ms * MS), 0, size_bytes - HEADER_BYTES)
        assert departure_ns is not None
        return departure_ns / MS

    assert send(0, 1000) == 10
    assert send(0, 500) == 10  # 500 bytes were left at 10 ms
    assert send(0, 1) == 20
    assert send(5, 1499) == 20
    assert send(5, 1501) == 30  # 1500 bytes in the second opportunity at 20 ms, and one at 30 ms
    assert send(30, 1499) == 30  # 1499 bytes were left at 30 ms; the packet arrives just in time
    assert send(31, 100) == 40  # the trace repeats after 30 ms; its second pass begins with an opportunity at 40 ms
    assert send(75, 100) == 80  # the opportunities between 40 and 75 ms passed unused
    assert send(75, 3000) == 90  # 1400 at 80, 1500 at 80, 100 at 90


def test_trace_begins_with_the_link() -> None:
    """A capacity trace begins when its link starts; a packet waits first for its delay, then for the trace."""
    emulated_link = EmulatedLink(
        LinkInjection(Impairment(delay_ms=3), 1, "video", parse_mahimahi("10\n", "t")), start_ns=500 * MS
    )
    assert emulated_link.departure_ns(500 * MS, 0, 100) == 510 * MS
    assert emulated_link.departure_ns(508 * MS, 0, 100) == 520 * MS


def test_full_queue_of_a_capacity_trace_drops_packets() -> None:
    """If the queue of packets that wait for a capacity trace is full, the next packet is dropped."""
    emulated_link = link(Impairment(), trace=parse_mahimahi("10\n", "t"), queue_packets=2)
    size_bytes = 1500 - HEADER_BYTES
    assert [emulated_link.departure_ns(0, 0, size_bytes) for _ in range(3)] == [10 * MS, 20 * MS, None]
    assert emulated_link.departure_ns(10 * MS, 0, size_bytes) == 30 * MS


def test_trace_delay_is_added_and_keeps_order() -> None:
    """A trace's delay is added to the constant delay, and packets keep their order even if the delay falls fast."""
    trace = parse_delays("time_s,delay_ms\n0,0\n1,100\n1.05,0\n2,0\n", "t")
    emulated_link = link(Impairment(delay_ms=20), trace=trace)
    departures_ns = [
        emulated_link.departure_ns(at_ms * MS, 0, 100) for at_ms in (0, 500, 1000, 1025, 1050, 1100, 1500, 2500)
    ]
    assert [departed_ns and departed_ns / MS for departed_ns in departures_ns] == [
        20,
        570,
        1120,
        1120,
        1120,
        1120,
        1520,
        2570,
    ]


IMPAIRMENTS: dict[str, dict[str, Any]] = {
    "loss": {"loss": 0.1},
    "bursts": {"loss": 0.1, "loss_burst_packets": 5.0},
    "reorder": {"reorder": 0.2},
    "jitter": {"jitter_ms": 5.0},
    "correlated": {"jitter_ms": 5.0, "jitter_correlation": 0.9},
    "rate": {"rate_bps": 2_000_000},
}


@given(
    st.lists(st.sampled_from(sorted(set(IMPAIRMENTS) - {"reorder"})), max_size=3, unique=True),
    st.lists(st.tuples(st.integers(0, 30 * MS), st.integers(0, 20 * MS), st.integers(0, 1500)), max_size=60),
)
def test_order_is_kept_without_reordering(names: list[str], packets: list[tuple[int, int, int]]) -> None:
    """Without `reorder` no packet overtakes another or leaves before it arrived, whatever the other impairments."""
    emulated_link = link(
        Impairment(delay_ms=10, **{key: value for name in names for key, value in IMPAIRMENTS[name].items()})
    )
    now_ns, last_ns = 0, 0
    for pause_ns, inherent_ns, size_bytes in packets:
        now_ns += pause_ns
        departure_ns = emulated_link.departure_ns(now_ns, inherent_ns, size_bytes)
        if departure_ns is not None:
            assert departure_ns >= max(now_ns, last_ns)
            last_ns = departure_ns
    assert emulated_link.overtook == 0


@pytest.mark.parametrize("name", IMPAIRMENTS)
def test_same_seed_gives_the_same_delays(name: str) -> None:
    """The same seed gives the same delays. Another seed or flow name gives other delays, unless nothing is random."""
    impairment = Impairment(delay_ms=75, **IMPAIRMENTS[name])
    first = delays_ns(link(impairment), count=2000)
    assert delays_ns(link(impairment), count=2000) == first
    for other in (link(impairment, seed=2), link(impairment, name="control")):
        assert (delays_ns(other, count=2000) == first) == (name == "rate")


@pytest.mark.parametrize("name", ["jitter", "correlated"])
@pytest.mark.parametrize("added", ["loss", "bursts", "reorder"])
def test_added_impairment_keeps_other_delays(name: str, added: str) -> None:
    """An added impairment does not change the delays of the packets that it does not affect."""
    impairment = Impairment(delay_ms=75, **IMPAIRMENTS[name])
    alone = delays_ns(link(impairment), count=2000)
    both = delays_ns(link(replace(impairment, **IMPAIRMENTS[added])), count=2000)
    assert sum(delay_ns in (None, 0) for delay_ns in both) > 50
    assert all(delay_ns in (None, 0, before) for before, delay_ns in zip(alone, both, strict=True))


@given(st.floats(1.1, 20.0), st.floats(0.01, 1.0), st.floats(1.01, 3.0), st.integers(0, 2**32 - 1))
def test_higher_loss_includes_any_lower_loss_up_to_a_limit(
    burst: float, share: float, factor: float, seed: int
) -> None:
    """Every packet lost at a lower loss of at most 1 - 1/burst is lost at a higher loss with equally long bursts."""
    lower = share * (1 - 1 / burst)
    higher = min(lower * factor, burst / (burst + 1))
    processes = [
        LossProcess(seed, "x", loss, burst_probabilities(Impairment(loss=loss, loss_burst_packets=burst)))
        for loss in (lower, higher)
    ]
    lost_at_lower, lost_at_higher = ([process.is_lost(index) for index in range(300)] for process in processes)
    assert all(at_higher or not at_lower for at_lower, at_higher in zip(lost_at_lower, lost_at_higher, strict=True))


def test_loss_does_not_change_reordering() -> None:
    """The same packets are reordered with and without loss."""
    impairment = Impairment(delay_ms=75, reorder=0.2)
    alone, both = delays_ns(link(impairment), count=2000), delays_ns(link(replace(impairment, loss=0.1)), count=2000)
    assert all(delay_ns in (None, before) for before, delay_ns in zip(alone, both, strict=True))


def test_delay_line_follows_its_link() -> None:
    """A delay line loses, delays and reorders packets like its link, and returns when each is due."""
    impairment = Impairment(delay_ms=75, loss=0.1, reorder=0.2)
    line, emulated_link = DelayLine(DelayModel(12.0), link(impairment)), link(impairment)
    due = [line.push(number, number * MS, 0, 100) for number in range(500)]
    assert due == [emulated_link.departure_ns(number * MS, 12 * MS, 100) for number in range(500)]
    order = sorted((due_ns, number) for number, due_ns in enumerate(due) if due_ns is not None)
    assert line.pop_due(2 * NS_PER_S) == [number for _, number in order]
    assert [number for _, number in order] != sorted(number for _, number in order)


CONTRADICTIONS: list[tuple[Impairment, str | None, str]] = [
    (Impairment(loss=1.0), None, "must be below 1"),
    (Impairment(loss=0.9, loss_burst_packets=2), None, "gaps of less than one packet"),
    (
        Impairment(delay_ms=9, jitter_ms=1, jitter_correlation=0.5, jitter_distribution="pareto"),
        None,
        "distribution normal",
    ),
    (Impairment(reorder=0.1), None, "needs a delay"),
    (Impairment(reorder=0.1), "10\n", "needs a delay"),
    (Impairment(rate_bps=1000), "10\n", "give one of the two"),
    (Impairment(rate_bps=7), None, "between 8 and"),
    (Impairment(delay_ms=float("nan")), None, "finite"),
]


@pytest.mark.parametrize(("impairment", "trace", "message"), CONTRADICTIONS)
def test_contradictory_impairments_are_rejected(impairment: Impairment, trace: str | None, message: str) -> None:
    """A contradictory impairment is rejected with the flow's name."""
    requested = LinkInjection(impairment, 1, "video", None if trace is None else parse_mahimahi(trace, "t"))
    with pytest.raises(UserError, match=rf"^video: .*{message}"):
        check_injection(requested)


def test_combinations_beyond_netem_are_allowed() -> None:
    """Jitter larger than the delay, correlation without jitter, and reordering with only a delay trace are allowed."""
    check_injection(LinkInjection(Impairment(jitter_ms=10), 1, "video"))
    check_injection(LinkInjection(Impairment(jitter_correlation=0.9), 1, "video"))
    check_injection(LinkInjection(Impairment(reorder=0.1), 1, "video", parse_delays("time_s,delay_ms\n0,1\n1,2", "t")))


def test_packets_without_injected_delay_keep_their_order() -> None:
    """The packets that `reorder` does not delay still have the inherent delay and do not overtake each other."""
    emulated_link = link(Impairment(delay_ms=75, reorder=0.999))
    not_delayed = [
        emulated_link.departure_ns(number * MS, inherent_ns, 100)
        for number, inherent_ns in enumerate((40 * MS, 0, 50 * MS))
    ]
    assert not_delayed == [40 * MS, 40 * MS, 52 * MS]


@pytest.mark.parametrize("added", [{"loss": 0.5}, {"reorder": 0.5}])
def test_loss_and_reordering_are_independent_of_jitter(added: dict[str, Any]) -> None:
    """The jitter of the remaining packets does not depend on loss or reordering."""
    delays = delays_ms(link(Impairment(delay_ms=100, jitter_ms=10, **added)))
    delayed = delays[delays > 0]
    assert len(delayed) == pytest.approx(COUNT / 2, rel=0.05)
    assert delayed.mean() == pytest.approx(100, abs=4 * 10 / len(delayed) ** 0.5)
