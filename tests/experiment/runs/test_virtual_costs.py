"""Tests of the costs of stages and links in virtual time: constant, or drawn from measured distributions."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import pytest

from lavt.config import Costs, RunConfig
from lavt.config_file import load_config, shipped
from lavt.domain import NS_PER_S
from lavt.experiment.analysis.metrics import measure
from lavt.experiment.runs.plan import plan_run
from lavt.experiment.runs.virtual_run import build_loop, drive, read_costs
from lavt.recording.record import Record, read_record

LEVELS = [0.0, 0.5, 0.95, 1.0]
FACTORS = [0.6, 1.0, 3.0, 8.0]
"""Each stage and link has these multiples of its median as its quantiles."""


def with_spread(medians: Costs) -> Costs:
    def quantiles(values_us: dict[str, float]) -> dict[str, list[float]]:
        return {name: [factor * us for factor in FACTORS] for name, us in values_us.items()}

    stages_us = {node: quantiles(values_us) for node, values_us in medians.stages_us.items()}
    return Costs(
        measured_on=medians.measured_on,
        stages_us=medians.stages_us,
        links_us=medians.links_us,
        levels=LEVELS,
        stage_quantiles_us=stages_us,
        link_quantiles_us=quantiles(medians.links_us),
    )


MEDIANS = read_costs().constant
SPREAD = with_spread(MEDIANS)


@pytest.fixture
def costs(monkeypatch: pytest.MonkeyPatch) -> pytest.MonkeyPatch:
    """Make runs read costs with a spread."""
    monkeypatch.setattr("lavt.experiment.runs.virtual_run.read_costs", lambda: SPREAD)
    return monkeypatch


def digest(out: Path, *changes: str, seconds: float = 3.0) -> str:
    config = load_config(RunConfig, shipped("configs/demo.yaml"), ("fidelity=geometry", *changes))
    loop = build_loop(plan_run(config), out)
    drive(loop, limit_ns=round(seconds * NS_PER_S))
    text: str = loop.digest.hexdigest()
    return text


def test_constant_costs_are_the_medians(costs: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """With `costs: constant`, a run is byte for byte that with a file of medians; drawn costs change it."""
    constant, drawn = digest(tmp_path / "constant", "costs=constant"), digest(tmp_path / "drawn")
    costs.setattr("lavt.experiment.runs.virtual_run.read_costs", lambda: MEDIANS)
    assert digest(tmp_path / "medians") == constant != drawn


def test_drawn_costs_are_reproducible(costs: pytest.MonkeyPatch, tmp_path: Path) -> None:  # noqa: ARG001
    """With drawn costs, too, equal runs have equal digests, and another seed changes the digest."""
    digests = [digest(tmp_path / str(number), f"seed={seed}") for number, seed in enumerate((1, 1, 2))]
    assert digests[0] == digests[1] != digests[2]


def durations_ns(record: Record, node: str, channel: str) -> dict[int, list[int]]:
    """Return the durations of all stages of a pipeline by the frame's stamp."""
    table = record.table("timeline")
    rows = zip(
        table.texts("node"),
        table.texts("channel"),
        table.ints("stamp_ns").tolist(),
        table.objects("stages"),
        strict=True,
    )
    return {
        stamp_ns: [late - early for (_, early), (_, late) in pairwise(stages)]
        for row_node, row_channel, stamp_ns, stages in rows
        if (row_node, row_channel) == (node, channel)
    }


def test_a_frame_has_the_same_costs_under_every_condition(costs: pytest.MonkeyPatch, tmp_path: Path) -> None:  # noqa: ARG001
    """Under two conditions, a frame has the same stamp and takes the same time in every stage of camera and driver."""
    records = []
    for condition in ("L0", "L5"):
        out = tmp_path / condition
        digest(out, f"network.condition={condition}", seconds=4)
        records.append((read_record(out / "server.mcap"), read_record(out / "client.mcap")))
    for side, node, channel in ((0, "camera", "wake"), (1, "driver", "access_unit"), (1, "driver", "view")):
        near, far = (durations_ns(pair[side], node, channel) for pair in records)
        common = near.keys() & far.keys()
        assert len(common) > 50
        assert {stamp: near[stamp] for stamp in common} == {stamp: far[stamp] for stamp in common}, (node, channel)
        assert len({tuple(durations) for durations in near.values()}) > 50


def test_drawn_costs_spread_the_loop_latency(costs: pytest.MonkeyPatch, tmp_path: Path) -> None:  # noqa: ARG001
    """Drawn costs spread the loop latency; with constant costs it hardly varies, and both have a similar median."""
    loop_ms = {}
    for kind in ("constant", "measured"):
        digest(tmp_path / kind, f"costs={kind}", seconds=12)
        records = (read_record(tmp_path / kind / f"{side}.mcap") for side in ("server", "client"))
        loop_ms[kind] = measure(*records).entry["loop_ms"]
    spread_ms = {kind: latency["p95"] - latency["p50"] for kind, latency in loop_ms.items()}
    assert spread_ms["constant"] < 0.5
    assert spread_ms["measured"] > 2
    assert loop_ms["constant"]["p50"] < loop_ms["measured"]["p50"] < 1.5 * loop_ms["constant"]["p50"]
