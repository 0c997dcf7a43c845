"""Test how a machine of the kernel lane reads the host's stalls, and what they excuse; the tests need no machine."""

from __future__ import annotations

import json
import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any
from unittest.mock import Mock

import pytest
from tests.field.by_wire import STOP_STALL_MS
from tests.kernel.lane import clocks, host_stalls, verdicts
from tests.kernel.lane.host_stalls import STALLS_PER_ANSWER, HostProbe
from tests.kernel.lane.verdicts import MEDIAN_SHARE, shortest_stall_ms
from tests.support.stalls import HostStalled, ProbeEnded, Stall, Stalls, excuse_slow_machine, stalled_share
from tests.test_stalls import QUIET, FakeLatenessProbe, stalls_of

from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.experiment.analysis.invalid_reason import InvalidCode, InvalidReason

COUNTER_HZ = 2e9
READING = 9_000_000_000, 50 * NS_PER_S
"""A reading of the counter and of this machine's clock."""
FAIR_SERVER_MS = 60
"""Time that ordinary programs get in each second if a machine uses its processor fully (the kernel's fair server)."""


@pytest.fixture(autouse=True)
def counter(monkeypatch: pytest.MonkeyPatch) -> None:
    """Replace the counter by fixed readings, so that no particular processor is needed."""
    monkeypatch.setattr(clocks, "counter_hz", lambda: COUNTER_HZ)
    monkeypatch.setattr(clocks, "read_monotonic_clock", lambda: READING)
    monkeypatch.setattr(host_stalls, "POLL_S", 1000)


def answer_with(*stalls: tuple[int, int, int], more: bool = False) -> dict[str, Any]:
    """Return an answer that the host made 1.5 s before `READING`, when its clock read 7 s."""
    counter, _ = READING
    return {
        "counter": counter - 3_000_000_000,
        "mono_ns": 7 * NS_PER_S,
        "stalls": stalls,
        "more": more,
        "has_realtime_priority": True,
        "processor_times": QUIET,
    }


@contextmanager
def serial_line(*answers: dict[str, Any]) -> Iterator[str]:
    """Return the device of a serial line whose other end gives these answers in order."""
    host, machine = os.openpty()

    def answer() -> None:
        for reply in answers:
            assert os.read(host, 1) == b"?"
            os.write(host, json.dumps(reply).encode() + b"\n")

    thread = threading.Thread(target=answer)
    thread.start()
    yield os.ttyname(machine)
    thread.join()
    os.close(machine)
    os.close(host)


def test_host_times_are_converted() -> None:
    """A stall that ended 0.5 s before the host's answer ended 2 s before a reading 1.5 s after that answer."""
    with serial_line(answer_with(), answer_with((1, 6_400_000_000, 6_500_000_000))) as device:
        probe = HostProbe(device)
        assert probe.report() == (48_500_000_000, [Stall(1, 47_900_000_000, 48_000_000_000)])
        probe.end()


def test_long_record_needs_several_answers() -> None:
    """If the host has more stalls than fit into an answer, a report repeats the query until it has all stalls."""
    pieces = [answer_with((0, number, number + 1), more=number < 2) for number in range(3)]
    with serial_line(answer_with(), *pieces, answer_with()) as device:
        probe = HostProbe(device)
        _, stalls = probe.report()
        assert len(stalls) == 3
        _, stalls = probe.report()
        assert stalls == []
        probe.end()


def test_ended_host_probe_is_reported() -> None:
    """A report raises `ProbeEnded` if one of the host's probes has ended."""
    with serial_line(answer_with(), {"ended": "processor 1"}) as device:
        probe = HostProbe(device)
        with pytest.raises(ProbeEnded, match="processor 1"):
            probe.report()
        probe.end()


def test_processor_times_are_those_of_the_host() -> None:
    """The processor times are the host's, and the last known times remain available after a probe has ended."""
    with serial_line(answer_with(), {"ended": "processor 1"}) as device:
        probe = HostProbe(device)
        with pytest.raises(ProbeEnded):
            probe.report()
        assert probe.processor_times() == QUIET
        probe.end()


def test_answers_have_a_limited_length() -> None:
    """An answer has at most 40 stalls and announces further stalls; the next answer has only these."""
    recorded = [Stall(0, number, number + 1) for number in range(STALLS_PER_ANSWER + 1)]
    stalls = Stalls([FakeLatenessProbe([(0, []), (0, recorded)])], lambda: QUIET)
    first, second = (host_stalls._answer(stalls) for _ in range(2))
    assert (len(first["stalls"]), first["more"]) == (STALLS_PER_ANSWER, True)
    assert (len(second["stalls"]), second["more"]) == (1, False)
    longest = answer_with(*((1, 10**18, 10**18) for _ in range(STALLS_PER_ANSWER)))
    assert len(json.dumps(longest)) < 3900


@pytest.mark.parametrize(
    ("reason", "least_ms"),
    [
        ("driving -> safe_stop: no command for 500 ms", 100),
        ("the vehicle does not accept commands: no SteerReport1 for 100 ms; no BrakeReport1 for 100 ms", 40),
        ("the vehicle does not accept commands: no SteerReport1 for 200 ms", 140),
    ],
)
def test_least_stall_for_each_safe_stop(reason: str, least_ms: float) -> None:
    """A stall of 100 ms explains a stop without commands; for missing reports, their timeout minus 60 ms is enough."""
    assert shortest_stall_ms(reason) == least_ms


@pytest.mark.parametrize(
    ("codes", "stalled_ms", "is_excused"),
    [
        ([InvalidCode.INJECTION_NOT_IN_FORCE], 80, True),
        ([InvalidCode.INJECTION_DIFFERS], 60, False),
        ([InvalidCode.CLOCK_NOT_SAMPLED], 80, False),
        ([InvalidCode.CLOCK_NOT_SAMPLED, InvalidCode.INJECTION_DIFFERS], 1600, True),
        ([InvalidCode.INJECTION_DIFFERS, InvalidCode.CLOCK_STEP], 1600, False),
    ],
)
def test_reasons_that_a_stall_explains(
    codes: list[InvalidCode], stalled_ms: int, is_excused: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A stalled share explains a wrong delay, and a long stall a missing sample; nothing explains a clock's step."""
    monkeypatch.setattr(verdicts, "invalid_reasons", lambda _: [InvalidReason(code, code.value) for code in codes])
    monkeypatch.setattr(verdicts, "driving_interval", lambda _: (0, NS_PER_S, "completed"))
    stalls = stalls_of(Stall(0, 0, stalled_ms * NS_PER_MS))
    with pytest.raises(HostStalled if is_excused else AssertionError):
        verdicts.require_valid(Mock(), stalls)


def test_full_processor_use_excuses_nothing() -> None:
    """The time that ordinary programs get on a fully used processor excuses neither a stop nor a median."""
    assert STOP_STALL_MS > FAIR_SERVER_MS
    short_stalls = stalls_of(
        *(Stall(0, at_s * NS_PER_S, at_s * NS_PER_S + FAIR_SERVER_MS * NS_PER_MS) for at_s in range(10))
    )
    assert isinstance(excuse_slow_machine(AssertionError(), short_stalls, 0, 10 * NS_PER_S), AssertionError)
    assert stalled_share(short_stalls.recorded, 0, 10 * NS_PER_S) < MEDIAN_SHARE


def test_many_short_stalls_excuse_a_drive() -> None:
    """A drive that was stalled for 15 % of its time, 3 ms at a time, is repeated."""
    many_stalls = stalls_of(*(Stall(0, at * 20 * NS_PER_MS, (at * 20 + 3) * NS_PER_MS) for at in range(50)))
    assert isinstance(excuse_slow_machine(AssertionError(), many_stalls, 0, NS_PER_S), HostStalled)
