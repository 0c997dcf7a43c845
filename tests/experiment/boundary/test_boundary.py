"""The search for boundaries: its parts on cases made by hand, and one real search."""

from __future__ import annotations

import json
import math
import os
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lavt.config import BoundaryConfig
from lavt.config_file import load_config, shipped
from lavt.domain import GroundTruth
from lavt.errors import UserError, WorkError
from lavt.experiment.boundary import boundary as boundary_module
from lavt.experiment.boundary.bisection import Bracket, first_bracket, zero_bracket
from lavt.experiment.boundary.boundary import (
    departed,
    not_completed,
    plan_boundary,
    search,
    search_all,
    theoretical_ms,
    with_video_delay,
)
from lavt.experiment.boundary.oscillation_growth import growth_per_s
from lavt.experiment.report.boundary_figure import boundary_figure, boundary_table
from lavt.experiment.report.table_format import html_of
from lavt.experiment.runs.monitored_run import MonitoredRun, watched
from lavt.experiment.runs.plan import PlannedRun
from lavt.experiment.statistics.boundary_summary import groups_of, summary
from lavt.experiment.sweep.workers import Workers
from lavt.nodes.payloads import Admission, Event, FrameWritten

GRID_MS = [0.0, 100.0, 200.0, 300.0]
MS = 1_000_000


def counted(function: Callable[[float], Any]) -> tuple[Callable[[float], Any], list[float]]:
    requested: list[float] = []

    def ask(delay_ms: float) -> Any:
        requested.append(delay_ms)
        return function(delay_ms)

    return ask, requested


# The search.


def test_bisection_closes_in_on_the_first_crossing() -> None:
    """What begins at 137 ms is bracketed to 2 ms: the grid is asked first, then six halves of 100 ms."""
    happens, requested = counted(lambda delay_ms: delay_ms >= 137)
    found = first_bracket(happens, GRID_MS, 2.0)
    assert found == Bracket(135.9375, 137.5, monotone=True)
    assert requested[:4] == GRID_MS
    assert len(requested) == 10


def test_what_stops_again_is_told() -> None:
    """The first crossing counts where there are several, and the bracket says that it was not monotone."""
    found = first_bracket(lambda delay_ms: 50 <= delay_ms < 250, GRID_MS, 2.0)
    assert found == Bracket(48.4375, 50.0, monotone=False)


def test_what_never_begins_has_only_a_lower_end() -> None:
    """Nothing within the range: the last delay tried is the lower end, and there is no upper one."""
    assert first_bracket(lambda _: False, GRID_MS, 2.0) == Bracket(300.0, None)


def test_what_has_begun_without_delay_has_only_an_upper_end() -> None:
    """What happens at the first delay of the grid began below the range."""
    assert first_bracket(lambda _: True, GRID_MS, 2.0) == Bracket(None, 0.0)
    assert first_bracket(lambda delay_ms: delay_ms != 100, GRID_MS, 2.0) == Bracket(None, 0.0, monotone=False)


@pytest.mark.parametrize("guess_ms", [0.0, 130.0, 137.0, 300.0, 1000.0])
def test_a_rate_is_followed_to_its_zero(guess_ms: float) -> None:
    """Wherever the guess lies, a smooth rate's zero is between ends 2 ms apart; infinite rates only have a sign."""

    def rate(delay_ms: float) -> float:
        return math.inf if delay_ms > 200 else (delay_ms - 137) / 500

    found = zero_bracket(rate, guess_ms, 400.0, 2.0)
    assert found.low_ms is not None
    assert found.high_ms is not None
    assert found.high_ms - found.low_ms == pytest.approx(2.0)
    assert found.low_ms <= 137 <= found.high_ms


@pytest.mark.parametrize("zero_ms", [7.1, 12.0, 18.3, 23.2, 137.0])
def test_a_zero_lies_between_its_ends(zero_ms: float) -> None:
    """Also that of a rate of which only the sign is known, where nothing but halving helps."""
    found = zero_bracket(lambda delay_ms: math.copysign(math.inf, delay_ms - zero_ms), 100.0, 200.0, 2.0)
    assert found.low_ms is not None
    assert found.high_ms is not None
    assert found.low_ms <= zero_ms <= found.high_ms


@pytest.mark.parametrize("zero_ms", [0.3, 199.8])
def test_the_ends_of_a_zero_are_within_the_range(zero_ms: float) -> None:
    """Of a zero nearer to an end of the range than the bracket reaches, that end is the bracket's."""
    found = zero_bracket(lambda delay_ms: (delay_ms - zero_ms) / 500, 100.0, 200.0, 2.0)
    assert found.low_ms is not None
    assert found.high_ms is not None
    assert 0 <= found.low_ms <= zero_ms <= found.high_ms <= 200
    assert found.low_ms == 0 or found.high_ms == 200


def test_a_rate_without_zero_in_the_range_is_out_of_it() -> None:
    """A rate that is positive everywhere is zero below, one that is negative everywhere is zero above."""
    assert zero_bracket(lambda _: 0.1, 137.0, 400.0, 2.0) == Bracket(None, 0.0)
    assert zero_bracket(lambda _: -math.inf, 137.0, 400.0, 2.0) == Bracket(400.0, None)


# The criteria.


def frame(number: int) -> FrameWritten:
    return FrameWritten(
        number=number, stamp_ns=number, stamped_mono_ns=number * 33 * MS + 5 * MS, capture_ns=number * 33 * MS,
        pixel_crc=0, size_bytes=0,
    )  # fmt: skip


def admission(stamp: int, applied_ns: int, *, verdict: str = "accepted", limited: str = "") -> Admission:
    return Admission(
        epoch=0, stamp_ns=stamp, sequence=0, sent_wall_ns=0, stamp_received_wall_ns=0, received_mono_ns=applied_ns,
        received_wall_ns=0, applied_mono_ns=applied_ns if verdict == "accepted" else None, verdict=verdict, reason="",
        limited=limited, mode="drive", steering_rad=0.0, throttle=0.0, brake=0.0,
    )  # fmt: skip


def truth(mono_ns: int) -> GroundTruth:
    return GroundTruth(mono_ns, 0.0, 0.0, 0.0, 8.0, 0.0, 0.25, 0.0, 0.0)


def payloads(*events: Event) -> dict[str, list[Any]]:
    return {
        "truth": [truth(number * 20 * MS) for number in range(100)],
        "event": [Event(100 * MS, "drive_began", ""), *events],
        "frame": [frame(number) for number in range(60)],
        # Of each frame one that is refused, one that comes into force after 80 ms, and its repetition.
        "admission": [
            each
            for number in range(10, 50)
            for each in (
                admission(number, number * 33 * MS + 70 * MS, verdict="rejected"),
                admission(number, number * 33 * MS + 80 * MS, limited="steering rate" if number == 20 else ""),
                admission(number, number * 33 * MS + 100 * MS),
            )
        ],
    }


def test_a_drive_is_what_lies_between_its_beginning_and_its_ending() -> None:
    """Rows and events outside do not count, times are since the beginning, a frame's first obeyed command counts."""
    drive = watched(
        payloads(
            Event(50 * MS, "lane_invasion", ""),
            Event(600 * MS, "lane_invasion", ""),
            Event(1500 * MS, "ending", "completed"),
            Event(1600 * MS, "lane_invasion", ""),
        )
    )
    assert (drive.ending, drive.lane_invasions, drive.total_delay_ms) == ("completed", 1, 80.0)
    assert (drive.time_s[0], drive.time_s[-1], len(drive.time_s)) == (0.0, 1.4, 71)
    assert drive.limited_s.tolist() == [pytest.approx(0.64)]


def test_a_drive_departs_with_the_first_invasion_and_fails_with_any_other_ending() -> None:
    """Departure is one lane invasion or more; completion is lost with any ending but `completed`, and without one."""
    invasion = Event(600 * MS, "lane_invasion", "")
    for events, expected in (
        ((Event(900 * MS, "ending", "completed"),), (False, False)),
        ((invasion, Event(900 * MS, "ending", "completed")), (True, False)),
        ((Event(900 * MS, "ending", "safe_stop"),), (False, True)),
        ((invasion, Event(900 * MS, "ending", "collision")), (True, True)),
        ((), (False, True)),
    ):
        drive = watched(payloads(*events))
        assert (departed(drive), not_completed(drive)) == expected


def test_a_vehicle_that_is_never_armed_has_not_completed() -> None:
    """Without a beginning there are no rows and no delay; nothing was left, nothing completed, and nothing swings."""
    never = payloads()
    never["event"] = [Event(600 * MS, "lane_invasion", "")]
    drive = watched(never)
    assert (len(drive.time_s), math.isnan(drive.total_delay_ms)) == (0, True)
    assert (departed(drive), not_completed(drive), growth_per_s(drive)) == (False, True, -math.inf)


# What many say together.


def test_ranks_count_what_is_out_of_range() -> None:
    """Of six seeds, two beyond the range: quartiles and interval are null where they fall among these."""
    found = summary([300.0, 310.0, 320.0, 330.0, math.inf, math.inf])
    assert found == {"p25": 312.5, "p50": 325.0, "p75": None, "interval": [300.0, None], "n": 4}


def test_the_interval_is_that_of_order_statistics() -> None:
    """Of ten seeds the interval of the median reaches from the second to the ninth (98 %), of five there is none."""
    assert summary([float(value) for value in range(10)])["interval"] == [1.0, 8.0]
    assert summary([1.0, 2.0, 3.0, 4.0, 5.0])["interval"] is None


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


RUNS = [
    *(run_entry("a", repetition) for repetition in range(6)),
    run_entry("b", 0, departure_ms=None, below=["departure"], not_monotone=["completion"]),
]


def test_groups_are_of_each_route_and_of_all() -> None:
    """Each route has a group, and all of them together one without a route, with counts of what was not monotone."""
    one, other, both = groups_of(RUNS)
    assert [(each["route"], each["n"]) for each in (one, other, both)] == [("a", 6), ("b", 1), (None, 7)]
    assert one["departure_ms"] == {"p25": 372.5, "p50": 385.0, "p75": 397.5, "interval": [360.0, 410.0], "n": 6}
    assert one["completion_ms"] == {"p25": None, "p50": None, "p75": None, "interval": [None, None], "n": 0}
    assert other["departure_ms"]["p50"] is None
    assert both["not_monotone"] == {"onset": 0, "departure": 0, "completion": 1}
    assert both["theory_ms"] == 341.0


def test_figure_and_table_show_every_group() -> None:
    """The figure has a panel for each preset and a row for each route; the table has a row for each group."""
    found = {"runs": RUNS, "groups": groups_of(RUNS)}
    (axes,) = boundary_figure(found).axes
    assert [label.get_text() for label in axes.get_yticklabels()] == ["all routes", "b", "a"]
    assert {text.get_text() for text in axes.texts} == {
        "\N{RIGHTWARDS ARROW}6", "\N{RIGHTWARDS ARROW}1", "\N{LEFTWARDS ARROW}1", "\N{RIGHTWARDS ARROW}7",
    }  # fmt: skip
    html = html_of(boundary_table(found))
    assert html.count("<tr>") == 4
    assert "360\N{NO-BREAK SPACE}to\N{NO-BREAK SPACE}410" in html


# What is planned.


def config(*changes: str) -> BoundaryConfig:
    return load_config(BoundaryConfig, shipped("configs/boundary.yaml"), changes)


def test_first_seeds_of_all_come_before_second_ones() -> None:
    """So that a search that is stopped has as many seeds of each."""
    names = [each.name for each in plan_boundary(config("routes=[a, b]", "repetitions=2"))]
    assert names[:4] == ["a designed 00", "a paper_calibrated 00", "b designed 00", "b paper_calibrated 00"]
    assert len(names) == 8


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ("time=real", "virtual time"),
        ("network.video.delay_ms=10", "leave it out"),
        ("routes=[a, a]", "each once"),
        ("presets=[]", "at least one"),
        ("presets=[swift]", "no preset 'swift'"),
        ("network.condition=L9", "no condition 'L9'"),
    ],
)
def test_what_cannot_be_searched_is_rejected(change: str, says: str) -> None:
    """Each is said in a sentence before anything is driven."""
    with pytest.raises(UserError, match=says):
        plan_boundary(config(change))


def test_the_delay_is_put_in_place_of_the_condition() -> None:
    """The video's constant delay is the one searched, to the nanosecond; everything else is as configured."""
    before = config("network.condition=L4")
    after = with_video_delay(before, 1 / 3)
    assert after.network.video.delay_ms == 0.333333
    assert with_video_delay(after, 0.0).network.video.delay_ms == 0.0
    assert after.model_copy(update={"network": before.network}) == before


# For real.


def small(*changes: str) -> BoundaryConfig:
    return config("routes=[a_key]", "presets=[paper_calibrated]", "repetitions=1", "longest_delay_ms=400", *changes)


@pytest.mark.full
def test_one_real_search() -> None:
    """One seed: the swing grows within 10 ms of the theory, then the car leaves its lane, then it does not arrive."""
    (requested,) = plan_boundary(small("grid_ms=200", "within_ms=10"))
    found = search(requested)
    assert found["theory_ms"] == theoretical_ms(requested.planned.config)
    assert found["onset_ms"] == pytest.approx(found["theory_ms"], abs=10)
    assert found["onset_ms"] < found["departure_ms"] < found["completion_ms"]
    low_ms, high_ms = found["searched_ms"]
    assert high_ms - low_ms == pytest.approx(400, abs=1)
    assert found["below"] == []
    json.dumps(found)


@pytest.mark.full
def test_a_limit_on_the_age_of_pictures_ends_completion() -> None:
    """With a limit of 100 ms the vehicle is not even armed beyond it: completion ends there, and no swing has begun."""
    (requested,) = plan_boundary(small("grid_ms=200", "within_ms=100", "safety.picture_age_limit_ms=100"))
    found = search(requested)
    assert (found["onset_ms"], found["departure_ms"]) == (None, None)
    assert found["completion_ms"] == pytest.approx(100, abs=60)
    assert found["searched_ms"][1] == pytest.approx(412, abs=2)


def test_nobody_leaves_a_lane_where_nobody_drives(monkeypatch: pytest.MonkeyPatch) -> None:
    """Departure is searched where drives begin: found or not there, and what never begins beyond says nothing of it."""

    def fake(planned: PlannedRun) -> MonitoredRun:
        delay_ms = planned.config.network.video.delay_ms or 0.0
        begins = delay_ms <= 250
        return MonitoredRun(
            ending="completed" if begins else "time_limit",
            lane_invasions=int(begins and delay_ms >= leaves_ms),
            total_delay_ms=delay_ms + 10 if begins else math.nan,
            time_s=np.arange(int(begins), dtype=np.float64),
            cross_track_m=np.zeros(int(begins)),
            speed_mps=np.zeros(int(begins)),
            limited_s=np.zeros(0),
        )

    monkeypatch.setattr(boundary_module, "drive_monitored", fake)
    monkeypatch.setattr(boundary_module, "straight_growth", lambda _: (math.nan, -math.inf))
    (requested,) = plan_boundary(small("grid_ms=100", "within_ms=2"))
    leaves_ms = 137
    found = search(requested)
    assert found["departure_ms"] == pytest.approx(147, abs=1)
    assert found["not_monotone"] == []
    assert found["completion_ms"] == pytest.approx(260, abs=1)
    leaves_ms = 0
    assert (search(requested)["below"], search(requested)["not_monotone"]) == (["departure"], [])
    leaves_ms = 300
    assert (search(requested)["departure_ms"], search(requested)["searched_ms"]) == (None, [10, 410])


def test_a_search_that_fails_leaves_the_others_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """It is told with its reason, and what the others found is there."""

    def fake(requested: boundary_module.BoundarySearch) -> dict[str, Any]:
        if requested.name.endswith("01"):
            raise WorkError("the vehicle was never armed")
        return run_entry("a_key", 0)

    monkeypatch.setattr(boundary_module, "search", fake)
    monkeypatch.setattr(boundary_module, "processes", in_this_process)
    told: list[str] = []
    found, failed, done = search_all(plan_boundary(small("repetitions=3")), jobs=1, on_progress=told.append)
    assert (len(found), done) == (2, True)
    assert failed == [{"name": "a_key paper_calibrated 01", "why": "the vehicle was never armed"}]
    assert "a_key paper_calibrated 01: failed: the vehicle was never armed" in told


def killed_by(requested: boundary_module.BoundarySearch) -> dict[str, Any]:
    """Search as if it were one of repetition 1 that its process does not survive, and of 2 that dies the first time."""
    repetition = int(requested.name[-2:])
    mark = Path(requested.planned.config.study.participant or "") / str(repetition)
    if repetition == 1 or (repetition == 2 and not mark.exists()):
        mark.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return run_entry("a_key", repetition)


@pytest.mark.full
def test_a_process_that_dies_costs_no_search(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """What a process that died was at is searched again, alone; only the one that dies there too has failed."""
    monkeypatch.setattr(boundary_module, "search", killed_by)
    searches = plan_boundary(small("repetitions=5", f"study.participant={tmp_path}"))
    found, failed, done = search_all(searches, jobs=2, on_progress=lambda _: None)
    assert [run["repetition"] for run in found] == [0, 2, 3, 4]
    assert failed == [{"name": "a_key paper_calibrated 01", "why": "the process that searched it died"}]
    assert done


def test_what_was_found_at_ctrl_c_is_written(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Ctrl-C after the second seed: what was under way is taken too, nothing more, and the files hold it."""
    monkeypatch.setattr(boundary_module, "search", lambda requested: run_entry("a_key", int(requested.name[-2:])))
    monkeypatch.setattr(boundary_module, "processes", in_this_process)
    monkeypatch.setattr(_InThisProcess, "begins", 3)
    told: list[str] = []

    def tell(line: str) -> None:
        told.append(line)
        if len(told) == 2:
            raise KeyboardInterrupt

    requested = small("repetitions=5")
    found, done = boundary_module.search_boundary(
        requested, plan_boundary(requested), tmp_path, jobs=1, on_progress=tell
    )
    assert (len(told), done) == (3, False)
    assert [run["repetition"] for run in found["runs"]] == [0, 1, 2]
    assert json.loads((tmp_path / "boundary.json").read_text()) == found
    assert (tmp_path / "boundary.csv").read_text().count("\n") == 4
    assert (tmp_path / "boundary.png").stat().st_size > 1000


class _InThisProcess:
    """An executor that needs no processes; of what is submitted it only begins some."""

    begins = 100

    def __init__(self) -> None:
        self.futures: list[Any] = []

    def shutdown(self, **_: Any) -> None:
        for future in self.futures:
            future.cancel()

    def submit(self, function: Callable[..., Any], *arguments: Any) -> Any:
        from concurrent.futures import Future

        future: Future[Any] = Future()
        self.futures.append(future)
        if len(self.futures) <= self.begins:
            try:
                future.set_result(function(*arguments))
            except WorkError as error:
                future.set_exception(error)
        return future


@contextmanager
def in_this_process(jobs: int) -> Iterator[Workers]:
    executor: Any = _InThisProcess()
    yield Workers(executor, jobs, far=False)


def test_paths_of_roads_can_be_routes(tmp_path: Path) -> None:
    """A road of one's own is a route like those that come with LAVT."""
    road = tmp_path / "bend.yaml"
    road.write_text("title: Bend\nsegments: [{length_m: 60}, {length_m: 40, curvature_per_m: 0.02}]\n")
    (requested,) = plan_boundary(small(f"routes=[{road}]"))
    assert requested.planned.identity["route"] == str(road)
