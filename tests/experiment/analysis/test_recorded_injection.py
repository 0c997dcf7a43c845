from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest

from lavt.experiment.analysis.injection_validity import missing_delay_reasons, recorded_reasons
from lavt.experiment.analysis.invalid_reason import InvalidCode, InvalidReason
from lavt.recording.record import Record
from lavt.recording.table import Table, table_of

REQUESTED_MS = {"video": 150.0, "control": 75.0}
BEGAN_S, ENDED_S = 10, 20
Sample = tuple[float, str, str, float, float | None, str]
"""Time (s), condition, flow, requested delay (ms), measured delay (ms), and how the measurement deviates;
"": it does not."""
VIDEO: list[Sample] = [(5, "L4", "video", 150.0, 150.2, ""), (15, "L4", "video", 150.0, 150.4, "")]
CONTROL: list[Sample] = [(1, "L4", "control", 75.0, 75.1, "")]


def table(rows: Sequence[Mapping[str, Any]]) -> Table:
    mono_ns = [row["mono_ns"] for row in rows]
    return table_of(rows, mono_ns, mono_ns)


def record(samples: Sequence[Sample], *, with_drive: bool = False) -> Record:
    keys = ("mono_ns", "condition", "flow", "requested_ms", "measured_ms", "reason")
    rows = [dict(zip(keys, (round(sample[0] * 1e9), *sample[1:]), strict=True)) for sample in samples]
    tables = {"injection": table(rows)} if rows else {}
    if with_drive:
        events = (("drive_began", BEGAN_S, ""), ("ending", ENDED_S, "completed"))
        tables["event"] = table(
            [{"mono_ns": at_s * 10**9, "kind": kind, "detail": detail} for kind, at_s, detail in events]
        )
    return Record(Path("none"), True, tables, {}, ENDED_S * 10**9)


def reasons(
    video: Sequence[Sample], control: Sequence[Sample], requested_ms: Mapping[str, float] = REQUESTED_MS
) -> list[InvalidReason]:
    return recorded_reasons(record(video, with_drive=True), record(control), "L4", requested_ms)


def test_a_condition_in_force_throughout_the_drive_is_valid() -> None:
    """A run is valid if the queues are as requested from before the drive to its end, whatever happens later."""
    assert reasons(VIDEO, CONTROL) == []
    assert reasons([(2, "", "", 0.0, None, ""), *VIDEO, (21, "", "", 0.0, None, "")], CONTROL) == []


@pytest.mark.parametrize(
    ("video", "control", "code", "fact"),
    [
        ([], CONTROL, InvalidCode.INJECTION_NOT_IN_FORCE, "server"),
        (VIDEO, [], InvalidCode.INJECTION_NOT_IN_FORCE, "client"),
        (VIDEO[1:], CONTROL, InvalidCode.INJECTION_NOT_IN_FORCE, "server"),
        ([*VIDEO, (18, "", "", 0.0, None, "")], CONTROL, InvalidCode.INJECTION_NOT_IN_FORCE, "server"),
        ([(5, "L5", "video", 225.0, 225.1, ""), *VIDEO[1:]], CONTROL, InvalidCode.INJECTION_NOT_IN_FORCE, "server"),
        ([VIDEO[0], (15, "L4", "video", 150.0, None, "no tc")], CONTROL, InvalidCode.INJECTION_NOT_IN_FORCE, "no tc"),
        (VIDEO, [*CONTROL, (9, "L4", "control", 75.0, 79.0, "late")], InvalidCode.INJECTION_NOT_IN_FORCE, "late"),
        (VIDEO, [(1, "L4", "control", 75.0, None, "")], InvalidCode.INJECTION_NOT_MEASURED, "control"),
    ],
)
def test_a_condition_that_was_not_in_force_makes_the_run_invalid(
    video: list[Sample], control: list[Sample], code: InvalidCode, fact: str
) -> None:
    """A run is invalid if a side has no sample before the drive, or a sample with another condition or a deviation."""
    assert [reason for reason in reasons(video, control) if reason.code is code and fact in reason.text]


def test_an_unrequested_delay_need_not_be_measured() -> None:
    """Under a condition that delays only the video, the control delay need not be measured."""
    assert reasons(VIDEO, [(1, "L4", "", 0.0, None, "")], {"video": 150.0, "control": 0.0}) == []


def test_a_long_gap_between_measurements_makes_the_run_invalid() -> None:
    """A run is invalid if the server took no sample for 20 s until the drive's end, or the client none between two."""
    before_drive = [(-15, "L4", "video", 150.0, 150.2, "")]
    (reason,) = reasons(before_drive, CONTROL)
    assert reason.code is InvalidCode.INJECTION_NOT_MEASURED
    assert "server" in reason.text
    assert "35 s" in reason.text
    with_gap = [*CONTROL, (30, "L4", "control", 75.0, 75.1, "")]
    (reason,) = reasons(VIDEO, with_gap)
    assert reason.code is InvalidCode.INJECTION_NOT_MEASURED
    assert "client" in reason.text
    assert "29 s" in reason.text


def test_another_clients_condition_invalidates_a_run_without_one() -> None:
    """A run without a condition is invalid if another client's condition was in force during the drive."""
    (reason,) = recorded_reasons(record(VIDEO, with_drive=True), record([]), "", REQUESTED_MS)
    assert reason.code is InvalidCode.INJECTION_NOT_REQUESTED
    assert "L4" in reason.text
    ended = [VIDEO[0], (8, "", "", 0.0, None, "")]
    assert recorded_reasons(record(ended, with_drive=True), record([]), "", REQUESTED_MS) == []


@pytest.mark.parametrize(
    ("tau_v_ms", "tau_c_ms", "flows"),
    [(151.0, 76.0, []), (140.0, 70.0, []), (30.0, 76.0, ["video"]), (151.0, 5.0, ["control"]), (None, None, [])],
)
def test_latencies_below_the_injected_delay_make_the_run_invalid(
    tau_v_ms: float | None, tau_c_ms: float | None, flows: list[str]
) -> None:
    """A run is invalid if its video or control latency is far less than injected: the delay was on another path."""
    entry = {"tau_v_ms": {"p50": tau_v_ms, "bound": 0.2}, "tau_c_ms": {"p50": tau_c_ms, "bound": None}}
    found = missing_delay_reasons(entry, REQUESTED_MS)
    assert {reason.code for reason in found} <= {InvalidCode.INJECTION_NOT_ON_PATH}
    assert [reason.text.split()[1] for reason in found] == flows
