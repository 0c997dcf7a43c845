from __future__ import annotations

import runpy
from contextlib import suppress

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lavt.assembly.links import TRACES, read_trace
from lavt.config_file import shipped
from lavt.domain import NS_PER_MS
from lavt.errors import UserError
from lavt.transport.emulation.trace import CapacityTrace, DelayTrace, parse_delays, parse_mahimahi

MS = NS_PER_MS


def test_capacity_repeats() -> None:
    """A capacity trace repeats after its last time; `first_at` finds the first entry at or after a time."""
    trace = parse_mahimahi("1\n5\n5\n10\n", "t")
    assert [trace.time_ns(number) // MS for number in range(10)] == [1, 5, 5, 10, 11, 15, 15, 20, 21, 25]
    first_opportunities = {0: 0, 1: 0, 2: 1, 5: 1, 6: 3, 10: 3, 11: 4, 15: 5, 16: 7, 20: 7, 21: 8}
    assert {time_ms: trace.first_at(time_ms * MS) for time_ms in first_opportunities} == first_opportunities


@given(st.lists(st.integers(0, 30), min_size=1, max_size=8), st.integers(0, 200 * MS))
def test_first_opportunity_is_the_earliest(times_ms: list[int], time_ns: int) -> None:
    """For any trace and time, `first_at` returns the earliest opportunity at or after that time."""
    trace = CapacityTrace(tuple(time_ms * MS for time_ms in (*sorted(times_ms), 31)))
    first = trace.first_at(time_ns)
    assert trace.time_ns(first) >= time_ns
    assert first == 0 or trace.time_ns(first - 1) < time_ns


def test_delays_are_interpolated_linearly() -> None:
    """Between two points of a trace the delay is interpolated linearly; after the last point the trace repeats."""
    trace = parse_delays("time_s,delay_ms\n0,10\n2,30\n3,0\n", "t")
    at_ms = {0: 10, 1000: 20, 1500: 25, 2000: 30, 2500: 15, 2999: 0.03, 3000: 10, 4000: 20, 303_500: 15}
    assert {time_ms: trace.delay_ns(time_ms * MS) / MS for time_ms in at_ms} == at_ms


BAD_MAHIMAHI = [
    ("", "no duration"),
    ("0\n0\n", "no duration"),
    ("5\n4\n", "entry 2 is 4 ms, after one of 5 ms"),
    ("1\nx\n", "t, line 2: 'x'"),
    ("1.5\n", "'1.5'"),
    ("-1\n", "'-1'"),
    ("²\n", "not a time"),
    ("9" * 5000, "not a time"),
    ("time_s,delay_ms\n0,1\n", ".csv"),
]


@pytest.mark.parametrize(("text", "message"), BAD_MAHIMAHI, ids=[text[:12] for text, _ in BAD_MAHIMAHI])
def test_invalid_capacity_is_rejected(text: str, message: str) -> None:
    """An invalid capacity trace is rejected with a message that names the source and the fault."""
    with pytest.raises(UserError, match=r"^t") as error:
        parse_mahimahi(text, "t")
    assert message in str(error.value)


HEADER = "time_s,delay_ms\n"
BAD_CSV = [
    ("", "header line time_s,delay_ms"),
    ("0,1\n1,2\n", "header line time_s,delay_ms"),
    (HEADER, "at least two rows"),
    (HEADER + "0,1\n", "at least two rows"),
    (HEADER + "1,1\n2,1\n", "the first of them at time_s 0"),
    (HEADER + "0,1\n2,1\n2,3\n", "time_s 2 comes after 2"),
    (HEADER + "0,1\n2,-1\n", "row 3: '2,-1' is not a time"),
    (HEADER + "0,1\n2,nan\n", "row 3"),
    (HEADER + "0,1\n2\n", "row 3"),
    (HEADER + "0,1\n1,60001\n", "row 3"),
    (HEADER + '0,1\n"', "t"),
]


@pytest.mark.parametrize(("text", "message"), BAD_CSV, ids=[text[16:30] or text for text, _ in BAD_CSV])
def test_invalid_delays_are_rejected(text: str, message: str) -> None:
    """An invalid delay trace is rejected with a message that names the source and the fault."""
    with pytest.raises(UserError, match=r"^t") as error:
        parse_delays(text, "t")
    assert message in str(error.value)
    assert "\n" not in str(error.value)


@given(st.text())
def test_any_text_raises_only_user_errors(text: str) -> None:
    """Parsing any text raises nothing but `UserError`."""
    for parse in (parse_mahimahi, parse_delays):
        with suppress(UserError):
            parse(text, "t")
        with suppress(UserError):
            parse(HEADER + text, "t")


def test_shipped_traces_match_their_script() -> None:
    """The shipped traces are the output of their script, and are found by name without a path."""
    folder = shipped(TRACES)
    script = runpy.run_path(str(folder / "make_traces.py"))
    assert (folder / "fading.mahimahi").read_text() == script["fading"]()
    assert (folder / "handover.csv").read_text() == script["handover"]()
    fading, handover = read_trace("fading.mahimahi"), read_trace("handover.csv")
    assert isinstance(fading, CapacityTrace)
    assert isinstance(handover, DelayTrace)
    mean_bps = len(fading.times_ns) * 1500 * 8 / (fading.times_ns[-1] / 1e9)
    assert mean_bps == pytest.approx(5e6, rel=1e-3)
    assert max(handover.delays_ns) == 180 * MS
