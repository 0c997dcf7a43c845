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
"""chronyc 4.3 as root, between two kernels, the local clock 250 ms behind."""
AS_ANYONE = TRACKING + "\n501 Not authorised\n"
BEFORE_SYNC = (
    "00000000,,0,0.000000000,0.000000000,0.000000000,0.000000000,0.000,0.000,0.000,1.000000000,1.000000000,0.0,"
    "Not synchronised\n"
    "10.9.0.1,0A090001,123,[UNSPEC],00000000,Normal,0,Invalid,0,0,1,0,1.000000000,0.000000,0.000000,00000000,,"
    "0.000000000,0.000000000,0.000000000,0.000000000,0.000000000,0.00,000,000,0000,No,No,Invalid,Invalid,1,0,0,0\n"
)
LOCAL = "7F7F0101,,8,1795292419.031279233,0.000000000,0.000000000,0.000000000,0.000,0.000,0.000,0.0,0.0,0.0,Normal\n"
"""The server of such a pair: it follows nobody."""
BEFORE, AFTER = Now(0, 1795292432 * NS_PER_S), Now(20_000_000, 1795292432 * NS_PER_S + 20_000_000)


def answering(ended: Completed | None) -> Run:
    return lambda _command, _timeout_s: ended


def parsed(answer: str) -> ClockReport:
    return parse_chrony("host", answer, BEFORE, AFTER)


def changed(line: str, **fields: str) -> str:
    parts = line.strip().split(",")
    for name, value in fields.items():
        parts[int(name.removeprefix("field"))] = value
    return ",".join(parts)


def test_correction_and_bound() -> None:
    """A clock that is behind has a positive correction; the bound is half the root delay plus the root dispersion."""
    report = parsed(TRACKING + "\n" + NTPDATA + "\n")
    assert (report.host, report.source, report.correction_s) == ("host", "chrony", 0.249678716)
    assert report.bound_s == pytest.approx(0.000182228 / 2 + 0.000052372, abs=1e-12)
    assert report.status == ""


def test_clock_ahead() -> None:
    """A clock that is ahead has a negative correction."""
    assert parsed(changed(TRACKING, field4="-0.000012000")).correction_s == -0.000012


def test_the_path_to_what_is_followed() -> None:
    """Whom chrony follows, the last sample's path, the good samples, the poll and the skew are told for afterwards."""
    report = parsed(TRACKING + "\n" + NTPDATA + "\n")
    assert (report.follows, report.skew_ppm, report.poll_s, report.good_samples) == ("10.9.0.1", 3.735, 1.0, 16)
    assert (report.peer_delay_s, report.peer_dispersion_s) == (0.000245972, 0.000029085)


def test_age_and_time_of_a_report() -> None:
    """A report belongs to the middle of the asking; its age is by the corrected clock."""
    report = parsed(TRACKING)
    assert (report.mono_ns, report.wall_ns - BEFORE.wall_ns, report.asking_s) == (10_000_000, 10_000_000, 0.02)
    assert report.age_s == pytest.approx(1795292432.01 + 0.249678716 - 1795292431.937353491, abs=1e-6)


def test_who_is_not_root_learns_less() -> None:
    """Where chronyd refuses the path's figures they are unknown, and all else is as for root."""
    report = parsed(AS_ANYONE)
    assert report.correction_s == 0.249678716
    assert (report.peer_delay_s, report.peer_dispersion_s, report.good_samples, report.poll_s) == (None,) * 4


def test_figures_of_another_source_are_not_taken() -> None:
    """The path's figures are those of the source that is followed, not of another that is asked too."""
    other = changed(NTPDATA, field0="10.9.0.7", field19="0.5")
    assert parsed(f"{TRACKING}\n{other}\n{NTPDATA}").peer_delay_s == 0.000245972
    assert parsed(f"{TRACKING}\n{other}").peer_delay_s is None


def test_a_clock_that_is_its_own_reference() -> None:
    """A chronyd that follows nobody and serves its own clock has correction 0 with bound 0, and says what it is."""
    report = parsed(LOCAL)
    assert (report.correction_s, report.bound_s, report.follows) == (0.0, 0.0, "")
    assert report.status == "its own clock is the reference"


NOT_SYNCHRONISED_YET = {
    "before the first sample": BEFORE_SYNC,
    "leap status not normal": changed(TRACKING, field13="Not synchronised"),
    "no reference": changed(TRACKING, field0="00000000"),
    "a word for the correction": changed(TRACKING, field4="slow"),
    "nothing for the correction": changed(TRACKING, field4=""),
    "nan for the correction": changed(TRACKING, field4="nan"),
    "an infinite correction": changed(TRACKING, field4="inf"),
    "a word for the root delay": changed(TRACKING, field10="?"),
    "nan for the root delay": changed(TRACKING, field10="nan"),
    "a negative root delay": changed(TRACKING, field10="-1.0"),
    "a negative dispersion": changed(TRACKING, field11="-0.1"),
    "an infinite dispersion": changed(TRACKING, field11="inf"),
}
NOT_CHRONY = {
    "empty": "",
    "chronyc's own error": "506 Cannot talk to daemon\n",
    "a field missing": TRACKING.partition(",")[2],
    "a field too many": "x," + TRACKING,
    "the path alone": NTPDATA,
}


@pytest.mark.parametrize("case", NOT_SYNCHRONISED_YET)
def test_not_synchronised(case: str) -> None:
    """A clock that is not synchronised, and figures that cannot be, give a report without correction that says so."""
    report = parsed(NOT_SYNCHRONISED_YET[case])
    assert (report.correction_s, report.bound_s, report.status) == (None, None, NOT_SYNCHRONISED)


@pytest.mark.parametrize("case", NOT_CHRONY)
def test_not_running(case: str) -> None:
    """An answer without chrony's line is that of a chrony that does not run."""
    report = parsed(NOT_CHRONY[case])
    assert (report.correction_s, report.bound_s, report.status) == (None, None, NOT_RUNNING)


def test_a_poll_of_less_than_a_second() -> None:
    """The poll is two to the power that chrony gives: its seconds are whole, 0 for half a second."""
    report = parsed(TRACKING + "\n" + changed(NTPDATA, field9="-1", field10="0"))
    assert report.poll_s == 0.5


@pytest.mark.parametrize("field", [19, 20, 9, 33])
@pytest.mark.parametrize("value", ["", "?", "nan", "-8", "inf"])
def test_a_path_that_cannot_be(field: int, value: str) -> None:
    """A figure of the path that is no number, or a negative one, is unknown; the rest stands."""
    report = parsed(TRACKING + "\n" + changed(NTPDATA, **{f"field{field}": value}))
    figures = (report.peer_delay_s, report.peer_dispersion_s, report.poll_s, report.good_samples)
    assert sum(each is None for each in figures) == 1
    assert report.correction_s == 0.249678716


FIELDS = st.text(max_size=8)


@given(
    st.one_of(
        st.text(),
        st.lists(FIELDS, min_size=14, max_size=14).map(",".join),
        st.lists(FIELDS, min_size=34, max_size=34).map(lambda fields: TRACKING + "\n10.9.0.1," + ",".join(fields[1:])),
    )
)
def test_any_answer(answer: str) -> None:
    """No answer raises, and what is given is finite and, but for the correction, not negative."""
    report = parsed(answer)
    assert report.correction_s is None or math.isfinite(report.correction_s)
    for each in (report.bound_s, report.age_s, report.peer_delay_s, report.peer_dispersion_s, report.poll_s):
        assert each is None or 0 <= each < math.inf


def test_one_client_of_chrony_stays_and_is_requested_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One process answers every question, each with all that it said until it found a command that it does not know."""
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


def test_no_chrony(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where chrony is not installed, the report says so and has no correction."""
    monkeypatch.setenv("PATH", "")
    report = read_chrony(MachineClock(), Chronyc().run)
    assert report is not None
    assert (report.source, report.status, report.correction_s, report.bound_s) == ("chrony", ABSENT, None, None)


class Jumping:
    """A clock on which 3 s go by from one reading to the next."""

    def __init__(self) -> None:
        self._mono_ns = 0

    def now(self) -> Now:
        """Read both clocks."""
        self._mono_ns += 3 * NS_PER_S
        return Now(self._mono_ns, self._mono_ns)


@pytest.mark.parametrize("read", [read_chrony, read_ptp])
def test_an_answer_that_is_read_late(read: Callable[[Clock, Run], ClockReport | None]) -> None:
    """Where a busy machine takes 3 s from the question to the answer nobody knows to when it belongs: a missed poll."""
    assert read(Jumping(), answering(Completed(0, TRACKING))) is None


@pytest.mark.parametrize("read", [read_chrony, read_ptp])
def test_no_answer_in_time(read: Callable[[Clock, Run], ClockReport | None]) -> None:
    """A machine too busy to answer is a missed poll, and does not mean that the source lost the clock."""
    assert read(MachineClock(), answering(None)) is None
