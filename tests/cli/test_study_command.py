from __future__ import annotations

import json
from pathlib import Path

import pytest
from tests.support.command_line import Run

from lavt.config_file import shipped

ROAD = """\
title: A few metres
segments:
  - {length_m: 10}
  - {length_m: 10, end_curvature_per_m: 0.02}
lanes: {widths_m: [3.5, 3.5], driven: 1}
"""
STUDY = str(shipped("configs/study.yaml"))
SMALL = ("participants=2", "conditions=[L0, L5]", "routes=[road.yaml]", "costs=constant")
OPTIONS = [part for change in SMALL for part in ("--set", change)]


def test_the_whole_chain_with_a_model(run: Run, tmp_path: Path) -> None:
    """A participant drives all runs in order, the next call adds the others, and the report compares them."""
    (tmp_path / "road.yaml").write_text(ROAD)
    code, _, messages = run("study", STUDY, *OPTIONS, "--participant", "1", "--out", "out", "--jobs", "1")
    assert code == 0, messages
    results = sorted((tmp_path / "out" / "runs").glob("p001_*/result.json"))
    before = {path: path.stat().st_mtime_ns for path in results}
    code, printed, messages = run("study", STUDY, *OPTIONS, "--out", "out", "--jobs", "1", "--json")
    assert code == 0, messages
    assert "not balanced" not in messages
    assert {path: path.stat().st_mtime_ns for path in results} == before

    plan = json.loads(run("study", STUDY, *OPTIONS, "--plan", "--json").out)
    driven = [json.loads(path.read_text()) for path in sorted((tmp_path / "out" / "runs").glob("*/result.json"))]
    places = [(entry["participant"], entry["block"], entry["order"], entry["condition"]) for entry in driven]
    assert places == [
        (person, number, number, condition) for person in "12" for number, condition in enumerate(plan[person], start=1)
    ]
    assert {entry["driver"] for entry in driven} == {"two_point"}
    (study,) = json.loads(printed)["studies"]
    assert json.loads((tmp_path / "out" / "study.json").read_text()) == json.loads(printed)
    assert study["measures"]["p95_m"]["participants"] == 2
    assert len(list((tmp_path / "out" / "answers").iterdir())) == 4
    page = (tmp_path / "out" / "report" / "index.html").read_text()
    assert "Comparison over the participants" in page
    assert "they say nothing about persons" in page.lower()

    assert run("report", "out").code == 0
    assert json.loads((tmp_path / "out" / "study.json").read_text()) == json.loads(printed)
    changed = [*OPTIONS, "--set", "seed=2", "--out", "out"]
    assert "another config (seed)" in run("study", STUDY, *changed).rejection()


@pytest.mark.parametrize("participant", ["1", None])
def test_the_plan_is_printed(participant: str | None, run: Run, tmp_path: Path) -> None:
    """With --plan the order of each participant is printed, and nothing is driven."""
    options = [] if participant is None else ["--participant", participant]
    lines = run("study", STUDY, "--plan", *options).out.splitlines()
    assert len(lines) == (12 if participant is None else 1)
    assert lines[0].startswith("participant 1: L")
    assert list(tmp_path.iterdir()) == []


def test_an_order_that_is_not_balanced_is_mentioned(run: Run) -> None:
    """If the participants are no multiple of the orders, a message says so."""
    messages = run("study", STUDY, "--plan", "--set", "participants=10").err
    assert "10 participants are no multiple of the 4 orders" in messages
