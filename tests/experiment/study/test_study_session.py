from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from lavt.config import StudyConfig
from lavt.config_file import load_config, shipped
from lavt.experiment.runs.plan import PlannedRun
from lavt.experiment.runs.run import RESULT
from lavt.experiment.study.answers import SCALES, Store, read_answers
from lavt.experiment.study.session import Experimenter, hold_session
from lavt.experiment.study.study_plan import Block, plan_participant

PERSON = ("controller.kind=human", "time=real", "fidelity=video", "conditions=[L0, L5]", "repetitions=2")
ENTER = ""


class Session:
    """A session whose participant gives the prepared answers, and whose drives only write a result."""

    def __init__(self, out: Path, *answers: str) -> None:
        self.blocks: list[Block] = plan_participant(load_config(StudyConfig, shipped("configs/study.yaml"), PERSON), 2)
        self.out = out
        self.texts: list[str] = []
        self.driven: list[str] = []
        self.results: list[dict[str, Any]] = []
        """The results of the next drives; then all are completed and valid."""
        self._answers: Iterator[str] = iter(answers)

    def hold(self, ask_in_page: Callable[[str, Store], None] | None = None) -> None:
        """Hold the session until the prepared answers are used up."""
        experimenter = Experimenter(self.texts.append, self._ask, self._drive, ask_in_page)
        hold_session(self.blocks, "Keep your lane.", self.out, experimenter)

    def _ask(self, question: str) -> str:
        self.texts.append(question)
        try:
            return next(self._answers)
        except StopIteration:
            raise KeyboardInterrupt from None

    def _drive(self, run: PlannedRun, directory: Path) -> dict[str, Any]:
        directory.mkdir(parents=True)
        (directory / RESULT).write_text("{}")
        self.driven.append(run.name)
        return self.results.pop(0) if self.results else {"ending": "completed", "valid": True}


BLOCK = (ENTER, ENTER, "5", "10", "15", "20", "25", "30", " It was late. ")


def test_a_session_drives_all_blocks_and_keeps_the_answers(tmp_path: Path) -> None:
    """The runs are driven in the planned order, and each block has the answers that were given at its end."""
    session = Session(tmp_path, *BLOCK, *BLOCK)
    session.hold()
    assert session.driven == [run.name for block in session.blocks for run in block.runs]
    answers = read_answers(tmp_path)
    assert [(entry["block"], entry["raw_tlx"], entry["comment"]) for entry in answers] == [
        (1, 17.5, "It was late."),
        (2, 17.5, "It was late."),
    ]
    assert answers[0]["driver"] == "human"
    assert session.texts.count("Keep your lane.") == 2


def test_the_questions_can_be_asked_in_a_page(tmp_path: Path) -> None:
    """With a page, the terminal asks for the drives only, and the answers of each block are those of the page."""
    session, titles = Session(tmp_path, *[ENTER] * 4), []

    def ask_in_page(title: str, store: Store) -> None:
        titles.append(title)
        store(dict.fromkeys(SCALES, 10 * len(titles)), "late")

    session.hold(ask_in_page)
    assert titles == ["Questions about block 1 of 2", "Questions about block 2 of 2"]
    answers = read_answers(tmp_path)
    assert [(entry["raw_tlx"], entry["comment"]) for entry in answers] == [(10.0, "late"), (20.0, "late")]


def test_the_participant_does_not_learn_the_condition(tmp_path: Path) -> None:
    """No text of a session has the name of a condition."""
    session = Session(tmp_path, *BLOCK, *BLOCK)
    session.hold()
    assert not any("L0" in text or "L5" in text for text in session.texts)


@pytest.mark.parametrize(("answered", "driven"), [(1, 1), (2, 2), (5, 2), (9, 2), (10, 3)])
def test_an_interrupted_session_continues(answered: int, driven: int, tmp_path: Path) -> None:
    """After an interruption no finished drive is repeated, and a block without all answers is asked from its start."""
    first = Session(tmp_path, *(BLOCK + BLOCK)[:answered])
    with pytest.raises(KeyboardInterrupt):
        first.hold()
    assert len(first.driven) == driven
    answered_blocks = len(read_answers(tmp_path))
    remaining = [[ENTER] * (2 - max(0, min(2, driven - 2 * number))) for number in range(2)]
    answers = [text for number in range(answered_blocks, 2) for text in (*remaining[number], *BLOCK[2:])]
    second = Session(tmp_path, *answers)
    second.hold()
    assert first.driven + second.driven == [run.name for block in second.blocks for run in block.runs]
    assert len(read_answers(tmp_path)) == 2


@pytest.mark.parametrize(("ending", "valid"), [("safe_stop", True), ("completed", False)])
def test_a_flawed_drive_can_be_repeated(ending: str, tmp_path: Path, *, valid: bool) -> None:
    """A stopped or invalid drive is repeated as often as requested, and each time the earlier drive is set aside."""
    session = Session(tmp_path, ENTER, "r", ENTER, "r", ENTER, ENTER, ENTER, *BLOCK[2:], *BLOCK)
    session.results = [{"ending": ending, "valid": valid}] * 3
    session.hold()
    names = [run.name for block in session.blocks for run in block.runs]
    assert session.driven == [names[0], names[0], *names]
    assert sorted(path.name for path in (tmp_path / "repeated").iterdir()) == [f"{names[0]}.1", f"{names[0]}.2"]
    assert sorted(path.name for path in (tmp_path / "runs").iterdir()) == sorted(names)


def test_a_wrong_answer_is_asked_again(tmp_path: Path) -> None:
    """An answer that is not a number of the scale is explained, and asked again."""
    wrong = (ENTER, ENTER, "a lot", "12", "-5", "105", "5.0", *BLOCK[2:])
    session = Session(tmp_path, *wrong, *BLOCK)
    session.hold()
    explained = [text for text in session.texts if text.startswith("mental_demand is ")]
    assert len(explained) == 5
    assert read_answers(tmp_path)[0]["tlx"]["mental_demand"] == 5
