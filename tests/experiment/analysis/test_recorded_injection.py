from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest

from lavt.experiment.analysis.injection_validity import absent_reasons, recorded_reasons
from lavt.recording.record import Record
from lavt.recording.table import Table, table_of

REQUESTED_MS = {"video": 150.0, "control": 75.0}
BEGAN_S, ENDED_S = 10, 20
Sample = tuple[float, str, str, float, float | None, str]
VIDEO: list[Sample] = [(5, "L4", "video", 150.0, 150.2, ""), (15, "L4", "video", 150.0, 150.4, "")]
CONTROL: list[Sample] = [(1, "L4", "control", 75.0, 75.1, "")]


def table(rows: Sequence[Mapping[str, Any]]) -> Table:
    mono_ns = [row["mono_ns"] for row in rows]
    return table_of(rows, mono_ns, mono_ns)


def record(samples: Sequence[Sample], *, drove: bool = False) -> Record:
    keys = ("mono_ns", "condition", "flow", "requested_ms", "measured_ms", "reason")
    rows = [dict(zip(keys, (round(sample[0] * 1e9), *sample[1:]), strict=True)) for sample in samples]
    tables = {"injection": table(rows)} if rows else {}
    if drove:
        events = (("drive_began", BEGAN_S, ""), ("ending", ENDED_S, "completed"))
        tables["event"] = table([{"mono_ns": s * 10**9, "kind": kind, "detail": detail} for kind, s, detail in events])
    return Record(Path("none"), True, tables, {}, ENDED_S * 10**9)


def reasons(
    video: Sequence[Sample], control: Sequence[Sample], requested_ms: Mapping[str, float] = REQUESTED_MS
) -> list[str]:
    return recorded_reasons(record(video, drove=True), record(control), "L4", requested_ms)


def test_a_condition_that_was_in_force_all_the_time_is_no_reason() -> None:
    """Both queues said before the drive that they do as asked, and nothing else until its end; after it all is free."""
    assert reasons(VIDEO, CONTROL) == []
    assert reasons([(2, "", "", 0.0, None, ""), *VIDEO, (21, "", "", 0.0, None, "")], CONTROL) == []


@pytest.mark.parametrize(
    ("video", "control", "said"),
    [
        ([], CONTROL, "the server did not say"),
        (VIDEO, [], "the client did not say"),
        (VIDEO[1:], CONTROL, "the server did not say"),
        ([*VIDEO, (18, "", "", 0.0, None, "")], CONTROL, "not in force as asked on the server"),
        ([(5, "L5", "video", 225.0, 225.1, ""), *VIDEO[1:]], CONTROL, "not in force as asked on the server"),
        ([VIDEO[0], (15, "L4", "video", 150.0, None, "no tc")], CONTROL, "on the server all the time: no tc"),
        (VIDEO, [*CONTROL, (9, "L4", "control", 75.0, 79.0, "late")], "asked on the client all the time: late"),
        (VIDEO, [(1, "L4", "control", 75.0, None, "")], "nobody measured"),
    ],
)
def test_each_way_of_not_being_in_force_is_a_reason(video: list[Sample], control: list[Sample], said: str) -> None:
    """A side that says nothing before the drive, another condition, a failure or a doubt makes the run invalid."""
    assert [reason for reason in reasons(video, control) if said in reason]


def test_what_was_not_requested_for_need_not_be_measured() -> None:
    """Under a condition that delays the video only, nobody has to measure the control."""
    assert reasons(VIDEO, [(1, "L4", "", 0.0, None, "")], {"video": 150.0, "control": 0.0}) == []


def test_a_long_silence_is_a_reason() -> None:
    """Where a queue was not measured for more than 20 s of the drive nobody knows what it did."""
    early = [(-15, "L4", "video", 150.0, 150.2, "")]
    (reason,) = reasons(early, CONTROL)
    assert reason.startswith("the server ")
    assert reason.endswith(" 35 s")
    gap = [*CONTROL, (30, "L4", "control", 75.0, 75.1, "")]
    (reason,) = reasons(VIDEO, gap)
    assert reason.startswith("the client ")
    assert reason.endswith(" 29 s")


def test_a_drive_without_a_condition_must_not_have_anothers() -> None:
    """A run that asked for nothing is invalid where another client's condition was in force."""
    (reason,) = recorded_reasons(record(VIDEO, drove=True), record([]), "", REQUESTED_MS)
    assert "L4 was in force on the server" in reason
    ended = [VIDEO[0], (8, "", "", 0.0, None, "")]
    assert recorded_reasons(record(ended, drove=True), record([]), "", REQUESTED_MS) == []


@pytest.mark.parametrize(
    ("tau_v_ms", "tau_c_ms", "flows"),
    [(151.0, 76.0, []), (140.0, 70.0, []), (30.0, 76.0, ["video"]), (151.0, 5.0, ["control"]), (None, None, [])],
)
def test_latencies_that_are_too_short_for_what_was_injected(
    tau_v_ms: float | None, tau_c_ms: float | None, flows: list[str]
) -> None:
    """Where video or control took less than was injected into them, the delay was on another path: invalid."""
    entry = {"tau_v_ms": {"p50": tau_v_ms, "bound": 0.2}, "tau_c_ms": {"p50": tau_c_ms, "bound": None}}
    said = absent_reasons(entry, REQUESTED_MS)
    assert [each.split()[1] for each in said] == flows
