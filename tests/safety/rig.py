"""A test rig for the safety gate: a vehicle whose state the test sets, a camera that issues stamps, and a client."""

# ruff: noqa: D102 (a test helper with short methods)

from __future__ import annotations

from itertools import count
from typing import Any

from msgspec.structs import replace

from lavt.domain import NS_PER_MS, NS_PER_S, Actuation, Command, Operation, SessionReply, SessionRequest, VehicleState
from lavt.safety.gate import CommandVerdict, SafetyGate
from lavt.safety.governor import Governor
from lavt.safety.limiter import Limiter
from lavt.safety.limits import LIMITS, Limits

COMMAND_PERIOD_NS = 20 * NS_PER_MS
"""Period of the client's commands and of the camera's pictures in the tests."""
START_NS = 1_000 * NS_PER_S
WALL_AHEAD_NS = 1_790_000_000 * NS_PER_S
"""The server's wall clock minus its monotonic clock."""
WHEELBASE_M = 2.8448
MAX_STEERING_RAD = 0.513
MAX_ACCELERATION_MPS2 = 2.0
MAX_BRAKING_MPS2 = 6.0


def new_limiter(limits: Limits = LIMITS) -> Limiter:
    return Limiter(
        limits,
        wheelbase_m=WHEELBASE_M,
        max_steering_rad=MAX_STEERING_RAD,
        max_acceleration_mps2=MAX_ACCELERATION_MPS2,
        max_braking_mps2=MAX_BRAKING_MPS2,
    )


def vehicle_at(speed_mps: float = 0.0, steering_rad: float = 0.0) -> VehicleState:
    return VehicleState(START_NS, speed_mps, steering_rad, "drive")


class Rig:
    """A safety gate with its surroundings; `now_ns` is the server's monotonic clock, which `pass_time` advances."""

    def __init__(self, limits: Limits = LIMITS, *, only_operator: str = "", governor: Governor | None = None) -> None:
        epochs, tokens = count(1000), count(1)
        self.gate = SafetyGate(
            limits,
            new_limiter(limits),
            new_epoch=lambda: next(epochs),
            new_token=lambda: next(tokens).to_bytes(16, "big"),
            host="bench",
            video_port=5600,
            only_operator=only_operator,
            governor=governor,
        )
        self.now_ns = START_NS
        self.vehicle = vehicle_at()
        self.epoch = 0
        self.sequence = 0
        self.frame = 0
        self.stamp_ns = 0
        self.wall_step_ns = 0

    def pass_time(self, duration_ns: int) -> None:
        """Let time pass, and call `check_timeouts` at each wake that the watchdog requests."""
        end_ns = self.now_ns + duration_ns
        while (wake_ns := self.gate.watchdog.next_wake_ns()) is not None and wake_ns <= end_ns:
            self.now_ns = max(self.now_ns, wake_ns)
            self.gate.watchdog.check_timeouts(self.now_ns)
            assert self.gate.watchdog.next_wake_ns() != wake_ns, "the watchdog requests the same wake again and again"
        self.now_ns = end_ns
        self.gate.watchdog.check_timeouts(end_ns)

    def take_picture(self, crc: int | None = None, *, captured_ns: int | None = None) -> int:
        """Issue the stamp of a new picture and return the stamp; the camera reports `captured_ns`."""
        self.frame += 1
        self.stamp_ns = WALL_AHEAD_NS + self.now_ns + self.wall_step_ns
        crc = self.frame if crc is None else crc
        self.gate.issued_stamps.add(self.stamp_ns, self.frame, self.now_ns, crc, captured_ns)
        self.gate.watchdog.check_timeouts(self.now_ns)
        return self.stamp_ns

    def request(self, operation: Operation, who: str = "alice", *, instance: int = 1, number: int = 0) -> SessionReply:
        """Send a session request from one instance of the client `who`; `number` is that of an emergency stop.

        If alice gets an epoch, her later commands have this epoch.
        """
        reply = self.gate.session.answer(SessionRequest(operation, who, instance, number), self.vehicle, self.now_ns)
        if who == "alice" and reply.epoch:
            self.epoch = reply.epoch
        return reply

    def command(self, **changes: Any) -> Command:
        """Return an arm command from the newest picture, with full brake; `changes` replaces some of its fields."""
        self.sequence += 1
        command = Command(
            self.epoch, self.sequence, self.now_ns, self.stamp_ns, self.now_ns, 0.0, 0.0, 1.0, (0.0,) * 10, "arm", 0
        )
        return replace(command, **changes)

    def send(self, **changes: Any) -> CommandVerdict:
        return self.gate.admit(self.command(**changes), self.vehicle, self.now_ns, self.now_ns)

    def send_drive(self, **changes: Any) -> CommandVerdict:
        return self.send(**{"mode": "drive", "throttle": 0.5, "brake": 0.0, **changes})

    def acquire(self) -> Rig:
        assert self.request("acquire").granted
        return self

    def arm_for(self, duration_ns: int) -> None:
        """Send an arm command from a new picture in each period, the last one at the end of `duration_ns`."""
        self.take_picture()
        self.send()
        for _ in range(duration_ns // COMMAND_PERIOD_NS):
            self.pass_time(COMMAND_PERIOD_NS)
            self.take_picture()
            self.send()

    def arm(self) -> Rig:
        """Acquire control and arm the vehicle."""
        self.acquire()
        self.arm_for(NS_PER_S)
        assert self.gate.state == "driving"
        return self

    def start_driving(self, **changes: Any) -> Rig:
        """Arm the vehicle and send one drive command, now."""
        self.arm()
        self.take_picture()
        assert self.send_drive(**changes).accepted
        return self

    def clear_emergency_stop(self, who: str = "alice", *, instance: int = 1, number: int | None = None) -> SessionReply:
        """Request to clear the last emergency stop that the vehicle reported, or the one with `number`."""
        last = self.request("acquire", who, instance=instance).emergency_stop
        number = last if number is None else number
        return self.request("clear_emergency_stop", who, instance=instance, number=number)

    def actuation(self) -> Actuation:
        return self.gate.watchdog.actuation(self.vehicle, self.now_ns)

    @property
    def state(self) -> str:
        return self.gate.state
