"""A test rig: the adapter drives a software car over a lossless bus without delay, and the actuation is recorded."""

from __future__ import annotations

from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import yaml

from lavt.assembly.dbw import load_profile
from lavt.domain import NS_PER_MS, Actuation, VehicleEvent
from lavt.vehicle.can_frame import CanFrame
from lavt.vehicle.dbw.adapter import ByWireAdapter
from lavt.vehicle.dbw.profile import Profile
from lavt.vehicle.sim.road.road import Road, load_road
from lavt.vehicle.sim.simulator import Simulator
from lavt.vehicle.software_car.car import SoftwareCar
from lavt.vehicle.software_car.kit import Kit

START_NS = 77_000_000_123
SPEED_SOURCES = {1: ("speed", "wheel_speed"), 2: ("speed", "second_speed", "wheel_speed")}
"""Sources of speed by generation."""
COARSE_MS = 5
"""Time step in ms where nothing is measured; elsewhere it is 1 ms, the resolution of all measurements."""


@cache
def profile(name: str) -> Profile:
    return load_profile(name, steering_sign=1)


@cache
def vector_file(name: str) -> dict[str, Any]:
    """Return the frames and limits of a profile that were worked out by hand."""
    text = (Path(__file__).parent / "vectors" / f"{name}.yaml").read_text()
    loaded: dict[str, Any] = yaml.load(text, Loader=yaml.CSafeLoader)
    return loaded


@cache
def road() -> Road:
    return load_road("a_key")


@dataclass(frozen=True)
class Moment:
    """The state and the actuation of a car at a time."""

    at_ns: int
    wheels: Actuation
    is_enabled: bool
    """True if an axis is enabled, so that commands reach the wheels."""
    state: str


class AdapterRig:
    """An adapter that drives a software car and gets `actuation` every `tick_ns`.

    `spoil` returns what reaches the car instead of a frame (None: nothing). `lose_report` returns whether a frame from
    the car is lost. If `is_cut`, all frames in both directions are lost.
    """

    def __init__(self, generation: int, *, start_frames: bool = True, **keys: Any) -> None:
        name = keys.pop("profile", f"dataspeed_gen{generation}")
        self.profile: Profile = name if isinstance(name, Profile) else profile(name)
        self.generation, self.tick_ns = generation, 20 * NS_PER_MS
        adapter_keys = {key: keys.pop(key) for key in ("inhibit_reason",) if key in keys}
        self.adapter = ByWireAdapter(self.profile, start_ns=START_NS, **adapter_keys)
        self.simulator = Simulator(road=road(), seed=1, start_mono_ns=START_NS)
        self.kit = Kit(1 if generation == 1 else 2, start_ns=START_NS, **keys)
        self.car = SoftwareCar(self.kit, self.simulator)
        self.now_ns = START_NS
        self.actuation = Actuation(0.0, 0.0, 1.0)
        self.is_ticking, self.is_cut = True, False
        self.spoil: Callable[[CanFrame], CanFrame | None] = lambda frame: frame
        self.lose_report: Callable[[CanFrame], bool] = lambda _: False
        self.dropped_frames = 0
        """Number of frames at the end of each set that the port does not write."""
        self.sent: list[tuple[int, CanFrame]] = []
        self.moments: list[Moment] = []
        self.events: list[VehicleEvent] = []
        self._next_tick_ns = START_NS
        if start_frames:
            self.run_ms(400)

    def copy(self) -> AdapterRig:
        """Return a rig in the same state that shares only immutable objects with this rig."""
        shared = (self.profile, self.profile.codec, road(), *self.moments)
        return deepcopy(self, {id(shared_object): shared_object for shared_object in shared})

    def run_ms(self, duration_ms: int, *, step_ms: int = 1) -> None:
        """Run for a time, in steps of `step_ms`."""
        end_ns = self.now_ns + duration_ms * NS_PER_MS
        while self.now_ns < end_ns:
            self.now_ns = min(self.now_ns + step_ms * NS_PER_MS, end_ns)
            self._step()

    def run_until(self, condition: Callable[[AdapterRig], bool], limit_ms: int = 5000, *, step_ms: int = 1) -> int:
        """Run until a condition is met, and return the time taken in ms."""
        for passed_ms in range(0, limit_ms, step_ms):
            if condition(self):
                return passed_ms
            self.run_ms(step_ms, step_ms=step_ms)
        raise AssertionError(f"not in {limit_ms} ms: {self.adapter.state()}")

    def stall_ms(self, duration_ms: int) -> None:
        """Let only the car run for a time; then give the adapter the reports, with their times of arrival."""
        waiting = []
        for _ in range(duration_ms):
            self.now_ns += NS_PER_MS
            waiting += [(frame, self.now_ns) for frame in self.car.advance(self.now_ns)]
        for frame, arrived_ns in waiting:
            self.adapter.receive(frame, arrived_ns)
        self._step()

    def _step(self) -> None:
        for frame in self.car.advance(self.now_ns):
            if not self.is_cut and not self.lose_report(frame):
                self.adapter.receive(frame, self.now_ns)
        if self.is_ticking and self.now_ns >= self._next_tick_ns:
            self._next_tick_ns = self.now_ns + self.tick_ns
            self.adapter.set_actuation(self.actuation, self.now_ns)
        frames = self.adapter.frames_due(self.now_ns)
        written = len(frames) - min(self.dropped_frames, len(frames))
        self.adapter.on_dropped(frames[written:])
        for frame in frames[:written]:
            self.sent.append((self.now_ns, frame))
            if not self.is_cut and (spoiled := self.spoil(frame)) is not None:
                self.car.receive(spoiled, self.now_ns)
        self.events += self.adapter.take_events()
        self.moments.append(
            Moment(self.now_ns, self.kit.actuation(self.now_ns), bool(self.enabled()), self.adapter._state)
        )

    def enabled(self) -> set[str]:
        """Return the enabled axes of the kit."""
        return {axis for axis, actuator in self.kit.state.actuators.items() if actuator.is_enabled}

    @property
    def state(self) -> str:
        """The adapter's state."""
        return self.adapter._state

    @property
    def speed_mps(self) -> float:
        """The car's speed."""
        return self.simulator.state().speed_mps

    def engage(self) -> None:
        """Engage the kit with the brake on, as the gate does."""
        self.actuation = Actuation(self.simulator.state().steering_rad, 0.0, 1.0)
        self.adapter.engage(True, self.now_ns)
        self.run_until(lambda rig: rig.state == "engaged")

    def run_until_released_ms(self, since_ns: int, limit_ms: int = 1000) -> int:
        """Run until no axis is enabled, and return the time since `since_ns` in ms."""
        self.run_until(lambda rig: not rig.enabled(), limit_ms)
        return (self.now_ns - since_ns) // NS_PER_MS


def stationary_rig(generation: int) -> AdapterRig:
    """Return a stationary car whose reports have all been received."""
    return _stationary_rig(generation).copy()


def driving_rig(generation: int, *, tick_ms: int = 20, **keys: Any) -> AdapterRig:
    """Return a car that drives at slightly more than 5 m/s, steered slightly to the left."""
    rig = _accelerated(AdapterRig(generation, **keys)) if keys else _driving_rig(generation).copy()
    rig.tick_ns = tick_ms * NS_PER_MS
    return rig


@cache
def _stationary_rig(generation: int) -> AdapterRig:
    return AdapterRig(generation)


@cache
def _driving_rig(generation: int) -> AdapterRig:
    return _accelerated(stationary_rig(generation))


def _accelerated(rig: AdapterRig) -> AdapterRig:
    rig.engage()
    rig.actuation = Actuation(0.01, 0.5, 0.0)
    rig.run_until(lambda rig: rig.speed_mps > 5.0, 10_000, step_ms=COARSE_MS)
    for record in (rig.sent, rig.events, rig.moments):
        record.clear()
    rig.adapter.take_reached()
    return rig


def with_limits(generation: int, **limits: float) -> Profile:
    """Return a profile with other limits."""
    base_profile = profile(f"dataspeed_gen{generation}")
    return replace(base_profile, limits=replace(base_profile.limits, **limits))


def with_one_speed(generation: int) -> Profile:
    """Return a profile of a kit that reports no wheel speeds and no second speed."""
    base_profile = profile(f"dataspeed_gen{generation}")
    reports = {name: report for name, report in base_profile.reports.items() if name != "WheelSpeed"}
    return replace(base_profile, reports=reports, speeds_per_mps={"speed": base_profile.speeds_per_mps["speed"]})


both_generations = pytest.mark.parametrize("generation", [1, 2])
mostly_generation_2 = pytest.mark.parametrize("generation", [pytest.param(1, marks=pytest.mark.full), 2])
"""Both generations; generation 1 in the full lane only, for long tests of what both have in common."""
