"""Accept or reject each received command, and apply accepted ones to the vehicle."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Mapping, Sequence
from typing import Literal

from msgspec import Struct

from lavt.domain import NS_PER_MS, NS_PER_S, Command, Ending, Now, Pose, SessionRequest, State, VehicleEvent
from lavt.errors import BadMessage
from lavt.node import WAKE, Message, Send, Stage
from lavt.nodes.payloads import Admission, AtWheel, Event, FrameWritten, Route, StationaryStatus
from lavt.safety.gate import CommandVerdict, SafetyGate
from lavt.transport.messages import decode, encode
from lavt.vehicle.camera import FrameTimes
from lavt.vehicle.vehicle import CountingVehicle, Vehicle

STATE_PERIOD_NS = 20 * NS_PER_MS
LATE_NS = 50 * NS_PER_MS
"""A physics step this late is an event: the simulated vehicle stood still for this long."""
REJECTION_SHOWN_NS = NS_PER_S
"""The state contains the last rejection for this long."""
MAX_PENDING_COMMANDS = 64
"""Commands of more than a second: one that has not reached the wheels by then never will."""
POSE_AHEAD_NS = NS_PER_MS // 2
"""A frame's pose is sent this long before the frame: a command that arrives then occupies the node for 0.2 ms."""

ENDINGS: dict[str, Ending] = {
    "completed": "completed",
    "collision": "collision",
    "off_road": "off_road",
    "timeout": "timeout",
}
"""Events that end a drive; a collision only if `after_collision` is "end"."""


class ReceivedCommand(Struct, frozen=True):
    """A decoded command with its time of arrival."""

    command: Command
    arrived: Now

    @property
    def stamp_ns(self) -> int:
        """Return the stamp of the picture that the command was made from."""
        return self.command.stamp_ns


class JudgedCommand(Struct, frozen=True):
    """A command with the gate's decision."""

    received: ReceivedCommand
    stamp_ns: int
    verdict: CommandVerdict
    limited: tuple[str, ...] = ()


class ActuatorNode:
    """The node that operates the vehicle: physics steps, safety gate, actuation and state reports.

    Physics advances whenever the vehicle is due. With `sample_times` it advances lazily: just before each of these
    times, and when the state is published. This is sufficient if physics catches up without loss and no wake is late.
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
        self._sample_times = tuple(sample_times)
        self._next_sample = 0
        self._sample_ns = start_ns
        self._is_pose_due = True
        self._ending: str | None = None
        self._stationary_status: StationaryStatus | None = None
        self._is_driving = False
        self._limited: tuple[str, ...] = ()
        self._rejected_ns = start_ns
        self._pending: deque[tuple[int, int, int]] = deque(maxlen=MAX_PENDING_COMMANDS)
        """Time, sequence and stamp of applied commands, until the vehicle reports that they reached the wheels."""
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
        counted = self.vehicle.counts if isinstance(self.vehicle, CountingVehicle) else {}
        return {**self._counts, **self.gate.counts, **counted}

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

    def _admit(self, received: ReceivedCommand, _now: Now) -> JudgedCommand:
        verdict = self.gate.admit(received.command, self.vehicle.state(), received.arrived.mono_ns)
        if not verdict.accepted:
            self._rejected_ns = received.arrived.mono_ns
        return JudgedCommand(received, received.stamp_ns, verdict)

    def _apply(self, judged: JudgedCommand, now: Now) -> JudgedCommand:
        if not judged.verdict.accepted:
            return judged
        self._actuate(now.mono_ns)
        self._pending.append((now.mono_ns, judged.received.command.sequence, judged.stamp_ns))
        self._limited = self.gate.limiter.applied_limits
        return JudgedCommand(judged.received, judged.stamp_ns, judged.verdict, self._limited)

    def _report(self, judged: JudgedCommand, now: Now) -> list[Send]:
        command, arrived = judged.received.command, judged.received.arrived
        accepted = judged.verdict.accepted
        self._counts["commands_limited"] += bool(judged.limited)
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
            reason=judged.verdict.message,
            limited=", ".join(judged.limited),
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
        # Check now: the next frame may end a series of equal pictures.
        self.gate.watchdog.check_timeouts(now.mono_ns)

    # Physics and state reports.

    def _advance(self, message: Message, now: Now) -> list[VehicleEvent]:
        due_ns = min(self.vehicle.next_wake_ns(), message.arrived.mono_ns)
        events = self.vehicle.advance(now.mono_ns)
        self._is_pose_due = not self._sample_times or self._sample_ns <= now.mono_ns
        while self._sample_times and self._sample_ns <= now.mono_ns:
            number, turn = divmod(self._next_sample, len(self._sample_times))
            self._sample_ns = self._sample_times[turn].due_ns(number) - POSE_AHEAD_NS
            self._next_sample += 1
        if now.mono_ns - due_ns > LATE_NS:
            late_ms = (now.mono_ns - due_ns) // NS_PER_MS
            events.append(VehicleEvent(now.mono_ns, "late", f"{late_ms} ms"))
        self.gate.watchdog.check_timeouts(now.mono_ns)
        self._actuate(now.mono_ns)
        return events

    def _actuate(self, now_ns: int) -> None:
        """Engage or disengage the vehicle, and apply the present actuation."""
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
        return State(
            sent_wall_ns=now.wall_ns,
            state_mono_ns=vehicle.mono_ns,
            speed_mps=vehicle.speed_mps,
            steering_rad=vehicle.steering_rad,
            gear=vehicle.gear,
            safety=self.gate.state,
            reason=self.gate.machine.reason,
            applied_sequence=self.gate.epoch.sequence,
            rejected=self.gate.rejected if now.mono_ns - self._rejected_ns < REJECTION_SHOWN_NS else "",
            limited=", ".join(self._limited),
            active_operator=active_operator,
            active_operator_instance=active_operator_instance,
            requested_by=session.takeover_requests.requested_by(now.mono_ns),
            instance=self.gate.instance,
        )

    def _report_reached_commands(self) -> list[Send]:
        """Return a `wheel` record for each command that the vehicle reports to have reached the wheels."""
        sends = []
        for reached in self.vehicle.take_reached():
            while self._pending and self._pending[0][0] < reached.applied_ns:
                self._pending.popleft()
            if self._pending and self._pending[0][0] == reached.applied_ns:
                applied_ns, sequence, stamp_ns = self._pending.popleft()
                sends.append(Send("wheel", AtWheel(sequence, stamp_ns, applied_ns, reached.reached_ns)))
        return sends

    def _report_transitions(self, now: Now) -> list[Send]:
        """Return events for each safety transition, the start of a drive and its end by a stop."""
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
