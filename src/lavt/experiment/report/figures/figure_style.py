"""Sizes, colours, markers and legends that all figures of a report share."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

Conditions = Mapping[str, Mapping[str, Any]]
"""The summary of each condition by its name: the value of `conditions` or `real` in `summary.json`."""

Colours = Mapping[str, Any]
"""The colour of each condition."""

KINDS = {"virtual": ("o", "virtual time"), "real": ("s", "real time")}
"""Marker and label of each kind of time. The markers of runs in real time are hollow (`marker`)."""

COLOURS = ("#0072b2", "#56b4e9", "#009e73", "#e69f00", "#d55e00", "#cc79a7")
"""Colours that people with any colour vision can distinguish (Okabe and Ito, "Color universal design")."""

WIDTH_IN = 3.5
"""Width of each figure: that of a phone, which then shows small text as 11 CSS pixels, and of a column of a paper.
Wider screens show several figures next to each other."""
LINE_CHARACTERS = 48
"""The number of small characters that fit in a line below a figure."""
HANDLE_CHARACTERS = 5
"""The width of a legend handle, in small characters."""

SMALL_TEXT_POINTS = 8
"""Size of the smallest text, and of all text under `SETTINGS`."""

SETTINGS: Any = {
    "font.size": SMALL_TEXT_POINTS,
    "axes.titlesize": "medium",
    "figure.labelsize": "medium",
    "text.parse_math": False,  # a dollar sign in a name does not begin a formula
}
"""The settings of Matplotlib under which the report makes its figures."""


class FigurePoint(NamedTuple):
    """The point of a condition in a figure, with the interval of y."""

    name: str
    x: float
    y: float
    interval: Sequence[float] | None


def shown_interval(
    entry: Mapping[str, Any], interval: Sequence[float] | None, scale: float = 1.0
) -> list[float] | None:
    """Return the interval multiplied by `scale`; nothing for a single run, which is an example."""
    return [bound * scale for bound in interval] if interval and entry.get("runs") != 1 else None


def draw_point(axes: Axes, point: FigurePoint, style: Mapping[str, Any]) -> None:
    """Draw a point, with its interval if it has one."""
    bars = None
    if point.interval is not None:
        low, high = point.interval
        bars = [[max(point.y - low, 0.0)], [max(high - point.y, 0.0)]]
    axes.errorbar(point.x, point.y, yerr=bars, capsize=3, linestyle="none", elinewidth=1, **style)


def condition_colours(names: Iterable[str]) -> dict[str, Any]:
    """Return a distinct colour for each condition, for use in every figure of a report."""
    ordered = sorted(set(names))
    if len(ordered) <= len(COLOURS):
        return dict(zip(ordered, COLOURS, strict=False))
    shades = np.linspace(0.05, 0.95, len(ordered))
    return {name: colormaps["turbo"](shade) for name, shade in zip(ordered, shades, strict=True)}


def new_figure(height_in: float) -> Figure:
    """Return a new figure whose layout is computed when it is drawn."""
    return Figure(figsize=(WIDTH_IN, height_in), layout="constrained")


def tidy(axes: Axes, x_label: str, y_label: str, title: str = "") -> None:
    """Label the axes, add a light grid, and remove the upper and right border."""
    axes.set_xlabel(x_label)
    axes.set_ylabel(y_label)
    axes.set_title(title, loc="left")
    axes.grid(visible=True, alpha=0.25)
    axes.spines[["top", "right"]].set_visible(False)


def marker(kind: str, colour: Any) -> dict[str, Any]:
    """Return the style of a point for runs in a kind of time (`KINDS`)."""
    symbol, label = KINDS[kind]
    face = colour if kind == "virtual" else "white"
    return {"marker": symbol, "markerfacecolor": face, "markeredgecolor": colour, "color": colour, "label": label}


def legend_below(figure: Figure, handles: list[Any]) -> None:
    """Add a legend below all panels."""
    lengths = [len(str(handle.get_label())) + HANDLE_CHARACTERS for handle in handles]
    columns = len(handles) if sum(lengths) <= LINE_CHARACTERS else max(1, LINE_CHARACTERS // max(lengths))
    spacing = {"handlelength": 1.6, "columnspacing": 1.0}  # so that a handle takes `HANDLE_CHARACTERS`
    style: dict[str, Any] = {"fontsize": SMALL_TEXT_POINTS, "frameon": False, **spacing}
    figure.legend(handles=handles, ncols=columns, loc="outside lower center", **style)


def kind_handles(kinds: Iterable[str]) -> list[Line2D]:
    """Return the legend handles of the kinds of time, in grey because colours denote conditions."""
    return [Line2D([], [], linestyle="none", **marker(kind, "0.4")) for kind in kinds]


def condition_handles(names: Iterable[str], colours: Colours) -> list[Line2D]:
    """Return the legend handles of the conditions."""
    return [Line2D([], [], color=colours[name], linewidth=2, label=name) for name in names]
