"""Which commands a vehicle obeys, and what it does without one.

No clock, no input, no output: the actuator node gives times of the server's monotonic clock, and nothing here relies on
what the message layer promises. States and transitions are the table `TRANSITIONS`.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import ClassVar, Literal

from lavt.domain import Actuation, Command, Operation, SafetyState, SessionReply, SessionRequest, VehicleState
from lavt.safety.issued_stamps import IssuedStamps
from lavt.safety.limiter import Limiter
from lavt.safety.limits import Limits
from lavt.safety.path_follower import PathFollower
from lavt.safety.takeover_requests import TakeoverRequests
from lavt.value import value

Trigger = Literal[
    "arming begins", "arming broken", "arming held", "silence", "fresh command", "long silence", "stop asked",
    "camera fault", "vehicle fault", "driver override", "emergency stop", "cleared", "released", "drive over",
    "server ends",
]  # fmt: skip

ACTIVE: tuple[SafetyState, ...] = ("arming", "driving", "degraded")
"""States in which somebody is about to drive or drives."""

UNCOMMANDED: tuple[SafetyState, ...] = ("degraded", "safe_stop", "emergency_stop")
"""States in which the vehicle steers by itself, along the last command's path."""

TRANSITIONS: dict[tuple[SafetyState, Trigger], SafetyState] = {
    ("disarmed", "arming begins"): "arming",
    ("safe_stop", "arming begins"): "arming",
    **{("arming", trigger): "disarmed"
       for trigger in ("arming broken", "stop asked", "camera fault", "vehicle fault", "released", "server ends")},
    ("arming", "arming held"): "driving",
    ("driving", "silence"): "degraded",
    ("degraded", "fresh command"): "driving",
    ("degraded", "long silence"): "safe_stop",
    **{(state, trigger): "safe_stop"
       for state in ("driving", "degraded")
       for trigger in ("stop asked", "camera fault", "vehicle fault", "released", "drive over", "server ends")},
    **{(state, "driver override"): "disarmed" for state in ("arming", "driving", "degraded", "safe_stop")},
    **{(state, "emergency stop"): "emergency_stop"
       for state in ("disarmed", "arming", "driving", "degraded", "safe_stop")},
    ("emergency_stop", "cleared"): "disarmed",
}  # fmt: skip
"""What leads from where to where. What is not in the table changes nothing."""

REASONS: dict[Trigger, str] = {
    "arming begins": "standing, brake on, input neutral, pictures fresh: holding for 1 s",
    "arming broken": "a condition of arming did not hold",
    "arming held": "armed by the client",
    "silence": "no command from a newer picture",
    "fresh command": "commands from newer pictures again",
    "long silence": "no command from a newer picture for too long",
    "stop asked": "the client asked for a stop",
    "camera fault": "the camera gives the same picture again and again",
    "vehicle fault": "the vehicle does not obey",
    "driver override": "the driver in the car has taken over",
    "emergency stop": "emergency stop",
    "cleared": "the emergency stop was cleared",
    "released": "the client released the vehicle",
    "drive over": "the drive is over",
    "server ends": "the server was told to end",
}


@value
class CommandVerdict:
    """What became of a command; `reason` is empty when it was obeyed."""

    accepted: bool
    reason: str


ACCEPTED = CommandVerdict(True, "")

NOT_ARMED = "the vehicle is not armed"
NOT_STATIONARY = "arming needs standstill"
HINDERED = "the vehicle cannot be driven now"
BREAKS_ARMING = (NOT_ARMED, NOT_STATIONARY, HINDERED)
"""Refused for these reasons, a command of the holder also ends an arming second: input or vehicle were not at rest."""


LARGEST_STORED_NUMBER = 2**62
"""Numbers of emergency stops are times in nanoseconds: this one is in the year 2116."""


class SafetyGate:
    """Holds the session, admits or refuses commands, and says what the vehicle shall do now."""

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
    ) -> None:
        self.limits = limits
        self.limiter = limiter
        self.written = IssuedStamps(limits.stamp_memory_ns, limits.frozen_frames)
        self.state: SafetyState = "disarmed"
        self.reason = "nobody has armed the vehicle yet"
        self.rejected = ""
        self.counts: Counter[str] = Counter()
        self.active_operator: tuple[str, int] | None = None
        self.claims = TakeoverRequests(
            handover_request_timeout_ns=limits.handover_request_timeout_ns, kept_ns=limits.kept_ns
        )
        self.token = b""
        self.applied_sequence = -1
        self._new_epoch = new_epoch
        self._new_token = new_token
        self._host = host
        self._video_port = video_port
        self.instance = instance
        self._epoch = new_epoch()
        self._sequence = -1
        self._newest_frame = -1
        self._fresh_ns = 0
        self._arming_since_ns = 0
        self._emergency_number = 0
        self._ends = False
        self._command: Command | None = None
        self._picture_ns = 0
        self._path = PathFollower(limiter.wheelbase_m, limits.stamp_memory_ns)
        self._is_needed = False
        self._transitions: list[tuple[SafetyState, SafetyState, str]] = []

    @property
    def in_force(self) -> tuple[int, int]:
        """The epoch in force and the sequence of the command last obeyed under it; any thread may ask."""
        return self._epoch, self._sequence

    # The session: who holds the vehicle.

    def answer(self, request: SessionRequest, vehicle: VehicleState, now_ns: int) -> SessionReply:
        """Decide on a session query; only its holder can change the session, anybody can stop the vehicle."""
        rejection = self._OPERATIONS[request.operation](self, request, vehicle, now_ns)
        granted = rejection == ""
        self.counts[f"session {request.operation} {'granted' if granted else 'refused'}"] += 1
        holds = granted and self._holds(request)  # whoever stops the vehicle must not thereby get to drive it
        return SessionReply(
            granted, rejection, self._epoch if holds else 0, self.token if holds else b"", self._video_port,
            self._host, self._emergency_number,
        )  # fmt: skip

    def _holds(self, request: SessionRequest) -> bool:
        return (request.who, request.instance) == self.active_operator

    def _hold(self, request: SessionRequest, vehicle: VehicleState, now_ns: int) -> str:
        if self._ends:
            return "the server is about to end"
        if self._holds(request):
            return ""
        if self.active_operator is not None and not self.at_rest(vehicle):
            return f"held by {self.active_operator[0]}, and the vehicle is not disarmed at standstill"
        kept_for = self.claims.reserved_for(request, now_ns)
        if kept_for:
            return f"handed over to {kept_for}, who has not taken it yet"
        self.claims.forget()
        self.active_operator = (request.who, request.instance)
        self.token = self._new_token()
        self._renew_epoch()
        return ""

    def _ask(self, request: SessionRequest, _vehicle: VehicleState, now_ns: int) -> str:
        if self._holds(request):
            return "you hold the vehicle"
        if self.active_operator is None:
            return "nobody holds the vehicle"
        return self.claims.ask(request, now_ns)

    def _release(self, request: SessionRequest, _vehicle: VehicleState, now_ns: int) -> str:
        if not self._holds(request):
            return "only who holds the vehicle can release it"
        self._trigger("released")
        self.claims.release(now_ns)
        self._give_up()
        return ""

    def _give_up(self) -> None:
        self.active_operator = None
        self.token = b""
        self._renew_epoch()

    def end(self) -> None:
        """Stop, for the server is about to end: nobody holds the vehicle any more, and nobody gets it."""
        self._ends = True
        self._trigger("server ends")
        self._give_up()

    def _emergency_stop(self, request: SessionRequest, _vehicle: VehicleState, _now_ns: int) -> str:
        if not self._stop_at_once(request.number):
            return "the number of this emergency stop is not a new one"
        self.reason = f"emergency stop by {request.who}"
        return ""

    def _clear_emergency_stop(self, request: SessionRequest, vehicle: VehicleState, _now_ns: int) -> str:
        if not self._holds(request):
            return "only who holds the vehicle can clear its emergency stop"
        if (
            request.number != self._emergency_number
        ):  # a late or repeated request must not clear one it knows nothing of
            return "this is not the number of the last emergency stop"
        if not self.stands(vehicle):
            return "the vehicle does not stand yet"
        self._trigger("cleared")
        return ""

    _OPERATIONS: ClassVar[dict[Operation, Callable[..., str]]] = {
        "hold": _hold,
        "ask": _ask,
        "release": _release,
        "emergency_stop": _emergency_stop,
        "clear_emergency_stop": _clear_emergency_stop,
    }

    # What is obeyed.

    def admit(self, command: Command, vehicle: VehicleState, now_ns: int) -> CommandVerdict:
        """Obey `command` or refuse it, at `now_ns`, when it was received."""
        self.check_vehicle(vehicle)
        self.watch(now_ns)  # a command that comes with the end of a silence comes too late
        if command.emergency_stop:
            self._stop_at_once(command.emergency_stop)
        reason = self.rejection_reason(command, vehicle, now_ns)
        if reason:
            if reason in BREAKS_ARMING:
                self._trigger("arming broken")
            self.rejected = f"{reason}: {vehicle.inhibit_reason}" if reason == HINDERED else reason
            self.counts[f"refused: {reason}"] += 1
            return CommandVerdict(False, self.rejected)
        self._sequence = self.applied_sequence = command.sequence
        newer = self._newer(command)
        if newer:
            self._newest_frame = self.written.number(command.stamp_ns)
            self._fresh_ns = now_ns
        if command.mode == "arm":
            self._arm(command, vehicle, now_ns)
        elif command.mode == "stop":
            self._trigger("stop asked")
        else:
            self._command = command
            self._picture_ns = self.written.mono_ns(command.stamp_ns, now_ns) or now_ns
            self._path.look(vehicle)
            self._path.take(
                command.steering_rad, command.path_curvature_per_m, self.written.captured_ns(command.stamp_ns)
            )
            if newer:
                self._trigger("fresh command")
        return ACCEPTED

    def rejection_reason(self, command: Command, vehicle: VehicleState, now_ns: int) -> str:
        """Say why `command` is not obeyed; empty: it is. The cheap checks come first."""
        if self.active_operator is None or command.epoch != self._epoch:
            return "not the epoch in force"
        if command.sequence <= self._sequence:
            return "not newer than the last command"
        if command.emergency_stop:
            return "it carries an emergency stop"
        written_ns = self.written.mono_ns(command.stamp_ns, now_ns)
        if written_ns is None:
            return "a stamp that this server did not write lately"
        if now_ns - written_ns > self.limits.picture_age_limit_ns:
            return "made from a picture that is too old"
        if command.mode == "drive" and self.state not in ("driving", "degraded"):
            return NOT_ARMED
        if command.mode == "drive" and self.state == "degraded" and not self._newer(command):
            return "not made from a newer picture"
        if command.mode == "arm" and self.state in ("driving", "degraded"):
            return "the vehicle is armed already"
        if command.mode == "arm" and self.state == "emergency_stop":
            return "the emergency stop must be cleared first"
        if command.mode == "arm" and not self.stands(vehicle):
            return NOT_STATIONARY
        if command.mode == "arm" and vehicle.inhibit_reason:
            return HINDERED
        return ""

    def _newer(self, command: Command) -> bool:
        """Whether a command was made from a newer picture than any before; its stamp must be known."""
        return self.written.number(command.stamp_ns) > self._newest_frame

    def _arm(self, command: Command, vehicle: VehicleState, now_ns: int) -> None:
        neutral = command.throttle == 0 and abs(command.steering_rad) <= self.limits.arming_steering_rad
        fresh = now_ns - self._fresh_ns < self.limits.degraded_after_ns
        if not (neutral and fresh) or command.brake < self.limits.arming_brake or self.written.frozen:
            self._trigger("arming broken")
        elif self.state != "arming":
            self._arming_since_ns = now_ns
            self._begin_at_rest(vehicle, now_ns)  # a vehicle that gets engaged now must not turn its wheel
            self._trigger("arming begins")
        elif vehicle.is_engaged and now_ns - self._arming_since_ns >= self.limits.arming_hold_ns:
            self._begin_at_rest(vehicle, now_ns)
            self._trigger("arming held")

    def _begin_at_rest(self, vehicle: VehicleState, now_ns: int) -> None:
        """Forget what was commanded before: the first steering target is where the wheel is."""
        self._command = None
        self._path.forget()
        self.limiter.start(vehicle.steering_rad, now_ns)

    def _stop_at_once(self, number: int) -> bool:
        if number <= self._emergency_number:
            self.counts["emergency stop with an old number"] += self.state != "emergency_stop"
            return False
        if (
            number <= LARGEST_STORED_NUMBER
        ):  # one that leaves no room for a next one stops the vehicle, and is forgotten
            self._emergency_number = number
        self._trigger("emergency stop")
        return True

    # What happens without a command.

    def check_vehicle(self, vehicle: VehicleState) -> None:
        """Look at the vehicle: whether it obeys, and who drives it."""
        if vehicle.is_overridden:
            self._trigger("driver override")
        elif vehicle.inhibit_reason:
            self._trigger("vehicle fault", vehicle.inhibit_reason)
        elif not vehicle.is_engaged and self.state in ("driving", "degraded"):
            self._trigger("vehicle fault")

    def watch(self, now_ns: int) -> None:
        """Look at the clock: what silence and frozen pictures lead to."""
        if self.written.frozen:
            self._trigger("camera fault")
        since_command_ns = now_ns - self._fresh_ns
        if since_command_ns >= self.limits.degraded_after_ns:
            self._trigger("arming broken")
            self._trigger("silence")
        if since_command_ns >= self.limits.stop_after_ns:
            self._trigger("long silence")

    def next_wake_ns(self) -> int | None:
        """When `watch` has something to see next, if nothing comes."""
        if self.state not in ACTIVE:
            return None
        after_ns = self.limits.stop_after_ns if self.state == "degraded" else self.limits.degraded_after_ns
        return self._fresh_ns + after_ns

    def actuation(self, vehicle: VehicleState, now_ns: int) -> Actuation:
        """Say what the vehicle shall do now: the command in force within all limits, or what its state asks for.

        Call it whenever the vehicle has lived on: its odometry is kept here.
        """
        self.check_vehicle(vehicle)
        self._path.look(vehicle)
        requested = self._command if self.state in ("driving", "degraded") else None
        throttle, brake = (requested.throttle, requested.brake) if requested else (0.0, self.limits.arming_brake)
        if self.state == "degraded":  # never eases a brake
            throttle, brake = 0.0, max(brake, self._pedal(self.limits.degraded_deceleration_mps2))
        elif self.state == "safe_stop":
            throttle, brake = 0.0, self._pedal(self.limits.stop_deceleration_mps2)
        elif self.state != "driving":
            throttle, brake = 0.0, 1.0
        picture_age_ns = now_ns - self._picture_ns if requested else None
        target = Actuation(self._target_rad(vehicle, now_ns), throttle, brake)
        return self.limiter.limit(target, vehicle, now_ns, picture_age_ns)

    def _target_rad(self, vehicle: VehicleState, now_ns: int) -> float:
        """Steer as commanded; without a command along the path of the last one; without a path, hold the wheel."""
        if self.state == "driving" and self._command is not None:
            return self._command.steering_rad
        if self.state in UNCOMMANDED:
            if self.stands(vehicle):  # where the car has come to stand its path ends, whoever moves it next
                self._path.forget()
            followed_rad = self._path.steering_rad(now_ns)
            if followed_rad is not None:
                return followed_rad
        return self.limiter.target_rad(vehicle)

    def end_drive(self) -> None:
        """The drive is over: stop."""
        self._trigger("drive over")

    def take_transitions(self) -> list[tuple[SafetyState, SafetyState, str]]:
        """Take the transitions since the last call: from, to, why."""
        transitions, self._transitions = self._transitions, []
        return transitions

    # Small print.

    def _trigger(self, trigger: Trigger, detail: str = "") -> None:
        after = TRANSITIONS.get((self.state, trigger))
        if after is None:
            return
        reason = f"{REASONS[trigger]}: {detail}" if detail else REASONS[trigger]
        self._transitions.append((self.state, after, reason))
        self.state, self.reason = after, reason
        if after in ("safe_stop", "emergency_stop") or trigger == "driver override":
            self._renew_epoch()

    def _renew_epoch(self) -> None:
        """Nothing sent under the old epoch is obeyed ever again."""
        self._epoch = self._new_epoch()
        self._sequence = self.applied_sequence = -1
        self._command = None

    def _pedal(self, deceleration_mps2: float) -> float:
        return min(1.0, deceleration_mps2 / self.limiter.max_braking_mps2)

    def at_rest(self, vehicle: VehicleState) -> bool:
        """Whether the vehicle stands and nobody drives it or is about to."""
        return self.state not in ACTIVE and self.stands(vehicle)

    def needs(self, vehicle: VehicleState) -> bool:
        """Whether the vehicle has to be engaged: somebody drives it or is about to, or it is being stopped.

        Call it whenever the vehicle has lived on. Once it has stood, or was disarmed, only arming takes it back: who
        moves it then, with a stop still latched, is a driver in the car.
        """
        is_being_stopped = self._is_needed and self.state != "disarmed" and not self.stands(vehicle)
        self._is_needed = self.state in ACTIVE or is_being_stopped
        return self._is_needed

    def stands(self, vehicle: VehicleState) -> bool:
        """Whether the vehicle is at standstill."""
        return abs(vehicle.speed_mps) < self.limits.standstill_mps
