from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml

from lavt.config import RunConfig, StudyConfig
from lavt.config_file import load_config, shipped
from lavt.errors import UserError
from lavt.experiment.analysis.results import IDENTITY_KEYS, write_json
from lavt.experiment.runs.run import CONFIG, RESULT, config_text
from lavt.experiment.runs.side_configs import client_config
from lavt.experiment.study.balanced_order import order_of
from lavt.experiment.study.study import STUDY, open_study
from lavt.experiment.study.study_plan import Block, check_order, plan_participant


def study(*changes: str) -> StudyConfig:
    return load_config(StudyConfig, shipped("configs/study.yaml"), changes)


def plan(participant: int = 3, *changes: str) -> list[Block]:
    return plan_participant(study(*changes), participant)


def test_a_block_has_one_condition_and_all_drives() -> None:
    """The blocks have the conditions in the participant's order; each block has all routes in each repetition."""
    blocks = plan(3, "routes=[a_key, b_key]", "repetitions=2", "conditions=[L0, L1, L5]")
    assert [block.condition for block in blocks] == list(order_of(3, ("L0", "L1", "L5"), 1))
    for block in blocks:
        assert {run.config.network.condition for run in block.runs} == {block.condition}
        drives = [(run.config.vehicle.route, run.config.repetition) for run in block.runs]
        assert drives == [("a_key", 0), ("b_key", 0), ("a_key", 1), ("b_key", 1)]


def test_the_identity_has_the_place_in_the_study() -> None:
    """Each run has participant, block and order in its identity, and its name begins with participant and order."""
    runs = [run for block in plan(3, "routes=[a_key, b_key]") for run in block.runs]
    places = [(run.identity["participant"], run.identity["block"], run.identity["order"]) for run in runs]
    assert places == [("3", 1 + number // 2, 1 + number) for number in range(8)]
    assert [run.name[:9] for run in runs] == [f"p003_{number:03d}_" for number in range(1, 9)]


def test_seeds_differ_between_participants_and_not_between_conditions() -> None:
    """A drive has the same seed under all conditions, and another for each route, repetition and participant."""
    seeds: dict[Any, set[int]] = {}
    for participant in (1, 2):
        for block in plan(participant, "routes=[a_key, b_key]", "repetitions=2"):
            for run in block.runs:
                key = (participant, run.config.vehicle.route, run.config.repetition)
                seeds.setdefault(key, set()).add(run.seed)
    assert all(len(values) == 1 for values in seeds.values())
    assert len(set.union(*seeds.values())) == len(seeds) == 8


@pytest.mark.parametrize("participant", [0, 13])
def test_unknown_participants_are_rejected(participant: int) -> None:
    """A participant whom the study does not have is rejected with the range of numbers."""
    with pytest.raises(UserError, match="from 1 to 12"):
        plan(participant)


def test_the_page_of_a_participant_shows_no_latency() -> None:
    """The client's config of a run in a study hides the latencies from the page; that of another run shows them."""
    run = plan()[0].runs[0]
    assert not client_config(run.config, run.seed).console.shows_latency
    assert client_config(RunConfig(), 1).console.shows_latency


def finish_first(blocks: list[Block], out: Path, config: StudyConfig) -> Path:
    """Write the files of a study whose first run is finished; return the run's directory."""
    run = blocks[0].runs[0]
    directory = out / "runs" / run.name
    directory.mkdir(parents=True)
    (directory / CONFIG).write_text(config_text(run))
    write_json(directory / RESULT, dict.fromkeys(IDENTITY_KEYS) | dict(run.identity))
    (out / STUDY).write_text(yaml.safe_dump(config.model_dump(mode="json")))
    return directory


def test_a_study_resumes(tmp_path: Path) -> None:
    """A finished run is not driven again, and the same config continues the study."""
    blocks = plan()
    finish_first(blocks, tmp_path, study())
    assert open_study(study(), blocks, tmp_path) == 3


def test_a_changed_config_is_rejected(tmp_path: Path) -> None:
    """A study that was begun with another config is rejected with the keys that differ."""
    finish_first(plan(), tmp_path, study())
    with pytest.raises(UserError, match=r"another config \(participants\)"):
        open_study(study("participants=8"), plan(3, "participants=8"), tmp_path)


def test_a_run_of_another_config_is_rejected(tmp_path: Path) -> None:
    """A finished run whose own config differs from the plan is rejected."""
    directory = finish_first(plan(), tmp_path, study())
    (directory / CONFIG).write_text("seed: 5\n")
    with pytest.raises(UserError, match="was driven with another config"):
        open_study(study(), plan(), tmp_path)


def test_a_changed_order_is_rejected(tmp_path: Path) -> None:
    """A finished run that is not in the participant's plan is rejected; one of another participant does not matter."""
    finish_first(plan(3, "seed=5"), tmp_path, study())
    with pytest.raises(UserError, match="order has changed"):
        check_order(plan(3), tmp_path / "runs")
    check_order(plan(4), tmp_path / "runs")
