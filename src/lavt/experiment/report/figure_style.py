"""What all figures of a report share: sizes, colours, markers, legends."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

Conditions = Mapping[str, Mapping[str, Any]]
"""A summary's `conditions` or `real`."""

Colours = Mapping[str, Any]
"""The colour of each condition."""

KINDS = {"virtual": ("o", "virtual time"), "real": ("s", "real time")}
"""Marker and name of the two ways a run can be driven; real runs are hollow, so that nobody takes one for the other."""

COLOURS = ("#0072b2", "#56b4e9", "#009e73", "#e69f00", "#d55e00", "#cc79a7")
"""Told apart with any colour vision, on white and on black (Okabe and Ito, "Color universal design")."""

WIDTH_IN = 8.0
LINE_CHARACTERS = 115
"""So many small ones fit below a figure, with a handle for 5 of them."""

SMALL = 8
"""Points of a small text."""

ASIDE = {
    "virtual": ((7, -2), "left", "top", "black"),
    "real": ((-7, 2), "right", "bottom", "black"),
    "paper": ((-7, 2), "right", "bottom", "0.45"),
    "group": ((7, 2), "left", "bottom", "black"),
}
"""Where the names of a kind of points go, in points of text and by which edges, and their colour."""

NAMES = 14
"""So many names of points fit above each other in a panel, and beside each other."""

Point = tuple[str, float, float, Sequence[float] | None]
"""A condition, its place on x and on y, and the interval of y."""


def condition_colours(names: Iterable[str]) -> dict[str, Any]:
    """Give each condition a colour of its own, to be used in every figure of a report."""
    ordered = sorted(set(names))
    if len(ordered) <= len(COLOURS):
        return dict(zip(ordered, COLOURS, strict=False))
    places = np.linspace(0.05, 0.95, len(ordered))
    return {name: colormaps["turbo"](place) for name, place in zip(ordered, places, strict=True)}


def new_figure(height_in: float, width_in: float = WIDTH_IN) -> Figure:
    """Begin a figure that is laid out when it is drawn."""
    return Figure(figsize=(width_in, height_in), layout="constrained")


def tidy(axes: Axes, x_label: str, y_label: str, title: str = "") -> None:
    """Label the axes, and leave away what does not help to read them."""
    axes.set_xlabel(x_label)
    axes.set_ylabel(y_label)
    axes.set_title(title, loc="left", fontsize=10)
    axes.grid(visible=True, alpha=0.25)
    axes.spines[["top", "right"]].set_visible(False)


def marker(kind: str, colour: Any) -> dict[str, Any]:
    """Give the style of a point of runs driven in this kind of time."""
    symbol, label = KINDS[kind]
    face = colour if kind == "virtual" else "white"
    return {"marker": symbol, "markerfacecolor": face, "markeredgecolor": colour, "color": colour, "label": label}


def beside(kind: str) -> dict[str, Any]:
    """Say where names go and in which colour: none lies on those of another kind at the same place, if it can be."""
    offset, side, edge, colour = ASIDE[kind]
    return {
        "xytext": offset, "ha": side, "va": edge, "color": colour, "textcoords": "offset points", "fontsize": SMALL,
    }  # fmt: skip


def near_each_other(points: Sequence[Point], axes: Axes) -> list[list[Point]]:
    """Put points together whose names, beside each of them in `axes`, would lie on each other; the upper are first."""
    reach_x, reach_y = ((high - low) / NAMES for low, high in (axes.get_xlim(), axes.get_ylim()))
    together: list[list[Point]] = []
    for point in sorted(points, key=lambda point: (-point[2], point[0])):
        near = (
            each
            for each in together
            if abs(each[-1][1] - point[1]) <= reach_x and abs(each[-1][2] - point[2]) <= reach_y
        )
        place = next(near, None)
        if place is None:
            together.append([point])
        else:
            place.append(point)
    return together


def legend_below(figure: Figure, handles: list[Any]) -> None:
    """Put a legend below all panels."""
    lengths = [len(str(handle.get_label())) + 5 for handle in handles]
    columns = len(handles) if sum(lengths) <= LINE_CHARACTERS else max(1, LINE_CHARACTERS // max(lengths))
    figure.legend(handles=handles, fontsize=SMALL, ncols=columns, loc="outside lower center", frameon=False)


def kind_handles(kinds: Iterable[str]) -> list[Line2D]:
    """Say which marker is which kind of time, in grey, because colours are for conditions."""
    return [Line2D([], [], linestyle="none", **marker(kind, "0.4")) for kind in kinds]


def condition_handles(names: Iterable[str], colours: Colours) -> list[Line2D]:
    """Say which colour is which condition."""
    return [Line2D([], [], color=colours[name], linewidth=2, label=name) for name in names]
