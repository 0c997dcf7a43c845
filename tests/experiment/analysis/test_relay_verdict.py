"""Tests of the relay's request, and of the reasons that its measurements give."""

from __future__ import annotations

from typing import Any

import pytest

from lavt.assembly.links import link_injection
from lavt.cli.relay import flows
from lavt.config import Condition, ImpairmentConfig, RunConfig
from lavt.config_file import conditions, parse_config
from lavt.experiment.analysis.invalid_reason import InvalidCode, InvalidReason, not_measured
from lavt.experiment.runs.plan import PlannedRun, injected_entry, plan_run
from lavt.experiment.runs.real_run import relay_checks, relay_config, relay_invalid_reasons, requested_ms


def planned(condition: str, **network: Any) -> PlannedRun:
    return plan_run(parse_config(RunConfig, {"time": "real", "network": {"condition": condition, **network}}, "test"))


@pytest.mark.parametrize("name", sorted(conditions()))
def test_the_relay_receives_the_whole_condition(name: str) -> None:
    """The relay's flows have the delay, impairment, trace and seed of the run's condition."""
    run = planned(name, inherent="paper_wifi5")
    video, control = flows(relay_config(run, "127.0.0.1:5600", "127.0.0.1:7448"))
    requested = run.requested
    assert video.downstream_injected == link_injection("video", requested.video_ms, requested.video, run.seed)
    assert control.upstream_injected == link_injection("control", requested.control_ms, requested.control, run.seed)
    assert video.upstream_injected is control.downstream_injected is None
    is_constant = video.downstream_injected is None
    assert video.downstream.constant_ms == pytest.approx(_inherent_ms() + (requested.video_ms if is_constant else 0))


def _inherent_ms() -> float:
    video, _ = flows(relay_config(planned("L0", inherent="paper_wifi5"), "127.0.0.1:5600", "127.0.0.1:7448"))
    return video.downstream.constant_ms


def reasons(
    median_ms: tuple[float | None, float | None], lateness_ms: tuple[float | None, float | None], **requested: Any
) -> list[InvalidReason]:
    """Return the reasons from the relay's measurements (video, control)."""
    directions = ("video downstream", "control upstream")
    return relay_invalid_reasons(
        {
            "requested_ms": requested,
            "held_ms": dict(zip(directions, median_ms, strict=True)),
            "late_ms": dict(zip(directions, lateness_ms, strict=True)),
        }
    )


def test_the_check_has_the_largest_difference() -> None:
    """The check has the larger difference of both flows: from the request, or of a varying delay from the plan."""
    report = {"held_ms": {"video downstream": 75.4, "control upstream": 9.0}, "late_ms": {"control upstream": -0.7}}
    (check,) = relay_checks({"requested_ms": {"video": 75.0, "control": None}, **report})
    assert (check.code, check.limit) == (InvalidCode.INJECTION_DIFFERS, 1.0)
    assert check.value == pytest.approx(0.7)
    assert relay_checks({}) == []


def test_a_constant_delay_is_judged_by_its_median() -> None:
    """The median of a constant delay must be within 1 ms of the request, whatever the reported lateness."""
    assert reasons((75.9, 0.1), (0.9, 0.1), video=75.0, control=0.0) == []
    (reason,) = reasons((76.1, 0.1), (0.0, 0.1), video=75.0, control=0.0)
    assert reason.code is InvalidCode.INJECTION_DIFFERS
    assert "76.1 ms" in reason.text
    (reason,) = reasons((75.0, None), (0.0, None), video=75.0, control=0.0)
    assert reason == not_measured("control")


def test_a_variable_delay_is_judged_by_its_lateness() -> None:
    """A variable delay makes a run invalid only if packets are sent more than 1 ms late, or if it is not measured."""
    assert reasons((500.0, 0.1), (0.3, 0.1), video=None, control=0.0) == []
    (reason,) = reasons((75.0, 0.1), (1.5, 0.1), video=None, control=0.0)
    assert reason.code is InvalidCode.INJECTION_DIFFERS
    assert "1.5 ms" in reason.text
    (reason,) = reasons((None, 0.1), (None, 0.1), video=None, control=0.0)
    assert reason == not_measured("video")


def test_a_relay_without_measurements_makes_the_run_invalid() -> None:
    """Without the relay's measurements, a run is invalid because no flow's delay was measured."""
    for reason, flow in zip(relay_invalid_reasons({}), ("video", "control"), strict=True):
        assert reason == not_measured(flow)


def test_only_a_constant_delay_has_a_requested_median() -> None:
    """Only a flow with a constant delay has a requested median."""
    assert requested_ms(planned("L4")) == {"video": 150, "control": 75}
    assert requested_ms(planned("jitter")) == {"video": None, "control": 0}


def test_least_expected_delay() -> None:
    """Jitter and reordering reduce the least expected delay of a condition."""
    assert injected_entry(conditions()["L4"]) == {"injected_ms": {"video": 150, "control": 75}}
    jitter, reordering = ImpairmentConfig(jitter_ms=10), ImpairmentConfig(reorder=0.5)
    requested = Condition(video_ms=75, control_ms=30, video=jitter, control=jitter)
    assert injected_entry(requested)["injected_least_ms"] == {"video": 75 - 4 * 10, "control": 0}
    requested = Condition(video_ms=75, control_ms=30, video=reordering)
    assert injected_entry(requested)["injected_least_ms"] == {"video": 0, "control": 30}
