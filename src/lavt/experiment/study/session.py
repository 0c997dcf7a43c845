"""The session of a participant who drives: instructions, drives, and the questions at the end of each block."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from lavt.errors import UserError
from lavt.experiment.runs.plan import PlannedRun
from lavt.experiment.study.answers import SCALES, STEP, Store, check_scale, has_answers, write_answers
from lavt.experiment.study.study_plan import Block
from lavt.experiment.sweep.sweep import remove_all_unfinished
from lavt.experiment.sweep.workers import is_finished

STOPPED = "safe_stop"
"""The ending of a drive that a person has stopped, perhaps by releasing the dead-man control."""
REPEATED = "repeated"
"""The directory of the drives that were repeated, in the directory of a study."""


@dataclass(frozen=True, slots=True)
class Experimenter:
    """What a session does outside: show a text, ask a question and return the answer, and drive a run."""

    say: Callable[[str], None]
    ask: Callable[[str], str]
    drive: Callable[[PlannedRun, Path], Mapping[str, Any]]
    """Drives a run into its directory, and returns its result."""
    ask_in_page: Callable[[str, Store], None] | None = None
    """Asks the questions about a block in a page with this title, and stores the answers; None: `ask` does."""


def hold_session(blocks: Sequence[Block], instructions: str, out: Path, experimenter: Experimenter) -> None:
    """Drive the runs of a participant that are not finished, and ask for the answers of each block without answers.

    No text names a condition. After an interruption, the same call continues the session.
    """
    for block in blocks:
        if has_answers(out, block):
            continue
        experimenter.say(f"\nBlock {block.number} of {len(blocks)}, {len(block.runs)} drives.")
        if instructions:
            experimenter.say(instructions)
        remove_all_unfinished(block.runs, out / "runs")
        for number, run in enumerate(block.runs, start=1):
            directory = out / "runs" / run.name
            if is_finished(directory):
                continue
            _drive(run, directory, f"Drive {number} of {len(block.runs)}", experimenter)
        title = f"Questions about block {block.number} of {len(blocks)}"
        _ask_about(title, experimenter, partial(write_answers, out, block))
        if block is not blocks[-1]:
            experimenter.say("Take a break if you like. Ctrl-C ends the session, and the same command continues it.")
    experimenter.say("The participant has driven all blocks.")


def _drive(run: PlannedRun, directory: Path, title: str, experimenter: Experimenter) -> None:
    """Drive a run; if it was stopped or is not valid, repeat it as often as the answers request.

    The reasons for an invalid run are not shown, because they can have the injected delays.
    """
    question = f"{title}: press Enter to begin."
    while True:
        experimenter.ask(question)
        result = experimenter.drive(run, directory)
        experimenter.say(f"{title} has ended.")
        flaws = []
        if result["ending"] == STOPPED:
            flaws.append("It was stopped before the end of the route")
        if not result["valid"]:
            flaws.append("It is not valid, because this machine was too busy or a part failed")
        if not flaws:
            return
        if experimenter.ask(f"{'. '.join(flaws)}: press Enter to keep it, or type r to repeat it.").strip() != "r":
            return
        _set_aside(directory)


def _set_aside(directory: Path) -> None:
    """Move the directory of a drive that is repeated to `REPEATED`, where no report finds it."""
    aside = directory.parents[1] / REPEATED
    aside.mkdir(exist_ok=True)
    number = len(list(aside.glob(f"{directory.name}.*"))) + 1
    directory.rename(aside / f"{directory.name}.{number}")


def _ask_about(title: str, experimenter: Experimenter, store: Store) -> None:
    """Ask the questions about a block, and store the answers."""
    if experimenter.ask_in_page is not None:
        experimenter.ask_in_page(title, store)
        return
    scales = _ask_scales(experimenter)
    store(scales, experimenter.ask("Comment on this block (one line, or only Enter):").strip())


def _ask_scales(experimenter: Experimenter) -> dict[str, int]:
    experimenter.say(f"Questions about this block: answer with a number from 0 (very low) to 100, in steps of {STEP}.")
    return {name: _ask_scale(experimenter, name, question) for name, question in SCALES.items()}


def _ask_scale(experimenter: Experimenter, name: str, question: str) -> int:
    while True:
        text = experimenter.ask(question).strip()
        try:
            value = int(text) if text.isdecimal() else text
            check_scale(name, value)
        except UserError as error:
            experimenter.say(f"{error}.")
        else:
            return int(value)
