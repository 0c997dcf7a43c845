"""The first screen of a report: what was run, the headline figure next to the replay, the findings, and a legend."""

from __future__ import annotations

from markupsafe import Markup

from lavt.experiment.analysis.lane_kept import LINE_MARGIN_M
from lavt.experiment.report import html_page
from lavt.experiment.report.figures.headline_figure import has_own_lane, headline_figure
from lavt.experiment.report.files import save_figure
from lavt.experiment.report.groups import differing_settings, title_of
from lavt.experiment.report.sections import MAX_COMPARED_GROUPS, Parts, ReportContext
from lavt.experiment.report.sentences import (
    contrast_sentence,
    length_sentences,
    limits_sentences,
    results_sentences,
    runs_overview,
)
from lavt.experiment.statistics.by_road import is_key_part
from lavt.experiment.statistics.paper_results import REFERENCE

VALIDITY = "Validity"
"""The chapter with the reasons of invalid runs."""

WHAT_IT_IS = (
    "LAVT (Latency-Aware Vision Teleoperation) delays what the driver of a remote car sees, and the commands that come "
    "back, and measures how driving degrades."
)
LANE_KEEPER = " The driver is a program that keeps the lane."
VIRTUAL = "the same programs on a simulated clock."
WITHOUT_PICTURES = " Runs without pictures (fidelity geometry) get the lane without an error of detection."
FRAME_AGE = (
    "at a moment, the time since the stamp of the frame from which the command in force was made. It grows while a "
    "command stays in force; its mean is over time."
)
OWN_LANE = (
    "until the end of the route, the middle of the rear axle was in the route's lane, or at most "
    f"{LINE_MARGIN_M:g} m beyond its line, and the driver followed no other lane. A wheel may have crossed the line."
)
PRESETS = {
    "paper_calibrated": "gains of the lane keeper, tuned by hand so that completion falls about where it does in the "
    "campaign of Khalil and Kwon (2026): the delay at which it falls is an input, not a finding.",
    "designed": "gains of the lane keeper, found by theory alone.",
}


def first_parts(report: ReportContext, replay: Parts, setting: str = "") -> Parts:
    """Return the parts of the first screen; `replay` is the replay, if there is one, and `setting` follows the runs.

    A narrow screen shows them in this order: what was run, the figure, its findings in words, and then the replay,
    which is an example. A wide screen has the replay next to the figure.
    """
    runs, failed = report.summary["runs"], report.summary.get("failed")
    invalid = any(not run["valid"] for run in runs) or failed
    link = ("See why.", html_page.chapter_anchor(VALIDITY)) if invalid else None
    driver = LANE_KEEPER if all(run.get("driver") == "lane_keeper" for run in runs) else ""
    about = html_page.paragraph(f"{WHAT_IT_IS}{driver} This page: {runs_overview(runs, setting)}", link=link)
    sentences = [sentence for sentence in _findings(report) if sentence]
    findings = [html_page.bullets(sentences)] if sentences else []
    shown = [*headline_parts(report), *findings, *replay]
    return [about, *([html_page.columns(shown)] if shown else []), _legend(report)]


def _findings(report: ReportContext) -> list[str]:
    names = differing_settings(report.groups)
    compared = report.groups if 1 < len(report.groups) <= MAX_COMPARED_GROUPS else []
    conditions_by_name = {f"Virtual time, {title_of(group, names)}": group["conditions"] for group in compared}
    if "virtual" in report.kinds and not conditions_by_name:
        conditions_by_name = {f"Virtual time{report.base_title()}": report.kinds["virtual"]}
    lengths_m = {
        str(run["route"]): float(run["route_length_m"]) for run in report.summary["runs"] if run.get("route_length_m")
    }
    sentences = []
    for name, conditions in conditions_by_name.items():
        lengths = length_sentences(conditions, lengths_m)
        sentences += [results_sentences(name, conditions), lengths and f"{name}. {lengths}" if compared else lengths]
    sentences.append(contrast_sentence(report.summary.get("contrasts") or []))
    real = report.kinds.get("real")
    examples = [results_sentences("Real time", real)] if real else []
    return [*sentences, *examples, limits_sentences(report.summary["runs"])]


def headline_parts(report: ReportContext) -> Parts:
    """Return the headline figure; nothing if no condition has a loop latency and a completion."""
    kinds = report.kinds
    if not any(
        entry["loop_ms"]["p50"] is not None and entry["completion_rate"] is not None
        for conditions in kinds.values()
        for entry in conditions.values()
    ):
        return []
    paper = report.paper(report.summary["conditions"])
    judged = "in their own lane" if has_own_lane(kinds) else "in any lane"
    sentences = [
        f"Runs completed {judged}, and P95 of the cross-track error of all runs, each up to its own end (mean over "
        "roads). Bars are 95 % intervals; a single run has none.",
        "Grey triangles are the paper's: its completion, in any lane, and its P95, at the sum of its two latencies."
        * bool(paper),
    ]
    figure = headline_figure(kinds, paper, report.colours)
    alternative = "completion and error over loop latency"
    return [save_figure(report.directory, "headline", figure, alternative, " ".join(filter(None, sentences)))]


def _legend(report: ReportContext) -> Markup:
    """Return the meanings of the names that this report uses."""
    runs = report.summary["runs"]
    without_pictures = WITHOUT_PICTURES * any(run.get("fidelity") == "geometry" for run in runs)
    delays = {str(run["condition"]): run.get("injected_ms") or {} for run in runs}
    listed = ", ".join(
        f"{name} {injected_ms['video']:g} + {injected_ms['control']:g}"
        for name, injected_ms in sorted(delays.items())
        if injected_ms.get("video") is not None and injected_ms.get("control") is not None
    )
    pairs = [
        ("Condition", f"the delay that was injected into video + control, in ms: {listed}." if listed else ""),
        ("Virtual time", (VIRTUAL + without_pictures) * ("virtual" in report.kinds)),
        ("Loop latency", "from a frame's stamp, set just before encoding, to the application of its command."),
        ("Frame age", FRAME_AGE if any(run.get("picture_age_ms") for run in runs) else ""),
        ("P95", "on 95 % of the distance, the rear axle was closer to the centre of the route's lane."),
        ("τ video, τ control", "the one-way latencies of a frame and of a command."),
        ("Own lane", OWN_LANE if has_own_lane(report.kinds) else ""),
        *((name, meaning) for name, meaning in PRESETS.items() if any(run.get("preset") == name for run in runs)),
        *_route_terms(sorted({str(run["route"]) for run in runs})),
        ("The paper", REFERENCE if report.paper(report.summary["conditions"]) else ""),
    ]
    return html_page.terms([(term, meaning) for term, meaning in pairs if meaning])


def _route_terms(routes: list[str]) -> list[tuple[str, str]]:
    terms = []
    if any(is_key_part(route) for route in routes):
        name = next(route for route in routes if is_key_part(route))
        terms.append((name, f"the key part, mostly the curve, of a longer route “{name.removesuffix('_key')}”."))
    if any(route.startswith("random_") for route in routes):
        terms.append(("random_1, …", "random roads of the same kind and of different lengths, by their number."))
    return terms
