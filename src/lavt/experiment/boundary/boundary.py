"""The search for the maximum tolerable latency of a loop, with many seeds and on all cores (`docs/boundary.md`)."""

from __future__ import annotations

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
import yaml

from lavt.config import BoundaryConfig, RunConfig
from lavt.config_file import parse_config
from lavt.domain import NS_PER_MS
from lavt.errors import UserError, WorkError, describe_error
from lavt.experiment.boundary.bisection import Bracket, first_bracket, zero_bracket
from lavt.experiment.boundary.boundary_files import BOUNDARY_CONFIG, SearchKey, read_found, search_key, write_results
from lavt.experiment.boundary.compensation_margin import configured_margin_s
from lavt.experiment.boundary.delay_margin import configured_loop, critical_delay_s
from lavt.experiment.boundary.oscillation_growth import straight_growth
from lavt.experiment.report.boundary_section import boundary_figure
from lavt.experiment.report.files import save_figure
from lavt.experiment.runs.monitored_run import MonitoredRun, drive_monitored
from lavt.experiment.runs.plan import PlannedRun, plan_run
from lavt.experiment.statistics.boundary_summary import CRITERIA
from lavt.experiment.sweep.sweep import check_recorded_config
from lavt.experiment.sweep.workers import Workers, attempt_in_processes, drives_alone
from lavt.recording.output_directory import replace_text

SEARCH_KEYS = frozenset({"routes", "presets", "repetition", "repetitions", "longest_delay_ms", "grid_ms", "within_ms"})
"""The keys of a boundary config that are not keys of a run's config."""

ProgressCallback = Callable[[str], None]
"""A callback that shows one line of progress."""
TotalDelay = Callable[[float], float]
"""A function from the added delay to the total delay, in ms."""


@dataclass(frozen=True, slots=True)
class BoundarySearch:
    """One search: a planned run with one seed, route and preset, without added delay, and the delays to search."""

    planned: PlannedRun
    longest_delay_ms: float
    grid_step_ms: float
    within_ms: float
    """The width to which the bracket of a boundary is reduced."""

    @property
    def name(self) -> str:
        """The name of the search, for messages."""
        return self.planned.name

    @property
    def key(self) -> SearchKey:
        """The identity of the search among those of one config."""
        return search_key(self.planned.identity)


def plan_boundary(config: BoundaryConfig) -> list[BoundarySearch]:
    """Plan the searches of every route with every preset, once for each repetition.

    The result begins with the first repetitions of all searches; then come all second repetitions, and so on. Raises
    `UserError` for a run that `plan_run` rejects, for a run in real time or without the simulator, for a config with a
    video delay, and for missing or duplicate routes or presets.
    """
    if config.time != "virtual" or config.vehicle.kind != "simulator":
        raise UserError(
            "a boundary is searched in virtual time with the built-in simulator: set time to virtual and vehicle.kind "
            "to simulator"
        )
    if config.network.video.delay_ms is not None:
        raise UserError("network.video.delay_ms is varied by the search: omit it")
    for key, names in (("routes", config.routes), ("presets", config.presets)):
        if not names or len(set(names)) < len(names):
            raise UserError(f"{key}: give at least one, and each once")
    base = config.model_dump(mode="json", exclude=set(SEARCH_KEYS))
    searches = []
    for repetition, route, preset in itertools.product(range(config.repetitions), config.routes, config.presets):
        run = {
            **base,
            "vehicle": {**base["vehicle"], "route": route},
            "controller": {**base["controller"], "preset": preset},
            "repetition": repetition,
        }
        planned = plan_run(parse_config(RunConfig, run, "the boundary"), name=f"{route} {preset} {repetition:02d}")
        searches.append(BoundarySearch(planned, config.longest_delay_ms, config.grid_ms, config.within_ms))
    return searches


def with_video_delay(config: RunConfig, delay_ms: float) -> RunConfig:
    """Return the config with this constant video delay, rounded to 1 ns, in place of the condition's."""
    delay_ms = round(delay_ms * NS_PER_MS) / NS_PER_MS
    video = config.network.video.model_copy(update={"delay_ms": delay_ms})
    return config.model_copy(update={"network": config.network.model_copy(update={"video": video})})


def has_begun(drive: MonitoredRun) -> bool:
    """Return whether the drive began: a vehicle whose frames are too old is never armed."""
    return len(drive.time_s) > 0


def has_departed(drive: MonitoredRun) -> bool:
    """Return whether the car left its lane (at least one event `lane_invasion`)."""
    return drive.lane_invasions > 0


def is_not_completed(drive: MonitoredRun) -> bool:
    """Return whether the drive ended before the end of the route."""
    return drive.ending != "completed"


def run_search(search: BoundarySearch) -> dict[str, Any]:
    """Find the boundaries of one search, and return its entry of `runs` in `boundary.json`."""
    config, identity = search.planned.config, search.planned.identity

    @functools.cache
    def drive(delay_ms: float) -> MonitoredRun:
        return drive_monitored(plan_run(with_video_delay(config, delay_ms), name=search.name))

    own_delays_ms: list[float] = []  # for each drive on the straight road, the total delay minus the added delay

    def growth(delay_ms: float) -> float:
        measured_ms, growth_per_s = straight_growth(with_video_delay(config, delay_ms))
        own_delays_ms.append(measured_ms - delay_ms)
        return growth_per_s

    grid_ms = _grid(search.longest_delay_ms, search.grid_step_ms)
    first_total_ms = drive(0.0).total_delay_ms
    if math.isnan(first_total_ms):
        raise WorkError("the drive does not begin even without added delay: try lavt run with the same config")

    def total_ms(delay_ms: float) -> float:
        measured_ms = drive(delay_ms).total_delay_ms
        if math.isnan(measured_ms):  # the frames were too old to drive
            return first_total_ms + delay_ms
        return measured_ms

    theory_ms = theoretical_ms(config)
    guess_ms = search.longest_delay_ms / 2 if theory_ms is None else theory_ms - first_total_ms
    onset = zero_bracket(functools.cache(growth), guess_ms, search.longest_delay_ms, search.within_ms)
    begun_grid_ms = [delay_ms for delay_ms in grid_ms if has_begun(drive(delay_ms))]
    departure = first_bracket(lambda delay_ms: has_departed(drive(delay_ms)), begun_grid_ms, search.within_ms)
    completion = first_bracket(lambda delay_ms: is_not_completed(drive(delay_ms)), grid_ms, search.within_ms)
    brackets: dict[str, tuple[Bracket, TotalDelay]] = {
        "onset": (onset, lambda delay_ms: delay_ms + float(np.nanmedian(own_delays_ms))),
        "departure": (departure, total_ms),
        "completion": (completion, total_ms),
    }
    return {
        **{key: identity[key] for key in ("route", "preset", "seed", "repetition")},
        **{f"{name}_ms": _middle_ms(bracket, total_delay) for name, (bracket, total_delay) in brackets.items()},
        "theory_ms": theory_ms,
        "searched_ms": [first_total_ms, total_ms(grid_ms[-1])],
        # Boundaries below the searched range: the criterion is met even without added delay.
        "below": [name for name, (bracket, _) in brackets.items() if bracket.low_ms is None],
        "not_monotone": [name for name, (bracket, _) in brackets.items() if not bracket.monotone],
    }


def _grid(longest_ms: float, step_ms: float) -> list[float]:
    """Return the delays 0, `step_ms`, 2 x `step_ms` and so on up to the longest delay, which is the last one."""
    count = math.ceil(longest_ms / step_ms)
    return [*(number * step_ms for number in range(count)), longest_ms]


def _middle_ms(bracket: Bracket, total_delay: TotalDelay) -> float | None:
    """Return the total delay in the middle of a bracket; None if the boundary is not in the searched range."""
    if bracket.low_ms is None or bracket.high_ms is None:
        return None
    return (total_delay(bracket.low_ms) + total_delay(bracket.high_ms)) / 2


def theoretical_ms(config: RunConfig) -> float | None:
    """Return the delay margin of the configured loop in ms; None if the loop has no model or no finite margin."""
    loop = configured_loop(config)
    critical_s = configured_margin_s(config) if loop is None else critical_delay_s(loop)
    return None if critical_s is None or math.isinf(critical_s) else critical_s * 1000


def search_boundary(
    config: BoundaryConfig,
    searches: Sequence[BoundarySearch],
    out: Path,
    *,
    jobs: int | None,
    on_progress: ProgressCallback,
) -> tuple[dict[str, Any], bool]:
    """Run the searches of `config` that `out` has no result of, `jobs` at a time (None: one per core).

    `out` has the config, and the results so far in `boundary.json` and `.csv`; at the end, it also gets `boundary.svg`
    and `.png`. On Ctrl-C, the searches in progress are finished, and no others are started. Returns the content of
    `boundary.json`, and whether all searches were run. Raises `UserError` if `out` was begun with another config.
    """
    check_recorded_config(config, out / BOUNDARY_CONFIG)
    replace_text(out / BOUNDARY_CONFIG, yaml.safe_dump(config.model_dump(mode="json"), sort_keys=False))
    progress, is_complete = _SearchProgress(config, searches, out, on_progress), True
    jobs = 1 if any(drives_alone(search.planned.config) for search in searches) else jobs or os.cpu_count() or 1
    try:
        for search in attempt_in_processes(progress.run, progress.todo, jobs):
            progress.fail(search, "each of the processes that searched it died")
    except KeyboardInterrupt:
        is_complete = False
    content = progress.write()
    if content["runs"]:
        save_figure(out, "boundary", boundary_figure(content), "boundaries", "")
    return content, is_complete


class _SearchProgress:
    """The finished and the failed searches so far, which are also in the files of a directory."""

    def __init__(
        self, config: BoundaryConfig, searches: Sequence[BoundarySearch], out: Path, on_progress: ProgressCallback
    ) -> None:
        self._config, self._searches, self._out, self._on_progress = config, searches, out, on_progress
        self._found = read_found(out)
        self._failed: list[dict[str, Any]] = []

    @property
    def todo(self) -> list[BoundarySearch]:
        """The searches without a result."""
        return [search for search in self._searches if search.key not in self._found]

    def run(self, workers: Workers, todo: Sequence[BoundarySearch]) -> list[BoundarySearch]:
        """Run the searches `todo`; return, in their order, the ones that have no result because a process died."""
        futures = {workers.executor.submit(run_search, search): search for search in todo}
        broken: set[str] = set()

        def take(future: Future[dict[str, Any]]) -> None:
            search, error = futures[future], None
            try:
                self._found[search.key] = future.result()
            except Exception as raised:  # an error of one search does not end the others
                error = raised
            del futures[future]  # only now: a Ctrl-C before this line must not lose the result
            if error is None:
                self.write()
                self._on_progress(f"{search.name}: {_format_boundaries(self._found[search.key])}")
            elif isinstance(error, BrokenExecutor):
                broken.add(search.name)
            else:
                self.fail(search, describe_error(error))

        try:
            for future in as_completed(list(futures)):
                take(future)
        except KeyboardInterrupt:
            try:
                workers.stop()
            finally:  # a second Ctrl-C breaks off only what has not finished
                for future in [future for future in futures if future.done() and not future.cancelled()]:
                    take(future)
            raise
        return [search for search in todo if search.name in broken]

    def fail(self, search: BoundarySearch, reason: str) -> None:
        """Add a failed search."""
        self._failed.append({"name": search.name, "why": reason})
        self._on_progress(f"{search.name}: failed: {reason}")

    def write(self) -> dict[str, Any]:
        """Write the results so far, in the order of the searches, and return the content of `boundary.json`."""
        found = [self._found[search.key] for search in self._searches if search.key in self._found]
        return write_results(self._config, found, self._failed, self._out)


def _format_boundaries(found: Mapping[str, Any]) -> str:
    """Return the boundaries in an entry of `runs` in `boundary.json`."""
    parts = [
        f"{name} {'-' if found[f'{name}_ms'] is None else format(found[f'{name}_ms'], '.0f')}" for name in CRITERIA
    ]
    return ", ".join(parts) + " ms"
