"""Print the tables of docs/safe_stop.md and draw its picture: safe stops in every curve of the six routes.

    python -m benchmarks.safe_stop [PICTURE]        # at the top of the repository

About two minutes on one core. The stops are those of tests/safety/test_safe_stop.py.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from itertools import groupby
from operator import itemgetter

from matplotlib.figure import Figure
from tests.safety.stops import ALLOWED_M, ROUTES, Curve, Stop, stops

from lavt.experiment.report.figure_style import COLOURS, new_figure

Done = list[tuple[Curve, Stop, Stop]]
FOLLOWED, HELD = "along the path", "wheel held"


def count_outside(done: Sequence[Stop]) -> int:
    """Return the number of stops that left the lane by more than the allowed distance."""
    return sum(stop.beyond_m > ALLOWED_M for stop in done)


def worst(done: Sequence[Stop]) -> str:
    """Return the largest distance of a corner beyond the lane, with the station of its last command."""
    stop = max(done, key=lambda each: each.beyond_m)
    return f"{stop.beyond_m:+.2f} m, at {stop.at_m:.0f} m"


def row(curve: Curve, done: Done) -> str:
    """Return a row of the table: a curve with the worst of its stops."""
    side = "left" if curve.radius_m > 0 else "right"
    followed, held = [stop for _, stop, _ in done], [stop for _, _, stop in done]
    return (
        f"| {curve.route} | {curve.from_m:.0f} to {curve.to_m:.0f} m | {side}, {abs(curve.radius_m):.0f} m "
        f"| {len(done)} | {worst(followed)} | {worst(held)} | {count_outside(held)} |"
    )


def draw(done: Done) -> Figure:
    """Draw the distance beyond the lane of each stop over the station of its last command, a panel for each route."""
    figure = new_figure(5.0)
    axes = figure.subplots(3, 2, sharey=True).ravel()
    for axis, route in zip(axes, ROUTES, strict=True):
        for curve, each in groupby((each for each in done if each[0].route == route), key=itemgetter(0)):
            _, followed, held = zip(*each, strict=True)
            axis.axvspan(curve.from_m, curve.to_m, color="0.92")
            for these, name, colour in ((followed, FOLLOWED, COLOURS[0]), (held, HELD, COLOURS[4])):
                places = [stop.at_m for stop in these], [stop.beyond_m for stop in these]
                axis.plot(*places, color=colour, label=name)
        axis.axhline(0.0, color="0.5", linewidth=0.8)
        axis.axhline(ALLOWED_M, color="black", linewidth=0.8, linestyle="--")
        axis.set_title(f"route {route}", fontsize="medium")
    for axis in axes[-2:]:
        axis.set_xlabel("last command at (m along the route)")
    axes[2].set_ylabel("corner of the body beyond the lane's edge (m)")
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles[:2], labels[:2], loc="outside lower center", ncols=2)
    return figure


def main() -> None:
    """Print the tables of all stops, and draw the picture if a file is given."""
    done = [each for route in ROUTES for each in stops(route)]
    print("| route | curve | bend, radius | stops | worst along the path | worst with the wheel held | of these out |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for curve, each in groupby(done, key=itemgetter(0)):
        print(row(curve, list(each)))
    followed = [stop for _, stop, _ in done]
    speeds_kmh = [stop.speed_mps * 3.6 for stop in followed]
    print(f"\nlast command at {min(speeds_kmh):.1f} to {max(speeds_kmh):.1f} km/h")
    print(f"distance from the last command to standstill: at most {max(stop.covered_m for stop in followed):.1f} m")
    print("\n| condition | stops | worst along the path | worst with the wheel held | of these out |")
    print("| --- | --- | --- | --- | --- |")
    for condition in ("L1", "L3", "L5"):
        _, delayed, held = zip(*stops("a", condition), strict=True)
        print(f"| {condition} | {len(held)} | {worst(delayed)} | {worst(held)} | {count_outside(held)} |")
    for picture in sys.argv[1:]:
        draw(done).savefig(picture, dpi=110)


if __name__ == "__main__":
    main()
