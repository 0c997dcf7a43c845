"""The plan of a study: the runs of each participant in their order."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from lavt.assembly.entropy import participant_seed
from lavt.config import HUMAN, RunConfig, StudyConfig
from lavt.config_file import parse_config
from lavt.errors import UserError
from lavt.experiment.runs.plan import PlannedRun, plan_run, run_name, with_changes
from lavt.experiment.study.balanced_order import order_of
from lavt.experiment.sweep.workers import is_finished

OWN_KEYS = set(StudyConfig.model_fields) - set(RunConfig.model_fields)
"""The keys of a study's config that the config of a run does not have."""


@dataclass(frozen=True, slots=True)
class Block:
    """The runs of a participant under one condition, in their order; `number` begins with 1."""

    participant: int
    number: int
    condition: str
    runs: Sequence[PlannedRun]


def plan_participant(study: StudyConfig, participant: int) -> list[Block]:
    """Plan the blocks of a participant.

    In every block the routes, their repetitions and the seeds of the runs are equal, so only the condition differs.
    Raises `UserError` for a participant whom the study does not have, and for a run that `plan_run` rejects.
    """
    if not 1 <= participant <= study.participants:
        raise UserError(
            f"there is no participant {participant}: name one from 1 to {study.participants}, or set participants"
        )
    base = study.model_dump(mode="json", exclude=OWN_KEYS)
    drives = list(itertools.product(range(study.repetitions), study.routes))
    blocks = []
    for number, condition in enumerate(order_of(participant, study.conditions, study.seed), start=1):
        runs = []
        for order, (repetition, route) in enumerate(drives, start=(number - 1) * len(drives) + 1):
            changes = {
                "vehicle.route": route,
                "network.condition": condition,
                "repetition": repetition,
                "seed": participant_seed(study.seed, participant),
                "study.participant": str(participant),
                "study.block": number,
                "study.order": order,
            }
            config = parse_config(RunConfig, with_changes(base, changes), "the study")
            name = f"{_prefix(participant)}{order:03d}_{run_name(route, condition, repetition, {})}"
            runs.append(plan_run(config, name=name, driver=HUMAN))
        blocks.append(Block(participant, number, condition, runs))
    return blocks


def check_order(blocks: Sequence[Block], runs_dir: Path) -> None:
    """Raise `UserError` if a participant of `blocks` has a finished run in `runs_dir` that the plan does not have."""
    planned = {run.name for block in blocks for run in block.runs}
    for participant in {block.participant for block in blocks}:
        for directory in sorted(runs_dir.glob(f"{_prefix(participant)}*")):
            if is_finished(directory) and directory.name not in planned:
                raise UserError(
                    f"{directory} is not in the plan of participant {participant}, so the order has changed since it "
                    "was driven: use the config and the version of LAVT of then, or name another --out"
                )


def _prefix(participant: int) -> str:
    return f"p{participant:03d}_"
