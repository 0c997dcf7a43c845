"""The plans of episodes: a run for each, whose route, delays and seed are drawn or chosen."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from lavt.config import AGENT, RunConfig
from lavt.config_file import build_config, find_file, parse_config, read_yaml
from lavt.errors import UserError
from lavt.experiment.runs.plan import PlannedRun, plan_run, with_changes
from lavt.gym.settings import parse_changes, parse_names, parse_path, parse_range_ms

OPTIONS: Final = {
    "route": "vehicle.route",
    "condition": "network.condition",
    "video_ms": "network.video.delay_ms",
    "control_ms": "network.control.delay_ms",
    "seed": "seed",
}
"""The options of `reset`, each with the config key that it sets. An option replaces what would be drawn."""
SEEDS: Final = 2**31
"""Seeds of episodes are drawn from 0 to this number minus 1."""

Names = str | Sequence[str] | None
Delay = float | tuple[float, float] | None
"""A delay in ms; a range of delays, from which each episode draws one; None: that of the condition."""


class EpisodePlanner:
    """A planner of episodes.

    `config` is the path of a config for `lavt run`, and `changes` are as after `--set`. An episode draws its route and
    its condition from the given names, and its delays from the given ranges, in ms. Each draw is made even if there is
    only one value, so that a changed setting does not change the other draws.

    Raises `UserError` for values that are wrong.
    """

    def __init__(
        self,
        *,
        config: str | Path | None,
        changes: Iterable[str],
        fidelity: str,
        route: Names,
        condition: Names,
        video_ms: Delay,
        control_ms: Delay,
    ) -> None:
        path = parse_path("config", config)
        data = {} if path is None else read_yaml(find_file(path))
        source = "the environment" if config is None else str(config)
        self.base = build_config(
            RunConfig, data, (*parse_changes(changes), f"controller.kind={AGENT}", f"fidelity={fidelity}"), source
        )
        if self.base.time != "virtual":
            raise UserError(f"{source}: an environment is for virtual time only: leave out the key time")
        self._routes = parse_names("route", route, self.base.vehicle.route)
        self._conditions = parse_names("condition", condition, self.base.network.condition)
        self._delays_ms = {
            "video": parse_range_ms("video_ms", video_ms),
            "control": parse_range_ms("control_ms", control_ms),
        }
        for name in self._routes:  # the first episode must not be the first to find an error
            self._plan({"vehicle.route": name}, "episode")
        for name in self._conditions:
            for ends in zip(*(limits or (None, None) for limits in self._delays_ms.values()), strict=True):
                delays_ms = dict(zip(("video_ms", "control_ms"), ends, strict=True))
                options = {option: delay_ms for option, delay_ms in delays_ms.items() if delay_ms is not None}
                self.plan(np.random.default_rng(0), {"condition": name} | options, "episode")

    def plan(self, generator: np.random.Generator, options: Mapping[str, Any], name: str) -> PlannedRun:
        """Return the plan of the next episode; raise `UserError` for an unknown option or a wrong value."""
        if not isinstance(options, Mapping):
            raise UserError(f"options is {options!r}: give a dictionary with keys of {', '.join(OPTIONS)}")
        unknown = [option for option in options if option not in OPTIONS]
        if unknown:
            raise UserError(f"reset has no option {unknown[0]!r}; choose among {', '.join(OPTIONS)}")
        changes: dict[str, Any] = {
            "seed": int(generator.integers(SEEDS)),
            "vehicle.route": _draw(generator, self._routes),
            "network.condition": _draw(generator, self._conditions),
        }
        for flow, limits_ms in self._delays_ms.items():
            share = float(generator.random())
            if limits_ms is not None:
                low_ms, high_ms = limits_ms
                changes[f"network.{flow}.delay_ms"] = low_ms + share * (high_ms - low_ms)
        return self._plan(changes | {OPTIONS[option]: value for option, value in options.items()}, name)

    def _plan(self, changes: Mapping[str, Any], name: str) -> PlannedRun:
        data = with_changes(self.base.model_dump(mode="json"), changes)
        return plan_run(parse_config(RunConfig, data, "the environment"), name=name, driver=AGENT)


def _draw(generator: np.random.Generator, names: Sequence[str]) -> str:
    """Return one of the names; the number of draws does not depend on the number of names."""
    return names[int(generator.random() * len(names))]
