"""Print the tables of docs/safe_stop.md and draw its picture: safe stops in every curve of the six routes.

    python -m benchmarks.safe_stop [PICTURE]        # at the top of the repository

It takes about two minutes on one core. The stops are those of tests/safety/test_safe_stop.py.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from itertools import groupby
from operator import itemgetter

from matplotlib.figure import Figure
from tests.safety.stops import ALLOWED_BEYOND_M, ROUTES, Curve, Stop, StopPair, stops

from lavt.experiment.report.figure_style import COLOURS, new_figure

CurveStops = list[StopPair]
FOLLOWING, HOLDING = "along the path", "wheel held"


def count_beyond(curve_stops: Sequence[Stop]) -> int:
    """Return how many stops left the lane by more than the allowed distance."""
    return sum(stop.beyond_m > ALLOWED_BEYOND_M for stop in curve_stops)


def format_worst(stops_of_kind: Sequence[Stop]) -> str:
    """Format how far a corner of the body got beyond the lane, and where the last command was."""
    stop = max(stops_of_kind, key=lambda stop: stop.beyond_m)
    return f"{stop.beyond_m:+.2f} m, at {stop.at_m:.0f} m"


def format_row(curve: Curve, curve_stops: CurveStops) -> str:
    """Format a table row: a curve and the worst of its stops."""
    side = "left" if curve.radius_m > 0 else "right"
    following, holding = [stop for _, stop, _ in curve_stops], [stop for _, _, stop in curve_stops]
    return (
        f"| {curve.route} | {curve.from_m:.0f} to {curve.to_m:.0f} m | {side}, {abs(curve.radius_m):.0f} m "
        f"| {len(curve_stops)} | {format_worst(following)} | {format_worst(holding)} | {count_beyond(holding)} |"
    )


def draw(curve_stops: CurveStops) -> Figure:
    """Plot how far each stop got beyond the lane over the position of its last command, with a panel per route."""
    figure = new_figure(5.0)
    axes = figure.subplots(3, 2, sharey=True).ravel()
    for axis, route in zip(axes, ROUTES, strict=True):
        of_route = (of_curve for of_curve in curve_stops if of_curve[0].route == route)
        for curve, of_curve in groupby(of_route, key=itemgetter(0)):
            _, following, holding = zip(*of_curve, strict=True)
            axis.axvspan(curve.from_m, curve.to_m, color="0.92")
            for group, name, colour in ((following, FOLLOWING, COLOURS[0]), (holding, HOLDING, COLOURS[4])):
                at_m, beyond_m = [stop.at_m for stop in group], [stop.beyond_m for stop in group]
                axis.plot(at_m, beyond_m, color=colour, label=name)
        axis.axhline(0.0, color="0.5", linewidth=0.8)
        axis.axhline(ALLOWED_BEYOND_M, color="black", linewidth=0.8, linestyle="--")
        axis.set_title(f"route {route}", fontsize="medium")
    for axis in axes[-2:]:
        axis.set_xlabel("last command at (m along the route)")
    axes[2].set_ylabel("corner of the body beyond the lane's edge (m)")
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles[:2], labels[:2], loc="outside lower center", ncols=2)
    return figure


def main() -> None:
    """Compute all stops, print the tables, and draw the picture if a file is named."""
    curve_stops = [curve_stop for route in ROUTES for curve_stop in stops(route)]
    print(
        "| route | curve | bend, radius | stops | worst along the path | worst with a constant angle | of these out |"
    )
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for curve, of_curve in groupby(curve_stops, key=itemgetter(0)):
        print(format_row(curve, list(of_curve)))
    following = [stop for _, stop, _ in curve_stops]
    speeds_kmh = [stop.speed_mps * 3.6 for stop in following]
    print(f"\nlast command at {min(speeds_kmh):.1f} to {max(speeds_kmh):.1f} km/h")
    print(f"distance from the last command to standstill: at most {max(stop.covered_m for stop in following):.1f} m")
    print("\n| condition | stops | worst along the path | worst with a constant angle | of these out |")
    print("| --- | --- | --- | --- | --- |")
    for condition in ("L1", "L3", "L5"):
        _, delayed, holding = zip(*stops("a", condition), strict=True)
        worst = f"{format_worst(delayed)} | {format_worst(holding)}"
        print(f"| {condition} | {len(holding)} | {worst} | {count_beyond(holding)} |")
    for picture in sys.argv[1:]:
        draw(curve_stops).savefig(picture, dpi=110)


if __name__ == "__main__":
    main()
