from __future__ import annotations

import copy
import csv
import io
import json
import re
from collections.abc import Callable, Sequence
from html import unescape
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
from matplotlib.figure import Figure

from lavt.experiment.analysis.results import run_result, write_json
from lavt.experiment.report import boundary_section
from lavt.experiment.report.condition_sections import (
    conditions_parts,
    contrast_parts,
    error_table_parts,
    latency_table_parts,
)
from lavt.experiment.report.condition_tables import COMPLETED_P95, FOLLOWED_P95
from lavt.experiment.report.figures.figure_style import condition_colours
from lavt.experiment.report.figures.run_figures import drawn_indexes
from lavt.experiment.report.figures.sweep_figures import axis_figure
from lavt.experiment.report.first_screen import first_parts
from lavt.experiment.report.groups import differing_settings, is_in_group, sort_groups, title_of
from lavt.experiment.report.report import write_report
from lavt.experiment.report.sections import (
    ReportContext,
    axis_parts,
    degradation_parts,
    group_parts,
    injected_parts,
    lane_change_parts,
    route_parts,
    run_parts,
    stage_parts,
    survival_parts,
    validity_parts,
)
from lavt.experiment.report.table_format import NOTHING
from lavt.experiment.statistics.summary import summarize
from lavt.recording.record import read_record

MakeRun = Callable[..., Path]

INJECTED = {"L0": (0, 0), "L1": (75, 0), "L2": (150, 0), "L3": (225, 0), "L4": (150, 75), "L5": (225, 100)}

NEW_CONDITION_KEYS = (
    "endings",
    "routes",
    "completed_in_own_lane",
    "own_lane_completion_rate",
    "own_lane_completion_interval",
    "invasion_free_completion_rate",
    "followed_p95_m",
    "followed_p95_route_balanced_m",
    "p95_route_balanced_m",
    "p95_routes",
    "by_road",
    "own_lane_share",
    "followed_unknown_share",
    "followed_changes_per_run",
    "occupied_changes_per_run",
    "p95_common_m",
    "p95_common_interval",
    "p95_worst_rank_m",
    "collisions_per_run_interval",
    "collisions_per_km",
    "lane_invasions_per_km",
    "heading_rms_rad",
    "lateral_jerk_rms_mps3",
    "steering_rate_rms_radps",
    "steering_reversals_per_s",
    "oscillation_hz",
    "mae_m",
    "rms_m",
    "max_m",
    "picture_age_ms",
    "age_at_actuation_ms",
    "page_decoded_ms",
    "page_shown_ms",
    "stages_ms",
    "survival",
)
"""Keys that a summary of an older version lacks."""


def run_of(condition: str, route: str = "a", repetition: int = 0, **changes: Any) -> dict[str, Any]:
    """Return a hand-made entry of a run: runs under L0 to L2 are completed, runs under L3 to L5 collide halfway."""
    video, control = INJECTED[condition]
    completed = video + control < 200
    percentiles = {"p5": 1.0, "p50": 62.0 + video, "p95": 90.0 + video, "bound": 0.2, "n": 100}
    run = {
        "run": f"{route}_{condition}_{repetition}",
        "time": "virtual",
        "fidelity": "geometry",
        "injection": "model",
        "inherent": "paper_wifi5",
        "route": route,
        "condition": condition,
        "controller": "lane_keeper",
        "preset": "paper_calibrated",
        "driver": "lane_keeper",
        "repetition": repetition,
        "seed": 7 + repetition,
        "injected_ms": {"video": float(video), "control": float(control)},
        "valid": True,
        "invalid_reasons": [],
        "ending": "completed" if completed else "collision",
        "distance_m": 100.0 if completed else 50.0,
        "route_length_m": 100.0,
        "duration_s": 12.0,
        "p95_m": 0.1,
        "p95_by_10m": [0.1] * (10 if completed else 5),
        "mae_m": 0.1,
        "rms_m": 0.1,
        "max_m": 0.2,
        "heading_rms_rad": 0.01,
        "steering_reversals_per_s": 0.2,
        "oscillation_hz": None,
        "collisions": 0 if completed else 1,
        "lane_invasions": 0,
        "collisions_per_km": 0.0,
        "lane_invasions_per_km": 0.0,
        "loop_ms": {**percentiles, "p5": 60.0, "p50": 72.0 + video + control},
        "tau_v_ms": percentiles,
        "tau_c_ms": {**percentiles, "p50": 9.0 + control},
        "picture_age_ms": {"mean": 90.0 + video + control, "p95": 120.0},
        "age_at_actuation_ms": {**percentiles},
        "stages_ms": [{"node": "camera", "stage": "encode", "p50": 2.0, "p95": 3.0, "n": 9}],
    }
    return {**run, **changes}


def campaign(**changes: Any) -> list[dict[str, Any]]:
    """Return three runs under each condition on each of two routes."""
    return [
        run_of(condition, route, repetition, **changes)
        for route in ("a", "b_key")
        for condition in INJECTED
        for repetition in range(3)
    ]


def report_of(summary: dict[str, Any], directory: Path) -> ReportContext:
    names = {str(run["condition"]) for run in summary["runs"]}
    return ReportContext(summary, directory, condition_colours(names))


SECTIONS: dict[str, Callable[[ReportContext], Sequence[str]]] = {
    "first": lambda report: first_parts(report, []),
    "validity": validity_parts,
    "conditions": conditions_parts,
    "latencies": latency_table_parts,
    "errors": error_table_parts,
    "contrasts": contrast_parts,
    "injected": injected_parts,
    "degradation": degradation_parts,
    "survival": survival_parts,
    "stages": lambda report: stage_parts(report, {}),
    "groups": group_parts,
    "axes": axis_parts,
    "routes": route_parts,
    "runs": run_parts,
    "lane_changes": lane_change_parts,
}


def parts_of(report: ReportContext, *names: str) -> dict[str, str]:
    """Return the HTML of the named sections by name, or of all sections if none is named.

    The figures are made, but their files are empty: to draw them takes most of the time of a section.
    """
    with patch.object(Figure, "savefig", save_empty):
        return {name: "\n".join(SECTIONS[name](report)) for name in names or SECTIONS}


def save_empty(_figure: Figure, file: Path | io.StringIO, **_options: Any) -> None:
    """Write an empty file instead of a figure."""
    if isinstance(file, Path):
        file.touch()


def text_of(html: str) -> str:
    return re.sub(r"\s+", " ", unescape(re.sub("<[^>]*>", " ", html)))


def test_results_are_compared_with_the_paper(tmp_path: Path) -> None:
    """The tables have the paper's completion, latency and error, and the p values of its contrasts by Fisher's test."""
    parts = parts_of(report_of(summarize(campaign(), None), tmp_path), "conditions", "latencies", "contrasts")
    assert "13.15" in parts["conditions"]
    titles = re.findall("<th[^>]*>(.*?)</th>", unescape(parts["conditions"] + parts["latencies"]))
    assert {"the paper's completed", "the paper's τ video ms", "the paper's τ control ms"} < set(titles)
    row = re.search(r"<tr><td class=\"text\"[^>]*>L3 – L4</td>(.*?)</tr>", parts["contrasts"])
    assert row is not None
    pairs, completed_under_one_only, p_values, paper_p_values = ["6"], ["0", "0"], ["1", "1"], ["0.78", "1"]
    by_road = ["2", "0", "0", "1", "1"]
    assert text_of(row[1]).split() == [*pairs, *completed_under_one_only, *p_values, *by_road, *paper_p_values]


def test_survival_curves_have_data_files(tmp_path: Path) -> None:
    """The survival figures come with files of all steps and their 95 % intervals."""
    report = report_of(summarize(campaign(), None), tmp_path)
    assert 'href="tables/survival_virtual.csv"' in "".join(survival_parts(report))
    first, *rows = (tmp_path / "tables" / "survival_virtual.csv").read_text().splitlines()
    interval = "95 % interval low (share),95 % interval high (share)"
    assert first == f"route,condition,distance m,still driving (share),{interval},ended so far"
    curves = [curve for entry in report.kinds["virtual"].values() for curve in entry["survival"].values()]
    assert len(rows) == sum(len(curve["distance_m"]) for curve in curves) > 0


def test_figures_and_tables_name_their_group(tmp_path: Path) -> None:
    """With two groups, contrasts and survival figures name their group."""
    runs = [*campaign(sweep="x"), *campaign(sweep="y", preset="designed")]
    parts = parts_of(
        report_of(summarize(runs, None, base={"sweep": "x"}), tmp_path), "contrasts", "survival", "degradation"
    )
    assert re.findall("<h4>(.*?)</h4>", parts["contrasts"]) == ["preset paper_calibrated", "preset designed"]
    assert parts["survival"].count("Virtual time (preset paper_calibrated).") == 2
    assert "Runs in virtual time are from one group (preset paper_calibrated)." in text_of(parts["degradation"])
    single_group = parts_of(report_of(summarize(campaign(), None), tmp_path), "contrasts")
    assert "<h4>" not in single_group["contrasts"]


def test_the_bar_of_stages_is_the_loop(tmp_path: Path) -> None:
    """Stages after the loop are in the table but in no bar, and a rest completes the bar to the loop latency."""
    stages = [
        {"node": "camera", "stage": "encode", "p50": 50.0},
        {"node": "actuator", "stage": "apply", "p50": 10.0},
        {"node": "actuator", "stage": "report", "p50": 8.0},
    ]
    report = report_of(summarize([run_of("L0", stages_ms=stages)], None), tmp_path)
    text = text_of("".join(stage_parts(report, {"virtual": {"L0": 5.0}})))
    assert ">72 ms</text>" in (tmp_path / "stages_virtual.svg").read_text()
    with (tmp_path / "tables" / "stages_virtual.csv").open(newline="") as file:
        assert list(csv.reader(file))[1:] == [
            ["camera: capture to stamp, before the loop", "5.0"],
            ["camera: encode", "50.0"],
            ["actuator: apply", "10.0"],
            ["rest: waiting (median loop minus the sum of stages)", "12.0"],
            ["actuator: report, after the loop", "8.0"],
        ]
    assert "the sum of these medians" in text
    assert "from one run of each condition" in text


def test_failed_runs_are_in_the_summary(tmp_path: Path) -> None:
    """The summary section has the number of failed runs, their names and the reasons."""
    failed = [{"run": "a_L0_00", "reason": "the disk is full"}]
    text = text_of("".join(validity_parts(report_of(summarize(campaign(), None, failed=failed), tmp_path))))
    assert "1 run failed and is left out: a_L0_00: the disk is full" in text
    assert "failed" not in text_of("".join(validity_parts(report_of(summarize(campaign(), None), tmp_path))))


def test_endings_are_counted_in_words(tmp_path: Path) -> None:
    """The table of conditions has the number of each ending in words, with a plural where there is one."""
    runs = [
        run_of("L0", repetition=number, ending=ending)
        for number, ending in enumerate(("collision", "collision", "off_road", "off_road", "safe_stop"))
    ]
    text = text_of(parts_of(report_of(summarize(runs, None), tmp_path), "conditions")["conditions"])
    assert "2 collisions, 2 off road, 1 safe stop" in text


def test_the_legend_explains_the_frame_age(tmp_path: Path) -> None:
    """A report with the frame age has its meaning in the legend; other reports do not."""
    for age in ({"mean": 90.0, "p95": 120.0}, None):
        summary = summarize([run_of("L0", picture_age_ms=age)], None)
        text = text_of("".join(first_parts(report_of(summary, tmp_path), [])))
        assert ("since the stamp of the frame from which the command in force was made" in text) == (age is not None)


def test_the_latencies_of_the_page_are_those_of_a_person(tmp_path: Path) -> None:
    """If a person drove, the table of latencies has those of the page with their bounds; other reports do not."""
    page = {"p5": 20.0, "p50": 30.0, "p95": 40.0, "bound": 0.31, "n": 10, "max": 90.0}
    for name, run in (("nobody", run_of("L0")), ("person", run_of("L0", page_decoded_ms=page, page_shown_ms=page))):
        (tmp_path / name).mkdir()
        text = text_of("".join(latency_table_parts(report_of(summarize([run], None), tmp_path / name))))
        assert ("stamp to shown in the page" in text) == (name == "person")
        assert ("from which a person drives" in text) == (name == "person")
    (row,) = csv_rows(tmp_path / "person" / "tables" / "conditions_virtual_latency.csv")
    for title in ("stamp to decoded in the page ms", "stamp to shown in the page ms"):
        assert [row[f"{title}{part}"] for part in (" p50", " bound", ", maximum")] == ["30.0", "0.31", "90.0"]


def test_other_conditions_are_not_compared_with_the_paper(tmp_path: Path) -> None:
    """Conditions whose name or injected delay is not the paper's are not compared with the paper."""
    runs = [{**run_of("L0"), "condition": "mine"}, {**run_of("L1"), "condition": "L0"}]
    parts = parts_of(report_of(summarize(runs, None), tmp_path))
    assert "the paper" not in text_of("".join(parts.values())).lower()
    assert "mine" in parts["degradation"] + parts["conditions"]


def test_a_summary_of_an_older_version_is_reported(tmp_path: Path) -> None:
    """Sections that need keys of a newer version are left out; all other sections are shown."""
    summary = copy.deepcopy(summarize(campaign(), None))
    for key in ("contrasts", "paper"):
        del summary[key]
    for entry in [summary, *summary["groups"]]:
        entry.pop("contrasts", None)
        for condition in entry["conditions"].values():
            for key in NEW_CONDITION_KEYS:
                del condition[key]
    parts = parts_of(report_of(summary, tmp_path))
    assert [name for name, html in parts.items() if not html] == [
        "contrasts",
        "survival",
        "stages",
        "groups",
        "axes",
        "routes",
        "lane_changes",
    ]
    tables = parts["conditions"] + parts["latencies"] + parts["errors"]
    rows = re.findall(r'<tr><td class="text"[^>]*>(L\d)</td>(.*?)</tr>', tables)
    assert [name for name, _ in rows] == [*INJECTED] * 3
    shown = {name: text_of(cells).split() for name, cells in rows[: len(INJECTED)]}
    for name, condition in summary["conditions"].items():
        assert shown[name][:2] == [f"{condition['runs']}", f"{100 * condition['completion_rate']:.0f}"]
    assert {cells[1] for cells in shown.values()} == {"0", "100"}


def test_few_roads_allow_no_statement_about_roads(tmp_path: Path) -> None:
    """With three roads the report says that no statement by road is possible; with six it says to quote it."""
    for count, expected in ((3, "No statement about other roads"), (6, "Quote the columns “by road”")):
        runs = [run_of(name, route=f"road{number}") for name in ("L2", "L3") for number in range(count)]
        parts = parts_of(report_of(summarize(runs, None), tmp_path), "conditions", "contrasts")
        conditions, contrasts = (text_of(html).replace("\N{NO-BREAK SPACE}", " ") for html in parts.values())
        assert expected in conditions
        assert ("no interval, 3 roads" in conditions) == (count == 3)
        assert ("With 3 roads it cannot be below 0.25" in contrasts) == (count == 3)
        assert "Quote “p by road”" in contrasts


def csv_rows(path: Path) -> list[dict[str, str]]:
    return list(csv.DictReader(path.read_text().splitlines()))


KEPT = {
    "own_lane_share": 1.0,
    "followed_unknown_share": 0.0,
    "followed_changes": 0,
    "occupied_changes": 0,
    "changes": [],
}
CHANGE = {"lane": "followed", "mono_ns": 5, "progress_m": 40.0, "from": 0, "to": -1}


def test_the_tables_have_completion_in_the_own_lane(tmp_path: Path) -> None:
    """The tables have completion, completion in the own lane, collisions, and P95 against both lanes, each once."""
    runs = [
        run_of("L0", followed_p95_m=0.1, completed_in_own_lane=True, lane_kept=KEPT),
        run_of(
            "L0",
            "b",
            p95_m=3.9,
            followed_p95_m=0.5,
            completed_in_own_lane=False,
            lane_kept={**KEPT, "changes": [CHANGE]},
        ),
    ]
    report = report_of(summarize(runs, None), tmp_path)
    html = "".join([*conditions_parts(report), *error_table_parts(report)])
    titles = re.findall("<th(?: [^>]*)?>(.*?)</th>", html)
    assert [title for title in titles if titles.count(title) > 1] == ["condition"] * 2
    (text, links) = lane_change_parts(report)
    assert "Every change of the lane" in text
    assert 'href="tables/lane_changes.csv"' in links
    (row,) = csv_rows(tmp_path / "tables" / "conditions_virtual_driving.csv")
    assert [row[name] for name in ("completed (share)", "completed in own lane (share)", "collisions / run")] == [
        "1.0",
        "0.5",
        "0.0",
    ]
    errors = (f"{COMPLETED_P95}, mean of routes", f"{FOLLOWED_P95}, mean of routes")
    (error_row,) = csv_rows(tmp_path / "tables" / "conditions_virtual_error.csv")
    assert [float(error_row[name]) for name in errors] == pytest.approx([2.0, 0.3])
    assert (row["completed, by road mean (share)"], row["completed, by road low (share)"]) == ("1.0", "")
    assert row["completed, by road roads (share)"] == "2"
    (change,) = csv_rows(tmp_path / "tables" / "lane_changes.csv")
    assert change == {
        "run": "b_L0_0",
        "lane": "followed",
        "server's monotonic clock ns": "5",
        "distance m": "40.0",
        "from lane": "0",
        "to lane": "-1",
    }


def test_two_presets_are_separate_groups(tmp_path: Path) -> None:
    """Two sweeps with equal run names are two groups; `conditions` has the first sweep; tables name their group."""
    runs = [
        *campaign(sweep="calibrated"),
        *campaign(sweep="other", preset="designed", ending="completed", collisions=0),
    ]
    summary = summarize(runs, None, base={"sweep": "calibrated"})
    assert summary["conditions"]["L5"]["completed"] == 0
    report = report_of(summary, tmp_path)
    parts = parts_of(report, "first", "conditions", "contrasts", "runs", "groups")
    assert [title_of(group, differing_settings(report.groups)) for group in report.groups] == [
        "preset paper_calibrated",
        "preset designed",
    ]
    assert "Virtual time, preset designed. Runs completed" in parts["first"]
    assert "(preset paper_calibrated)" in parts["conditions"]
    assert {path.name for path in (tmp_path / "tables").glob("contrasts*.csv")} == {
        "contrasts.csv",
        "contrasts_preset_designed.csv",
    }
    assert parts["runs"].count('data-title="sweep">other</td>') == 36
    assert "designed" in parts["groups"]


def test_sweeps_with_equal_settings_are_separate_groups() -> None:
    """Two sweeps with the same settings are two groups, distinguished by their names."""
    groups = summarize([*campaign(sweep="x"), *campaign(sweep="y")], None)["groups"]
    assert [title_of(group, differing_settings(groups)) for group in groups] == ["sweep x", "sweep y"]
    assert "sweep" not in summarize(campaign(), None)["groups"][0]


@pytest.mark.parametrize("count", [1, 2, 3])
def test_axes_of_a_sweep_are_drawn(count: int, tmp_path: Path) -> None:
    """One axis gives one figure, two axes a figure for each value of the second; three give no figure."""
    axes = {"controller.speed_mps": (10.0, 6.0, 8.0), "network.video.loss": (0.0, 0.1), "camera.rate_hz": (30.0, 15.0)}
    runs = campaign()
    for name in list(axes)[:count]:
        runs = [{**run, "axes": {**run.get("axes", {}), name: value}} for value in axes[name] for run in runs]
    report = report_of(summarize(runs, None), tmp_path)
    html = "\n".join(axis_parts(report))
    second = ["axes_video_loss_0_0.png", "axes_video_loss_0_1.png"]
    assert re.findall(r'href="(axes[^"]*\.png)"', html) == {1: ["axes.png"], 2: second, 3: []}[count]
    if count < 3:
        same_second = [group for group in report.groups if group.get("network.video.loss") in {None, 0.1}]
        figure = axis_figure(same_second, "controller.speed_mps", report.colours, report.groups)
        assert len(figure.axes) == 3
        line = figure.axes[0].get_lines()[0]
        assert list(np.asarray(line.get_xdata())) == [6.0, 8.0, 10.0]
        assert len(figure.axes[0].get_lines()) == 6


def test_group_titles_are_as_short_as_possible() -> None:
    """A setting that an axis implies is not in the title of a group, and groups are sorted by their axis values."""
    runs = [run_of("L0", axes={"loss": loss}, changes=f"loss {loss}") for loss in (10.0, 2.0)]
    groups = sort_groups(summarize(runs, None)["groups"])
    assert differing_settings(groups) == ["loss"]
    assert [title_of(group, ["loss"]) for group in groups] == ["loss 2.0", "loss 10.0"]
    assert [is_in_group(runs[1], group) for group in groups] == [True, False]


def test_a_sweep_without_runs_of_its_base_config_shows_groups(tmp_path: Path) -> None:
    """If no run has the values of the base config, the page says so and shows the groups."""
    runs = [{**run, "axes": {"speed": speed}} for run in campaign() for speed in (1.0, 2.0)]
    summary = summarize(runs, None, base={"speed": None})
    assert summary["conditions"] == {}
    parts = parts_of(report_of(summary, tmp_path), "conditions", "groups", "injected", "degradation", "survival")
    assert "base config" in parts["conditions"]
    assert "groups.png" in parts["groups"]
    assert parts["injected"] == parts["degradation"] == parts["survival"] == ""


def test_sweeps_without_a_common_condition_are_reported(tmp_path: Path) -> None:
    """Two sweeps without a common condition are compared as groups."""
    runs = [run_of("L0", sweep="x"), run_of("L3", sweep="y", preset="designed")]
    parts = parts_of(report_of(summarize(runs, None, base={"sweep": "x"}), tmp_path), "contrasts", "groups")
    assert parts["contrasts"] == ""
    assert "L3" in text_of(parts["groups"])


def test_a_drive_is_drawn_every_half_metre() -> None:
    """The drawn points of a drive are the first, the last, and one for each half metre of progress."""
    progress_m = np.linspace(0.0, 10.0, 1001)
    rows = drawn_indexes(progress_m)
    assert (rows[0], rows[-1], len(rows)) == (0, 1000, 21)
    assert drawn_indexes(np.zeros(0)) == []


def test_a_boundary_that_was_not_found_is_a_dash_with_its_reason() -> None:
    """Where no median was found, table and sentence have a dash, and the sentence says how many seeds are in range."""
    summary = {"p25": 300.0, "p50": None, "p75": None, "interval": None, "n": 1}
    criteria = {f"{name}_ms": summary for name in ("onset", "departure", "completion")}
    group = {"route": "a", "preset": "own", "n": 4, "theory_ms": None, **criteria, "not_monotone": {"onset": 0}}
    [sentence] = boundary_section.boundary_sentences([group])
    assert f"oscillation begins to grow: {NOTHING} (in the searched range for only 1 of 4);" in sentence
    table = boundary_section.boundary_table({"groups": [group]})
    shown = {column.title: column.show(cell) for column, cell in zip(table.columns, table.rows[0], strict=True)}
    assert shown["onset by theory (ms)"] == shown["oscillation begins to grow: median (ms)"] == NOTHING


def test_the_report_has_the_maximum_tolerable_latency(make_run: MakeRun, tmp_path: Path) -> None:
    """The result of `lavt boundary` is a section of the page with a figure and a table in each format."""
    directory = make_run(tmp_path / "runs" / "0", seconds=2.0)
    server, client = (read_record(directory / f"{side}.mcap") for side in ("server", "client"))
    identity = {"run": "0", "time": "virtual", "injection": "model", "route": "A", "condition": "L0"}
    write_json(directory / "result.json", run_result(identity, server, client))
    found = {"p25": 200.0, "p50": 210.0, "p75": 220.0, "interval": [195.0, 230.0], "n": 1}
    criteria = {f"{name}_ms": found for name in ("onset", "departure", "completion")}
    group = {
        "route": "a",
        "preset": "designed",
        "n": 1,
        "theory_ms": 204.0,
        **criteria,
        "not_monotone": {"onset": 0, "departure": 0, "completion": 0},
    }
    searched = {"searched_ms": [50.0, 600.0], "below": [], "onset_ms": 210.0, "departure_ms": 210.0}
    run = {"route": "a", "preset": "designed", "completion_ms": None, **searched}
    boundary = {"schema": 1, "config": {}, "runs": [run], "groups": [group]}
    html = write_report(tmp_path, boundaries=[boundary]).read_text()
    assert '<h3 id="maximum_tolerable_latency">' in html
    assert 'href="boundary.svg"' in html
    assert "designed, route a: theory predicts growing oscillation from a total delay of 204 ms" in html
    assert "210" in (tmp_path / "report" / "tables" / "boundary.csv").read_text()
    assert boundary_section.DASHES in html
    assert json.loads((tmp_path / "summary.json").read_text())["schema"] == 2
