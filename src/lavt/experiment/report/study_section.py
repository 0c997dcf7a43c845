"""The section of a report that compares the conditions of a study over its participants."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from lavt.config import HUMAN
from lavt.experiment.report import html_page
from lavt.experiment.report.files import save_table
from lavt.experiment.report.sections import Parts
from lavt.experiment.report.table_format import (
    LOW_HIGH,
    Column,
    TableData,
    format_interval,
    format_probability,
    number_column,
    probability_column,
    text_column,
)
from lavt.experiment.statistics.participants import PRIMARY, WORKLOAD

TITLES = {
    "p95_m": "P95 of the cross-track error (m)",
    "completed": "share of the drives completed",
    "completed_in_own_lane": "share of the drives completed in the own lane",
    "lane_invasions": "lane invasions per drive",
    "steering_reversals": "steering reversals per drive",
    WORKLOAD: "workload (raw NASA-TLX, 0 to 100)",
}
WHY = (
    "The unit is the participant: the value of a participant under a condition is the mean over the same drives under "
    "every condition, because the drives of one person are no independent evidence. Everybody drove under all "
    "conditions, so the tests compare the values of each participant with each other: Friedman's test over all "
    "conditions, and Wilcoxon's signed-rank test for each pair, with Holm's correction over the pairs of a measure. "
    "Both use ranks and permutations only, so they hold for few participants and for any distribution. A mixed-effects "
    "model would assume normally distributed effects of persons, which so few participants cannot confirm. The tests "
    "do not model practice or fatigue; the balanced order spreads these over the conditions. “Smallest p” is what this "
    "number of participants can reach if all of them differ in the same direction, without ties. If it is above 0.05, "
    "the test cannot show a difference. No correction covers several measures, so the secondary ones are exploratory."
)
EFFECTS = (
    "Effect sizes: Kendall's W is 0 without agreement between the participants, and 1 if all rank the conditions "
    "alike. The rank-biserial correlation r is 0 without a difference, 1 if the second condition has the larger value "
    "for everybody, and -1 if it has the smaller one. A difference is the second condition minus the first."
)
MODEL = (
    "The driver was {driver}, no person. Its “participants” differ in their starts and noise only, so these numbers "
    "test the chain of the study, and are a baseline. They say nothing about persons, and nobody was asked about the "
    "workload."
)


def study_parts(studies: Sequence[Mapping[str, Any]], report_dir: Path) -> Parts:
    """Return the sentences and tables of each comparison of `participants.compare_studies`."""
    parts: Parts = []
    for number, study in enumerate(studies, start=1):
        name = "study" if len(studies) == 1 else f"study_{number}"
        if len(studies) > 1:
            parts.append(html_page.heading(", ".join(filter(None, (study["sweep"], study["driver"])))))
        if study["driver"] != HUMAN:
            parts.append(html_page.paragraph(MODEL.format(driver=study["driver"])))
        parts.append(html_page.bullets([sentence(key, entry) for key, entry in study["measures"].items()]))
        tables = {"conditions": condition_table(study), "pairs": pair_table(study)}
        parts += [save_table(report_dir, f"{name}_{key}", table) for key, table in tables.items() if table.rows]
    return [*parts, html_page.paragraph(f"{WHY} {EFFECTS}", is_note=True)] if parts else []


def sentence(key: str, measure: Mapping[str, Any]) -> str:
    """Return the result of Friedman's test of a measure as a sentence."""
    count = measure["participants"]
    people = f"{count} participant{'s' * (count != 1)}"
    rank = "primary measure" if key == PRIMARY else "secondary measure"
    begin = f"{TITLES[key][0].upper()}{TITLES[key][1:]} ({rank}, {people})"
    left_out = measure["left_out"]
    end = f" Left out, because a condition has no valid drive: {', '.join(left_out)}." if left_out else ""
    test = measure["friedman"]
    if test is None:
        return f"{begin}: no test, because nobody has a value under every condition.{end}"
    how = "exact" if test["permutations"] is None else f"from {test['permutations']:,} random permutations"
    return (
        f"{begin}: Friedman's chi-squared {test['statistic']:.2f}, p {_relation(test['p'])} ({how}; "
        f"smallest p {_relation(test['smallest_p'])}), Kendall's W = {test['kendall_w']:.2f}.{end}"
    )


def _relation(p: float) -> str:
    """Return a p value with its relation, such as "= 0.02" or "< 0.0001"."""
    text = format_probability(p)
    return text if text.startswith("<") else f"= {text}"


def condition_table(study: Mapping[str, Any]) -> TableData:
    """Return the medians and quartiles over the participants, with a row for each measure and condition."""
    columns = [
        text_column("measure", is_long=True),
        text_column("condition"),
        number_column("participants", 0),
        number_column("median", 2),
        Column("quartiles", lambda cell: format_interval(cell, digits=2), LOW_HIGH),
    ]
    rows = [
        [TITLES[key], condition, measure["participants"], median["p50"], [median["p25"], median["p75"]]]
        for key, measure in study["measures"].items()
        for condition, median in measure["medians"].items()
    ]
    return TableData(columns, rows)


def pair_table(study: Mapping[str, Any]) -> TableData:
    """Return Wilcoxon's tests, with a row for each measure and pair of conditions."""
    columns = [
        text_column("measure", is_long=True),
        text_column("conditions"),
        number_column("participants", 0),
        number_column("with a difference", 0),
        number_column("median difference", 3),
        number_column("effect r", 2),
        probability_column("p"),
        probability_column("p (Holm)"),
        probability_column("smallest p (Holm)"),
    ]
    keys = ("participants", "differing", "median_difference", "effect", "p", "p_holm", "smallest_p_holm")
    rows = [
        [TITLES[key], f"{pair['a']} and {pair['b']}", *(pair[name] for name in keys)]
        for key, measure in study["measures"].items()
        for pair in measure["pairs"]
    ]
    return TableData(columns, rows)
