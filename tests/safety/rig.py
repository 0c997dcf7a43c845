"""A safety gate on a bench: a vehicle whose state the test sets, a camera that writes stamps, a holder who commands."""

# ruff: noqa: D102 (a helper of tests: short methods say themselves what they do)

from __future__ import annotations

from dataclasses import replace
from itertools import count
from typing import Any

from lavt.domain import NS_PER_MS, NS_PER_S, Actuation, Command, Operation, SessionReply, SessionRequest, VehicleState
from lavt.safety.gate import CommandVerdict, SafetyGate
from lavt.safety.limiter import Limiter
from lavt.safety.limits import LIMITS, Limits

TICK_NS = 20 * NS_PER_MS
START_NS = 1_000 * NS_PER_S
WALL_NS = 1_790_000_000 * NS_PER_S
WHEELBASE_M = 2.8448
MAX_STEERING_RAD = 0.513
MAX_BRAKING_MPS2 = 6.0


def new_limiter(limits: Limits = LIMITS) -> Limiter:
    return Limiter(
        limits, wheelbase_m=WHEELBASE_M, max_steering_rad=MAX_STEERING_RAD, max_braking_mps2=MAX_BRAKING_MPS2
    )


def vehicle_at(speed_mps: float = 0.0, steering_rad: float = 0.0) -> VehicleState:
    return VehicleState(START_NS, speed_mps, steering_rad, "drive")


class Rig:
    """The gate with all that surrounds it; `now_ns` is the server's monotonic clock and moves by `go` only."""

    def __init__(self, limits: Limits = LIMITS) -> None:
        epochs, tokens = count(1000), count(1)
        self.gate = SafetyGate(
            limits,
            new_limiter(limits),
            new_epoch=lambda: next(epochs),
            new_token=lambda: next(tokens).to_bytes(16, "big"),
            host="bench",
            video_port=5600,
        )
        self.now_ns = START_NS
        self.vehicle = vehicle_at()
        self.epoch = 0
        self.sequence = 0
        self.frame = 0
        self.stamp_ns = 0
        self.wall_step_ns = 0

    def go(self, duration_ns: int) -> None:
        """Let time pass, and the gate look at the clock whenever it asked to."""
        end_ns = self.now_ns + duration_ns
        while (wake_ns := self.gate.next_wake_ns()) is not None and wake_ns <= end_ns:
            self.now_ns = max(self.now_ns, wake_ns)
            self.gate.watch(self.now_ns)
            assert self.gate.next_wake_ns() != wake_ns, "the gate asks for the same wake again and again"
        self.now_ns = end_ns
        self.gate.watch(end_ns)

    def picture(self, crc: int | None = None) -> int:
        """Write the stamp of a new picture, let the gate look at it, and tell the stamp."""
        self.frame += 1
        self.stamp_ns = WALL_NS + self.now_ns + self.wall_step_ns
        self.gate.written.note(self.stamp_ns, self.frame, self.now_ns, self.frame if crc is None else crc)
        self.gate.watch(self.now_ns)
        return self.stamp_ns

    def ask(self, operation: Operation, who: str = "alice", instance: int = 1, number: int = 0) -> SessionReply:
        reply = self.gate.answer(SessionRequest(operation, who, instance, number), self.vehicle, self.now_ns)
        if who == "alice" and reply.epoch:
            self.epoch = reply.epoch
        return reply

    def command(self, **changes: Any) -> Command:
        """Make a sound command from the newest picture; "arm" with the brake on unless told otherwise."""
        self.sequence += 1
        command = Command(
            self.epoch, self.sequence, self.now_ns, self.stamp_ns, self.now_ns, 0.0, 0.0, 1.0, (0.0,) * 10, "arm", 0
        )
        return replace(command, **changes)

    def send(self, **changes: Any) -> CommandVerdict:
        return self.gate.admit(self.command(**changes), self.vehicle, self.now_ns)

    def drive(self, **changes: Any) -> CommandVerdict:
        return self.send(**{"mode": "drive", "throttle": 0.5, "brake": 0.0, **changes})

    def hold(self) -> Rig:
        assert self.ask("hold").granted
        return self

    def arm_for(self, duration_ns: int) -> None:
        """Ask for arming with a new picture every tick, the last time at the very end of `duration_ns`."""
        self.picture()
        self.send()
        for _ in range(duration_ns // TICK_NS):
            self.go(TICK_NS)
            self.picture()
            self.send()

    def armed(self) -> Rig:
        """Take the vehicle and arm it."""
        self.hold()
        self.arm_for(NS_PER_S)
        assert self.gate.state == "driving"
        return self

    def driving(self, **changes: Any) -> Rig:
        """Arm it and have one drive command obeyed, now."""
        self.armed()
        self.picture()
        assert self.drive(**changes).accepted
        return self

    def clear(self, who: str = "alice", instance: int = 1, number: int | None = None) -> SessionReply:
        """Ask to clear the emergency stop that the vehicle told of last, or the one named."""
        last = self.ask("hold", who, instance).emergency_stop
        return self.ask("clear_emergency_stop", who, instance, last if number is None else number)

    def actuation(self) -> Actuation:
        return self.gate.actuation(self.vehicle, self.now_ns)

    @property
    def state(self) -> str:
        return self.gate.state
