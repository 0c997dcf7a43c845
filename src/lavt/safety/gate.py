"""The command gate on the vehicle: which commands are accepted, and why all others are rejected.

The gate reads no clock and does no input or output: the actuator node passes times of the server's monotonic clock. The
gate relies on no guarantee of the message layer.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from enum import StrEnum

from msgspec import Struct

from lavt.domain import Command, SafetyState, VehicleState
from lavt.safety.governor import Governor
from lavt.safety.issued_stamps import IssuedStamps
from lavt.safety.limiter import Limiter
from lavt.safety.limits import Limits
from lavt.safety.session import CommandEpoch, VehicleSession
from lavt.safety.state_machine import SafetyStateMachine
from lavt.safety.watchdog import Watchdog


class RejectionReason(StrEnum):
    """Why a command is rejected, in the order of the checks. The values are the shown messages."""

    WRONG_EPOCH = "not the present epoch"
    OLD_SEQUENCE = "not newer than the last command"
    EMERGENCY_STOP = "it carries an emergency stop"
    UNKNOWN_STAMP = "its stamp was not issued by this server recently"
    PICTURE_TOO_OLD = "made from a picture that is too old"
    NOT_ARMED = "the vehicle is not armed"
    PICTURE_NOT_NEWER = "not made from a newer picture"
    ALREADY_ARMED = "the vehicle is armed already"
    EMERGENCY_STOP_LATCHED = "the emergency stop must be cleared first"
    NOT_STATIONARY = "the vehicle is not stationary"
    INHIBITED = "the vehicle is inhibited"


INTERRUPTS_ARMING = (RejectionReason.NOT_ARMED, RejectionReason.NOT_STATIONARY, RejectionReason.INHIBITED)
"""A command that is rejected for one of these reasons interrupts arming, because the driver's input or the vehicle was
not at rest."""


class CommandVerdict(Struct, frozen=True):
    """The decision on a command; `reason` is None for an accepted command."""

    reason: RejectionReason | None = None
    detail: str = ""

    @property
    def accepted(self) -> bool:
        """Return whether the command is accepted."""
        return self.reason is None

    @property
    def message(self) -> str:
        """Return the reason as a message; empty for an accepted command."""
        if self.reason is None:
            return ""
        return f"{self.reason}: {self.detail}" if self.detail else self.reason.value


ACCEPTED = CommandVerdict()


class SafetyGate:
    """The safety gate of one vehicle: a command gate with the session, state machine and watchdog that it needs."""

    def __init__(
        self,
        limits: Limits,
        limiter: Limiter,
        *,
        new_epoch: Callable[[], int],
        new_token: Callable[[], bytes],
        host: str = "",
        video_port: int = 0,
        instance: int = 0,
        only_operator: str = "",
        governor: Governor | None = None,
    ) -> None:
        self.limiter = limiter
        self.governor = governor
        """The speed governor; None: the vehicle has none."""
        self.instance = instance
        self.counts: Counter[str] = Counter()
        self.last_rejection = ""
        """Message of the last rejection."""
        self.issued_stamps = IssuedStamps(limits.stamp_memory_ns, limits.frozen_frames)
        self.epoch = CommandEpoch(new_epoch)
        self.machine = SafetyStateMachine(limits, self.epoch.renew)
        self.session = VehicleSession(
            limits,
            self.machine,
            self.epoch,
            self.counts,
            new_token=new_token,
            host=host,
            video_port=video_port,
            only_operator=only_operator,
        )
        self.watchdog = Watchdog(limits, limiter, self.machine, self.epoch, self.issued_stamps, governor=governor)
        self._limits = limits
        self._newest_frame = -1
        self._arming_since_ns = 0

    @property
    def state(self) -> SafetyState:
        """Return the safety state."""
        return self.machine.state

    def in_force(self) -> tuple[int, int]:
        """Return the present epoch and the sequence number last accepted in it; callable from any thread."""
        return self.epoch.number, self.epoch.sequence

    def admit(self, command: Command, vehicle: VehicleState, arrived_ns: int, now_ns: int) -> CommandVerdict:
        """Accept or reject a command that arrived at `arrived_ns`; an accepted command is applied at `now_ns`.

        The command timeout counts from the arrival of the last fresh command. The age of the command's picture is that
        at its application, which is later than the arrival if the node or its process was stalled.
        """
        self.watchdog.check_vehicle(vehicle)
        self.watchdog.check_timeouts(arrived_ns)  # first, because a command that arrives at the timeout is too late
        if command.emergency_stop:
            self.session.raise_emergency_stop(command.emergency_stop)
        reason = self.rejection_reason(command, vehicle, now_ns)
        if reason is not None:
            return self._reject(reason, vehicle)
        self.epoch.sequence = command.sequence
        is_fresh = self._is_fresh(command)
        if is_fresh:
            self._newest_frame = self.issued_stamps.frame_number(command.stamp_ns)
            self.watchdog.reset_timeout(arrived_ns)
        if command.mode == "arm":
            self._arm(command, vehicle, arrived_ns)
        elif command.mode == "stop":
            self.machine.trigger("stop requested")
        else:
            self.watchdog.set_command(command, vehicle)
            if is_fresh:
                self.machine.trigger("fresh command")
        if self.governor is not None:
            age_ns = now_ns - self.issued_stamps.captured_ns(command.stamp_ns)
            self.governor.note_age(age_ns, now_ns, is_newer=is_fresh)
        return ACCEPTED

    def rejection_reason(self, command: Command, vehicle: VehicleState, now_ns: int) -> RejectionReason | None:
        """Return why a command is not applied at `now_ns`; None if it is accepted. The cheap checks come first."""
        state = self.machine.state
        if self.session.active_operator is None or command.epoch != self.epoch.number:
            return RejectionReason.WRONG_EPOCH
        if command.sequence <= self.epoch.sequence:
            return RejectionReason.OLD_SEQUENCE
        if command.emergency_stop:
            return RejectionReason.EMERGENCY_STOP
        if self.issued_stamps.issued_ns(command.stamp_ns, now_ns) is None:
            return RejectionReason.UNKNOWN_STAMP
        if now_ns - self.issued_stamps.captured_ns(command.stamp_ns) > self._limits.picture_age_limit_ns:
            return RejectionReason.PICTURE_TOO_OLD
        if command.mode == "drive" and state not in ("driving", "degraded"):
            return RejectionReason.NOT_ARMED
        if command.mode == "drive" and state == "degraded" and not self._is_fresh(command):
            return RejectionReason.PICTURE_NOT_NEWER
        if command.mode == "arm" and state in ("driving", "degraded"):
            return RejectionReason.ALREADY_ARMED
        if command.mode == "arm" and state == "emergency_stop":
            return RejectionReason.EMERGENCY_STOP_LATCHED
        if command.mode == "arm" and not self._limits.is_stationary(vehicle):
            return RejectionReason.NOT_STATIONARY
        if command.mode == "arm" and (vehicle.inhibit_reason or not self._limits.is_possible(vehicle)):
            return RejectionReason.INHIBITED
        return None

    def _reject(self, reason: RejectionReason, vehicle: VehicleState) -> CommandVerdict:
        if reason in INTERRUPTS_ARMING:
            self.machine.trigger("arming interrupted")
        self.counts[f"rejected: {reason}"] += 1
        verdict = CommandVerdict(reason, vehicle.inhibit_reason if reason is RejectionReason.INHIBITED else "")
        self.last_rejection = verdict.message
        return verdict

    def _is_fresh(self, command: Command) -> bool:
        """Return whether a command was made from a newer picture than all earlier ones; its stamp must be known."""
        return self.issued_stamps.frame_number(command.stamp_ns) > self._newest_frame

    def _arm(self, command: Command, vehicle: VehicleState, now_ns: int) -> None:
        is_neutral = command.throttle == 0 and abs(command.steering_rad) <= self._limits.arming_steering_rad
        is_braked = command.brake >= self._limits.arming_brake
        has_fresh_pictures = self.watchdog.has_fresh_command(now_ns) and not self.issued_stamps.is_frozen
        if not (is_neutral and is_braked and has_fresh_pictures):
            self.machine.trigger("arming interrupted")
        elif self.machine.state != "arming":
            self._arming_since_ns = now_ns
            self.watchdog.start_at_rest(vehicle, now_ns)  # engaging the vehicle must not turn its wheel
            if self.governor is not None:
                self.governor.begin_arming()
            self.machine.trigger("arming begins")
        elif vehicle.is_engaged and now_ns - self._arming_since_ns >= self._limits.arming_hold_ns:
            self.watchdog.start_at_rest(vehicle, now_ns)
            if self.governor is not None:
                self.governor.begin_drive(now_ns)
            self.machine.trigger("arming complete")
