"""Property tests of the safety gate with random clients, cameras, vehicles and clocks."""

# ruff: noqa: D102 (the names of rules and invariants describe them)

from __future__ import annotations

import math
from typing import Any

from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule
from msgspec.structs import replace
from tests.safety.rig import COMMAND_PERIOD_NS, MAX_STEERING_RAD, Rig, vehicle_at

from lavt.domain import NS_PER_MS, NS_PER_S, PATH_POINTS, Operation, SafetyState
from lavt.safety.gate import INTERRUPTS_ARMING
from lavt.safety.limits import LIMITS
from lavt.safety.state_machine import TRANSITIONS

TABLE_TRANSITIONS = {(before, after) for (before, _), after in TRANSITIONS.items()}
COMMAND_VALUES = {
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
"""All values of a command that `decode` accepts."""
SPEEDS = st.one_of(st.just(0.0), st.floats(-5, 40), st.just(math.nan))


class GateMachine(RuleBasedStateMachine):
    """A state machine that gives the gate random inputs and tracks since when all arming conditions have been met."""

    def __init__(self) -> None:
        super().__init__()
        self.rig = Rig().acquire()
        self.met_since_ns: int | None = None
        self.newest_used_ns = -NS_PER_S
        self.newest_used_frame = 0
        self.last_actuation_ns = self.rig.now_ns
        self.previous_state: SafetyState = "disarmed"

    def send(self, **changes: Any) -> None:
        """Send a command to the gate, and track whether it met all arming conditions."""
        rig = self.rig
        command = rig.command(**changes)
        is_valid = command.epoch == rig.gate.epoch.number and not command.emergency_stop
        verdict = rig.gate.admit(command, rig.vehicle, rig.now_ns, rig.now_ns)
        if verdict.accepted and command.stamp_ns == rig.stamp_ns and rig.frame > self.newest_used_frame:
            self.newest_used_frame, self.newest_used_ns = rig.frame, rig.now_ns
        is_fresh = rig.now_ns - self.newest_used_ns < LIMITS.degraded_after_ns
        is_neutral = command.throttle == 0 and abs(command.steering_rad) <= LIMITS.arming_steering_rad
        is_braked = command.brake >= LIMITS.arming_brake
        is_stationary = abs(rig.vehicle.speed_mps) < LIMITS.standstill_mps
        is_arming = is_valid and command.mode == "arm" and is_neutral and is_fresh and is_braked
        are_conditions_met = is_arming and verdict.accepted and is_stationary
        if not are_conditions_met and (verdict.accepted or verdict.reason in INTERRUPTS_ARMING):
            self.met_since_ns = None
        self.transitions_follow_the_table()
        if are_conditions_met and self.met_since_ns is None:
            self.met_since_ns = rig.now_ns

    @rule()
    def send_valid_arm_command(self) -> None:
        self.rig.take_picture()
        self.send()

    @rule(seconds=st.sampled_from([0.4, 0.8, 1.0]))
    def send_valid_arm_commands(self, seconds: float) -> None:
        self.rig.request("acquire")
        self.rig.vehicle = vehicle_at(0.0, self.rig.vehicle.steering_rad)
        for _ in range(round(seconds * 50)):
            self.pass_time(COMMAND_PERIOD_NS)
            self.rig.take_picture()
            self.send()

    @rule(changes=st.fixed_dictionaries({}, optional=COMMAND_VALUES))
    def send_any_command(self, changes: dict[str, Any]) -> None:
        self.send(**changes)

    @rule(
        changes=st.fixed_dictionaries(
            {},
            optional={
                name: COMMAND_VALUES[name] for name in ("steering_rad", "throttle", "brake", "path_curvature_per_m")
            },
        )
    )
    def send_drive_command(self, changes: dict[str, Any]) -> None:
        self.rig.take_picture()
        self.send(mode="drive", **changes)

    @rule(crc=st.sampled_from([None, None, -1]))
    def take_picture(self, crc: int | None) -> None:
        self.rig.take_picture(crc)

    @rule()
    def freeze_pictures(self) -> None:
        for _ in range(LIMITS.frozen_frames):
            self.rig.take_picture(-1)
        self.met_since_ns = None

    @rule(duration_ns=st.sampled_from([0, 1, NS_PER_MS, COMMAND_PERIOD_NS, 200 * NS_PER_MS, 300 * NS_PER_MS, NS_PER_S]))
    def pass_time(self, duration_ns: int) -> None:
        self.rig.pass_time(duration_ns)
        if self.rig.now_ns - self.newest_used_ns >= LIMITS.degraded_after_ns:
            self.met_since_ns = None

    @rule(duration_ns=st.integers(0, NS_PER_S))
    def pass_time_without_wakes(self, duration_ns: int) -> None:
        self.rig.now_ns += duration_ns
        if self.rig.now_ns - self.newest_used_ns >= LIMITS.degraded_after_ns:
            self.met_since_ns = None

    @rule(
        operation=st.sampled_from(["acquire", "request_handover", "release", "emergency_stop", "clear_emergency_stop"]),
        who=st.sampled_from(["alice", "alice", "bob"]),
        number=st.integers(0, 5),
    )
    def request(self, operation: Operation, who: str, number: int) -> None:
        reply = self.rig.request(operation, who, number=number)
        if operation == "release" and reply.granted:
            self.met_since_ns = None
        if reply.epoch:
            assert self.rig.gate.session.active_operator == (who, 1)

    @rule(speed_mps=SPEEDS, steering_rad=st.floats(-MAX_STEERING_RAD, MAX_STEERING_RAD))
    def set_vehicle_motion(self, speed_mps: float, steering_rad: float) -> None:
        self.rig.vehicle = replace(vehicle_at(speed_mps, steering_rad), mono_ns=self.rig.now_ns)

    @rule(inhibit_reason=st.sampled_from(["", "fault"]), engaged=st.booleans(), overridden=st.booleans())
    def set_vehicle_readiness(self, inhibit_reason: str, *, engaged: bool, overridden: bool) -> None:
        self.rig.vehicle = replace(
            self.rig.vehicle, inhibit_reason=inhibit_reason, is_engaged=engaged, is_overridden=overridden
        )

    @precondition(lambda self: self.rig.state == "driving")
    @rule()
    def end_drive(self) -> None:
        self.rig.gate.machine.trigger("drive over")

    @invariant()
    def transitions_follow_the_table(self) -> None:
        for before, after, _ in self.rig.gate.machine.take_transitions():
            assert before == self.previous_state
            assert (before, after) in TABLE_TRANSITIONS
            if (before, after) == ("arming", "driving"):
                assert self.met_since_ns is not None
                assert self.rig.now_ns - self.met_since_ns >= LIMITS.arming_hold_ns
            if after != "arming" and (before == "arming" or after == "emergency_stop"):
                self.met_since_ns = None
            self.previous_state = after
        assert self.rig.state == self.previous_state

    @invariant()
    def actuation_is_within_all_limits(self) -> None:
        rig = self.rig
        before_rad = rig.gate.limiter.target_rad(rig.vehicle)
        actuation = rig.actuation()
        assert all(math.isfinite(value) for value in (actuation.steering_rad, actuation.throttle, actuation.brake))
        assert 0 <= actuation.throttle <= 1
        assert 0 <= actuation.brake <= 1
        assert abs(actuation.steering_rad) <= MAX_STEERING_RAD
        step_rad = LIMITS.steering_rate_radps * (rig.now_ns - self.last_actuation_ns) / NS_PER_S
        assert abs(actuation.steering_rad - before_rad) <= step_rad + 1e-12
        self.last_actuation_ns = rig.now_ns
        if rig.state != "driving":
            assert actuation.throttle == 0
            assert actuation.brake > 0
        if not rig.vehicle.speed_mps <= LIMITS.speed_limit_mps:
            assert actuation.throttle == 0


GateMachine.TestCase.settings = settings(max_examples=150, stateful_step_count=25)
TestGateMachine = GateMachine.TestCase
TestGateMachine.__doc__ = (
    "No inputs reach driving without 1 s of arming, make a transition outside the table, or exceed a limit."
)


def test_every_state_is_reachable() -> None:
    """From every state of the table every state can be reached."""
    for start in {before for before, _ in TRANSITIONS} | set(TRANSITIONS.values()):
        reached: set[SafetyState] = {start}
        while True:
            further = {after for (before, _), after in TRANSITIONS.items() if before in reached} - reached
            if not further:
                break
            reached |= further
        assert reached == {"disarmed", "arming", "driving", "degraded", "safe_stop", "emergency_stop"}


def test_only_arming_and_a_fresh_command_lead_to_driving() -> None:
    """The table has two ways to driving: complete arming, and a fresh command while degraded."""
    ways = {key for key, after in TRANSITIONS.items() if after == "driving"}
    assert ways == {("arming", "arming complete"), ("degraded", "fresh command")}
