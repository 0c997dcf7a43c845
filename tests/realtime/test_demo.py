"""`lavt demo` as a user at a terminal sees it."""

from __future__ import annotations

from tests.realtime.conftest import Demo
from tests.support.stalls import LONG_STALL_MS, Stalls
from tests.support.summary_keys import CONDITION_KEYS, RUN_KEYS

from lavt.experiment.runs.run import compute_result

VIRTUAL_CONDITIONS = ["L0", "L1", "L2", "L3", "L4", "L5"]


def test_the_demo_drives_in_real_and_in_virtual_time(demo: Demo) -> None:
    """The demo drives at L0 and L5 in real time through a relay, and from L0 to L5 on six roads in virtual time."""
    runs: dict[tuple[str, str], list[str]] = {}
    for run in demo.summary["runs"]:
        runs.setdefault((run["time"], run["injection"]), []).append(run["condition"])
    assert runs == {("real", "relay"): ["L0", "L5"], ("virtual", "model"): VIRTUAL_CONDITIONS * 6}
    assert all(run["preset"] == "paper_calibrated" for run in demo.summary["runs"])


def test_the_summary_has_the_agreed_keys(demo: Demo) -> None:
    """Every run, condition and group in summary.json has the documented keys."""
    assert set(demo.summary) == {
        "schema",
        "speed",
        "runs",
        "conditions",
        "contrasts",
        "real",
        "groups",
        "controllers",
        "paper",
        "failed",
    }
    assert all(run.keys() >= RUN_KEYS for run in demo.summary["runs"])
    conditions = [*demo.summary["conditions"].values(), *demo.summary["real"].values()]
    assert all(set(condition) == CONDITION_KEYS for condition in conditions)
    assert list(demo.summary["conditions"]) == VIRTUAL_CONDITIONS
    assert demo.summary["groups"]


def test_delay_degrades_lane_keeping(demo: Demo, stalls: Stalls) -> None:
    """At L0 the P95 cross-track error is below 0.3 m; at L5 no run is completed in its own lane, in either time."""
    for run in demo.summary["runs"]:
        if run["condition"] == "L0":
            with stalls.excusing_failures(demo.since_ns, demo.until_ns, stall_ms=LONG_STALL_MS):
                assert (run["ending"], run["lane_invasions"]) == ("completed", 0)
                assert run["p95_m"] < 0.3
        if run["condition"] == "L5":
            assert run["completed_in_own_lane"] is False


def test_the_terminal_shows_the_drive(demo: Demo) -> None:
    """On a terminal the demo shows speed, tau_v, tau_c and cross-track error, then a table and three sentences.

    The live view also shows whether the newest picture has a lane.
    """
    for text in (
        "lane seen",
        "Shown:",
        "Not shown:",
        "Valid:",
        "km/h",
        "tau_v",
        "tau_c",
        "cross-track",
        "225 + 100",
        "the report is",
    ):
        assert text in demo.output
    assert (demo.out / "report" / "index.html").is_file()


def test_a_run_in_real_time_can_be_computed_again(demo: Demo) -> None:
    """The results of both runs in real time can be computed again from their records alone."""
    for drive in demo.drives_by_condition.values():
        assert compute_result(drive.out, drive.result, None) == drive.result
