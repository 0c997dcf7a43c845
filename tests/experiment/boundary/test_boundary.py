"""Tests of the search for boundaries: parts of the search on simple cases, and real searches."""

from __future__ import annotations

import json
import math
import os
import signal
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lavt.config import BoundaryConfig
from lavt.config_file import load_config, shipped
from lavt.domain import NS_PER_MS, GroundTruth
from lavt.errors import UserError, WorkError
from lavt.experiment.boundary import boundary as boundary_module
from lavt.experiment.boundary.bisection import Bracket, first_bracket, zero_bracket
from lavt.experiment.boundary.boundary import (
    has_departed,
    is_not_completed,
    plan_boundary,
    run_search,
    search_boundary,
    theoretical_ms,
    with_video_delay,
)
from lavt.experiment.boundary.oscillation_growth import growth_per_s
from lavt.experiment.report.boundary_section import boundary_figure, boundary_table
from lavt.experiment.report.table_format import html_of
from lavt.experiment.runs.monitored_run import MonitoredRun, summarize_drive
from lavt.experiment.runs.plan import PlannedRun
from lavt.experiment.statistics.boundary_summary import summarize_boundaries, summarize_groups
from lavt.experiment.sweep.workers import Workers
from lavt.nodes.payloads import Admission, Event, FrameWritten

GRID_MS = [0.0, 100.0, 200.0, 300.0]


def record_calls(function: Callable[[float], Any]) -> tuple[Callable[[float], Any], list[float]]:
    """Return the function with a recording of its arguments, and the list of these arguments."""
    calls: list[float] = []

    def recorded(delay_ms: float) -> Any:
        calls.append(delay_ms)
        return function(delay_ms)

    return recorded, calls


# The search.


def test_bisection_brackets_the_first_crossing() -> None:
    """To bracket a crossing within 2 ms, the grid is evaluated first, and then 100 ms are bisected six times."""
    criterion, calls = record_calls(lambda delay_ms: delay_ms >= 137)
    found = first_bracket(criterion, GRID_MS, 2.0)
    assert found == Bracket(135.9375, 137.5, monotone=True)
    assert calls[:4] == GRID_MS
    assert len(calls) == 10


def test_a_criterion_that_is_not_monotone_is_marked() -> None:
    """The first of several crossings is bracketed, and the bracket is marked as not monotone."""
    found = first_bracket(lambda delay_ms: 50 <= delay_ms < 250, GRID_MS, 2.0)
    assert found == Bracket(48.4375, 50.0, monotone=False)


def test_without_a_crossing_the_bracket_has_no_upper_end() -> None:
    """Without a crossing in the range, the last delay is the lower end, and there is no upper end."""
    assert first_bracket(lambda _: False, GRID_MS, 2.0) == Bracket(300.0, None)


def test_a_crossing_below_the_range_has_no_lower_end() -> None:
    """A criterion that is met at the first delay has a bracket without a lower end."""
    assert first_bracket(lambda _: True, GRID_MS, 2.0) == Bracket(None, 0.0)
    assert first_bracket(lambda delay_ms: delay_ms != 100, GRID_MS, 2.0) == Bracket(None, 0.0, monotone=False)


@pytest.mark.parametrize("guess_ms", [0.0, 130.0, 137.0, 300.0, 1000.0])
def test_the_zero_of_a_rate_is_bracketed(guess_ms: float) -> None:
    """For any guess, the zero of a smooth rate is bracketed to 2 ms, even if the rate is infinite elsewhere."""

    def rate(delay_ms: float) -> float:
        return math.inf if delay_ms > 200 else (delay_ms - 137) / 500

    found = zero_bracket(rate, guess_ms, 400.0, 2.0)
    assert found.low_ms is not None
    assert found.high_ms is not None
    assert found.high_ms - found.low_ms == pytest.approx(2.0)
    assert found.low_ms <= 137 <= found.high_ms


@pytest.mark.parametrize("zero_ms", [7.1, 12.0, 18.3, 23.2, 137.0])
def test_the_zero_of_a_step_is_bracketed(zero_ms: float) -> None:
    """If a rate is infinite everywhere, the bracket contains the delay at which its sign changes."""
    found = zero_bracket(lambda delay_ms: math.copysign(math.inf, delay_ms - zero_ms), 100.0, 200.0, 2.0)
    assert found.low_ms is not None
    assert found.high_ms is not None
    assert found.low_ms <= zero_ms <= found.high_ms


@pytest.mark.parametrize("zero_ms", [0.3, 199.8])
def test_a_bracket_is_within_the_range(zero_ms: float) -> None:
    """If the zero is near an end of the range, the bracket ends at the end of the range."""
    found = zero_bracket(lambda delay_ms: (delay_ms - zero_ms) / 500, 100.0, 200.0, 2.0)
    assert found.low_ms is not None
    assert found.high_ms is not None
    assert 0 <= found.low_ms <= zero_ms <= found.high_ms <= 200
    assert found.low_ms == 0 or found.high_ms == 200


def test_a_rate_without_a_zero_is_out_of_range() -> None:
    """An always positive rate has its zero below the range; an always negative rate has its zero above the range."""
    assert zero_bracket(lambda _: 0.1, 137.0, 400.0, 2.0) == Bracket(None, 0.0)
    assert zero_bracket(lambda _: -math.inf, 137.0, 400.0, 2.0) == Bracket(400.0, None)


# The criteria.


def frame(number: int) -> FrameWritten:
    return FrameWritten(
        number=number,
        stamp_ns=number,
        stamped_mono_ns=number * 33 * NS_PER_MS + 5 * NS_PER_MS,
        capture_ns=number * 33 * NS_PER_MS,
        pixel_crc=0,
        size_bytes=0,
    )


def admission(stamp: int, applied_ns: int, *, verdict: str = "accepted", limited: str = "") -> Admission:
    return Admission(
        epoch=0,
        stamp_ns=stamp,
        sequence=0,
        sent_wall_ns=0,
        stamp_received_wall_ns=0,
        received_mono_ns=applied_ns,
        received_wall_ns=0,
        applied_mono_ns=applied_ns if verdict == "accepted" else None,
        verdict=verdict,
        reason="",
        limited=limited,
        mode="drive",
        steering_rad=0.0,
        throttle=0.0,
        brake=0.0,
    )


def truth(mono_ns: int) -> GroundTruth:
    return GroundTruth(mono_ns, 0.0, 0.0, 0.0, 8.0, 0.0, 0.25, 0.0, 0.0)


def payloads(*events: Event) -> dict[str, list[Any]]:
    return {
        "truth": [truth(number * 20 * NS_PER_MS) for number in range(100)],
        "event": [Event(100 * NS_PER_MS, "drive_began", ""), *events],
        "frame": [frame(number) for number in range(60)],
        # For each frame: a rejected command, a command applied 80 ms after capture, and a repetition of that command.
        "admission": [
            command
            for number in range(10, 50)
            for command in (
                admission(number, number * 33 * NS_PER_MS + 70 * NS_PER_MS, verdict="rejected"),
                admission(
                    number, number * 33 * NS_PER_MS + 80 * NS_PER_MS, limited="steering rate" if number == 20 else ""
                ),
                admission(number, number * 33 * NS_PER_MS + 100 * NS_PER_MS),
            )
        ],
    }


def test_a_monitored_run_covers_the_drive_only() -> None:
    """Samples and events outside the drive are excluded, and times count from the start of the drive."""
    drive = summarize_drive(
        payloads(
            Event(50 * NS_PER_MS, "lane_invasion", ""),
            Event(600 * NS_PER_MS, "lane_invasion", ""),
            Event(1500 * NS_PER_MS, "ending", "completed"),
            Event(1600 * NS_PER_MS, "lane_invasion", ""),
        )
    )
    assert (drive.ending, drive.lane_invasions, drive.total_delay_ms) == ("completed", 1, 80.0)
    assert (drive.time_s[0], drive.time_s[-1], len(drive.time_s)) == (0.0, 1.4, 71)
    assert drive.limited_s.tolist() == [pytest.approx(0.64)]


def test_departure_and_completion() -> None:
    """A drive with a lane invasion departed; a drive without the ending `completed` was not completed."""
    invasion = Event(600 * NS_PER_MS, "lane_invasion", "")
    for events, expected in (
        ((Event(900 * NS_PER_MS, "ending", "completed"),), (False, False)),
        ((invasion, Event(900 * NS_PER_MS, "ending", "completed")), (True, False)),
        ((Event(900 * NS_PER_MS, "ending", "safe_stop"),), (False, True)),
        ((invasion, Event(900 * NS_PER_MS, "ending", "collision")), (True, True)),
        ((), (False, True)),
    ):
        drive = summarize_drive(payloads(*events))
        assert (has_departed(drive), is_not_completed(drive)) == expected


def test_a_drive_that_never_began() -> None:
    """A drive that never began has no samples, no delay, no departure, no completion and no oscillation."""
    recorded = payloads()
    recorded["event"] = [Event(600 * NS_PER_MS, "lane_invasion", "")]
    drive = summarize_drive(recorded)
    assert (len(drive.time_s), math.isnan(drive.total_delay_ms)) == (0, True)
    assert (has_departed(drive), is_not_completed(drive), growth_per_s(drive)) == (False, True, -math.inf)


# The summary of many seeds.


def test_values_out_of_range_are_ranked_last() -> None:
    """With two of six boundaries out of range, the upper quartile and the upper end of the interval are null."""
    found = summarize_boundaries([300.0, 310.0, 320.0, 330.0, math.inf, math.inf])
    assert found == {"p25": 312.5, "p50": 325.0, "p75": None, "interval": [300.0, None], "n": 4}


def test_the_interval_consists_of_order_statistics() -> None:
    """The median of ten values has an interval from the second to the ninth value; the median of five has none."""
    assert summarize_boundaries([float(value) for value in range(10)])["interval"] == [1.0, 8.0]
    assert summarize_boundaries([1.0, 2.0, 3.0, 4.0, 5.0])["interval"] is None


def run_entry(route: str, repetition: int, **changes: Any) -> dict[str, Any]:
    return {
        "route": route,
        "preset": "designed",
        "seed": repetition,
        "repetition": repetition,
        "onset_ms": 340.0 + repetition,
        "departure_ms": 360.0 + 10 * repetition,
        "completion_ms": None,
        "theory_ms": 341.0,
        "searched_ms": [12.0, 712.0],
        "below": [],
        "not_monotone": [],
        **changes,
    }


def entry_of(search: boundary_module.BoundarySearch) -> dict[str, Any]:
    """Return an entry for a search, without running it."""
    identity = search.planned.identity
    return run_entry(identity["route"], identity["repetition"], preset=identity["preset"])


RUNS = [
    *(run_entry("a", repetition) for repetition in range(6)),
    run_entry("b", 0, departure_ms=None, below=["departure"], not_monotone=["completion"]),
]


def test_groups_are_of_each_route_and_of_all() -> None:
    """There is a group for each route and one for all routes, with counts of searches that were not monotone."""
    route_a, route_b, all_routes = summarize_groups(RUNS)
    assert [(group["route"], group["n"]) for group in (route_a, route_b, all_routes)] == [("a", 6), ("b", 1), (None, 7)]
    assert route_a["departure_ms"] == {"p25": 372.5, "p50": 385.0, "p75": 397.5, "interval": [360.0, 410.0], "n": 6}
    assert route_a["completion_ms"] == {"p25": None, "p50": None, "p75": None, "interval": [None, None], "n": 0}
    assert route_b["departure_ms"]["p50"] is None
    assert all_routes["not_monotone"] == {"onset": 0, "departure": 0, "completion": 1}
    assert all_routes["theory_ms"] == 341.0


def test_figure_and_table_show_every_group() -> None:
    """The figure has a panel for each preset; figure and table have a row for each group."""
    found = {"runs": RUNS, "groups": summarize_groups(RUNS)}
    (axes,) = boundary_figure(found).axes
    assert [label.get_text() for label in axes.get_yticklabels()] == ["all routes", "b", "a"]
    assert {text.get_text() for text in axes.texts} == {
        "\N{RIGHTWARDS ARROW}6",
        "\N{RIGHTWARDS ARROW}1",
        "\N{LEFTWARDS ARROW}1",
        "\N{RIGHTWARDS ARROW}7",
    }
    html = html_of(boundary_table(found))
    assert html.count("<tr>") == 4
    assert "360\N{NO-BREAK SPACE}to\N{NO-BREAK SPACE}410" in html


# The plan.


def config(*changes: str) -> BoundaryConfig:
    return load_config(BoundaryConfig, shipped("configs/boundary.yaml"), changes)


def test_first_seeds_are_searched_before_second_seeds() -> None:
    """The first seed of every route and preset is searched before any second seed."""
    names = [search.name for search in plan_boundary(config("routes=[a, b]", "repetitions=2"))]
    assert names[:4] == ["a designed 00", "a paper_calibrated 00", "b designed 00", "b paper_calibrated 00"]
    assert len(names) == 8


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ("time=real", "virtual time"),
        ("network.video.delay_ms=10", "delay_ms"),
        ("routes=[a, a]", "each once"),
        ("presets=[]", "at least one"),
        ("presets=[swift]", "no preset 'swift'"),
        ("network.condition=L9", "unknown condition 'L9'"),
    ],
)
def test_invalid_boundary_configs_are_rejected(change: str, expected: str) -> None:
    """An invalid boundary config is rejected before anything is driven."""
    with pytest.raises(UserError, match=expected):
        plan_boundary(config(change))


def test_a_searched_video_delay_replaces_that_of_the_condition() -> None:
    """The constant video delay is the given one, rounded to 1 ns; everything else is unchanged."""
    before = config("network.condition=L4")
    after = with_video_delay(before, 1 / 3)
    assert after.network.video.delay_ms == 0.333333
    assert with_video_delay(after, 0.0).network.video.delay_ms == 0.0
    assert after.model_copy(update={"network": before.network}) == before


# Real searches.


def small_search(*changes: str) -> BoundaryConfig:
    return config("routes=[a_key]", "presets=[paper_calibrated]", "repetitions=1", "longest_delay_ms=400", *changes)


@pytest.mark.full
def test_one_real_search() -> None:
    """Onset, departure and completion are found at increasing delays, and the onset within 10 ms of theory."""
    (search,) = plan_boundary(small_search("grid_ms=200", "within_ms=10"))
    found = run_search(search)
    assert found["theory_ms"] == theoretical_ms(search.planned.config)
    assert found["onset_ms"] == pytest.approx(found["theory_ms"], abs=10)
    assert found["onset_ms"] < found["departure_ms"] < found["completion_ms"]
    low_ms, high_ms = found["searched_ms"]
    assert high_ms - low_ms == pytest.approx(400, abs=1)
    assert found["below"] == []
    json.dumps(found)


@pytest.mark.full
def test_the_frame_age_limit_ends_completion() -> None:
    """With a frame age limit of 100 ms the vehicle is not armed at longer delays, so no longer delay is completed."""
    (search,) = plan_boundary(small_search("grid_ms=200", "within_ms=100", "safety.picture_age_limit_ms=100"))
    found = run_search(search)
    assert (found["onset_ms"], found["departure_ms"]) == (None, None)
    assert found["completion_ms"] == pytest.approx(100, abs=60)
    assert found["searched_ms"][1] == pytest.approx(400 + 17, abs=2)  # 17 ms: the total delay without injection


def test_departure_is_searched_where_drives_begin(monkeypatch: pytest.MonkeyPatch) -> None:
    """Departure is searched only at delays at which drives begin."""

    def fake(planned: PlannedRun) -> MonitoredRun:
        delay_ms = planned.config.network.video.delay_ms or 0.0
        begins = delay_ms <= 250
        return MonitoredRun(
            ending="completed" if begins else "time_limit",
            lane_invasions=int(begins and delay_ms >= departure_ms),
            total_delay_ms=delay_ms + 10 if begins else math.nan,
            time_s=np.arange(int(begins), dtype=np.float64),
            cross_track_m=np.zeros(int(begins)),
            speed_mps=np.zeros(int(begins)),
            limited_s=np.zeros(0),
        )

    monkeypatch.setattr(boundary_module, "drive_monitored", fake)
    monkeypatch.setattr(boundary_module, "straight_growth", lambda _: (math.nan, -math.inf))
    (search,) = plan_boundary(small_search("grid_ms=100", "within_ms=2"))
    departure_ms = 137
    found = run_search(search)
    assert found["departure_ms"] == pytest.approx(137 + 10, abs=1)  # as total delay
    assert found["not_monotone"] == []
    assert found["completion_ms"] == pytest.approx(250 + 10, abs=1)
    departure_ms = 0
    assert (run_search(search)["below"], run_search(search)["not_monotone"]) == (["departure"], [])
    departure_ms = 300
    assert (run_search(search)["departure_ms"], run_search(search)["searched_ms"]) == (None, [10, 410])


def search_all(out: Path, *changes: str, jobs: int = 1, lines: list[str] | None = None) -> dict[str, Any]:
    """Run all searches of a small search with these changes; return the content of `boundary.json`."""
    config = small_search(*changes)
    on_progress = (lambda _: None) if lines is None else lines.append
    result, is_complete = search_boundary(config, plan_boundary(config), out, jobs=jobs, on_progress=on_progress)
    assert is_complete
    assert json.loads((out / "boundary.json").read_text()) == result
    return result


def test_a_failed_search_does_not_stop_the_others(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """A failed search is listed with its reason, and all other searches are completed."""

    def fake(search: boundary_module.BoundarySearch) -> dict[str, Any]:
        if search.name.endswith("01"):
            raise WorkError("the vehicle was never armed")
        return entry_of(search)

    monkeypatch.setattr(boundary_module, "run_search", fake)
    monkeypatch.setattr("lavt.experiment.sweep.workers.process_workers", in_this_process)
    lines: list[str] = []
    result = search_all(tmp_path, "repetitions=3", lines=lines)
    assert [run["repetition"] for run in result["runs"]] == [0, 2]
    assert result["failed"] == [{"name": "a_key paper_calibrated 01", "why": "the vehicle was never armed"}]
    assert "a_key paper_calibrated 01: failed: the vehicle was never armed" in lines


def submit_cancelled(*_: object) -> Future[Any]:
    future: Future[Any] = Future()
    future.cancel()
    future.set_running_or_notify_cancel()
    return future


def test_a_cancelled_search_has_failed(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """A search that was cancelled, as by a cluster that ends, is listed as failed and raises nothing."""
    monkeypatch.setattr("lavt.experiment.sweep.workers.process_workers", in_this_process)
    monkeypatch.setattr(_InThisProcess, "submit", submit_cancelled)
    result = search_all(tmp_path, "repetitions=2")
    assert (result["runs"], len(result["failed"])) == ([], 2)


DEATHS = {0: 0, 1: 3, 2: 2}
"""The number of processes that die in the search of each repetition."""


def die_or_return_entry(search: boundary_module.BoundarySearch) -> dict[str, Any]:
    """Kill the process as often as `DEATHS` says, which files in `study.participant` mark; then return an entry."""
    repetition = int(search.name[-2:])
    folder = Path(search.planned.config.study.participant or "")
    deaths = len(list(folder.glob(f"{repetition} *")))
    if deaths < DEATHS[repetition]:
        (folder / f"{repetition} {deaths}").touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return entry_of(search)


@pytest.mark.full
def test_searches_of_a_dead_process_are_repeated(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """A search whose process dies is repeated twice; only a search whose processes died three times has failed."""
    monkeypatch.setattr(boundary_module, "run_search", die_or_return_entry)
    out = tmp_path / "out"
    out.mkdir()
    result = search_all(out, "repetitions=3", f"study.participant={tmp_path}", jobs=2)
    assert [run["repetition"] for run in result["runs"]] == [0, 2]
    reason = "each of the processes that searched it died"
    assert result["failed"] == [{"name": "a_key paper_calibrated 01", "why": reason}]


@pytest.mark.parametrize("interrupts", [1, 2])
def test_ctrl_c_keeps_the_found_boundaries(interrupts: int, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """After Ctrl-C, no search is started, and the files have all finished ones, also after a second Ctrl-C."""
    monkeypatch.setattr(boundary_module, "run_search", entry_of)
    monkeypatch.setattr("lavt.experiment.sweep.workers.process_workers", in_this_process)
    monkeypatch.setattr(_InThisProcess, "max_calls", 3)
    lines: list[str] = []
    if interrupts == 2:
        monkeypatch.setattr(_InThisProcess, "shutdown", interrupt)

    def interrupt_after_two(line: str) -> None:
        lines.append(line)
        if len(lines) == 2:
            raise KeyboardInterrupt

    config = small_search("repetitions=5")
    result, completed = search_boundary(
        config, plan_boundary(config), tmp_path, jobs=1, on_progress=interrupt_after_two
    )
    assert (len(lines), completed) == (3, False)
    assert [run["repetition"] for run in result["runs"]] == [0, 1, 2]
    assert json.loads((tmp_path / "boundary.json").read_text()) == result
    assert (tmp_path / "boundary.csv").read_text().count("\n") == 4
    assert (tmp_path / "boundary.png").stat().st_size > 1000


def test_each_result_is_written_at_once_and_kept_by_a_resumed_search(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """A killed search has lost only what was in progress; a resumed one runs the others, and has the same results."""
    monkeypatch.setattr("lavt.experiment.sweep.workers.process_workers", in_this_process)
    monkeypatch.setattr(boundary_module, "run_search", entry_of)
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    for out in (whole, killed):
        out.mkdir()
    lines: list[str] = []

    def kill_at_second(line: str) -> None:
        lines.append(line)
        if len(lines) == 2:
            raise Killed

    config = small_search("repetitions=4")
    with pytest.raises(Killed):
        search_boundary(config, plan_boundary(config), killed, jobs=1, on_progress=kill_at_second)
    found = json.loads((killed / "boundary.json").read_text())["runs"]
    searched: list[int] = []

    def note(search: boundary_module.BoundarySearch) -> dict[str, Any]:
        entry = entry_of(search)
        searched.append(entry["repetition"])
        return entry

    monkeypatch.setattr(boundary_module, "run_search", note)
    resumed = search_all(killed, "repetitions=4")
    assert (len(found), len(searched)) == (2, 2)
    assert sorted([*searched, *(entry["repetition"] for entry in found)]) == [0, 1, 2, 3]
    assert resumed == search_all(whole, "repetitions=4")


def test_a_search_is_not_resumed_with_another_config(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """A search is not resumed with another config, nor with damaged results; its files are not changed."""
    monkeypatch.setattr("lavt.experiment.sweep.workers.process_workers", in_this_process)
    monkeypatch.setattr(boundary_module, "run_search", entry_of)
    search_all(tmp_path)
    results = tmp_path / "boundary.json"
    before = results.read_text()
    with pytest.raises(UserError, match=r"another config \(within_ms\)"):
        search_all(tmp_path, "within_ms=7")
    assert results.read_text() == before
    results.write_text('{"runs": [{"route": "a_key"}], "groups": []}')
    with pytest.raises(WorkError, match=r"boundary.json has a run without 'preset'"):
        search_all(tmp_path)


def test_a_directory_that_cannot_be_written_is_named_before_the_first_search(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """The config is written first, so a wrong directory ends the command before the searches begin."""
    monkeypatch.setattr(boundary_module, "attempt_in_processes", lambda *_: pytest.fail("the searches began"))
    with pytest.raises(OSError, match="absent"):
        search_all(tmp_path / "absent")


class Killed(BaseException):
    """Ends a search as if its process had been killed."""


def interrupt(*_: object, **__: object) -> None:
    raise KeyboardInterrupt


class _InThisProcess:
    """An executor in this process that runs only the first `max_calls` submitted calls."""

    max_calls = 100

    def __init__(self) -> None:
        self.futures: list[Any] = []

    def shutdown(self, **_: Any) -> None:
        for future in self.futures:
            future.cancel()

    def submit(self, function: Callable[..., Any], *arguments: Any) -> Any:
        future: Future[Any] = Future()
        self.futures.append(future)
        if len(self.futures) <= self.max_calls:
            try:
                future.set_result(function(*arguments))
            except WorkError as error:
                future.set_exception(error)
        return future


@contextmanager
def in_this_process(jobs: int) -> Iterator[Workers]:
    executor: Any = _InThisProcess()
    yield Workers(executor, jobs, remote=False)


def test_the_path_of_a_road_file_is_a_route(tmp_path: Path) -> None:
    """The path of a road file works as a route."""
    road = tmp_path / "bend.yaml"
    road.write_text("title: Bend\nsegments: [{length_m: 60}, {length_m: 40, curvature_per_m: 0.02}]\n")
    (search,) = plan_boundary(small_search(f"routes=[{road}]"))
    assert search.planned.identity["route"] == str(road)
