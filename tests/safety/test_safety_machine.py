"""What no sequence of inputs may do to the safety gate: a machine that plays client, camera, vehicle and clock."""

# ruff: noqa: D102 (rules and invariants are named after what they are)

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule
from tests.safety.rig import MAX_STEERING_RAD, TICK_NS, Rig, vehicle_at

from lavt.domain import NS_PER_MS, NS_PER_S, PATH_POINTS, Operation, SafetyState
from lavt.safety.gate import BREAKS_ARMING, TRANSITIONS
from lavt.safety.limits import LIMITS

STEPS = {(before, after) for (before, _), after in TRANSITIONS.items()}
WIRE = {
    "steering_rad": st.floats(-1, 1),
    "throttle": st.floats(0, 1),
    "brake": st.floats(0, 1),
    "path_curvature_per_m": st.tuples(*[st.floats(-1, 1)] * PATH_POINTS),
    "mode": st.sampled_from(["arm", "drive", "stop"]),
    "epoch": st.integers(0, 2**64 - 1),
    "sequence": st.integers(0, 2**63 - 1),
    "stamp_ns": st.integers(0, 2**63 - 1),
    "emergency_stop": st.sampled_from([0, 0, 0, 1, 2, 3]),
}
"""All that `decode` lets through."""
SPEEDS = st.one_of(st.just(0.0), st.floats(-5, 40), st.just(math.nan))


class GateMachine(RuleBasedStateMachine):
    """Feeds the gate anything, and knows since when all conditions of arming have held."""

    def __init__(self) -> None:
        super().__init__()
        self.rig = Rig().hold()
        self.held_since_ns: int | None = None
        self.used_ns = -NS_PER_S
        self.newest_used = 0
        self.last_rad = 0.0
        self.last_ns = self.rig.now_ns
        self.before: SafetyState = "disarmed"

    def give(self, **changes: Any) -> None:
        """Hand a command to the gate and to the oracle: did it keep all conditions, or break one?"""
        rig = self.rig
        command = rig.command(**changes)
        lawful = command.epoch == rig.gate._epoch and not command.emergency_stop
        verdict = rig.gate.admit(command, rig.vehicle, rig.now_ns)
        if verdict.accepted and command.stamp_ns == rig.stamp_ns and rig.frame > self.newest_used:
            self.newest_used, self.used_ns = rig.frame, rig.now_ns
        fresh = rig.now_ns - self.used_ns < LIMITS.degraded_after_ns
        neutral = command.throttle == 0 and abs(command.steering_rad) <= LIMITS.arming_steering_rad
        good = lawful and command.mode == "arm" and neutral and fresh and command.brake >= LIMITS.arming_brake
        kept = good and verdict.accepted and abs(rig.vehicle.speed_mps) < LIMITS.standstill_mps
        if not kept and (verdict.accepted or verdict.reason in BREAKS_ARMING):
            self.held_since_ns = None
        self.only_the_table_leads_anywhere()
        if kept and self.held_since_ns is None:
            self.held_since_ns = rig.now_ns

    @rule()
    def arm_well(self) -> None:
        self.rig.picture()
        self.give()

    @rule(seconds=st.sampled_from([0.4, 0.8, 1.0]))
    def arm_well_for_a_while(self, seconds: float) -> None:
        self.rig.ask("hold")
        self.rig.vehicle = vehicle_at(0.0, self.rig.vehicle.steering_rad)
        for _ in range(round(seconds * 50)):
            self.pass_time(TICK_NS)
            self.rig.picture()
            self.give()

    @rule(changes=st.fixed_dictionaries({}, optional=WIRE))
    def any_command(self, changes: dict[str, Any]) -> None:
        self.give(**changes)

    @rule(
        changes=st.fixed_dictionaries(
            {}, optional={k: WIRE[k] for k in ("steering_rad", "throttle", "brake", "path_curvature_per_m")}
        )
    )
    def drive(self, changes: dict[str, Any]) -> None:
        self.rig.picture()
        self.give(mode="drive", **changes)

    @rule(crc=st.sampled_from([None, None, -1]))
    def picture(self, crc: int | None) -> None:
        self.rig.picture(crc)

    @rule()
    def frozen_pictures(self) -> None:
        for _ in range(LIMITS.frozen_frames):
            self.rig.picture(-1)
        self.held_since_ns = None

    @rule(duration_ns=st.sampled_from([0, 1, NS_PER_MS, TICK_NS, 200 * NS_PER_MS, 300 * NS_PER_MS, NS_PER_S]))
    def pass_time(self, duration_ns: int) -> None:
        self.rig.go(duration_ns)
        if self.rig.now_ns - self.used_ns >= LIMITS.degraded_after_ns:
            self.held_since_ns = None

    @rule(duration_ns=st.integers(0, NS_PER_S))
    def pass_time_unwatched(self, duration_ns: int) -> None:
        self.rig.now_ns += duration_ns
        if self.rig.now_ns - self.used_ns >= LIMITS.degraded_after_ns:
            self.held_since_ns = None

    @rule(
        operation=st.sampled_from(["hold", "ask", "release", "emergency_stop", "clear_emergency_stop"]),
        who=st.sampled_from(["alice", "alice", "bob"]),
        number=st.integers(0, 5),
    )
    def ask(self, operation: Operation, who: str, number: int) -> None:
        reply = self.rig.ask(operation, who, 1, number)
        if operation == "release" and reply.granted:
            self.held_since_ns = None
        if reply.epoch:
            assert self.rig.gate.active_operator == (who, 1)

    @rule(speed_mps=SPEEDS, steering_rad=st.floats(-MAX_STEERING_RAD, MAX_STEERING_RAD))
    def vehicle_is(self, speed_mps: float, steering_rad: float) -> None:
        self.rig.vehicle = replace(vehicle_at(speed_mps, steering_rad), mono_ns=self.rig.now_ns)

    @rule(inhibit_reason=st.sampled_from(["", "fault"]), engaged=st.booleans(), overridden=st.booleans())
    def vehicle_accepts_or_not(self, inhibit_reason: str, *, engaged: bool, overridden: bool) -> None:
        self.rig.vehicle = replace(
            self.rig.vehicle, inhibit_reason=inhibit_reason, is_engaged=engaged, is_overridden=overridden
        )

    @precondition(lambda self: self.rig.state == "driving")
    @rule()
    def end_drive(self) -> None:
        self.rig.gate.end_drive()

    @invariant()
    def only_the_table_leads_anywhere(self) -> None:
        for before, after, _ in self.rig.gate.take_transitions():
            assert before == self.before
            assert (before, after) in STEPS
            if (before, after) == ("arming", "driving"):
                assert self.held_since_ns is not None
                assert self.rig.now_ns - self.held_since_ns >= LIMITS.arming_hold_ns
            if after != "arming" and (before == "arming" or after == "emergency_stop"):
                self.held_since_ns = None
            self.before = after
        assert self.rig.state == self.before

    @invariant()
    def actuation_is_within_all_limits(self) -> None:
        rig = self.rig
        before_rad = rig.gate.limiter.target_rad(rig.vehicle)
        actuation = rig.actuation()
        assert all(math.isfinite(value) for value in (actuation.steering_rad, actuation.throttle, actuation.brake))
        assert 0 <= actuation.throttle <= 1
        assert 0 <= actuation.brake <= 1
        assert abs(actuation.steering_rad) <= MAX_STEERING_RAD
        step_rad = LIMITS.steering_rate_radps * (rig.now_ns - self.last_ns) / NS_PER_S
        assert abs(actuation.steering_rad - before_rad) <= step_rad + 1e-12
        self.last_ns = rig.now_ns
        if rig.state != "driving":
            assert actuation.throttle == 0
            assert actuation.brake > 0
        if not rig.vehicle.speed_mps <= LIMITS.speed_limit_mps:
            assert actuation.throttle == 0


GateMachine.TestCase.settings = settings(max_examples=150, stateful_step_count=25)
TestGateMachine = GateMachine.TestCase
TestGateMachine.__doc__ = (
    "No inputs reach driving without a full arming second, leave the table, or put an actuation beyond a limit."
)


def test_every_row_of_the_table_is_reachable() -> None:
    """Each state can be reached from the first, and each of them can be left again for driving."""
    for start in {before for before, _ in TRANSITIONS} | set(TRANSITIONS.values()):
        reached: set[SafetyState] = {start}
        while True:
            further = {after for (before, _), after in TRANSITIONS.items() if before in reached} - reached
            if not further:
                break
            reached |= further
        assert reached == {"disarmed", "arming", "driving", "degraded", "safe_stop", "emergency_stop"}


def test_only_arming_and_a_newer_picture_lead_to_driving() -> None:
    """The table has two ways to driving: a held arming second, and the end of a silence."""
    ways = {key for key, after in TRANSITIONS.items() if after == "driving"}
    assert ways == {("arming", "arming held"), ("degraded", "fresh command")}
