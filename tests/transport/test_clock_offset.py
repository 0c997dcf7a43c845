from __future__ import annotations

import math
import subprocess
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lavt.transport.clock_offset import ClockReport, kernel_identity, parse_tracking, read_clock

SLOW = (
    "0A090001,10.9.0.1,9,1795221031.900173751,0.250475228,0.000002364,0.000012531,2.076,0.089,4.963,"
    "0.000150693,0.000033259,0.5,Normal\n"
)
"""Measured between two kernels, the local clock 250 ms behind."""
BEFORE_SYNC = (
    "00000000,,0,0.000000000,0.000000000,0.000000000,0.000000000,0.000,0.000,0.000,1.000000000,1.000000000,0.0,"
    "Not synchronised\n"
)


def changed(**fields: str) -> str:
    parts = SLOW.strip().split(",")
    for name, value in fields.items():
        parts[int(name.removeprefix("field"))] = value
    return ",".join(parts)


def test_correction_and_bound() -> None:
    """A clock that is behind has a positive correction; the bound is half the root delay plus the root dispersion."""
    report = parse_tracking("host", SLOW)
    assert (report.host, report.source, report.correction_s) == ("host", "chrony", 0.250475228)
    assert report.bound_s == pytest.approx(0.0001086055, abs=1e-12)


def test_clock_ahead() -> None:
    """A clock that is ahead has a negative correction."""
    assert parse_tracking("host", changed(field4="-0.000012000")).correction_s == -0.000012


NOT_TO_BE_USED = {
    "before the first sample": BEFORE_SYNC,
    "leap status not normal": changed(field13="Not synchronised"),
    "no reference": changed(field0="00000000"),
    "empty": "",
    "chronyc's own error": "506 Cannot talk to daemon\n",
    "a field missing": SLOW.partition(",")[2],
    "a field too many": "x," + SLOW,
    "two lines": SLOW + SLOW,
    "a word for the correction": changed(field4="slow"),
    "nothing for the correction": changed(field4=""),
    "nan for the correction": changed(field4="nan"),
    "an infinite correction": changed(field4="inf"),
    "a word for the root delay": changed(field10="?"),
    "nan for the root delay": changed(field10="nan"),
    "a negative root delay": changed(field10="-1.0"),
    "a negative dispersion": changed(field11="-0.1"),
    "an infinite dispersion": changed(field11="inf"),
}


@pytest.mark.parametrize("case", NOT_TO_BE_USED)
def test_not_synchronised(case: str) -> None:
    """A clock that is not synchronised, and a line that chrony does not write, give a report without a bound."""
    report = parse_tracking("host", NOT_TO_BE_USED[case])
    assert report == ClockReport("host", "chrony, not synchronised", 0.0, None)


@given(st.one_of(st.text(), st.lists(st.text(max_size=8), min_size=14, max_size=14).map(",".join)), st.booleans())
def test_any_line(line: str, normal: bool) -> None:
    """No line raises, and a bound that is given is finite and not negative."""
    report = parse_tracking("host", line + (",Normal" if normal else ""))
    assert math.isfinite(report.correction_s)
    assert report.bound_s is None or 0 <= report.bound_s < math.inf


@pytest.mark.parametrize(
    "failure",
    [FileNotFoundError(), subprocess.TimeoutExpired("chronyc", 1), subprocess.CalledProcessError(1, "chronyc")],
)
def test_no_chrony(failure: Exception, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where chrony is not there, hangs or fails, the report says so and has no bound."""

    def run(*_arguments: Any, **_options: Any) -> None:
        raise failure

    monkeypatch.setattr(subprocess, "run", run)
    assert read_clock() == ClockReport(kernel_identity(), "none", 0.0, None)


def test_kernel_identity() -> None:
    """A kernel's identity does not change while it runs."""
    assert kernel_identity() == kernel_identity()
