"""The answers of a participant at the end of a block: NASA-TLX and a free comment, in one JSON file for each block.

NASA-TLX has six scales from 0 to 100 in steps of 5 (S. G. Hart and L. E. Staveland, Development of NASA-TLX, Advances
in Psychology 52, 1988). The raw TLX is their mean, without the weights of the original (S. G. Hart, NASA-Task Load
Index, 20 Years Later, Proceedings of the Human Factors and Ergonomics Society 50, 2006).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from lavt.errors import UserError, WorkError
from lavt.experiment.analysis.results import read_json, write_json
from lavt.experiment.study.study_plan import Block

ANSWERS = "answers"
"""The directory with the answers, in the directory of a study."""
VERSION = 1
SCALES = {
    "mental_demand": "How mentally demanding was the task?",
    "physical_demand": "How physically demanding was the task?",
    "temporal_demand": "How hurried or rushed was the pace of the task?",
    "performance": "How unsuccessful were you in what you were asked to do?",
    "effort": "How hard did you have to work to reach your performance?",
    "frustration": "How insecure, discouraged, irritated, stressed and annoyed were you?",
}
"""The scales with their questions. In all of them 0 is the least load, so 0 of `performance` is a perfect one."""
STEP = 5

Store = Callable[[Mapping[str, int], str], None]
"""Stores the scales and the comment of a block."""


def raw_tlx(scales: Mapping[str, int]) -> float:
    """Return the raw TLX; raise `UserError` unless `scales` has all scales with numbers from 0 to 100 in steps of 5."""
    if scales.keys() != SCALES.keys():
        raise UserError(f"NASA-TLX has the scales {', '.join(SCALES)}: give each of them a number")
    for name, value in scales.items():
        check_scale(name, value)
    return sum(scales.values()) / len(scales)


def check_scale(name: str, value: object) -> None:
    """Raise `UserError` unless `value` is a number from 0 to 100 in steps of 5."""
    if type(value) is not int or value not in range(0, 101, STEP):
        raise UserError(f"{name} is {value!r}: write a number from 0 to 100 in steps of {STEP}")


def has_answers(out: Path, block: Block) -> bool:
    """Return whether the block has answers in the directory `out` of its study."""
    return _path(out, block).is_file()


def write_answers(out: Path, block: Block, scales: Mapping[str, int] | None, comment: str) -> None:
    """Write the answers of a block into the directory `out` of its study; `scales` is None if nobody was asked."""
    path = _path(out, block)
    path.parent.mkdir(exist_ok=True)
    answers = {
        "version": VERSION,
        "participant": str(block.participant),
        "block": block.number,
        "condition": block.condition,
        "driver": block.runs[0].identity["driver"],
        "tlx": None if scales is None else dict(scales),
        "raw_tlx": None if scales is None else raw_tlx(scales),
        "comment": comment,
    }
    write_json(path, answers)


def read_answers(out: Path) -> list[dict[str, Any]]:
    """Return the answers in the directory `out` of a study, in the order of participants and blocks.

    Raises `UserError` for a file that is not the answers of a block.
    """
    return [_read(path) for path in sorted((out / ANSWERS).glob("p*_b*.json"))]


def _path(out: Path, block: Block) -> Path:
    return out / ANSWERS / _file_name(block.participant, block.number)


def _file_name(participant: int, block: int) -> str:
    return f"p{participant:03d}_b{block:02d}.json"


def _read(path: Path) -> dict[str, Any]:
    try:
        answers = read_json(path)
    except WorkError as error:
        raise UserError(f"{error}: restore the file, or remove it") from error
    if not isinstance(answers, dict):
        raise UserError(f"{path} has no answers: restore the file, or remove it")
    if answers.get("version") != VERSION:
        raise UserError(f"{path} has no answers of version {VERSION}: read it with the version of LAVT that wrote it")
    try:
        expected = None if answers["tlx"] is None else raw_tlx(answers["tlx"])
        is_valid = (
            answers["raw_tlx"] == expected
            and {"condition", "driver"} <= answers.keys()
            and path.name == _file_name(int(answers["participant"]), int(answers["block"]))
        )
    except (KeyError, AttributeError) as error:
        raise UserError(f"{path} lacks {error}: restore the file, or remove it") from error
    except (TypeError, ValueError):
        is_valid = False
    if not is_valid:
        raise UserError(f"{path} is not consistent, or has the answers of another block: restore it, or remove it")
    return answers
