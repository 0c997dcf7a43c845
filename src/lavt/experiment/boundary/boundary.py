"""How much total delay a loop bears: by search, seed after seed, on all cores. docs/boundary.md defines it."""

from __future__ import annotations

import csv
import functools
import itertools
import math
import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import BrokenExecutor, Future, as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lavt.config import BoundaryConfig, RunConfig
from lavt.config_file import parse_config
from lavt.domain import NS_PER_MS
from lavt.errors import UserError, WorkError, in_words
from lavt.experiment.analysis.results import write_json
from lavt.experiment.boundary.bisection import Bracket, first_bracket, zero_bracket
from lavt.experiment.boundary.delay_margin import configured_loop, critical_delay_s
from lavt.experiment.boundary.oscillation_growth import straight_growth
from lavt.experiment.report.boundary_figure import boundary_figure
from lavt.experiment.report.files import save_figure
from lavt.experiment.runs.monitored_run import MonitoredRun, drive_monitored
from lavt.experiment.runs.plan import PlannedRun, plan_run
from lavt.experiment.statistics.boundary_summary import CRITERIA, groups_of
from lavt.experiment.sweep.workers import Workers, processes

BOUNDARY = "boundary.json"
FIELDS = ("route", "preset", "seed", "repetition", *(f"{name}_ms" for name in CRITERIA), "theory_ms")
SEARCHED = frozenset({"routes", "presets", "repetition", "repetitions", "longest_delay_ms", "grid_ms", "within_ms"})
"""Keys of a boundary config that are not a run's."""

ProgressCallback = Callable[[str], None]
Totals = Callable[[float], float]


@dataclass(frozen=True, slots=True)
class BoundarySearch:
    """One seed on one route with one preset: its run without added delay, and where to look."""

    planned: PlannedRun
    longest_delay_ms: float
    grid_ms: float
    within_ms: float

    @property
    def name(self) -> str:
        """What is told of it."""
        return self.planned.name


def plan_boundary(config: BoundaryConfig) -> list[BoundarySearch]:
    """Plan every route with every preset, repeated; a first seed of each comes before any second one.

    Raises `UserError` for what `plan_run` refuses, for what has no straight road or no virtual time, for a video delay
    that is given, and where nothing is asked for or something twice.
    """
    if config.time != "virtual" or config.vehicle.kind != "simulator":
        raise UserError(
            "a boundary is searched in virtual time with the built-in simulator: set time and vehicle.kind so"
        )
    if config.network.video.delay_ms is not None:
        raise UserError("network.video.delay_ms is what is searched for: leave it out")
    for key, names in (("routes", config.routes), ("presets", config.presets)):
        if not names or len(set(names)) < len(names):
            raise UserError(f"{key}: give at least one, and each once")
    base = config.model_dump(mode="json", exclude=set(SEARCHED))
    searches = []
    for repetition, route, preset in itertools.product(range(config.repetitions), config.routes, config.presets):
        requested = {
            **base,
            "vehicle": {**base["vehicle"], "route": route},
            "controller": {**base["controller"], "preset": preset},
            "repetition": repetition,
        }
        planned = plan_run(
            parse_config(RunConfig, requested, "the boundary"), name=f"{route} {preset} {repetition:02d}"
        )
        searches.append(BoundarySearch(planned, config.longest_delay_ms, config.grid_ms, config.within_ms))
    return searches


def with_video_delay(config: RunConfig, delay_ms: float) -> RunConfig:
    """Give the config with this constant delay of the video instead of the condition's, to the nanosecond."""
    delay_ms = round(delay_ms * NS_PER_MS) / NS_PER_MS
    video = config.network.video.model_copy(update={"delay_ms": delay_ms})
    return config.model_copy(update={"network": config.network.model_copy(update={"video": video})})


def began(drive: MonitoredRun) -> bool:
    """Whether the vehicle was armed: with pictures that are too old it is not, and nobody drives anywhere."""
    return len(drive.time_s) > 0


def departed(drive: MonitoredRun) -> bool:
    """Whether the car left its lane: at least one event `lane_invasion`."""
    return drive.lane_invasions > 0


def not_completed(drive: MonitoredRun) -> bool:
    """Whether the drive ended in any other way than at the route's end."""
    return drive.ending != "completed"


def search(requested: BoundarySearch) -> dict[str, Any]:
    """Find the boundaries of one seed, and give its entry of `boundary.json`."""
    config, identity = requested.planned.config, requested.planned.identity

    @functools.cache
    def drive(delay_ms: float) -> MonitoredRun:
        return drive_monitored(plan_run(with_video_delay(config, delay_ms), name=requested.name))

    added_ms: list[float] = []

    def growth(delay_ms: float) -> float:
        measured_ms, growth_per_s = straight_growth(with_video_delay(config, delay_ms))
        added_ms.append(measured_ms - delay_ms)
        return growth_per_s

    grid_ms = _grid(requested.longest_delay_ms, requested.grid_ms)
    first_total_ms = drive(0.0).total_delay_ms
    if math.isnan(first_total_ms):
        raise WorkError("nothing is driven even without added delay: look at lavt run with the same config")

    def total_ms(delay_ms: float) -> float:
        measured_ms = drive(delay_ms).total_delay_ms
        return first_total_ms + delay_ms if math.isnan(measured_ms) else measured_ms  # pictures too old to be obeyed

    theory_ms = theoretical_ms(config)
    guess_ms = requested.longest_delay_ms / 2 if theory_ms is None else theory_ms - first_total_ms
    onset = zero_bracket(functools.cache(growth), guess_ms, requested.longest_delay_ms, requested.within_ms)
    begun_ms = [delay_ms for delay_ms in grid_ms if began(drive(delay_ms))]
    departure = first_bracket(lambda delay_ms: departed(drive(delay_ms)), begun_ms, requested.within_ms)
    completion = first_bracket(lambda delay_ms: not_completed(drive(delay_ms)), grid_ms, requested.within_ms)
    found: dict[str, tuple[Bracket, Totals]] = {
        "onset": (onset, lambda delay_ms: delay_ms + float(np.nanmedian(added_ms))),
        "departure": (departure, total_ms),
        "completion": (completion, total_ms),
    }
    return {
        "route": identity["route"],
        "preset": identity["preset"],
        "seed": identity["seed"],
        "repetition": identity["repetition"],
        **{f"{name}_ms": _middle_ms(bracket, total) for name, (bracket, total) in found.items()},
        "theory_ms": theory_ms,
        "searched_ms": [first_total_ms, total_ms(grid_ms[-1])],
        "below": [name for name, (bracket, _) in found.items() if bracket.low_ms is None],
        "not_monotone": [name for name, (bracket, _) in found.items() if not bracket.monotone],
    }


def _grid(longest_ms: float, step_ms: float) -> list[float]:
    """Give delays from 0 on, `step_ms` apart, and the longest."""
    count = math.ceil(longest_ms / step_ms)
    return [*(number * step_ms for number in range(count)), longest_ms]


def _middle_ms(bracket: Bracket, total: Totals) -> float | None:
    """Give the total delay half-way between the ends of a bracket; None where the boundary is not within the range."""
    if bracket.low_ms is None or bracket.high_ms is None:
        return None
    return (total(bracket.low_ms) + total(bracket.high_ms)) / 2


def theoretical_ms(config: RunConfig) -> float | None:
    """Give the critical total delay of the loop as configured; None where nothing is known of it, or there is none."""
    loop = configured_loop(config)
    critical_s = math.inf if loop is None else critical_delay_s(loop)
    return critical_s * 1000 if math.isfinite(critical_s) else None


def search_all(
    searches: Sequence[BoundarySearch], *, jobs: int | None, on_progress: ProgressCallback
) -> tuple[list[dict[str, Any]], list[dict[str, Any]], bool]:
    """Search them all, `jobs` at a time (None: one a core).

    Returns what was found, in the order asked for; what failed, with the reason; and whether all was done: not after
    Ctrl-C, which lets the searches under way end, and takes what they found.
    """
    work, done = _SearchProgress(on_progress), True
    try:
        _search_in_processes(work, searches, jobs or os.cpu_count() or 1)
    except KeyboardInterrupt:
        done = False
    return [work.found[each.name] for each in searches if each.name in work.found], work.failed, done


class _SearchProgress:
    """What has become of the searches so far."""

    def __init__(self, on_progress: ProgressCallback) -> None:
        self.found: dict[str, dict[str, Any]] = {}
        self.failed: list[dict[str, Any]] = []
        self._on_progress = on_progress

    def search(self, workers: Workers, todo: Sequence[BoundarySearch]) -> list[BoundarySearch]:
        """Have searches done; give those that were not, because a worker's process died, in the order of `todo`."""
        futures = {workers.executor.submit(search, each): each for each in todo}
        broken: set[str] = set()

        def take(future: Future[dict[str, Any]]) -> None:
            requested = futures.pop(future)
            try:
                self.found[requested.name] = future.result()
            except BrokenExecutor:
                broken.add(requested.name)
            except Exception as error:  # whatever it is, the other searches have nothing to do with it
                self.fail(requested, in_words(error))
            else:
                self._on_progress(f"{requested.name}: {_sentence(self.found[requested.name])}")

        try:
            for future in as_completed(list(futures)):
                take(future)
        except KeyboardInterrupt:
            workers.stop()
            for future in [each for each in futures if not each.cancelled()]:
                take(future)
            raise
        return [each for each in todo if each.name in broken]

    def fail(self, requested: BoundarySearch, why: str) -> None:
        """Note that a search failed."""
        self.failed.append({"name": requested.name, "why": why})
        self._on_progress(f"{requested.name}: failed: {why}")


def _search_in_processes(work: _SearchProgress, todo: Sequence[BoundarySearch], jobs: int) -> None:
    """Search, also when a process dies, which takes the pool with it: what may have been begun is searched alone."""
    while todo:
        with processes(jobs) as workers:
            broken = work.search(workers, todo)
        for each in broken[:jobs]:  # they are begun in their order
            with processes(1) as alone:
                if work.search(alone, [each]):
                    work.fail(each, "the process that searched it died")
        todo = broken[jobs:]


def _sentence(run: Mapping[str, Any]) -> str:
    parts = [f"{name} {'-' if run[f'{name}_ms'] is None else format(run[f'{name}_ms'], '.0f')}" for name in CRITERIA]
    return ", ".join(parts) + " ms"


def search_boundary(
    config: BoundaryConfig,
    searches: Sequence[BoundarySearch],
    out: Path,
    *,
    jobs: int | None,
    on_progress: ProgressCallback,
) -> tuple[dict[str, Any], bool]:
    """Search, and write `boundary.json`, `.csv`, `.svg` and `.png` into `out`, also of what was found before Ctrl-C.

    `searches` are those of `config`. Returns what is in `boundary.json`, and whether all was done.
    """
    runs, failed, done = search_all(searches, jobs=jobs, on_progress=on_progress)
    entry = {
        "schema": 1,
        "config": config.model_dump(mode="json"),
        "runs": runs,
        "groups": groups_of(runs),
        "failed": failed,
    }
    write_json(out / BOUNDARY, entry)
    with (out / "boundary.csv").open("w", newline="", encoding="utf-8") as file:
        rows = csv.DictWriter(file, FIELDS, extrasaction="ignore")
        rows.writeheader()
        rows.writerows(runs)
    if runs:
        save_figure(out, "boundary", boundary_figure(entry), "boundaries", "")
    return entry, done
