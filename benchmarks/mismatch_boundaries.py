"""Search the total delay at which controllers become unstable under wrong assumptions, beside the delay by the model.

    python -m benchmarks.mismatch_boundaries [--out out/mismatch_boundaries] [--axis wheelbase ...]
                                             [--kind predictive ...] [--picture docs/pictures/mismatch_boundaries.png]

The axes are those of `benchmarks/mismatch_axes.py` for which the model has a critical delay. Each point is a search on
a straight road in virtual time, with geometry fidelity, the inherent latency `loopback` and a constant delay of the
video, as in `benchmarks/growth_onset.py`. Each finished point is appended to `mismatch_boundaries.csv`; a program that
was interrupted continues there. `docs/compensation.md` has the output.
"""

from __future__ import annotations

import argparse
import csv
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import median

from benchmarks.growth_onset import onset_ms
from benchmarks.mismatch_axes import AXES, KINDS, Axis
from matplotlib.figure import Figure

from lavt.config import RunConfig
from lavt.config_file import load_config, shipped
from lavt.experiment.boundary.bisection import Bracket, zero_bracket
from lavt.experiment.boundary.boundary import theoretical_ms, with_video_delay
from lavt.experiment.boundary.oscillation_growth import straight_growth
from lavt.experiment.report.figures.figure_style import COLOURS
from lavt.experiment.report.table_format import NOTHING

SEARCHED = ("delay", "steering_lag", "wheelbase", "understeer", "frame_rate", "speed")
SEARCHED_KINDS = ("predictive", "scheduled_lookahead", "lane_keeper")
"""Without `smith`: by the model, it is stable up to 2.8 s on all these axes, and no drive can be delayed so long."""
OWN_VALUE = {"speed": 30 / 3.6}
"""The exact value of an axis whose runs have other settings."""
MAX_DELAY_MS = 1900.0
"""The longest added delay of the video: the vehicle accepts no picture older than 2 s."""
MOST_MS = 3000.0
"""The longest critical delay that the model computes."""
PRECISION_MS = 2.0
COLUMNS = ("axis", "kind", "value", "theory_ms", "measured_ms", "outside")


@dataclass(frozen=True, slots=True)
class Point:
    """The boundary of one controller at one value of an axis, one row of the CSV."""

    axis: str
    kind: str
    value: float
    theory_ms: float | None
    """None: over 3 s."""
    measured_ms: float | None
    outside: str
    """`below` if the oscillation grows without added delay, `beyond` if it does not at the longest; else empty."""


def config_of(axis: Axis, kind: str, value: float) -> RunConfig:
    """Return the config of the drives of one point, with limits so wide that none depends on the delay."""
    changes = [
        "fidelity=geometry",
        "controller.preset=designed",
        f"controller.kind={kind}",
        f"{axis.key}={value}",
        "safety.stopping_distance_limit_m=200",
        "safety.speed_limit_mps=22.3",
    ]
    return load_config(RunConfig, shipped("configs/demo.yaml"), changes)


def search_point(name: str, kind: str, value: float) -> Point:
    """Find the boundary of one point."""
    config = config_of(AXES[name], kind, value)
    theory_ms = theoretical_ms(config)
    own_delays_ms: list[float] = []  # of each drive: the total delay minus the added delay of the video

    def growth(added_ms: float) -> float:
        total_ms, growth_per_s = straight_growth(with_video_delay(config, added_ms))
        own_delays_ms.append(total_ms - added_ms)
        return growth_per_s

    guess_ms = MAX_DELAY_MS if theory_ms is None else theory_ms
    bracket = zero_bracket(growth, guess_ms, MAX_DELAY_MS, PRECISION_MS)
    own_ms = median(own_delays_ms)
    low_ms, high_ms = (None if end_ms is None else end_ms + own_ms for end_ms in (bracket.low_ms, bracket.high_ms))
    outside = "below" if low_ms is None else "beyond" if high_ms is None else ""
    return Point(name, kind, value, theory_ms, onset_ms(Bracket(low_ms, high_ms)), outside)


def values_of(name: str) -> list[float]:
    """Return all values of an axis, with the exact one, sorted."""
    axis = AXES[name]
    exact = OWN_VALUE.get(name, axis.exact)
    further = [] if exact is None or any(abs(value - exact) < 0.01 for value in axis.values) else [exact]
    return sorted(float(value) for value in (*axis.values, *further))


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
                number(row["theory_ms"]),
                number(row["measured_ms"]),
                row["outside"],
            )
            for row in csv.DictReader(file)
        ]


def search_points(
    wanted: Sequence[tuple[str, str, float]], path: Path, *, search: Callable[[str, str, float], Point] = search_point
) -> list[Point]:
    """Search all wanted points that the CSV does not have yet, append them, and return the wanted ones."""
    found = {(point.axis, point.kind, point.value): point for point in read_points(path)}
    path.parent.mkdir(parents=True, exist_ok=True)
    if not path.exists():
        path.write_text(f"{','.join(COLUMNS)}\n")
    for place in wanted:
        if place not in found:
            found[place] = search(*place)
            with path.open("a", newline="") as file:
                csv.DictWriter(file, COLUMNS, lineterminator="\n").writerow(asdict(found[place]))
        print(table_row(found[place]), flush=True)
    return [found[place] for place in wanted]


def table_row(point: Point) -> str:
    """Return the Markdown row of one point."""
    theory = "over 3000 ms" if point.theory_ms is None else f"{point.theory_ms:.0f} ms"
    measured = point.outside or (NOTHING if point.measured_ms is None else f"{point.measured_ms:.0f} ms")
    return f"| {AXES[point.axis].title} | {point.value:g} | `{point.kind}` | {theory} | {measured} |"


def draw(points: Sequence[Point]) -> Figure:
    """Draw the delay over each axis: lines by the model, points as measured, triangles on the dotted line beyond it."""
    names = list(dict.fromkeys(point.axis for point in points))
    figure = Figure(figsize=(10.5, 6.2), dpi=100, layout="constrained")
    grid = figure.subplots(2, -(-len(names) // 2), squeeze=False, sharey=True)
    for axes, name in zip(grid.flat, names, strict=False):
        for kind, colour in zip(KINDS, COLOURS, strict=False):
            line = sorted(
                (point for point in points if (point.axis, point.kind) == (name, kind)), key=lambda point: point.value
            )
            if not line:
                continue
            theory_ms = [MOST_MS if point.theory_ms is None else point.theory_ms for point in line]
            axes.plot([point.value for point in line], theory_ms, color=colour, label=kind)
            for point in line:
                if point.measured_ms is not None:
                    axes.plot(point.value, point.measured_ms, "o", color=colour, markersize=4)
                elif point.outside == "beyond":
                    axes.plot(point.value, MAX_DELAY_MS, "^", color=colour, markersize=5)
        axes.set_title(AXES[name].title, fontsize=8, loc="left")
        axes.axhline(MAX_DELAY_MS, color="grey", linestyle=":", linewidth=1)
        axes.set_ylim(0, MOST_MS)
        axes.grid(alpha=0.3)
    for axes in grid[:, 0]:
        axes.set_ylabel("total delay at the onset / ms")
    for axes in list(grid.flat)[len(names) :]:
        axes.set_visible(False)
    figure.legend(*grid[0][0].get_legend_handles_labels(), fontsize=8, loc="outside lower center", ncols=4)
    return figure


def main() -> None:
    """Search the points, print them as a Markdown table, and draw them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--axis", choices=SEARCHED, action="append")
    parser.add_argument("--kind", choices=KINDS, action="append")
    parser.add_argument("--out", type=Path, default=Path("out/mismatch_boundaries"))
    parser.add_argument("--picture", type=Path, default=None, help="default: mismatch_boundaries.png in --out")
    options = parser.parse_args()
    wanted = [
        (name, kind, value)
        for kind in options.kind or SEARCHED_KINDS
        for name in options.axis or SEARCHED
        for value in values_of(name)
    ]
    print("| axis | value | controller | by the model | measured |")
    print("|---" * 5 + "|")
    points = search_points(wanted, options.out / "mismatch_boundaries.csv")
    picture: Path = options.picture or options.out / "mismatch_boundaries.png"
    picture.parent.mkdir(parents=True, exist_ok=True)
    draw(points).savefig(picture)
    print(f"{picture}: {picture.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
