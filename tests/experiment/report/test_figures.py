from __future__ import annotations

from itertools import combinations
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.container import ErrorbarContainer
from matplotlib.text import Annotation

from lavt.experiment.report.figures.figure_style import (
    SETTINGS,
    FigurePoint,
    condition_colours,
    condition_handles,
    legend_below,
    new_figure,
)
from lavt.experiment.report.figures.headline_figure import headline_figure
from lavt.experiment.report.figures.latency_figures import degradation_figure, presets_figure
from lavt.experiment.report.figures.point_names import name_points
from lavt.experiment.report.figures.run_figures import cross_track_figure
from lavt.experiment.statistics.paper_results import paper

COLOURS = condition_colours(["L2", "L3", "L4"])


def entry(loop_ms: float, rate: float, p95_m: float) -> dict[str, Any]:
    return {
        "loop_ms": {"p50": loop_ms},
        "completion_rate": rate,
        "completion_interval": [rate - 0.1, rate + 0.1],
        "p95_m": p95_m,
        "p95_interval": [p95_m - 0.5, p95_m + 0.5],
        "p95_common_m": 1.0,
        "p95_common_interval": [0.75, 1.5],
    }


CONDITIONS = {"L2": entry(222.4, 0.9, 2.5), "L3": entry(297.6, 0.467, 6.0), "L4": entry(297.4, 0.533, 6.3)}


def point_names(axes: Axes) -> list[str]:
    return [text.get_text() for text in axes.texts if isinstance(text, Annotation)]


def error_bars(axes: Axes) -> list[list[float]]:
    """Return the low and the high end of each error bar."""
    bars = [
        container.lines[2][0]
        for container in axes.containers
        if isinstance(container, ErrorbarContainer) and container.has_yerr
    ]
    return [[round(float(y), 9) for _, y in bar.get_segments()[0]] for bar in bars]


def test_names_never_overlap() -> None:
    """However the points lie, no two names overlap or leave the panel, and each point has its name."""
    generator = np.random.default_rng(5)
    for _ in range(5):
        figure = new_figure(3.5)
        axes = figure.subplots()
        axes.set(xlim=(0, 400), ylim=(-14, 109))
        points = {
            kind: [
                FigurePoint(f"L{number}", 150 + 50 * x, 50 + 20 * y, None)
                for number, (x, y) in enumerate(generator.normal(size=(6, 2)))
            ]
            for kind in ("virtual", "paper")
        }
        name_points(figure, [(axes, kind, members) for kind, members in points.items()])
        boxes = [text.get_window_extent() for text in axes.texts]
        assert not [pair for pair in combinations(boxes, 2) if pair[0].overlaps(pair[1])]
        assert all(axes.get_window_extent().contains(*corner) for box in boxes for corner in box.corners())
        names = ", ".join(point_names(axes)).split(", ")
        assert sorted(names) == sorted(point.name for members in points.values() for point in members)


def test_points_at_the_same_place_share_a_name() -> None:
    """Points of one kind at the same place share a name; the paper's point there has its own name."""
    figure = new_figure(3.5)
    axes = figure.subplots()
    axes.set(xlim=(0, 400), ylim=(0, 100))
    points = [FigurePoint(name, 200.0, 50.0, None) for name in ("L4", "L3")]
    name_points(figure, [(axes, "virtual", points), (axes, "paper", points[:1])])
    assert point_names(axes) == ["L3, L4", "L4"]


def test_a_legend_is_not_cut_off() -> None:
    """A legend of six short names is inside its figure."""
    figure = new_figure(2.0)
    figure.subplots()
    names = [f"L{number}" for number in range(6)]
    with rc_context(SETTINGS):
        legend_below(figure, list(condition_handles(names, condition_colours(names))))
        figure.draw_without_rendering()
    (legend,) = figure.legends
    box = legend.get_window_extent()
    assert figure.bbox.x0 <= box.x0
    assert box.x1 <= figure.bbox.x1


def test_the_degradation_figure_has_all_intervals_and_names() -> None:
    """LAVT's points and the paper's completion have intervals, and all points have names."""
    paper_conditions = {name: condition for name, condition in paper()["conditions"].items() if name in CONDITIONS}
    completion, error = degradation_figure({"virtual": CONDITIONS}, paper_conditions, COLOURS).axes
    paper_intervals = [
        [round(100 * end, 9) for end in condition["completion_interval"]] for condition in paper_conditions.values()
    ]
    assert error_bars(completion) == [*paper_intervals, [80.0, 100.0], [36.7, 56.7], [43.3, 63.3]]
    assert error_bars(error) == [[2.0, 3.0], [5.5, 6.5], [5.8, 6.8], *[[0.75, 1.5]] * 3]
    assert point_names(completion) == ["L2", "L3", "L4", "L2", "L3", "L4"]
    assert point_names(error) == ["L2", "L3, L4", "L2", "L3", "L4"]


def test_a_single_run_has_no_interval() -> None:
    """One run for each condition is an example: its points have no bars."""
    single = {name: {**condition, "runs": 1} for name, condition in CONDITIONS.items()}
    completion, _ = degradation_figure({"virtual": single}, {}, COLOURS).axes
    assert error_bars(completion) == []


def test_conditions_with_overlapping_points_are_named() -> None:
    """The comparison of groups names conditions whose points are at the same place, and no others."""
    conditions = {**CONDITIONS, "L4": CONDITIONS["L3"]}
    completion, error = presets_figure({"one": conditions, "other": {"L2": CONDITIONS["L2"]}}, COLOURS).axes
    assert point_names(completion) == point_names(error) == ["L3, L4"]


def test_the_lowest_panel_has_an_x_label() -> None:
    """The routes are below each other, and only the last has an x label."""
    panels = cross_track_figure({"a": [], "b": [], "c": []}, COLOURS, []).axes[:3]
    assert [axes.get_xlabel() for axes in panels] == ["", "", "distance along the route (m)"]
    assert len({axes.get_position().x0 for axes in panels}) == 1


@pytest.mark.parametrize(("kept", "drawn_m"), [({"lane_width_m": 3.5}, [-2.0, 2.0]), (None, [])])
def test_the_limits_of_the_own_lane_are_drawn(kept: dict[str, float] | None, drawn_m: list[float]) -> None:
    """Dashed lines are half a lane and the margin of 0.25 m from the centre, if the lane is known."""
    truth = SimpleNamespace(floats=lambda _: np.array([0.0, 0.1]))
    drive: Any = SimpleNamespace(truth=truth, condition="L2", result={"ending": "completed", "lane_kept": kept})
    (axes,) = cross_track_figure({"a": [drive]}, COLOURS, [drive]).axes
    dashed = [line for line in axes.get_lines() if line.get_linestyle() == "--"]
    assert [np.asarray(line.get_ydata()).max() for line in dashed] == drawn_m
    low, high = axes.get_ylim()
    assert all(low < limit_m < high for limit_m in drawn_m)


def test_names_are_inside_their_panel() -> None:
    """The name of a point next to an edge of its panel is on the other side of the point; no label is cut off."""
    own_lane = {"own_lane_completion_rate": 0.5, "own_lane_completion_interval": [0.4, 0.6]}
    conditions = {
        name: {**entry(loop_ms, 0.5, 3.0), **own_lane} for name, loop_ms in (("L2", 9.0), ("L3", 200.0), ("L4", 390.0))
    }
    for kind in ("virtual", "real"):
        with rc_context(SETTINGS):
            figure = headline_figure({kind: conditions}, {}, COLOURS)
            figure.draw_without_rendering()
        for axes in figure.axes:
            label = axes.yaxis.label.get_window_extent()
            assert figure.bbox.y0 <= label.y0
            assert label.y1 <= figure.bbox.y1
            names = [text for text in axes.texts if isinstance(text, Annotation)]
            assert len(names) == 3
            for text in names:
                box, panel = text.get_window_extent(), axes.get_window_extent()
                assert panel.x0 <= box.x0
                assert box.x1 <= panel.x1


def test_a_name_is_written_once() -> None:
    """A point in real time next to the point of its condition in virtual time is not named again."""
    near, far = entry(224.0, 0.91, 2.6), entry(300.0, 0.1, 9.0)
    completion, error = headline_figure({"virtual": CONDITIONS, "real": {"L2": near, "L3": far}}, {}, COLOURS).axes
    assert sorted(point_names(completion)) == ["L2", "L3", "L3, L4"]
    assert point_names(error).count("L2") == 1
