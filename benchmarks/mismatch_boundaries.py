"""Search the total delay at which controllers fail under wrong assumptions, beside the delay by the model.

    python -m benchmarks.mismatch_boundaries [--out out/mismatch_boundaries] [--axis wheelbase ...] [--jobs 2]
                                             [--kind predictive ...] [--picture docs/pictures/mismatch_boundaries.png]

The axes are those of `benchmarks/mismatch_axes.py`. Each point is a search in virtual time, with geometry fidelity, the
inherent latency `loopback` and a constant delay of the video, once for each seed. It finds where an oscillation begins
to grow on a straight road, as `benchmarks/growth_onset.py` does; with a noisy lane, where the car leaves its lane on
the route `b_key`, because noise excites an oscillation at any delay. Each finished search is appended to
`mismatch_boundaries.csv`; a program that was interrupted continues there. `docs/compensation.md` has the output.
"""

from __future__ import annotations

import argparse
import csv
import math
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import median
from typing import NamedTuple

import numpy as np
from benchmarks.growth_onset import onset_ms
from benchmarks.mismatch_axes import AXES, KINDS
from matplotlib.figure import Figure

from lavt.config import RunConfig
from lavt.config_file import load_config, shipped
from lavt.experiment.boundary.bisection import Bracket, first_bracket, zero_bracket
from lavt.experiment.boundary.boundary import has_departed, theoretical_ms, with_video_delay
from lavt.experiment.boundary.oscillation_growth import straight_growth
from lavt.experiment.report.figures.figure_style import COLOURS
from lavt.experiment.report.table_format import NOTHING
from lavt.experiment.runs.monitored_run import drive_monitored
from lavt.experiment.runs.plan import plan_run

DEPARTURES = ("position_noise", "direction_noise")
"""The axes on which the departure from the lane is searched, for which the model has no delay."""
SEARCHED = (
    "delay",
    "steering_lag",
    "wheelbase",
    "understeer",
    "speed_report",
    "frame_rate",
    "speed",
    "jitter",
    "control_jitter",
    "loss",
    *DEPARTURES,
)
"""The axes that are searched: not `bursts`, because the vehicle stops in a long burst, which ends each oscillation."""
SEARCHED_KINDS = ("predictive", "scheduled_lookahead", "lane_keeper")
"""Without `smith`: by the model, it is stable up to 2.8 s on all these axes but one, and no drive can be delayed so
long."""
FURTHER_VALUES = {"speed": (30 / 3.6, 70 / 3.6)}
"""Values that are searched beside those of an axis: its exact one, and one that only a straight road permits."""
SEEDS = (1, 2, 3)
MAX_DELAY_MS = 1900.0
"""The longest added delay of the video: the vehicle accepts no picture older than 2 s."""
MOST_MS = 3000.0
"""The longest critical delay that the model computes."""
PRECISION_MS = 2.0
GRID_MS = tuple(float(delay_ms) for delay_ms in range(0, 1901, 190))
"""The delays at which a departure is searched first."""
COLUMNS = ("axis", "kind", "value", "seed", "theory_ms", "measured_ms", "outside")
OUTSIDE = {"below": -math.inf, "beyond": math.inf}


class Place(NamedTuple):
    """What is searched: an axis, a controller, a value and a seed."""

    axis: str
    kind: str
    value: float
    seed: int


@dataclass(frozen=True, slots=True)
class Point:
    """The boundary that one search found, one row of the CSV."""

    axis: str
    kind: str
    value: float
    seed: int
    theory_ms: float | None
    """None: over 3 s, or an axis of `DEPARTURES`."""
    measured_ms: float | None
    outside: str
    """`below` if the controller fails without added delay, `beyond` if it does not at the longest; else empty."""

    @property
    def place(self) -> Place:
        """What was searched."""
        return Place(self.axis, self.kind, self.value, self.seed)

    @property
    def boundary_ms(self) -> float:
        """The boundary; infinite if it is outside the searched delays."""
        return OUTSIDE.get(self.outside, math.nan) if self.measured_ms is None else self.measured_ms


def config_of(place: Place) -> RunConfig:
    """Return the config of the drives of one search, with limits so wide that none depends on the delay.

    Of the axis's settings it has those of the network; its routes and limits are for other roads.
    """
    axis = AXES[place.axis]
    changes = [
        "vehicle.route=b_key",
        "fidelity=geometry",
        "controller.preset=designed",
        f"controller.kind={place.kind}",
        f"seed={place.seed}",
        "safety.stopping_distance_limit_m=200",
        "safety.speed_limit_mps=22.3",
        *(setting for setting in axis.settings if setting.startswith(("network.", "video."))),
        f"{axis.key}={place.value}",
    ]
    return load_config(RunConfig, shipped("configs/demo.yaml"), changes)


def search_point(place: Place) -> Point:
    """Find the boundary at one place."""
    config = config_of(place)
    own_delays_ms: list[float] = []  # of each drive: the total delay minus the added delay of the video

    def growth(added_ms: float) -> float:
        total_ms, growth_per_s = straight_growth(with_video_delay(config, added_ms))
        own_delays_ms.append(total_ms - added_ms)
        return growth_per_s

    def departs(added_ms: float) -> bool:
        drive = drive_monitored(plan_run(with_video_delay(config, added_ms), name=place.axis))
        own_delays_ms.append(drive.total_delay_ms - added_ms)
        return has_departed(drive)

    if place.axis in DEPARTURES:
        theory_ms, bracket = None, first_bracket(departs, GRID_MS, PRECISION_MS)
    else:
        theory_ms = theoretical_ms(config)
        guess_ms = MAX_DELAY_MS if theory_ms is None else theory_ms
        bracket = zero_bracket(growth, guess_ms, MAX_DELAY_MS, PRECISION_MS)
    own_ms = float(np.nanmedian(own_delays_ms))
    low_ms, high_ms = (None if end_ms is None else end_ms + own_ms for end_ms in (bracket.low_ms, bracket.high_ms))
    outside = "below" if low_ms is None else "beyond" if high_ms is None else ""
    return Point(*place, theory_ms, onset_ms(Bracket(low_ms, high_ms)), outside)


def values_of(name: str) -> list[float]:
    """Return all values of an axis, with the exact one, sorted."""
    axis = AXES[name]
    exact = () if axis.exact is None else (axis.exact,)
    further = [value for value in (*exact, *FURTHER_VALUES.get(name, ())) if not _is_among(value, axis.values)]
    return sorted(float(value) for value in (*axis.values, *further))


def _is_among(value: float, others: Iterable[float]) -> bool:
    return any(math.isclose(value, other, rel_tol=1e-3) for other in others)


def read_points(path: Path) -> list[Point]:
    """Return the rows of a CSV; none if it does not exist."""
    if not path.exists():
        return []

    def number(text: str) -> float | None:
        return float(text) if text else None

    with path.open() as file:
        return [
            Point(
                row["axis"],
                row["kind"],
                float(row["value"]),
                int(row["seed"]),
                number(row["theory_ms"]),
                number(row["measured_ms"]),
                row["outside"],
            )
            for row in csv.DictReader(file)
        ]


def search_points(
    wanted: Sequence[Place], path: Path, search_all: Callable[[Sequence[Place]], Iterable[Point]]
) -> list[Point]:
    """Search all wanted places that the CSV does not have yet, append them, and return the points of the wanted ones.

    Places with the same config, such as the exact values of two axes, are searched once.
    """
    found = {point.place: point for point in read_points(path)}
    path.parent.mkdir(parents=True, exist_ok=True)
    if not path.exists():
        path.write_text(f"{','.join(COLUMNS)}\n")
    same: defaultdict[tuple[bool, str], list[Place]] = defaultdict(list)
    for place in wanted:
        if place not in found:
            same[place.axis in DEPARTURES, config_of(place).model_dump_json()].append(place)
    points = search_all([places[0] for places in same.values()])
    for places, point in zip(same.values(), points, strict=True):
        for place in places:
            found[place] = Point(*place, point.theory_ms, point.measured_ms, point.outside)
            with path.open("a", newline="") as file:
                csv.DictWriter(file, COLUMNS, lineterminator="\n").writerow(asdict(found[place]))
    return [found[place] for place in wanted]


def by_value(points: Iterable[Point]) -> list[list[Point]]:
    """Return the points of all seeds for each axis, controller and value, in their order."""
    groups: dict[tuple[str, str, float], list[Point]] = {}
    for point in points:
        groups.setdefault((point.axis, point.kind, point.value), []).append(point)
    return list(groups.values())


def table_row(points: Sequence[Point]) -> str:
    """Return the Markdown row of the points of all seeds: the median, and the smallest and largest if they differ."""
    first, boundaries_ms = points[0], sorted(point.boundary_ms for point in points)
    theory = "over 3000 ms" if first.theory_ms is None else f"{first.theory_ms:.0f} ms"
    low, middle, high = (_shown(value) for value in (boundaries_ms[0], median(boundaries_ms), boundaries_ms[-1]))
    cells = (
        AXES[first.axis].title,
        f"{first.value:g}",
        f"`{first.kind}`",
        NOTHING if first.axis in DEPARTURES else theory,
        middle if low == high else f"{middle} ({low} to {high})",
    )
    return f"| {' | '.join(cells)} |"


def _shown(boundary_ms: float) -> str:
    names = {value: name for name, value in OUTSIDE.items()}
    return names.get(boundary_ms) or f"{boundary_ms:.0f} ms"


def draw(points: Sequence[Point]) -> Figure:
    """Draw the boundary over each axis: lines by the model; the median of the seeds with its range, as measured.

    A triangle on the dotted line is a median beyond the longest delay of the search.
    """
    names = list(dict.fromkeys(point.axis for point in points))
    columns = min(4, len(names))
    figure = Figure(figsize=(13.0, 2.9 * -(-len(names) // columns) + 0.5), dpi=100, layout="constrained")
    grid = figure.subplots(-(-len(names) // columns), columns, squeeze=False, sharey=True)
    for axes, name in zip(grid.flat, names, strict=False):
        for kind, colour in zip(KINDS, COLOURS, strict=False):
            if kind not in {point.kind for point in points}:
                continue
            line = sorted(
                by_value(point for point in points if (point.axis, point.kind) == (name, kind)),
                key=lambda group: group[0].value,
            )
            values = [group[0].value for group in line]
            theory_ms = [MOST_MS if group[0].theory_ms is None else group[0].theory_ms for group in line]
            is_modelled = line and name not in DEPARTURES
            axes.plot(values if is_modelled else [], theory_ms if is_modelled else [], color=colour, label=kind)
            for value, group in zip(values, line, strict=True):
                found_ms = np.clip(sorted(point.boundary_ms for point in group), 0, MAX_DELAY_MS)
                middle_ms = float(np.median(found_ms))
                marker = "^" if middle_ms == MAX_DELAY_MS else "o"
                reach_ms = [[middle_ms - found_ms[0]], [found_ms[-1] - middle_ms]]
                axes.errorbar(value, middle_ms, yerr=reach_ms, fmt=marker, color=colour, markersize=4, capsize=3)
        departure = ", departure" if name in DEPARTURES else ""
        axes.set_title(f"{AXES[name].title.partition(' (')[0]}{departure}", fontsize=8, loc="left")
        axes.axhline(MAX_DELAY_MS, color="grey", linestyle=":", linewidth=1)
        axes.set_ylim(0, MOST_MS)
        axes.grid(alpha=0.3)
    for axes in grid[:, 0]:
        axes.set_ylabel("total delay at the boundary / ms", fontsize=8)
    for axes in list(grid.flat)[len(names) :]:
        axes.set_visible(False)
    figure.legend(*grid[0][0].get_legend_handles_labels(), fontsize=8, loc="outside lower center", ncols=4)
    return figure


def main() -> None:
    """Search the points, print them as a Markdown table, and draw them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--axis", choices=SEARCHED, action="append")
    parser.add_argument("--kind", choices=KINDS, action="append")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("out/mismatch_boundaries"))
    parser.add_argument("--picture", type=Path, default=None, help="default: mismatch_boundaries.png in --out")
    options = parser.parse_args()
    wanted = [
        Place(name, kind, value, seed)
        for name in options.axis or SEARCHED
        for kind in options.kind or SEARCHED_KINDS
        for value in values_of(name)
        for seed in SEEDS
    ]
    with ProcessPoolExecutor(options.jobs) as pool:
        points = search_points(
            wanted, options.out / "mismatch_boundaries.csv", lambda places: pool.map(search_point, places)
        )
    print("| axis | value | controller | by the model | measured |")
    print("|---" * 5 + "|")
    print("\n".join(map(table_row, by_value(points))))
    picture: Path = options.picture or options.out / "mismatch_boundaries.png"
    picture.parent.mkdir(parents=True, exist_ok=True)
    draw(points).savefig(picture)
    print(f"{picture}: {picture.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
