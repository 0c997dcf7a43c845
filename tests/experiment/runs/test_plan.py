from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest

from lavt.config import RunConfig, StudyPlaceConfig, SweepConfig
from lavt.config_file import parse_config
from lavt.errors import UserError
from lavt.experiment.analysis.results import IDENTITY_KEYS
from lavt.experiment.runs import plan
from lavt.experiment.runs.plan import PlannedRun, plan_run, plan_sweep


def planned(**keys: Any) -> list[PlannedRun]:
    return plan_sweep(parse_config(SweepConfig, keys, "test"))


@pytest.fixture
def any_route(monkeypatch: pytest.MonkeyPatch) -> None:
    """Allow routes that do not exist."""
    monkeypatch.setattr(plan, "check_names", lambda *_: None)


@pytest.mark.usefixtures("any_route")
def test_a_sweep_has_every_combination() -> None:
    """A sweep has every combination of route, condition and repetition once."""
    runs = planned(routes=["a_key", "b_key"], conditions=["L0", "L3", "L5"], repetitions=4)
    combinations = {(run.identity["route"], run.identity["condition"], run.identity["repetition"]) for run in runs}
    assert len(runs) == len(combinations) == 2 * 3 * 4


@pytest.mark.usefixtures("any_route")
def test_seeds_are_paired() -> None:
    """A repetition on a route has the same seed under all conditions; no two repetitions or routes share a seed."""
    runs = planned(routes=["a_key", "b_key"], conditions=["L0", "L3", "L5"], repetitions=4, seed=9)
    seeds: dict[tuple[str, int], set[int]] = {}
    for run in runs:
        seeds.setdefault((run.identity["route"], run.identity["repetition"]), set()).add(run.seed)
    assert {len(paired_seeds) for paired_seeds in seeds.values()} == {1}
    assert len(set.union(*seeds.values())) == len(seeds) == 8
    assert all(run.identity["seed"] == run.seed for run in runs)


def test_seeds_are_paired_over_axes() -> None:
    """Runs that differ only in a further axis have the same seed."""
    runs = planned(conditions=["L0"], repetitions=3, axes={"controller.preset": ["designed", "paper_calibrated"]})
    assert [run.seed for run in runs[:3]] == [run.seed for run in runs[3:]]
    assert len({run.seed for run in runs}) == 3


def test_seed_of_a_single_run() -> None:
    """A single run has the seed of the first repetition in a sweep; another `seed` in the config changes this seed."""
    single_run = plan_run(RunConfig(seed=5))
    assert single_run.seed == planned(conditions=["L0"], seed=5)[0].seed
    assert single_run.seed != plan_run(RunConfig(seed=6)).seed


AXES = {
    "video.bit_rate_bps": [1_000_000, 4_000_000],
    "safety.picture_age_limit_ms": [500.0, 2000.0],
    "controller.preset": ["designed", "paper_calibrated"],
    "study.participant": ["a/b", "../c", "d e", "é"],
}


def test_run_names_are_unique_and_safe() -> None:
    """Every run has a unique name that is safe as the name of a directory."""
    names = [run.name for run in planned(conditions=["L0", "L1"], repetitions=2, axes=AXES)]
    assert len(set(names)) == len(names) == 2 * 2 * 2 * 2 * 2 * 4
    for name in names:
        assert re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9=._-]{0,200}", name)
        assert Path(name).name == name
    assert planned(conditions=["L3"])[0].name == "a_key_L3_00"


def test_axes_change_nested_values() -> None:
    """A further axis changes exactly the value that it names, and the run's identity has this value."""
    runs = planned(conditions=["L2"], video={"gop_frames": 15}, axes={"video.bit_rate_bps": [1_000_000, 2_000_000]})
    assert [run.config.video.bit_rate_bps for run in runs] == [1_000_000, 2_000_000]
    axes = [run.identity["axes"] for run in runs]
    assert axes == [{"video.bit_rate_bps": 1_000_000}, {"video.bit_rate_bps": 2_000_000}]
    video = runs[0].config.video.model_copy(update={"bit_rate_bps": 2_000_000})
    assert runs[0].config.model_copy(update={"video": video}) == runs[1].config
    assert runs[0].config.video.gop_frames == 15


def test_axes_are_combined() -> None:
    """Further axes are combined: each value of one with each value of the other."""
    runs = planned(conditions=["L0"], axes={"video.gop_frames": [15, 30], "camera.rate_hz": [20.0, 30.0]})
    values = {(run.config.video.gop_frames, run.config.camera.rate_hz) for run in runs}
    assert values == {(15, 20.0), (15, 30.0), (30, 20.0), (30, 30.0)}


def test_a_sweep_without_axes() -> None:
    """Without further axes, a run's identity has no axes."""
    assert all("axes" not in run.identity for run in planned())


BAD_SWEEPS: list[tuple[dict[str, Any], str]] = [
    ({"axes": {"video.bit_rate": [1_000_000]}}, "did you mean 'bit_rate_bps'"),
    ({"axes": {"vidio.bit_rate_bps": [1_000_000]}}, "vidio"),
    ({"axes": {"vidio": [1]}}, "did you mean 'video'"),
    ({"axes": {"seed.more": [1]}}, "'seed.more'"),
    ({"axes": {"video.bit_rate_bps": ["fast"]}}, "video.bit_rate_bps"),
    ({"axes": {"video.bit_rate_bps": [1]}}, "video.bit_rate_bps"),
    ({"axes": {"network.condition": ["L0", "L1"]}}, "use 'conditions'"),
    ({"axes": {"vehicle.route": ["a_key"]}}, "use 'routes'"),
    ({"axes": {"repetition": [0, 1]}}, "use 'repetitions' for 'repetition'"),
    ({"axes": {"network": [{"inherent": "loopback"}]}}, "use 'conditions' for 'network.condition'"),
    ({"axes": {"vehicle": [{"route": "a_key"}]}}, "use 'routes' for 'vehicle.route'"),
    ({"axes": {"video.gop_frames": []}}, "has no run"),
    ({"routes": []}, "has no run"),
    ({"conditions": []}, "has no run"),
    ({"conditions": ["L0", "L0"]}, "a_key_L0_00 twice"),
    ({"axes": {"study.participant": ["a b", "a/b"]}}, "twice"),
    ({"conditions": ["L0", "L9"]}, "'L9': choose one of L0"),
    ({"routes": ["a_key", "nowhere"]}, "'nowhere': name one"),
    ({"controller": {"preset": "magic"}}, "'magic'; choose one of"),
    ({"axes": {"controller.preset": ["designed", "magic"]}}, "'magic'; choose one of"),
    ({"axes": {"controller.kind": ["wizard"]}}, "'wizard'; choose one of"),
    ({"axes": {"vehicle.kind": ["boat"]}}, "'boat'"),
    ({"fidelity": "pixels", "vehicle": {"lane_noise_m": 0.1}}, "choose fidelity geometry"),
]


@pytest.mark.parametrize(("keys", "expected"), BAD_SWEEPS, ids=[str(keys) for keys, _ in BAD_SWEEPS])
def test_invalid_sweeps_are_rejected(keys: dict[str, Any], expected: str) -> None:
    """A sweep with an invalid run, with duplicate runs or without runs is rejected before any run is driven."""
    with pytest.raises(UserError, match=re.escape(expected)):
        planned(**keys)


@pytest.mark.parametrize("time", ["real", "virtual"])
def test_identity_has_every_key(time: str) -> None:
    """A run's identity has every identifying key before the run is driven."""
    config = parse_config(
        RunConfig,
        {
            "time": time,
            "network": {"condition": "L4", "inherent": "paper_wifi5"},
            "controller": {"preset": "paper_calibrated"},
            "study": {"participant": "p7", "block": 2, "order": 3},
            "repetition": 4,
        },
        "test",
    )
    identity = plan_run(config, name="this").identity
    assert set(IDENTITY_KEYS) <= identity.keys()
    assert {name: identity[name] for name in IDENTITY_KEYS if name != "seed"} == {
        "run": "this",
        "time": time,
        "fidelity": "video",
        "injection": "model" if time == "virtual" else "relay",
        "inherent": "paper_wifi5",
        "route": "a_key",
        "condition": "L4",
        "controller": "lane_keeper",
        "preset": "paper_calibrated",
        "driver": "lane_keeper",
        "participant": "p7",
        "block": 2,
        "order": 3,
        "repetition": 4,
    }
    assert identity["injected_ms"] == {"video": 150, "control": 75}


def test_identity_without_a_study() -> None:
    """Without a study, the keys of the study are null."""
    identity = plan_run(RunConfig(study=StudyPlaceConfig())).identity
    assert (identity["participant"], identity["block"], identity["order"]) == (None, None, None)
