"""The plans of episodes, and the checks of the environment's parameters."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

pytest.importorskip("gymnasium")

from lavt.errors import UserError
from lavt.experiment.runs.plan import PlannedRun
from lavt.gym.episode_plan import EpisodePlanner
from lavt.gym.settings import check_count, check_positive, parse_changes, parse_names, parse_range_ms


def planner(**settings: Any) -> EpisodePlanner:
    defaults: dict[str, Any] = {
        "config": None,
        "changes": (),
        "fidelity": "geometry",
        "route": None,
        "condition": None,
        "video_ms": None,
        "control_ms": None,
    }
    return EpisodePlanner(**(defaults | settings))


def plans(count: int, options: dict[str, Any] | None = None, **settings: Any) -> list[PlannedRun]:
    generator, made = np.random.default_rng(5), planner(**settings)
    return [made.plan(generator, options or {}, f"episode-{number}") for number in range(count)]


def delays_ms(planned: PlannedRun) -> tuple[float, float]:
    return planned.requested.video_ms, planned.requested.control_ms


def test_an_episode_is_a_run_that_an_agent_drives() -> None:
    """A plan has the name, a seed of its own, the agent as driver, and the changes of the config."""
    first, second = plans(2, changes=("controller.speed_mps=5",))
    assert (first.name, second.name) == ("episode-0", "episode-1")
    assert first.seed != second.seed
    assert first.identity["controller"] == "agent"
    assert first.config.controller.speed_mps == 5


def test_routes_and_conditions_are_drawn() -> None:
    """Every named route and condition is drawn, and nothing else."""
    drawn = plans(20, route=("a_key", "b_key"), condition=["L0", "L3"])
    pairs = {(planned.config.vehicle.route, planned.config.network.condition) for planned in drawn}
    assert pairs == {(route, condition) for route in ("a_key", "b_key") for condition in ("L0", "L3")}


def test_delays_are_drawn_from_their_ranges() -> None:
    """A delay is uniform in its range; a number is a delay of every episode."""
    drawn = [delays_ms(planned) for planned in plans(30, video_ms=(20, 300), control_ms=50)]
    video_ms = [delay_ms for delay_ms, _ in drawn]
    assert 20 <= min(video_ms) < 60
    assert 260 < max(video_ms) <= 300
    assert {delay_ms for _, delay_ms in drawn} == {50.0}


def test_the_impairments_of_the_condition_remain() -> None:
    """A drawn delay replaces the constant delay of the condition, and its loss and jitter remain."""
    [planned] = plans(1, condition="L2", video_ms=10, changes=("network.video.loss=0.01",))
    assert (planned.requested.video_ms, planned.requested.video.loss) == (10, 0.01)
    assert planned.requested.control_ms == 0


def test_a_changed_setting_does_not_change_the_other_draws() -> None:
    """The seeds and delays of episodes do not depend on how many routes there are."""
    one = plans(3, video_ms=(0, 100))
    two = plans(3, video_ms=(0, 100), route=("a_key", "b_key"))
    assert [delays_ms(planned) for planned in one] == [delays_ms(planned) for planned in two]
    assert [planned.config.seed for planned in one] == [planned.config.seed for planned in two]


def test_options_of_a_reset_replace_the_draws() -> None:
    """Options set the route, the condition, the delays and the seed of an episode."""
    options = {"route": "b_key", "condition": "L1", "video_ms": 33.0, "control_ms": 44.0, "seed": 9}
    [planned] = plans(1, options, video_ms=(0, 10))
    assert planned.config.vehicle.route == "b_key"
    assert planned.config.network.condition == "L1"
    assert (*delays_ms(planned), planned.config.seed) == (33.0, 44.0, 9)


@pytest.mark.parametrize(
    ("settings", "options", "message"),
    [
        ({"route": "nowhere"}, {}, "nowhere"),
        ({"condition": ("L0", "L99")}, {}, "L99"),
        ({"config": "missing.yaml"}, {}, "missing.yaml"),
        ({"config": 3}, {}, "config is 3: give the path"),
        ({"changes": ("time=real",)}, {}, "virtual time"),
        ({"changes": ("controller.spee_mps=5",)}, {}, "speed_mps"),
        ({"fidelity": "photo"}, {}, "fidelity"),
        ({"video_ms": (300, 20)}, {}, "video_ms"),
        ({}, {"delay": 5}, "no option 'delay'"),
        ({}, {"video_ms": -1.0}, "delay_ms"),
        ({"changes": "vehicle.scenery=none"}, {}, "give a list of texts"),
        ({"changes": (3,)}, {}, "give a list of texts"),
        ({}, {"route": "nowhere"}, "nowhere"),
        ({}, 5, "options is 5: give a dictionary"),
    ],
)
def test_wrong_settings_are_one_sentence(settings: dict[str, Any], options: dict[str, Any], message: str) -> None:
    """A wrong setting or option raises a `UserError` that names it."""
    with pytest.raises(UserError, match=message):
        plans(1, options, **settings)


def test_changes_are_any_iterable_of_texts() -> None:
    """A generator gives the changes as a list does."""
    assert parse_changes(text for text in ("seed=2",)) == parse_changes(["seed=2"]) == ("seed=2",)


@pytest.mark.parametrize("name", ["video_ms", "control_ms"])
def test_both_ends_of_a_range_are_checked(name: str) -> None:
    """A range whose largest delay is not allowed is rejected before the first episode, not when it is drawn."""
    with pytest.raises(UserError, match="60000"):
        planner(**{name: (0, 60001)})


@pytest.mark.parametrize(("value", "expected"), [("a", ("a",)), (["a", "b"], ("a", "b")), (None, ("d",))])
def test_names_are_a_name_or_a_list(value: Any, expected: tuple[str, ...]) -> None:
    """A single name is a list of one name, and None is the default."""
    assert parse_names("route", value, "d") == expected


@pytest.mark.parametrize("value", [[], 5, ["a", 5], {"a": 1}])
def test_other_values_are_no_names(value: Any) -> None:
    """An empty list, and anything but text, is rejected."""
    with pytest.raises(UserError, match="route"):
        parse_names("route", value, "d")


@pytest.mark.parametrize(
    ("value", "expected"), [(None, None), (5, (5.0, 5.0)), ([1, 2.5], (1.0, 2.5)), (np.int64(5), (5.0, 5.0))]
)
def test_a_range_is_a_delay_or_a_pair(value: Any, expected: tuple[float, float] | None) -> None:
    """A single delay is a range of one value."""
    assert parse_range_ms("video_ms", value) == expected


@pytest.mark.parametrize("value", [-1, "5", (1, 2, 3), (2, 1), float("nan"), (0, float("inf")), True, 10**400])
def test_other_values_are_no_range(value: Any) -> None:
    """A negative delay, a reversed pair, and anything but finite numbers is rejected."""
    with pytest.raises(UserError, match="video_ms"):
        parse_range_ms("video_ms", value)


@pytest.mark.parametrize("value", [0, -1, "1", float("inf"), float("nan"), True, None])
def test_a_scale_must_be_positive(value: Any) -> None:
    """Zero, a negative number, and anything but a finite number is rejected."""
    with pytest.raises(UserError, match="scale"):
        check_positive("scale", value)


@pytest.mark.parametrize("value", [-1, 11, 1.5, True, None])
def test_a_count_must_be_a_whole_number_in_its_range(value: Any) -> None:
    """A number beyond the range, and anything but a whole number, is rejected."""
    with pytest.raises(UserError, match="history"):
        check_count("history", value, 10)
