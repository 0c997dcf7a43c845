"""The contract of vehicles as checks: LAVT's tests, `lavt carla check` and the packages of other vehicles call them.

Each check drives a new vehicle, which begins at `start_ns`, and returns what it does against the contract, in
sentences. `ContractLimits` has what differs from vehicle to vehicle.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Final

from msgspec import Struct

from lavt.domain import NS_PER_MS, NS_PER_S, Actuation
from lavt.vehicle.vehicle import Vehicle

MAX_PERIOD_NS: Final = 20 * NS_PER_MS
BRAKE: Final = Actuation(0.0, 0.0, 1.0)
SOME_ACTUATIONS: Final = (
    (1.0, 1.0, 0.0, 400),
    (-1.0, 0.5, 0.2, 300),
    (0.0, 0.0, 1.0, 700),
    (-0.3, 1.0, 1.0, 1),
    (0.3, 0.0, 0.0, 200),
)
"""Steering (rad), throttle, brake, and the duration (ms): commands at and beyond the limits."""


class ContractLimits(Struct, frozen=True, kw_only=True):
    """What a vehicle does with the commands of the checks; the defaults are those of the built-in car."""

    throttle: float = 0.5
    speed_mps: tuple[float, float] = (1.0, 2.0)
    """The speed after two seconds of this throttle lies in between."""
    full_throttle_mps: float = 2.0
    """Two seconds of full throttle give at least this speed."""
    steering_rad: float = 0.05
    steering_tolerance_rad: float = 0.002
    """The largest difference of the steering angle after two seconds, as reported and in truth."""
    engage_s: float = 3.0
    """The longest time until a stationary, braked vehicle is engaged."""
    stop_s: float = 3.0
    """The longest time in which the full brake stops the vehicle from the speed of the full throttle."""


class ContractResult(Struct, frozen=True):
    """A check with what the vehicle did against the contract; empty: nothing."""

    name: str
    violations: tuple[str, ...]


def run(vehicle: Vehicle, start_ns: int, actuation: Actuation, *, should_engage: bool, seconds: float) -> int:
    """Call the vehicle as the actuator node does, at each wake time, and return the end time."""
    now_ns, end_ns = start_ns, start_ns + round(seconds * NS_PER_S)
    while now_ns < end_ns:
        vehicle.advance(now_ns)
        vehicle.engage(should_engage, now_ns)
        vehicle.apply(actuation, now_ns)
        now_ns = min(max(vehicle.next_wake_ns(), now_ns + 1), now_ns + MAX_PERIOD_NS, end_ns)
    vehicle.advance(end_ns)
    return end_ns


def check_times(vehicle: Vehicle, start_ns: int) -> list[str]:
    """Check that a state's time never decreases nor exceeds that of `advance`, and that the next wake is after it."""
    violations = []
    vehicle.advance(start_ns + 20 * NS_PER_MS)
    before_ns, latest_ns = vehicle.state().mono_ns, start_ns + 20 * NS_PER_MS
    for offset_ms in (20, 21, 21, 40, 500, 400, 501):
        vehicle.advance(start_ns + offset_ms * NS_PER_MS)
        latest_ns = max(latest_ns, start_ns + offset_ms * NS_PER_MS)
        state_ns = vehicle.state().mono_ns
        if not before_ns <= state_ns <= latest_ns:
            violations.append(f"the state's time is {state_ns} ns, not between {before_ns} and {latest_ns} ns")
        if vehicle.next_wake_ns() <= state_ns:
            violations.append(f"the next wake, at {vehicle.next_wake_ns()} ns, is not after the state's {state_ns} ns")
        before_ns = state_ns
    for _ in range(1000):
        if vehicle.next_wake_ns() > start_ns + 601 * NS_PER_MS:
            break
        vehicle.advance(vehicle.next_wake_ns())
    if vehicle.state().mono_ns <= before_ns:
        violations.append("the state's time does not grow although `advance` was called at each wake")
    return violations


def check_rest(vehicle: Vehicle, start_ns: int) -> list[str]:
    """Check that without a command the vehicle is stationary and has no events."""
    events = vehicle.advance(start_ns + 3 * NS_PER_S)
    violations = [f"the event {event.kind} ({event.detail}) came without a command" for event in events]
    return [*violations, *_moving(vehicle, "without a command")]


def check_capabilities(vehicle: Vehicle, _start_ns: int) -> list[str]:
    """Check that sizes and limits are positive and finite, and that there is ground truth if it is announced."""
    capabilities = vehicle.capabilities
    values = {
        "wheelbase_m": capabilities.wheelbase_m,
        "max_steering_rad": capabilities.max_steering_rad,
        "max_acceleration_mps2": capabilities.max_acceleration_mps2,
        "max_braking_mps2": capabilities.max_braking_mps2,
    }
    violations = [f"{name} is {value}" for name, value in values.items() if not 0 < value < math.inf]
    if (vehicle.ground_truth() is not None) != capabilities.ground_truth:
        violations.append(f"the capabilities say ground_truth {capabilities.ground_truth}, but it is otherwise")
    return violations


def check_actuations(
    vehicle: Vehicle, start_ns: int, actuations: Sequence[tuple[float, float, float, int]] = SOME_ACTUATIONS
) -> list[str]:
    """Check that actuations leave a finite state, a steering angle within the limits, and events in order.

    Each actuation has steering (rad), throttle, brake, and its duration (ms).
    """
    violations, now_ns = [], start_ns
    limit_rad = vehicle.capabilities.max_steering_rad + 1e-9
    for steering_rad, throttle, brake, duration_ms in actuations:
        vehicle.apply(Actuation(steering_rad, throttle, brake), now_ns)
        now_ns += duration_ms * NS_PER_MS
        times_ns = [event.mono_ns for event in vehicle.advance(now_ns)]
        if times_ns != sorted(times_ns):
            violations.append("the events are not in the order of their times")
        state = vehicle.state()
        if not math.isfinite(state.speed_mps):
            violations.append(f"the speed is {state.speed_mps}")
        if not abs(state.steering_rad) <= limit_rad:
            violations.append(f"the steering angle is {state.steering_rad} rad, beyond max_steering_rad")
    return violations


def check_following(vehicle: Vehicle, start_ns: int, limits: ContractLimits) -> list[str]:
    """Check that a stationary, braked vehicle engages, and then accelerates and turns as commanded."""
    now_ns = run(vehicle, start_ns, BRAKE, should_engage=False, seconds=0.5)
    violations = []
    if reason := vehicle.state().inhibit_reason:
        violations.append(f"the stationary vehicle is inhibited: {reason}")
    now_ns = run(vehicle, now_ns, BRAKE, should_engage=True, seconds=limits.engage_s)
    state = vehicle.state()
    if not state.is_engaged or state.inhibit_reason or state.is_overridden or state.gear != "drive":
        violations.append(
            f"after {limits.engage_s:g} s it is not ready: engaged {state.is_engaged}, overridden "
            f"{state.is_overridden}, gear {state.gear}, inhibit reason {state.inhibit_reason!r}"
        )
    run(vehicle, now_ns, Actuation(limits.steering_rad, limits.throttle, 0.0), should_engage=True, seconds=2)
    state, truth = vehicle.state(), vehicle.ground_truth()
    lowest_mps, highest_mps = limits.speed_mps
    if not lowest_mps < state.speed_mps < highest_mps:
        violations.append(
            f"after 2 s with throttle {limits.throttle:g} it drives at {state.speed_mps:.2f} m/s, not between "
            f"{lowest_mps:g} and {highest_mps:g} m/s"
        )
    angles = (
        {"reported": state.steering_rad}
        if truth is None
        else {
            "reported": state.steering_rad,
            "true": truth.steering_rad,
        }
    )
    for name, angle_rad in angles.items():
        if abs(angle_rad - limits.steering_rad) > limits.steering_tolerance_rad:
            violations.append(
                f"the {name} steering angle is {angle_rad:.4f} rad for a command of {limits.steering_rad:.4f} rad"
            )
    return violations


def check_disengaging(vehicle: Vehicle, start_ns: int, limits: ContractLimits) -> list[str]:
    """Check that a driving vehicle that is disengaged and braked stops, and then remains stationary."""
    now_ns = run(vehicle, start_ns, BRAKE, should_engage=False, seconds=0.5)
    now_ns = run(vehicle, now_ns, BRAKE, should_engage=True, seconds=limits.engage_s)
    now_ns = run(vehicle, now_ns, Actuation(0.0, 1.0, 0.0), should_engage=True, seconds=2)
    violations = []
    if vehicle.state().speed_mps <= limits.full_throttle_mps:
        violations.append(f"after 2 s of full throttle it drives at {vehicle.state().speed_mps:.2f} m/s only")
    now_ns = run(vehicle, now_ns, BRAKE, should_engage=False, seconds=limits.stop_s)
    violations += _moving(vehicle, f"after {limits.stop_s:g} s of the full brake")
    run(vehicle, now_ns, BRAKE, should_engage=False, seconds=1)
    return [*violations, *_moving(vehicle, "a second after it stopped")]


def _moving(vehicle: Vehicle, when: str) -> list[str]:
    """Return a violation if the vehicle moves, as reported or in truth."""
    truth = vehicle.ground_truth()
    speeds_mps = {"reports": vehicle.state().speed_mps, **({} if truth is None else {"truly has": truth.speed_mps})}
    return [f"{when} it {verb} {speed:.3g} m/s" for verb, speed in speeds_mps.items() if speed != 0.0]


CHECKS: Final[dict[str, Callable[[Vehicle, int, ContractLimits], list[str]]]] = {
    "times of states and wakes": lambda vehicle, start_ns, _: check_times(vehicle, start_ns),
    "stationary until commanded": lambda vehicle, start_ns, _: check_rest(vehicle, start_ns),
    "capabilities": lambda vehicle, start_ns, _: check_capabilities(vehicle, start_ns),
    "any command leaves a finite state": lambda vehicle, start_ns, _: check_actuations(vehicle, start_ns),
    "follows commands": check_following,
    "stops when disengaged": check_disengaging,
}
"""All checks by name."""


def check_contract(
    build: Callable[[int], Vehicle], start_ns: int, limits: ContractLimits | None = None
) -> list[ContractResult]:
    """Run all checks; `build` returns a new, stationary vehicle that begins at the given time."""
    used = limits or ContractLimits()
    return [ContractResult(name, tuple(check(build(start_ns), start_ns, used))) for name, check in CHECKS.items()]
