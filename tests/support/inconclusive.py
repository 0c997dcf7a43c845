"""Pytest hooks: a test that the host stalled is run again, at most twice, and is then inconclusive.

`tests/conftest.py` loads this plugin. A test that judges times uses the fixture `stalls`, directly or through another
one. A test whose assertions are all about times has the marker `judges_times` instead, with the arguments of
`Stalls.excusing_failures`. Tests of both kinds are run again only after `HostStalled`: any other exception fails the
test, even one that was raised while a `HostStalled` was handled. A pytest session fails if too many tests were
inconclusive on an idle machine, or if a probe ended early.
"""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass, field

import pytest
from tests.support.stalls import MAX_ATTEMPTS, HostStalled, ProbeEnded, Stalls, inconclusive_too_often

RERUN = pytest.mark.flaky(reruns=MAX_ATTEMPTS - 1, rerun_except="^(?!HostStalled:)")
"""pytest-rerunfailures matches the pattern with "type: message" of the exception itself, not of its causes."""
INCONCLUSIVE = "inconclusive"
JUDGES_TIMES = "judges_times"


@dataclass
class SessionState:
    """The data that the hooks keep during a pytest session."""

    stalls: Stalls | None = None
    tests: set[str] = field(default_factory=set)
    """Ids of the tests that have run."""
    messages: list[str] = field(default_factory=list)
    """Lines for the summary in the terminal."""


SESSION = pytest.StashKey[SessionState]()


@pytest.fixture(scope="session")
def stalls(request: pytest.FixtureRequest) -> Stalls:
    """Return the record of the host's stalls; the probes end with the session."""
    record = Stalls.start_probes()
    request.config.stash[SESSION].stalls = record
    return record


def pytest_configure(config: pytest.Config) -> None:
    """Create the session's state."""
    config.stash[SESSION] = SessionState()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark each test that uses the fixture `stalls` for reruns; a test with `judges_times` gets that fixture."""
    for item in items:
        names: list[str] = getattr(item, "fixturenames", [])
        if item.get_closest_marker(JUDGES_TIMES) and "stalls" not in names:
            names.append("stalls")
        if "stalls" in names and not item.get_closest_marker("flaky"):
            item.add_marker(RERUN)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item) -> Generator[None, None, None]:
    """Excuse a failed assertion of a test with `judges_times` if the host stalled while the test ran."""
    marker = item.get_closest_marker(JUDGES_TIMES)
    if marker is None:
        return (yield)
    record = item.config.stash[SESSION].stalls
    assert record is not None
    with record.excusing_failures(record.clock.now().mono_ns, **marker.kwargs):
        return (yield)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item, call: pytest.CallInfo[None]
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Record in the report whether the host stalled the test: a report from another process contains no exception."""
    report = yield
    vars(report)["host_stalled"] = call.excinfo is not None and isinstance(call.excinfo.value, HostStalled)
    if report.when == "call":
        item.config.stash[SESSION].tests.add(item.nodeid)
    return report


@pytest.hookimpl(wrapper=True)
def pytest_runtest_logreport(report: pytest.TestReport) -> Generator[None, object, object]:
    """If the host stalled the last attempt of a failed test, make the outcome inconclusive before pytest counts it."""
    if report.failed and getattr(report, "host_stalled", False):
        vars(report)["outcome"] = INCONCLUSIVE
    return (yield)


def pytest_report_teststatus(report: pytest.TestReport) -> tuple[str, str, tuple[str, dict[str, bool]]] | None:
    """Return the category, letter and word with which pytest reports inconclusive tests."""
    if report.outcome != INCONCLUSIVE:
        return None
    return INCONCLUSIVE, "I", ("INCONCLUSIVE", {"yellow": True})


@pytest.hookimpl(trylast=True)
def pytest_sessionfinish(session: pytest.Session) -> None:
    """End the probes; fail the session if a probe ended early or too many tests were inconclusive."""
    state = session.config.stash[SESSION]
    if state.stalls is None:
        return
    reporter = session.config.pluginmanager.getplugin("terminalreporter")
    inconclusive = {report.nodeid for report in reporter.stats.get(INCONCLUSIVE, [])} if reporter else set()
    tests, idle = len(state.tests | inconclusive), state.stalls.idle_share()
    failures = []
    try:
        state.stalls.collect()
    except ProbeEnded as ended:
        failures.append(str(ended))
    state.stalls.end()
    state.messages.append(
        f"HOST {state.stalls.summary()}; the machine was {idle:.0%} idle; "
        f"{len(inconclusive)} of {tests} tests inconclusive"
    )
    if inconclusive_too_often(len(inconclusive), tests, idle):
        failures.append(f"{len(inconclusive)} of {tests} tests were inconclusive on a machine that was {idle:.0%} idle")
    state.messages += [f"FAILED: {failure}" for failure in failures]
    if failures and session.exitstatus == pytest.ExitCode.OK:
        session.exitstatus = pytest.ExitCode.TESTS_FAILED


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    """Print which tests were run again or were inconclusive and why, and how often the host stalled."""
    for category, label in (("rerun", "AGAIN"), (INCONCLUSIVE, "INCONCLUSIVE")):
        for report in terminalreporter.getreports(category):
            terminalreporter.write_line(f"{label} {report.nodeid}: {report.longrepr.reprcrash.message}")
    for line in config.stash[SESSION].messages:
        terminalreporter.write_line(line)
