from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lavt.clock import MachineClock
from lavt.domain import Now
from lavt.transport.clock_sync.clock_report import ClockReport
from lavt.transport.clock_sync.persistent_process import NOT_FOUND, Completed
from lavt.transport.clock_sync.ptp import ABSENT, NO_MASTER, NOT_RUNNING, parse_ptp, read_ptp

SLAVE = """sending: GET PORT_DATA_SET
sending: GET CURRENT_DATA_SET
\t8eac63.fffe.5bf59d-1 seq 0 RESPONSE MANAGEMENT PORT_DATA_SET
\t\tportIdentity            8eac63.fffe.5bf59d-1
\t\tportState               UNCALIBRATED
\t\tlogMinDelayReqInterval  0
\t\tpeerMeanPathDelay       0
\t\tdelayMechanism          1
\t\tversionNumber           2
sending: GET TIME_STATUS_NP
\t8eac63.fffe.5bf59d-0 seq 1 RESPONSE MANAGEMENT CURRENT_DATA_SET
\t\tstepsRemoved     1
\t\toffsetFromMaster 512.0
\t\tmeanPathDelay    2304.0
\t8eac63.fffe.5bf59d-0 seq 2 RESPONSE MANAGEMENT TIME_STATUS_NP
\t\tmaster_offset              512
\t\tingress_time               1795292570014569603
\t\tcumulativeScaledRateOffset +0.000000000
\t\tscaledLastGmPhaseChange    0
\t\tgmTimeBaseIndicator        0
\t\tlastGmPhaseChange          0x0000'0000000000000000.0000
\t\tgmPresent                  true
\t\tgmIdentity                 a6bb40.fffe.382888
"""
"""Output of pmc 3.1.1 for a ptp4l that receives a master, with software timestamps."""
MASTER = """\ta6bb40.fffe.382888-1 seq 0 RESPONSE MANAGEMENT PORT_DATA_SET
\t\tportIdentity            a6bb40.fffe.382888-1
\t\tportState               MASTER
\ta6bb40.fffe.382888-0 seq 1 RESPONSE MANAGEMENT CURRENT_DATA_SET
\t\tstepsRemoved     0
\t\toffsetFromMaster 0.0
\t\tmeanPathDelay    0.0
\ta6bb40.fffe.382888-0 seq 2 RESPONSE MANAGEMENT TIME_STATUS_NP
\t\tmaster_offset              0
\t\tgmPresent                  false
\t\tgmIdentity                 a6bb40.fffe.382888
"""
"""Output of pmc for that ptp4l's master."""
NO_PTP4L = "sending: GET PORT_DATA_SET\nsending: GET CURRENT_DATA_SET\nsending: GET TIME_STATUS_NP\n"
"""Output of pmc without a ptp4l; pmc still exits with 0."""


def parse(answer: str) -> ClockReport:
    return parse_ptp("host", answer, Now(0, 10**18), Now(120_000_000, 10**18 + 120_000_000))


def test_correction_and_bound_of_a_slave() -> None:
    """The correction is the negative offset from the master; the bound is the mean path delay times the steps."""
    report = parse(SLAVE)
    assert (report.source, report.correction_s, report.bound_s) == ("ptp", -512e-9, 2304e-9)
    assert report.follows == "a6bb40.fffe.382888"
    assert (report.mono_ns, report.asking_s) == (60_000_000, 0.12)
    assert parse(SLAVE.replace("stepsRemoved     1", "stepsRemoved     3")).bound_s == pytest.approx(3 * 2304e-9)


def test_grandmaster_has_zero_correction() -> None:
    """A grandmaster that is master on a port has correction 0 with bound 0."""
    report = parse(MASTER)
    assert (report.correction_s, report.bound_s, report.follows) == (0.0, 0.0, "a6bb40.fffe.382888")


@pytest.mark.parametrize(
    "answer",
    [
        MASTER.replace("MASTER", "LISTENING"),  # before the first announcement every ptp4l is its own grandmaster
        SLAVE.replace("2304.0", "0.0"),
        SLAVE.replace("2304.0", "nan"),
        SLAVE.replace("512.0", "far"),
        SLAVE.replace("true", "perhaps"),
    ],
)
def test_unsynchronised_ptp4l_has_no_correction(answer: str) -> None:
    """A ptp4l that is not a master and has not measured a path to one has no correction."""
    report = parse(answer)
    assert (report.correction_s, report.bound_s, report.status) == (None, None, NO_MASTER)


@pytest.mark.parametrize("answer", ["", NO_PTP4L, "gmPresent true", "\x00"])
def test_ptp4l_not_running(answer: str) -> None:
    """An answer without the data sets means that ptp4l does not run."""
    assert parse(answer).status == NOT_RUNNING


@given(st.lists(st.tuples(st.sampled_from(SLAVE.split()), st.text(max_size=8)), max_size=20))
def test_any_answer_is_parsed(lines: list[tuple[str, str]]) -> None:
    """Any answer is parsed without an error, and a bound is finite and not negative."""
    report = parse("\n".join(f"{name} {value}" for name, value in lines) + "\ngmIdentity x\ngmPresent true\n")
    assert report.correction_s is None or math.isfinite(report.correction_s)
    assert report.bound_s is None or 0 <= report.bound_s < math.inf


def test_linuxptp_not_installed() -> None:
    """If pmc is not installed, the report says so and has no correction."""
    report = read_ptp(MachineClock(), lambda _command, _timeout_s: Completed(NOT_FOUND, ""))
    assert report is not None
    assert (report.source, report.status, report.correction_s) == ("ptp", ABSENT, None)
