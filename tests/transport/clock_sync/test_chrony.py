from __future__ import annotations

import math
import os
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lavt.clock import Clock, MachineClock
from lavt.domain import NS_PER_S, Now
from lavt.transport.clock_sync.chrony import ABSENT, NOT_RUNNING, NOT_SYNCHRONISED, Chronyc, parse_chrony, read_chrony
from lavt.transport.clock_sync.clock_report import ClockReport
from lavt.transport.clock_sync.persistent_process import Completed, Run
from lavt.transport.clock_sync.ptp import read_ptp

TRACKING = (
    "0A090001,10.9.0.1,9,1795292431.937353491,0.249678716,-0.000000352,0.000014692,-0.310,0.014,3.735,"
    "0.000182228,0.000052372,1.1,Normal"
)
NTPDATA = (
    "10.9.0.1,0A090001,123,10.9.0.2,0A090002,Normal,4,Server,8,0,1,-16,0.000015259,0.000000,0.000000,7F7F0101,,"
    "1795292419.031279232,0.000004625,0.000245972,0.000029085,0.000235565,0.00,111,111,1111,Yes,No,Daemon,Kernel,"
    "18,17,17,16"
)
"""Output of chronyc 4.3 as root, between two kernels, with the local clock 250 ms behind."""
OUTPUT_WITHOUT_ROOT = TRACKING + "\n501 Not authorised\n"
OUTPUT_BEFORE_SYNC = (
    "00000000,,0,0.000000000,0.000000000,0.000000000,0.000000000,0.000,0.000,0.000,1.000000000,1.000000000,0.0,"
    "Not synchronised\n"
    "10.9.0.1,0A090001,123,[UNSPEC],00000000,Normal,0,Invalid,0,0,1,0,1.000000000,0.000000,0.000000,00000000,,"
    "0.000000000,0.000000000,0.000000000,0.000000000,0.000000000,0.00,000,000,0000,No,No,Invalid,Invalid,1,0,0,0\n"
)
OUTPUT_OF_THE_SERVER = (
    "7F7F0101,,8,1795292419.031279233,0.000000000,0.000000000,0.000000000,0.000,0.000,0.000,0.0,0.0,0.0,Normal\n"
)
"""Output on the server of this pair, which has no source and serves its own clock."""
QUERY_BEGIN, QUERY_END = Now(0, 1795292432 * NS_PER_S), Now(20_000_000, 1795292432 * NS_PER_S + 20_000_000)


def run_that_returns(completed: Completed | None) -> Run:
    return lambda _command, _timeout_s: completed


def parse(answer: str) -> ClockReport:
    return parse_chrony("host", answer, QUERY_BEGIN, QUERY_END)


def replace_fields(line: str, **fields: str) -> str:
    """Return one of chronyc's lines with other values; `field0` is the first one."""
    parts = line.strip().split(",")
    for name, value in fields.items():
        parts[int(name.removeprefix("field"))] = value
    return ",".join(parts)


def test_correction_and_bound_of_a_slow_clock() -> None:
    """A slow clock has a positive correction; the bound is half the root delay plus the root dispersion."""
    report = parse(TRACKING + "\n" + NTPDATA + "\n")
    assert (report.host, report.source, report.correction_s) == ("host", "chrony", 0.249678716)
    assert report.bound_s == pytest.approx(0.000182228 / 2 + 0.000052372, abs=1e-12)
    assert report.status == ""


def test_fast_clock_has_a_negative_correction() -> None:
    """A fast clock has a negative correction."""
    assert parse(replace_fields(TRACKING, field4="-0.000012000")).correction_s == -0.000012


def test_peer_data_is_reported() -> None:
    """The report has chrony's source, the last sample's path, the good samples, the polling interval and the skew."""
    report = parse(TRACKING + "\n" + NTPDATA + "\n")
    assert (report.follows, report.skew_ppm, report.poll_s, report.good_samples) == ("10.9.0.1", 3.735, 1.0, 16)
    assert (report.peer_delay_s, report.peer_dispersion_s) == (0.000245972, 0.000029085)


def test_report_time_and_age() -> None:
    """A report is for the middle of the query; its age is measured on the corrected clock."""
    report = parse(TRACKING)
    assert (report.mono_ns, report.wall_ns - QUERY_BEGIN.wall_ns, report.asking_s) == (10_000_000, 10_000_000, 0.02)
    assert report.age_s == pytest.approx(1795292432.01 + 0.249678716 - 1795292431.937353491, abs=1e-6)


def test_without_root_peer_data_is_unknown() -> None:
    """Without root the peer data is unknown, but the correction is known."""
    report = parse(OUTPUT_WITHOUT_ROOT)
    assert report.correction_s == 0.249678716
    assert (report.peer_delay_s, report.peer_dispersion_s, report.good_samples, report.poll_s) == (None,) * 4


def test_data_of_other_sources_is_ignored() -> None:
    """The peer data is that of the selected source, not of another source."""
    other = replace_fields(NTPDATA, field0="10.9.0.7", field19="0.5")
    assert parse(f"{TRACKING}\n{other}\n{NTPDATA}").peer_delay_s == 0.000245972
    assert parse(f"{TRACKING}\n{other}").peer_delay_s is None


def test_local_reference_has_zero_correction() -> None:
    """A chronyd without a source that serves its own clock has correction 0 with bound 0, and a status."""
    report = parse(OUTPUT_OF_THE_SERVER)
    assert (report.correction_s, report.bound_s, report.follows) == (0.0, 0.0, "")
    assert report.status == "its own clock is the reference"


UNSYNCHRONISED = {
    "before the first sample": OUTPUT_BEFORE_SYNC,
    "leap status not normal": replace_fields(TRACKING, field13="Not synchronised"),
    "no reference": replace_fields(TRACKING, field0="00000000"),
    "text for the correction": replace_fields(TRACKING, field4="slow"),
    "nothing for the correction": replace_fields(TRACKING, field4=""),
    "nan for the correction": replace_fields(TRACKING, field4="nan"),
    "an infinite correction": replace_fields(TRACKING, field4="inf"),
    "text for the root delay": replace_fields(TRACKING, field10="?"),
    "nan for the root delay": replace_fields(TRACKING, field10="nan"),
    "a negative root delay": replace_fields(TRACKING, field10="-1.0"),
    "a negative dispersion": replace_fields(TRACKING, field11="-0.1"),
    "an infinite dispersion": replace_fields(TRACKING, field11="inf"),
}
NOT_CHRONY = {
    "empty": "",
    "chronyc's own error": "506 Cannot talk to daemon\n",
    "a field missing": TRACKING.partition(",")[2],
    "a field too many": "x," + TRACKING,
    "only the peer data": NTPDATA,
}


@pytest.mark.parametrize("case", UNSYNCHRONISED)
def test_unsynchronised_chrony_has_no_correction(case: str) -> None:
    """An unsynchronised clock or an invalid value is reported as not synchronised, without a correction."""
    report = parse(UNSYNCHRONISED[case])
    assert (report.correction_s, report.bound_s, report.status) == (None, None, NOT_SYNCHRONISED)


@pytest.mark.parametrize("case", NOT_CHRONY)
def test_chrony_not_running(case: str) -> None:
    """An answer without chrony's tracking line means that chrony does not run."""
    report = parse(NOT_CHRONY[case])
    assert (report.correction_s, report.bound_s, report.status) == (None, None, NOT_RUNNING)


def test_polling_interval_below_a_second() -> None:
    """The polling interval is 2 to the power that chrony reports, because its field in whole seconds would be 0."""
    report = parse(TRACKING + "\n" + replace_fields(NTPDATA, field9="-1", field10="0"))
    assert report.poll_s == 0.5


@pytest.mark.parametrize("field", [19, 20, 9, 33])  # delay, dispersion, polling interval, good samples
@pytest.mark.parametrize("value", ["", "?", "nan", "-8", "inf"])
def test_invalid_peer_data_is_unknown(field: int, value: str) -> None:
    """An invalid or negative value of the peer data is unknown; the other values are kept."""
    report = parse(TRACKING + "\n" + replace_fields(NTPDATA, **{f"field{field}": value}))
    peer_data = (report.peer_delay_s, report.peer_dispersion_s, report.poll_s, report.good_samples)
    assert sum(value is None for value in peer_data) == 1
    assert report.correction_s == 0.249678716


FIELDS = st.text(max_size=8)


@given(
    st.one_of(
        st.text(),
        st.lists(FIELDS, min_size=14, max_size=14).map(",".join),
        st.lists(FIELDS, min_size=34, max_size=34).map(lambda fields: TRACKING + "\n10.9.0.1," + ",".join(fields[1:])),
    )
)
def test_any_answer_is_parsed(answer: str) -> None:
    """Any answer is parsed without an error; values are finite and, except for the correction, not negative."""
    report = parse(answer)
    assert report.correction_s is None or math.isfinite(report.correction_s)
    for value in (report.bound_s, report.age_s, report.peer_delay_s, report.peer_dispersion_s, report.poll_s):
        assert value is None or 0 <= value < math.inf


def test_one_chronyc_answers_all_queries(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One process answers every query; an answer ends where the unknown command `lavt` fails."""
    (tmp_path / "chronyc").write_text(
        "#!/bin/sh\n"
        "while read -r command; do\n"
        '  case "$command" in lavt) echo "Unrecognized command" >&2;; *) echo "$command, $$";; esac\n'
        "done\n"
    )
    (tmp_path / "chronyc").chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}{os.pathsep}{os.environ['PATH']}")
    with closing(Chronyc()) as chronyc:
        answers = [chronyc.run(("tracking", "ntpdata"), 10) for _ in range(2)]
    assert answers[0] is not None
    process = answers[0].output.split()[1]
    assert answers == [Completed(0, f"tracking, {process}\nntpdata, {process}\n")] * 2


def test_chrony_not_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    """If chrony is not installed, the report says so and has no correction."""
    monkeypatch.setenv("PATH", "")
    report = read_chrony(MachineClock(), Chronyc().run)
    assert report is not None
    assert (report.source, report.status, report.correction_s, report.bound_s) == ("chrony", ABSENT, None, None)


class JumpingClock:
    """A clock that advances by 3 s between two readings."""

    def __init__(self) -> None:
        self._mono_ns = 0

    def now(self) -> Now:
        """Return both clocks."""
        self._mono_ns += 3 * NS_PER_S
        return Now(self._mono_ns, self._mono_ns)


@pytest.mark.parametrize("read", [read_chrony, read_ptp])
def test_late_answer_is_a_missed_poll(read: Callable[[Clock, Run], ClockReport | None]) -> None:
    """An answer that takes 3 s on a busy machine is a missed poll, because its time is not known well enough."""
    assert read(JumpingClock(), run_that_returns(Completed(0, TRACKING))) is None


@pytest.mark.parametrize("read", [read_chrony, read_ptp])
def test_no_answer_is_a_missed_poll(read: Callable[[Clock, Run], ClockReport | None]) -> None:
    """An answer that does not come in time is a missed poll, not a loss of synchronisation."""
    assert read(MachineClock(), run_that_returns(None)) is None
