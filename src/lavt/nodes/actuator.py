"""The actuator node, which accepts or rejects each command and applies accepted ones to the vehicle."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Mapping, Sequence
from typing import Literal, NamedTuple

from msgspec import UNSET, Struct

from lavt.domain import NS_PER_MS, NS_PER_S, Command, Ending, Now, Pose, SessionRequest, State, VehicleEvent
from lavt.errors import BadMessage
from lavt.node import WAKE, Message, Send, Stage
from lavt.nodes.payloads import Admission, AtWheel, Event, FrameWritten, Route, SpeedLimitSample, StationaryStatus
from lavt.safety.gate import CommandVerdict, SafetyGate
from lavt.transport.messages import decode, encode
from lavt.vehicle.camera import FrameTimes
from lavt.vehicle.vehicle import CountingVehicle, Vehicle

STATE_PERIOD_NS = 20 * NS_PER_MS
LATE_NS = 50 * NS_PER_MS
"""A physics step that is this late is recorded as an event, because the simulated vehicle did not move meanwhile."""
REJECTION_SHOWN_NS = NS_PER_S
"""For this long after a rejection, the state contains its reason."""
MAX_PENDING_COMMANDS = 64
"""How many applied commands can wait for the vehicle's report that they reached the wheels. It is more than are applied
in a second, and a command that has not reached the wheels after a second never will."""
POSE_AHEAD_NS = NS_PER_MS // 2
"""The pose for a frame is sent this long before the frame is due, because a command can occupy the node for 0.2 ms just
before that time."""

ENDINGS: dict[str, Ending] = {
    "completed": "completed",
    "collision": "collision",
    "off_road": "off_road",
    "timeout": "timeout",
}
"""The ending of a drive for each kind of event that ends it. A collision does so only if `after_collision` is "end"."""


class ReceivedCommand(Struct, frozen=True):
    """A decoded command with its time of arrival."""

    command: Command
    arrived: Now

    @property
    def stamp_ns(self) -> int:
        """Return the stamp of the picture that the command was made from."""
        return self.command.stamp_ns


class CheckedCommand(Struct, frozen=True):
    """A command with the verdict of the gate."""

    received: ReceivedCommand
    stamp_ns: int
    verdict: CommandVerdict
    limited: tuple[str, ...] = ()
    """Names of the limits that changed the command."""


class PendingCommand(NamedTuple):
    """An applied command whose arrival at the wheels the vehicle has not reported yet."""

    applied_ns: int
    sequence: int
    stamp_ns: int


class ActuatorNode:
    """The node that operates the vehicle: physics steps, safety gate, actuation and state reports.

    Physics advances at the times that the vehicle requests. `sample_times` are the times at which the camera needs the
    vehicle's pose. If they are given, physics advances lazily: just before each of these times, and when the state is
    published. This requires that physics catches up without loss of accuracy and that no wake is late.
    """

    name = "actuator"

    def __init__(
        self,
        vehicle: Vehicle,
        gate: SafetyGate,
        *,
        start_ns: int,
        route: Route | None = None,
        sample_times: Sequence[FrameTimes] = (),
        after_collision: Literal["end", "continue"] = "end",
    ) -> None:
        self._counts: Counter[str] = Counter()
        self.gate = gate
        self.vehicle = vehicle
        self._route = route
        self._endings = {
            kind: ending for kind, ending in ENDINGS.items() if (kind, after_collision) != ("collision", "continue")
        }
        self._publish_ns = start_ns
        """When the next state is published."""
        self._sample_times = tuple(sample_times)
        self._next_sample = 0
        self._sample_ns = start_ns
        """When physics advances for the next sample time, if there are sample times."""
        self._is_pose_due = True
        self._ending: str | None = None
        self._stationary_status: StationaryStatus | None = None
        self._is_driving = False
        self._limited: tuple[str, ...] = ()
        self._rejected_ns = start_ns
        self._pending: deque[PendingCommand] = deque(maxlen=MAX_PENDING_COMMANDS)
        self.pipelines: Mapping[str, Sequence[Stage]] = {
            "control": (
                ("decode", self._decode),
                ("admit", self._admit),
                ("apply", self._apply),
                ("report", self._report),
            ),
            "session": (("answer", self._answer),),
            "server_ends": (("stop", self._shut_down),),
            "frame": (("note", self._note_frame),),
            WAKE: (("advance", self._advance), ("publish", self._publish)),
        }

    @property
    def counts(self) -> Mapping[str, int]:
        """Return the counts of the node, the safety gate and the vehicle."""
        vehicle_counts = self.vehicle.counts if isinstance(self.vehicle, CountingVehicle) else {}
        return {**self._counts, **self.gate.counts, **vehicle_counts}

    def next_wake_ns(self) -> int:
        """Return when the vehicle, the watchdog or the state is due."""
        watchdog_ns = self.gate.watchdog.next_wake_ns()
        physics_ns = self._sample_ns if self._sample_times else self.vehicle.next_wake_ns()
        due_ns = min(self._publish_ns, physics_ns)
        return due_ns if watchdog_ns is None or due_ns < watchdog_ns else watchdog_ns

    # Commands.

    def _decode(self, message: Message, _now: Now) -> ReceivedCommand | None:
        try:
            return ReceivedCommand(decode(Command, message.payload), message.arrived)
        except BadMessage:
            self._counts["commands_unreadable"] += 1
            return None

    def _admit(self, received: ReceivedCommand, now: Now) -> CheckedCommand:
        verdict = self.gate.admit(received.command, self.vehicle.state(), received.arrived.mono_ns, now.mono_ns)
        if not verdict.accepted:
            self._rejected_ns = received.arrived.mono_ns
        return CheckedCommand(received, received.stamp_ns, verdict)

    def _apply(self, checked: CheckedCommand, now: Now) -> CheckedCommand:
        if not checked.verdict.accepted:
            return checked
        self._actuate(now.mono_ns)
        self._pending.append(PendingCommand(now.mono_ns, checked.received.command.sequence, checked.stamp_ns))
        self._limited = self.gate.limiter.applied_limits
        return CheckedCommand(checked.received, checked.stamp_ns, checked.verdict, self._limited)

    def _report(self, checked: CheckedCommand, now: Now) -> list[Send]:
        command, arrived = checked.received.command, checked.received.arrived
        accepted = checked.verdict.accepted
        self._counts["commands_limited"] += bool(checked.limited)
        admission = Admission(
            epoch=command.epoch,
            sequence=command.sequence,
            stamp_ns=command.stamp_ns,
            sent_wall_ns=command.sent_wall_ns,
            stamp_received_wall_ns=command.stamp_received_wall_ns,
            received_mono_ns=arrived.mono_ns,
            received_wall_ns=arrived.wall_ns,
            applied_mono_ns=now.mono_ns if accepted else None,
            verdict="accepted" if accepted else "rejected",
            reason=checked.verdict.message,
            limited=", ".join(checked.limited),
            mode=command.mode,
            steering_rad=command.steering_rad,
            throttle=command.throttle,
            brake=command.brake,
        )
        return [*self._report_transitions(now), Send("admission", admission)]

    # Session and frames.

    def _answer(self, message: Message, now: Now) -> list[Send]:
        try:
            request = decode(SessionRequest, message.payload)
        except BadMessage:
            self._counts["session_requests_unreadable"] += 1
            return []
        session = self.gate.session
        token = session.token
        reply = session.answer(request, self.vehicle.state(), now.mono_ns)
        sends = [*self._report_transitions(now), Send("session_reply", encode(reply), message.peer)]
        if session.token != token:
            sends.append(Send("video_token", session.token or None))
        outcome = "granted" if reply.granted else f"rejected: {reply.reason}"
        sends.append(Send("event", Event(now.mono_ns, "session", f"{request.operation} by {request.who} {outcome}")))
        return sends

    def _shut_down(self, _message: Message, now: Now) -> list[Send]:
        self.gate.session.close()
        return [*self._report_transitions(now), Send("video_token", None)]

    def _note_frame(self, message: Message, now: Now) -> None:
        frame: FrameWritten = message.payload
        self.gate.issued_stamps.add(
            frame.stamp_ns, frame.number, frame.stamped_mono_ns, frame.pixel_crc, frame.capture_ns
        )
        # A series of equal pictures (a frozen camera) is a timeout. It is checked now, because a different picture
        # could end the series before the next wake.
        self.gate.watchdog.check_timeouts(now.mono_ns)

    # Physics and state reports.

    def _advance(self, message: Message, now: Now) -> list[VehicleEvent]:
        due_ns = min(self.vehicle.next_wake_ns(), message.arrived.mono_ns)
        events = self.vehicle.advance(now.mono_ns)
        self._is_pose_due = not self._sample_times or self._sample_ns <= now.mono_ns
        while self._sample_times and self._sample_ns <= now.mono_ns:
            frame_number, index = divmod(self._next_sample, len(self._sample_times))
            self._sample_ns = self._sample_times[index].due_ns(frame_number) - POSE_AHEAD_NS
            self._next_sample += 1
        if now.mono_ns - due_ns > LATE_NS:
            late_ms = (now.mono_ns - due_ns) // NS_PER_MS
            events.append(VehicleEvent(now.mono_ns, "late", f"{late_ms} ms"))
        self.gate.watchdog.check_timeouts(now.mono_ns)
        self._actuate(now.mono_ns)
        return events

    def _actuate(self, now_ns: int) -> None:
        """Engage or disengage the vehicle, and apply the current actuation."""
        state = self.vehicle.state()
        actuation = self.gate.watchdog.actuation(state, now_ns)
        self.vehicle.engage(self.gate.watchdog.should_engage(state), now_ns)
        self.vehicle.apply(actuation, now_ns)

    def _publish(self, events: list[VehicleEvent], now: Now) -> list[Send]:
        sends = []
        is_state_due = now.mono_ns >= self._publish_ns
        truth = self.vehicle.ground_truth() if is_state_due or self._is_pose_due else None
        if truth is not None and self._is_pose_due:
            sends.append(Send("pose", Pose(truth.mono_ns, truth.x_m, truth.y_m, truth.heading_rad)))
        for event in events:
            sends.append(Send("event", Event(event.mono_ns, event.kind, event.detail)))
            if event.kind in self._endings:
                sends += self._end_drive(self._endings[event.kind], event.mono_ns)
        sends += self._report_transitions(now)
        sends += self._report_reached_commands()
        if is_state_due:
            self._publish_ns += STATE_PERIOD_NS * (1 + (now.mono_ns - self._publish_ns) // STATE_PERIOD_NS)
            sends.append(Send("state", encode(self._state(now))))
            sends += self._report_speed_limit(now)
            status = StationaryStatus(
                self.gate.machine.is_at_rest(self.vehicle.state()), self.gate.session.active_operator
            )
            if status != self._stationary_status:
                self._stationary_status = status
                sends.append(Send("rest", status))
            if truth is not None:
                sends.append(Send("truth", truth))
            if self._route is not None:
                sends.append(Send("route", self._route))
                self._route = None
        return sends

    def _state(self, now: Now) -> State:
        vehicle = self.vehicle.state()
        session = self.gate.session
        active_operator, active_operator_instance = session.active_operator or ("", 0)
        speed_limit = self.gate.watchdog.speed_limit
        return State(
            sent_wall_ns=now.wall_ns,
            state_mono_ns=vehicle.mono_ns,
            speed_mps=vehicle.speed_mps,
            steering_rad=vehicle.steering_rad,
            gear=vehicle.gear,
            safety=self.gate.state,
            reason=self.gate.machine.reason,
            applied_sequence=self.gate.epoch.sequence,
            rejected=self.gate.last_rejection if now.mono_ns - self._rejected_ns < REJECTION_SHOWN_NS else "",
            limited=", ".join(self._limited),
            active_operator=active_operator,
            active_operator_instance=active_operator_instance,
            requested_by=session.takeover_requests.requested_by(now.mono_ns),
            instance=self.gate.instance,
            speed_limit_mps=UNSET if speed_limit is None else speed_limit.mps,
            speed_limit_reason=UNSET if speed_limit is None else speed_limit.reason,
        )

    def _report_speed_limit(self, now: Now) -> list[Send]:
        """Return a record entry of the present limit of the speed, if there is a speed governor and it is in force."""
        governor, speed_limit = self.gate.governor, self.gate.watchdog.speed_limit
        if governor is None or speed_limit is None:
            return []
        age_s = governor.age_s(now.mono_ns)
        age_ms = None if age_s is None else age_s * 1000
        return [Send("speed_limit", SpeedLimitSample(now.mono_ns, speed_limit.mps, speed_limit.reason, age_ms))]

    def _report_reached_commands(self) -> list[Send]:
        """Return a record entry for each command that has reached the wheels according to the vehicle's reports."""
        sends = []
        for reached in self.vehicle.take_reached():
            while self._pending and self._pending[0].applied_ns < reached.applied_ns:
                self._pending.popleft()
            if self._pending and self._pending[0].applied_ns == reached.applied_ns:
                command = self._pending.popleft()
                at_wheel = AtWheel(command.sequence, command.stamp_ns, command.applied_ns, reached.reached_ns)
                sends.append(Send("wheel", at_wheel))
        return sends

    def _report_transitions(self, now: Now) -> list[Send]:
        """Return an event for each safety transition, for the start of a drive, and for its end by a stop."""
        sends = []
        for before, after, reason in self.gate.machine.take_transitions():
            sends.append(Send("event", Event(now.mono_ns, "safety", f"{before} -> {after}: {reason}")))
            if before == "arming" and after == "driving":
                self._is_driving, self._ending = True, None
                sends.append(Send("event", Event(now.mono_ns, "drive_began", "")))
        if self._is_driving and self._ending is None and self.gate.machine.is_at_rest(self.vehicle.state()):
            sends += self._end_drive("safe_stop", now.mono_ns)
        return sends

    def _end_drive(self, ending: Ending, at_ns: int) -> list[Send]:
        if not self._is_driving or self._ending is not None:
            return []
        self._is_driving, self._ending = False, ending
        self.gate.machine.trigger("drive over")
        return [Send("event", Event(at_ns, "ending", ending))]
