from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from lavt.config import StudyConfig
from lavt.config_file import load_config, shipped
from lavt.errors import UserError
from lavt.experiment.study.answers import SCALES, has_answers, raw_tlx, read_answers, write_answers
from lavt.experiment.study.study_plan import plan_participant

BLOCKS = plan_participant(load_config(StudyConfig, shipped("configs/study.yaml")), 2)
GIVEN = dict(zip(SCALES, (10, 20, 30, 40, 50, 75), strict=True))


def test_answers_are_read_as_they_were_written(tmp_path: Path) -> None:
    """The answers of a block are read with its place, the scales, their mean, and the comment."""
    write_answers(tmp_path, BLOCKS[1], GIVEN, "Hard to steer.")
    write_answers(tmp_path, BLOCKS[0], None, "not asked")
    assert has_answers(tmp_path, BLOCKS[1])
    assert not has_answers(tmp_path, BLOCKS[2])
    nobody, given = read_answers(tmp_path)
    assert (nobody["block"], nobody["tlx"], nobody["raw_tlx"]) == (1, None, None)
    assert given == {
        "version": 1,
        "participant": "2",
        "block": 2,
        "condition": BLOCKS[1].condition,
        "driver": "two_point",
        "tlx": GIVEN,
        "raw_tlx": 37.5,
        "comment": "Hard to steer.",
    }


@pytest.mark.parametrize("value", [-5, 105, 12, 50.0, True, None])
def test_a_wrong_answer_is_rejected(value: Any) -> None:
    """A scale has a whole number from 0 to 100 in steps of 5."""
    with pytest.raises(UserError, match="effort"):
        raw_tlx(GIVEN | {"effort": value})


def test_a_missing_scale_is_rejected() -> None:
    """Without all six scales there is no raw TLX."""
    with pytest.raises(UserError, match="mental_demand"):
        raw_tlx({"effort": 5})


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"version": 2}, "version 1"),
        ({"raw_tlx": 12.0}, "not consistent"),
        ({"tlx": {"effort": 5}}, "scales"),
        ({"tlx": 5}, "restore"),
        ({"participant": "3"}, "another block"),
        ({"block": None}, "another block"),
    ],
)
def test_a_changed_file_is_rejected(changes: dict[str, object], reason: str, tmp_path: Path) -> None:
    """A file of another version, or whose values do not agree, is rejected in one sentence."""
    write_answers(tmp_path, BLOCKS[0], GIVEN, "")
    (path,) = (tmp_path / "answers").iterdir()
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))
    with pytest.raises(UserError, match=reason):
        read_answers(tmp_path)


@pytest.mark.parametrize("text", ["[]", '{"version"', ""])
def test_a_damaged_file_is_rejected(text: str, tmp_path: Path) -> None:
    """A file that has no answers is rejected in one sentence, and stays."""
    write_answers(tmp_path, BLOCKS[0], GIVEN, "")
    (path,) = (tmp_path / "answers").iterdir()
    path.write_text(text)
    with pytest.raises(UserError, match="restore the file"):
        read_answers(tmp_path)
    assert path.read_text() == text
