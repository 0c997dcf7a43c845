from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from tests.support.command_line import Run

from lavt.config_file import shipped
from lavt.recording.output_directory import reserve_directory

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


def results(out: Path) -> list[dict[str, Any]]:
    """Return the results of the finished runs in the order of their names."""
    return [json.loads(path.read_text()) for path in sorted((out / "runs").glob("*/result.json"))]


def test_a_participant_drives_the_planned_blocks(run: Run, tmp_path: Path) -> None:
    """A model drives a participant's runs in the planned order; records, answers and report have their place."""
    (tmp_path / "road.yaml").write_text(ROAD)
    code, printed, messages = run(
        "study", STUDY, *OPTIONS, "--participant", "1", "--out", "out", "--jobs", "1", "--json"
    )
    assert code == 0, messages
    assert "not balanced" not in messages
    plan = json.loads(run("study", STUDY, *OPTIONS, "--plan", "--json").out)
    places = [(run["participant"], run["block"], run["order"], run["condition"]) for run in results(tmp_path / "out")]
    assert places == [("1", number, number, condition) for number, condition in enumerate(plan["1"], start=1)]
    (study,) = json.loads(printed)["studies"]
    assert (study["driver"], study["measures"]["p95_m"]["participants"]) == ("two_point", 1)
    answers = [json.loads(path.read_text()) for path in sorted((tmp_path / "out" / "answers").iterdir())]
    assert [(entry["condition"], entry["raw_tlx"]) for entry in answers] == [(name, None) for name in plan["1"]]
    page = (tmp_path / "out" / "report" / "index.html").read_text()
    assert "Comparison over the participants" in page
    assert "They say nothing about persons" in page
    first, second = sorted((tmp_path / "out" / "runs").iterdir())
    command = ("study", STUDY, *OPTIONS, "--participant", "1", "--out", "out")
    with reserve_directory(tmp_path / "out"):
        assert "another command writes into out" in run(*command).rejection()
    (first / "result.json").write_text((second / "result.json").read_text())
    assert "the result of another run" in run(*command).rejection()
    (first / "config.yaml").unlink()
    assert "cannot be read" in run(*command).rejection()


@pytest.mark.full
def test_a_study_adds_participants(run: Run, tmp_path: Path) -> None:
    """The next call keeps the finished runs and adds participants, and `lavt report` writes the same comparison."""
    (tmp_path / "road.yaml").write_text(ROAD)
    out = tmp_path / "out"
    assert run("study", STUDY, *OPTIONS, "--participant", "2", "--out", "out").code == 0
    before = {path: path.stat().st_mtime_ns for path in (out / "runs").glob("p002_*/result.json")}
    code, printed, messages = run("study", STUDY, *OPTIONS, "--out", "out", "--json")
    assert code == 0, messages
    assert len(before) == 2
    assert {path: path.stat().st_mtime_ns for path in before} == before
    assert len(results(out)) == len(list((out / "answers").iterdir())) == 4
    (study,) = json.loads(printed)["studies"]
    assert study["measures"]["p95_m"]["participants"] == 2

    (out / "study.json").unlink()
    assert run("report", "out").code == 0
    assert json.loads((out / "study.json").read_text()) == json.loads(printed)
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
