"""The speed governor as a config describes it."""

from __future__ import annotations

import pytest

from lavt.assembly.nodes import build_governor
from lavt.config import RunConfig, SweepConfig
from lavt.config_file import build_config, load_config, shipped
from lavt.control.preset import DESIGNED
from lavt.control.pure_pursuit import lookahead_m
from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.errors import UserError
from lavt.experiment.boundary.delay_margin import LateralLoop, spectral_radius
from lavt.safety.governor import GovernorSettings

ENABLED = "safety.governor.enabled=true"


def settings_of(*changes: str) -> GovernorSettings:
    """Return the settings of the governor that a run's config with these changes builds."""
    governor = build_governor(build_config(RunConfig, {}, (ENABLED, *changes), "test").safety)
    assert governor is not None
    return governor.settings


def test_a_vehicle_has_no_governor_by_default() -> None:
    """Without the key, no governor is built."""
    assert build_governor(RunConfig().safety) is None


def test_the_defaults_of_the_config_are_those_of_the_governor() -> None:
    """The config's defaults are those of the governor, with the highest speed of the vehicle as the nominal one."""
    assert settings_of() == GovernorSettings(nominal_mps=RunConfig().safety.speed_limit_mps)
    assert settings_of("safety.speed_limit_mps=5.0").nominal_mps == 5.0


def test_every_key_reaches_the_governor() -> None:
    """Each key of the config sets the value of the same name."""
    values = {
        "latency_limit_ms": "150.0",
        "nominal_mps": "8.0",
        "sight_m": "15.0",
        "braking_mps2": "3.0",
        "brake_delay_ms": "100.0",
        "reaction_ms": "900.0",
        "delay_margin": "[[5.0, 400.0], [8.0, 300.5]]",
        "window_s": "2.0",
        "tail": "0.9",
        "rise_mps2": "0.25",
        "hysteresis_mps": "1.0",
    }
    assert settings_of(*(f"safety.governor.{key}={value}" for key, value in values.items())) == GovernorSettings(
        nominal_mps=8.0,
        latency_limit_ns=150 * NS_PER_MS,
        sight_m=15.0,
        braking_mps2=3.0,
        brake_delay_ns=100 * NS_PER_MS,
        reaction_ns=900 * NS_PER_MS,
        delay_margin=((5.0, 400 * NS_PER_MS), (8.0, 300_500_000)),
        window_ns=2 * NS_PER_S,
        tail=0.9,
        rise_mps2=0.25,
        hysteresis_mps=1.0,
    )


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ("delay_margin=[[5.0, 300.0], [8.0, 400.0]]", "growing speeds with delays that do not grow"),
        ("delay_margin=[[5.0, 300.0], [5.0, 200.0]]", "growing speeds with delays that do not grow"),
        ("delay_margin=[[5.0]]", "safety.governor.delay_margin.0.1"),
        ("delay_margin=[5.0, 300.0]", "write a list"),
        ("delay_margin=5.0", "write a list"),
        ("delay_margin=[[0.0, 300.0]]", "greater than 0"),
        ("latency_limit_ms=0", "greater than 0"),
        ("tail=1.5", "less than or equal to 1"),
        ("rise_mps2=.nan", "finite"),
        ("enable=true", "did you mean 'enabled'"),
    ],
)
def test_a_wrong_value_is_one_sentence(change: str, reason: str) -> None:
    """A wrong value is rejected in one sentence that says what is wrong."""
    with pytest.raises(UserError, match=reason) as rejected:
        build_config(RunConfig, {}, (f"safety.governor.{change}",), "test")
    assert "\n" not in str(rejected.value)


@pytest.mark.full
def test_the_shipped_delay_margins_are_those_of_the_theory() -> None:
    """At each speed of `configs/governor.yaml`, the loop of `designed` becomes unstable at the delay of the table."""
    table = load_config(SweepConfig, shipped("configs/governor.yaml")).safety.governor.delay_margin
    assert len(table) == 8
    for speed_mps, delay_ms in table:
        loop = LateralLoop(lookahead_m(DESIGNED.lookahead_s, speed_mps) / speed_mps, speed_mps=speed_mps)
        assert spectral_radius(loop, (delay_ms - 1) / 1000) < 1, speed_mps
        assert spectral_radius(loop, (delay_ms + 2) / 1000) > 1, speed_mps
