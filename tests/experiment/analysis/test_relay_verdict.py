"""What is asked of the relay, and how it is judged by what it says it did."""

from __future__ import annotations

from typing import Any

import pytest

from lavt.assembly.links import injected
from lavt.cli.relay import flows
from lavt.config import Condition, ImpairmentConfig, RunConfig
from lavt.config_file import conditions, parse_config
from lavt.experiment.runs.plan import PlannedRun, injected_entry, plan_run
from lavt.experiment.runs.real_run import _relay_config, _requested_ms, relay_reasons


def planned(condition: str, **network: Any) -> PlannedRun:
    return plan_run(parse_config(RunConfig, {"time": "real", "network": {"condition": condition, **network}}, "test"))


@pytest.mark.parametrize("name", sorted(conditions()))
def test_the_relay_is_told_all(name: str) -> None:
    """From a run's condition to the flows of the relay nothing is lost: the same law, trace, queue and seed."""
    run = planned(name, inherent="paper_wifi5")
    video, control = flows(_relay_config(run, 5600, 7448))
    requested = run.requested
    assert video.downstream_injected == injected("video", requested.video_ms, requested.video, run.seed)
    assert control.upstream_injected == injected("control", requested.control_ms, requested.control, run.seed)
    assert video.upstream_injected is control.downstream_injected is None
    constant = video.downstream_injected is None
    assert video.downstream.constant_ms == pytest.approx(_inherent_ms() + (requested.video_ms if constant else 0))


def _inherent_ms() -> float:
    video, _ = flows(_relay_config(planned("L0", inherent="paper_wifi5"), 5600, 7448))
    return video.downstream.constant_ms


def said(
    held: tuple[float | None, float | None], late: tuple[float | None, float | None], **requested: Any
) -> list[str]:
    ways = ("video downstream", "control upstream")
    return relay_reasons(
        {
            "requested_ms": requested,
            "held_ms": dict(zip(ways, held, strict=True)),
            "late_ms": dict(zip(ways, late, strict=True)),
        }
    )


def test_constant_delays_are_judged_by_their_median() -> None:
    """A constant delay must be held within 1 ms, whatever the relay thinks of its punctuality."""
    assert said((75.9, 0.1), (0.9, 0.1), video=75.0, control=0.0) == []
    assert said((76.1, 0.1), (0.0, 0.1), video=75.0, control=0.0) == [
        "video was delayed by 76.1 ms where 75 ms was asked"
    ]
    assert said((75.0, None), (0.0, None), video=75.0, control=0.0) == ["nobody measured the injected delay of control"]


def test_what_varies_is_judged_by_its_lateness() -> None:
    """Where more than a constant delay was asked, no hold is wrong, but leaving over 1 ms late is."""
    assert said((500.0, 0.1), (0.3, 0.1), video=None, control=0.0) == []
    assert said((75.0, 0.1), (1.5, 0.1), video=None, control=0.0) == [
        "video left the relay 1.5 ms later than was asked, in the median"
    ]
    assert said((None, 0.1), (None, 0.1), video=None, control=0.0) == ["nobody measured the injected delay of video"]


def test_a_relay_that_said_nothing() -> None:
    """Without a word of the relay nobody knows what was injected."""
    assert relay_reasons({}) == [f"nobody measured the injected delay of {flow}" for flow in ("video", "control")]


def test_requested_of_the_relay() -> None:
    """A median is asked of a flow with a constant delay only."""
    assert _requested_ms(planned("L4")) == {"video": 150, "control": 75}
    assert _requested_ms(planned("jitter")) == {"video": None, "control": 0}


def test_least() -> None:
    """A latency is too short for a condition only where jitter and overtaking do not explain it."""
    assert injected_entry(conditions()["L4"]) == {"injected_ms": {"video": 150, "control": 75}}
    jitter, early = ImpairmentConfig(jitter_ms=10), ImpairmentConfig(reorder=0.5)
    requested = Condition(video_ms=75, control_ms=30, video=jitter, control=jitter)
    assert injected_entry(requested)["injected_least_ms"] == {"video": 35, "control": 0}
    requested = Condition(video_ms=75, control_ms=30, video=early)
    assert injected_entry(requested)["injected_least_ms"] == {"video": 0, "control": 30}
