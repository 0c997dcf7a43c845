"""Print the tables of docs/safe_stop.md and draw its picture: safe stops in every curve of the six routes.

    python -m benchmarks.safe_stop [PICTURE]        # at the top of the repository

It takes about two minutes on one core. The stops are those of tests/safety/test_safe_stop.py.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from itertools import groupby
from operator import attrgetter

from matplotlib.figure import Figure
from tests.safety.stops import ALLOWED_BEYOND_M, ROUTES, Curve, Stop, StopPair, stops

from lavt.experiment.report.figures.figure_style import COLOURS, new_figure

FOLLOWED, HELD = "along the path", "wheel held"
"""Labels of the two kinds of stops: the vehicle follows the last command's path, or keeps the steering angle."""


def count_beyond(stops_of_kind: Sequence[Stop]) -> int:
    """Return how many stops left the lane by more than the allowed distance."""
    return sum(stop.beyond_m > ALLOWED_BEYOND_M for stop in stops_of_kind)


def format_worst(stops_of_kind: Sequence[Stop]) -> str:
    """Format the worst stop: how far a corner of the body got beyond the lane, and where the last command came."""
    worst = max(stops_of_kind, key=lambda stop: stop.beyond_m)
    return f"{worst.beyond_m:+.2f} m, at {worst.at_m:.0f} m"


def format_row(curve: Curve, pairs: Sequence[StopPair]) -> str:
    """Format a table row: a curve and the worst of its stops."""
    side = "left" if curve.radius_m > 0 else "right"
    followed, held = [pair.followed for pair in pairs], [pair.held for pair in pairs]
    return (
        f"| {curve.route} | {curve.from_m:.0f} to {curve.to_m:.0f} m | {side}, {abs(curve.radius_m):.0f} m "
        f"| {len(pairs)} | {format_worst(followed)} | {format_worst(held)} | {count_beyond(held)} |"
    )


def draw(pairs: Sequence[StopPair]) -> Figure:
    """Plot for each stop how far the car got beyond the lane, over the position of its last command.

    The figure has a panel for each route.
    """
    figure = new_figure(5.0)
    axes = figure.subplots(3, 2, sharey=True).ravel()
    for axis, route in zip(axes, ROUTES, strict=True):
        pairs_on_route = (pair for pair in pairs if pair.curve.route == route)
        for curve, pairs_in_curve in groupby(pairs_on_route, key=attrgetter("curve")):
            _, followed, held = zip(*pairs_in_curve, strict=True)
            axis.axvspan(curve.from_m, curve.to_m, color="0.92")
            for stops_of_kind, label, colour in ((followed, FOLLOWED, COLOURS[0]), (held, HELD, COLOURS[4])):
                at_m, beyond_m = [stop.at_m for stop in stops_of_kind], [stop.beyond_m for stop in stops_of_kind]
                axis.plot(at_m, beyond_m, color=colour, label=label)
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
    pairs = [pair for route in ROUTES for pair in stops(route)]
    print(
        "| route | curve | bend, radius | stops | worst along the path | worst with a constant angle "
        "| constant angle: over 0.3 m |"
    )
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for curve, pairs_in_curve in groupby(pairs, key=attrgetter("curve")):
        print(format_row(curve, list(pairs_in_curve)))
    speeds_kmh = [pair.followed.speed_mps * 3.6 for pair in pairs]
    covered_m = [pair.followed.covered_m for pair in pairs]
    print(f"\nlast command at {min(speeds_kmh):.1f} to {max(speeds_kmh):.1f} km/h")
    print(f"distance between the last command and standstill: at most {max(covered_m):.1f} m")
    print("\n| condition | stops | worst along the path | worst with a constant angle | constant angle: over 0.3 m |")
    print("| --- | --- | --- | --- | --- |")
    for condition in ("L1", "L3", "L5"):
        _, followed, held = zip(*stops("a", condition), strict=True)
        worst = f"{format_worst(followed)} | {format_worst(held)}"
        print(f"| {condition} | {len(held)} | {worst} | {count_beyond(held)} |")
    for picture in sys.argv[1:]:
        draw(pairs).savefig(picture, dpi=110)


if __name__ == "__main__":
    main()
