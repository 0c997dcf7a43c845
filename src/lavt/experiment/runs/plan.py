"""Planning: the runs of a config, each with its name, its complete config and its identity."""

from __future__ import annotations

import itertools
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from lavt.assembly.detection.detectors import check_detector
from lavt.assembly.entropy import run_seed
from lavt.assembly.injection import NO_CONDITION, netem_flows
from lavt.assembly.links import link_injection
from lavt.assembly.nodes import AGENT_ELSEWHERE, check_names
from lavt.config import AGENT, HUMAN, Condition, RunConfig, SweepConfig
from lavt.config_file import condition, parse_config
from lavt.errors import UserError
from lavt.operating_system import require_loopback, require_real_time
from lavt.transport.emulation.impairment import check_flows

RESERVED_AXES = {"vehicle.route": "routes", "network.condition": "conditions", "repetition": "repetitions"}
"""The config keys that cannot be further axes, each with the key of a sweep's config that varies it."""

DRIVEN_ELSEWHERE = {
    HUMAN: "a person drives by `lavt drive`, `lavt client CONFIG --human` or `lavt study` only: name another "
    "controller",
    AGENT: AGENT_ELSEWHERE,
}
"""The kinds of controllers that are no controllers but drivers outside of LAVT, each with an error message."""


@dataclass(frozen=True, slots=True)
class PlannedRun:
    """A run to be driven.

    `identity` is the beginning of the run's `result.json`. `seed` is the seed of this run alone, derived from the
    config's seed.
    """

    name: str
    config: RunConfig
    identity: Mapping[str, Any]
    seed: int
    requested: Condition
    """The requested network condition."""


def plan_run(
    config: RunConfig, *, name: str = "run", axes: Mapping[str, Any] | None = None, driver: str = ""
) -> PlannedRun:
    """Plan one run; a person or an agent can drive it only if `driver`, a key of `DRIVEN_ELSEWHERE`, is present.

    Raises `UserError` for a condition, route, vehicle, controller or preset that does not exist.
    """
    if config.controller.kind in DRIVEN_ELSEWHERE and config.controller.kind != driver:
        raise UserError(DRIVEN_ELSEWHERE[config.controller.kind])
    requested = config.network.requested(condition(config.network.condition))
    check_names(config.vehicle, config.controller)
    check_detector(config.perception.detector)
    _check_fidelity(config)
    _check_injection(config, requested)
    is_unimpaired = config.network.inherent == "loopback" and requested == NO_CONDITION
    if config.time == "real" and config.network.injection == "none" and not is_unimpaired:
        raise UserError(
            "network.injection is none, so nothing can delay this run in real time: choose relay, or condition L0 and "
            "inherent loopback"
        )
    if config.time == "real":
        require_real_time("a run in real time")
        require_loopback()
    if config.time == "real" and config.fidelity != "video":
        raise UserError(
            f"fidelity {config.fidelity} is for virtual time only: choose fidelity video for real time, or time virtual"
        )
    if config.time == "virtual" and config.vehicle.kind == "carla" and config.vehicle.carla.asynchronous:
        raise UserError(
            "vehicle.carla.asynchronous needs time real, because the world then runs by itself: set it, or leave out "
            "vehicle.carla.asynchronous"
        )
    seed = run_seed(config.seed, config.vehicle.route, config.repetition)
    identity = {
        "run": name,
        "time": config.time,
        "fidelity": config.fidelity,
        "injection": "model" if config.time == "virtual" else config.network.injection,
        "inherent": config.network.inherent,
        "route": config.vehicle.route,
        "condition": config.network.condition,
        "controller": config.controller.kind,
        "preset": config.controller.settings,
        "driver": config.controller.kind,
        "participant": config.study.participant,
        "block": config.study.block,
        "order": config.study.order,
        "repetition": config.repetition,
        "seed": seed,
        **injected_entry(requested),
        **({"detector": config.perception.settings} if config.perception.settings else {}),
        **({"axes": dict(axes)} if axes else {}),
        **({"changes": config.network.changes} if config.network.changes else {}),
    }
    return PlannedRun(name, config, identity, seed, requested)


def injected_entry(requested: Condition) -> dict[str, Any]:
    """Return the key `injected_ms` and, if the smallest expected delay differs from the requested, `injected_least_ms`.

    The delay of a trace is None.
    """
    least_entry = {} if requested.least_ms == requested.constant_ms else {"injected_least_ms": requested.least_ms}
    return {"injected_ms": requested.constant_ms, **least_entry}


def _check_fidelity(config: RunConfig) -> None:
    """Raise `UserError` for a detector without pictures, or noise of a lane with pictures."""
    if config.fidelity == "geometry" and config.perception.settings:
        raise UserError(
            "fidelity geometry has no pictures for a detector: leave out perception.detector, or choose fidelity "
            "pixels or video"
        )
    if config.fidelity != "geometry" and (config.vehicle.lane_noise_m or config.vehicle.lane_noise_rad):
        raise UserError(
            "vehicle.lane_noise_m and vehicle.lane_noise_rad are noise of a lane without pictures: leave them out, or "
            "choose fidelity geometry"
        )


def _check_injection(config: RunConfig, requested: Condition) -> None:
    """Raise `UserError` if the chosen kind of injection cannot apply the condition and the inherent latency."""
    network = config.network
    if network.state_delay == "with_video" and requested.video.trace:
        raise UserError(
            "network.state_delay with_video delays the state by the video's constant delay, and cannot follow its "
            f"trace {requested.video.trace!r}: choose none, or a condition without a trace"
        )
    if config.time == "real" and network.injection == "netem":
        if network.inherent != "loopback":
            raise UserError(
                f"netem cannot inject the lognormal part of network.inherent {network.inherent}: choose loopback, or "
                "network.injection relay"
            )
        # The check does not depend on the ports, which are chosen when the run starts.
        check_flows(netem_flows(requested, "both", video_port=1, control_port=2, state_delay=network.state_delay))
    else:
        link_injection("video", requested.video_ms, requested.video, seed=0)
        link_injection("control", requested.control_ms, requested.control, seed=0)


def plan_sweep(sweep: SweepConfig) -> list[PlannedRun]:
    """Plan all runs of a sweep: all combinations of routes, conditions, repetitions and values of the further axes.

    Raises `UserError` for a run that `plan_run` rejects, for a sweep without runs, and for duplicate runs.
    """
    for key, reserved in itertools.product(sweep.axes, RESERVED_AXES):
        if f"{reserved}.".startswith(f"{key}."):  # an axis of a whole section would also set the reserved value
            raise UserError(f"{key!r} cannot be a further axis: use {RESERVED_AXES[reserved]!r} for {reserved!r}")
    base = sweep.model_dump(mode="json", exclude={"routes", "conditions", "repetition", "repetitions", "axes"})
    runs = []
    for values in itertools.product(*sweep.axes.values()):
        axes = dict(zip(sweep.axes, values, strict=True))
        keys = itertools.product(sweep.routes, sweep.conditions, range(sweep.repetitions))
        for route, condition_name, repetition in keys:
            changes = {"vehicle.route": route, "network.condition": condition_name, "repetition": repetition, **axes}
            config = parse_config(RunConfig, with_changes(base, changes), "the sweep")
            runs.append(plan_run(config, name=run_name(route, condition_name, repetition, axes), axes=axes))
    if not runs:
        raise UserError("the sweep has no run: give routes, conditions and axes at least one value each")
    duplicates = [name for name, count in Counter(run.name for run in runs).items() if count > 1]
    if duplicates:
        raise UserError(f"the sweep has the run {duplicates[0]} twice: give each route, condition and value once")
    return runs


def run_name(route: str, condition_name: str, repetition: int, axes: Mapping[str, Any]) -> str:
    """Return the name of a run, which is also the name of its directory."""
    parts = [route, condition_name, f"{repetition:02d}", *(f"{key}={value}" for key, value in axes.items())]
    return "_".join(re.sub("[^A-Za-z0-9=._-]", "-", part) for part in parts)


def with_changes(base: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Return a copy of `base` with `changes`, by dotted keys; raise `UserError` for a missing section."""
    result = dict(base)
    for key, value in changes.items():
        _set_value(result, key.split("."), value, key)
    return result


def _set_value(section: dict[str, Any], names: Sequence[str], value: Any, key: str) -> None:
    """Set the value at the nested `names` of a section; an error names `key`."""
    first, *others = names
    if not others:
        section[first] = value
        return
    inner = section.get(first)
    if not isinstance(inner, Mapping):
        raise UserError(
            f"the axis {key!r} is not a config value: write it as in the config, such as video.bit_rate_bps"
        )
    section[first] = dict(inner)
    _set_value(section[first], others, value, key)
