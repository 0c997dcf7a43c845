"""Tests of the benchmarks that measure costs and that compare real with virtual time, without driving in real time."""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from benchmarks.measure_costs import LEVELS, add_drive, correlation, costs
from benchmarks.quiet import require_quiet
from benchmarks.real_vs_virtual import agreement, plans

from lavt.config import Costs, RunConfig
from lavt.config_file import load_config, parse_config, shipped
from lavt.domain import NS_PER_S
from lavt.errors import WorkError
from lavt.experiment.runs.plan import plan_run
from lavt.experiment.runs.virtual_run import build_loop, drive, read_costs
from lavt.recording.record import read_record
from lavt.runtime.virtual import HostClock


def test_costs_are_measured_from_records(tmp_path: Path) -> None:
    """From the records of a virtual drive on one clock, the measurement finds the costs that the drive had."""
    changes = ("fidelity=geometry", "costs=constant")
    clock = HostClock(1_000 * NS_PER_S, 0)
    out = tmp_path / "run"
    loop = build_loop(
        plan_run(load_config(RunConfig, shipped("configs/demo.yaml"), changes)), out, clocks=(clock, clock)
    )
    drive(loop, limit_ns=6 * NS_PER_S)
    stages: dict[str, list[float]] = defaultdict(list)
    links: dict[str, list[float]] = defaultdict(list)
    add_drive(read_record(out / "server.mcap"), read_record(out / "client.mcap"), stages, links)
    del links["state"]  # not recorded at fidelity geometry
    measured, used = parse_config(Costs, costs(stages, links, "a test"), "measured"), read_costs()
    assert measured.stages_us.keys() == used.stages_us.keys()
    for node, medians in used.stages_us.items():
        assert measured.stages_us[node] == pytest.approx(medians, abs=0.2), node
    assert measured.links_us == pytest.approx({name: used.links_us[name] for name in ("video", "control")}, abs=0.2)
    assert {len(values) for values in measured.link_quantiles_us.values()} == {len(LEVELS)}


def test_correlation_of_consecutive_values() -> None:
    """Independent values have a correlation near 0, and slowly changing values one near 1."""
    values = np.random.default_rng(1).normal(size=2000)
    assert abs(correlation(values.tolist())) < 0.1
    assert correlation(np.cumsum(values).tolist()) > 0.9
    assert np.isnan(correlation([1.0] * 20))


def test_a_busy_machine_is_rejected(monkeypatch: pytest.MonkeyPatch) -> None:
    """On a busy machine the benchmarks end, unless they are allowed to continue."""
    monkeypatch.setattr("benchmarks.quiet.busy_share", lambda: 0.4)
    with pytest.raises(WorkError, match="40%"):
        require_quiet(allow_busy=False)
    assert require_quiet(allow_busy=True) == 0.4
    monkeypatch.setattr("benchmarks.quiet.busy_share", lambda: 0.02)
    assert require_quiet(allow_busy=False) == 0.02


def test_the_same_runs_are_planned_in_real_and_virtual_time() -> None:
    """Real and virtual runs have the same names and seeds."""
    planned = plans(["a_key"], ["L0", "L3"], 2, [])
    assert [run.name for run in planned["real"]] == ["a_key_L0_00", "a_key_L0_01", "a_key_L3_00", "a_key_L3_01"]
    assert len({tuple((run.name, run.seed) for run in runs) for runs in planned.values()}) == 1
    assert {kind: runs[0].config.time for kind, runs in planned.items()} == {
        "real": "real",
        "virtual": "virtual",
        "constant": "virtual",
    }


def entry(p50_ms: float, p95_ms: float, p95_m: float, *, completed: bool = True, valid: bool = True) -> dict[str, Any]:
    return {
        "loop_ms": {"p50": p50_ms, "p95": p95_ms},
        "p95_m": p95_m,
        "ending": "completed" if completed else "off_road",
        "completed_in_own_lane": completed,
        "valid": valid,
    }


def test_agreement_of_real_and_virtual_time() -> None:
    """Runs agree if loop latency, P95 and completion are similar; invalid runs do not count."""
    real = entry(240, 244, 1.0)
    assert agreement([(real, entry(241, 246, 1.15))])["agrees"]
    for other in (
        entry(247, 248, 1.0),
        entry(240, 250, 1.0),
        entry(240, 244, 1.3),
        entry(240, 244, 1.0, completed=False),
    ):
        assert agreement([(real, other)])["agrees"] is False
    with_invalid = agreement([(real, real), (entry(300, 400, 9.0, valid=False), real)])
    assert (with_invalid["agrees"], with_invalid["valid"], with_invalid["runs"]) == (True, 1, 2)
    assert agreement([(entry(300, 400, 9.0, valid=False), real)])["agrees"] is None
