"""Steps 12 and 13 of the life of a frame: the command is admitted or refused, and the vehicle obeys."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Mapping, Sequence
from typing import Literal

from lavt.domain import NS_PER_MS, NS_PER_S, Command, Ending, Now, Pose, SessionRequest, State, VehicleEvent
from lavt.errors import BadMessage
from lavt.node import WAKE, Hop, Message, Send
from lavt.nodes.payloads import Admission, AtWheel, Event, FrameWritten, Route, StationaryStatus
from lavt.safety.gate import ACTIVE, CommandVerdict, SafetyGate
from lavt.transport.messages import decode, encode
from lavt.value import value
from lavt.vehicle.camera import FrameTimes
from lavt.vehicle.vehicle import CountingVehicle, Vehicle

STATE_PERIOD_NS = 20 * NS_PER_MS
LATE_NS = 50 * NS_PER_MS
"""Physics that is this late is counted: the vehicle stood still in the world for so long."""
REJECTED_FOR_NS = NS_PER_S
"""So long the state tells of a refused command."""
REMEMBERED = 64
"""Commands of more than a second: what has not reached the wheels by then never will."""
POSE_AHEAD_NS = NS_PER_MS // 2
"""So much before a frame its pose is told: a command that comes just then takes 0.2 ms of the node's time."""

ENDINGS: dict[str, Ending] = {
    "completed": "completed",
    "collision": "collision",
    "off_road": "off_road",
    "timeout": "timeout",
}
"""Events that end a drive; a collision only where the vehicle does not go on after it."""


@value
class ReceivedCommand:
    """A command as it came in."""

    command: Command
    arrived: Now

    @property
    def stamp_ns(self) -> int:
        """Stamp of the picture it was made from."""
        return self.command.stamp_ns


@value
class JudgedCommand:
    """A command with what was decided on it."""

    received: ReceivedCommand
    stamp_ns: int
    verdict: CommandVerdict
    limited: tuple[str, ...] = ()


class ActuatorNode:
    """The only one who talks to the vehicle: lets it live, watches, admits commands, and tells its state.

    The vehicle lives on whenever it asks to; with `looks`, only when somebody looks, which is just before each of these
    times, and when its state is told. That is enough where physics catches up without loss and no wake is ever late.
    """

    name = "actuator"

    def __init__(
        self,
        vehicle: Vehicle,
        gate: SafetyGate,
        *,
        start_ns: int,
        route: Route | None = None,
        looks: Sequence[FrameTimes] = (),
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
        self._looks = tuple(looks)
        self._next_look = 0
        self._look_ns = start_ns
        self._pose_wanted = True
        self._ending: str | None = None
        self._rest: StationaryStatus | None = None
        self._driving = False
        self._limited: tuple[str, ...] = ()
        self._rejected_ns = start_ns
        self._applied: deque[tuple[int, int, int]] = deque(maxlen=REMEMBERED)
        """When commands were obeyed, their sequences and stamps: until they are seen to have reached the wheels."""
        self.chains: Mapping[str, Sequence[Hop]] = {
            "control": (
                ("decode", self._decode),
                ("admit", self._admit),
                ("apply", self._apply),
                ("report", self._report),
            ),
            "session": (("answer", self._answer),),
            "server_ends": (("stop", self._stop_for_good),),
            "frame": (("note", self._note_frame),),
            WAKE: (("advance", self._advance), ("publish", self._publish)),
        }

    @property
    def counts(self) -> Mapping[str, int]:
        """What was counted here, and what the safety gate has decided."""
        counted = self.vehicle.counts if isinstance(self.vehicle, CountingVehicle) else {}
        return {**self._counts, **self.gate.counts, **counted}

    def next_wake_ns(self) -> int:
        """When the vehicle, the watchdog or the state is due."""
        watch_ns = self.gate.next_wake_ns()
        lives_ns = self._look_ns if self._looks else self.vehicle.next_wake_ns()
        due_ns = min(self._publish_ns, lives_ns)
        return due_ns if watch_ns is None or due_ns < watch_ns else watch_ns

    # A command comes.

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
        self._act(now.mono_ns)
        self._applied.append((now.mono_ns, judged.received.command.sequence, judged.stamp_ns))
        self._limited = self.gate.limiter.changed
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
            reason=judged.verdict.reason,
            limited=", ".join(judged.limited),
            mode=command.mode,
            steering_rad=command.steering_rad,
            throttle=command.throttle,
            brake=command.brake,
        )
        return [*self._changes(now), Send("admission", admission)]

    # Somebody asks.

    def _answer(self, message: Message, now: Now) -> list[Send]:
        try:
            request = decode(SessionRequest, message.payload)
        except BadMessage:
            self._counts["session_requests_unreadable"] += 1
            return []
        token = self.gate.token
        reply = self.gate.answer(request, self.vehicle.state(), now.mono_ns)
        sends = [*self._changes(now), Send("session_reply", encode(reply), message.peer)]
        if self.gate.token != token:
            sends.append(Send("video_token", self.gate.token or None))
        said = "granted" if reply.granted else f"refused: {reply.reason}"
        sends.append(Send("event", Event(now.mono_ns, "session", f"{request.operation} by {request.who} {said}")))
        return sends

    def _stop_for_good(self, _message: Message, now: Now) -> list[Send]:
        self.gate.end()
        return [*self._changes(now), Send("video_token", None)]

    def _note_frame(self, message: Message, now: Now) -> None:
        frame: FrameWritten = message.payload
        self.gate.written.note(frame.stamp_ns, frame.number, frame.stamped_mono_ns, frame.pixel_crc, frame.capture_ns)
        self.gate.watch(now.mono_ns)  # before the next frame, which may hide that these were all equal

    # Time goes on.

    def _advance(self, message: Message, now: Now) -> list[VehicleEvent]:
        due_ns = min(self.vehicle.next_wake_ns(), message.arrived.mono_ns)
        events = self.vehicle.advance(now.mono_ns)
        self._pose_wanted = not self._looks or self._look_ns <= now.mono_ns
        while self._looks and self._look_ns <= now.mono_ns:
            turn, number = self._next_look % len(self._looks), self._next_look // len(self._looks)
            self._look_ns = self._looks[turn].due_ns(number) - POSE_AHEAD_NS
            self._next_look += 1
        if now.mono_ns - due_ns > LATE_NS:
            late_ms = (now.mono_ns - due_ns) // NS_PER_MS
            events.append(VehicleEvent(now.mono_ns, "late", f"{late_ms} ms"))
        self.gate.watch(now.mono_ns)
        self._act(now.mono_ns)
        return events

    def _act(self, now_ns: int) -> None:
        """Have the vehicle do what it shall do now."""
        state = self.vehicle.state()
        actuation = self.gate.actuation(state, now_ns)
        self.vehicle.engage(self.gate.needs(state), now_ns)
        self.vehicle.apply(actuation, now_ns)

    def _publish(self, events: list[VehicleEvent], now: Now) -> list[Send]:
        sends = []
        told = now.mono_ns >= self._publish_ns
        truth = self.vehicle.ground_truth() if told or self._pose_wanted else None
        if truth is not None and self._pose_wanted:
            sends.append(Send("pose", Pose(truth.mono_ns, truth.x_m, truth.y_m, truth.heading_rad)))
        for event in events:
            sends.append(Send("event", Event(event.mono_ns, event.kind, event.detail)))
            if event.kind in self._endings:
                sends += self._end(self._endings[event.kind], event.mono_ns)
        sends += self._changes(now)
        sends += self._reached()
        if told:
            self._publish_ns += STATE_PERIOD_NS * (1 + (now.mono_ns - self._publish_ns) // STATE_PERIOD_NS)
            sends.append(Send("state", encode(self._state(now))))
            rest = StationaryStatus(self.gate.at_rest(self.vehicle.state()), self.gate.active_operator)
            if rest != self._rest:
                self._rest = rest
                sends.append(Send("rest", rest))
            if truth is not None:
                sends.append(Send("truth", truth))
            if self._route is not None:
                sends.append(Send("route", self._route))
                self._route = None
        return sends

    def _state(self, now: Now) -> State:
        vehicle = self.vehicle.state()
        active_operator, active_operator_instance = self.gate.active_operator or ("", 0)
        return State(
            sent_wall_ns=now.wall_ns,
            state_mono_ns=vehicle.mono_ns,
            speed_mps=vehicle.speed_mps,
            steering_rad=vehicle.steering_rad,
            gear=vehicle.gear,
            safety=self.gate.state,
            reason=self.gate.reason,
            applied_sequence=self.gate.applied_sequence,
            rejected=self.gate.rejected if now.mono_ns - self._rejected_ns < REJECTED_FOR_NS else "",
            limited=", ".join(self._limited),
            active_operator=active_operator,
            active_operator_instance=active_operator_instance,
            requested_by=self.gate.claims.requested_by(now.mono_ns),
            instance=self.gate.instance,
        )

    def _reached(self) -> list[Send]:
        """Tell which commands were seen to have reached the wheels, and when."""
        sends = []
        for reached in self.vehicle.take_reached():
            while self._applied and self._applied[0][0] < reached.applied_ns:
                self._applied.popleft()
            if self._applied and self._applied[0][0] == reached.applied_ns:
                applied_ns, sequence, stamp_ns = self._applied.popleft()
                sends.append(Send("wheel", AtWheel(sequence, stamp_ns, applied_ns, reached.reached_ns)))
        return sends

    # What changed is told.

    def _changes(self, now: Now) -> list[Send]:
        """Tell every transition of the safety state, the begin of a drive, and its end by a stop."""
        sends = []
        for before, after, reason in self.gate.take_transitions():
            sends.append(Send("event", Event(now.mono_ns, "safety", f"{before} -> {after}: {reason}")))
            if before == "arming" and after == "driving":
                self._driving, self._ending = True, None
                sends.append(Send("event", Event(now.mono_ns, "drive_began", "")))
        over = self._driving and self._ending is None and self.gate.state not in ACTIVE
        if over and self.gate.stands(self.vehicle.state()):
            sends += self._end("safe_stop", now.mono_ns)
        return sends

    def _end(self, ending: Ending, at_ns: int) -> list[Send]:
        if not self._driving or self._ending is not None:
            return []
        self._driving, self._ending = False, ending
        self.gate.end_drive()
        return [Send("event", Event(at_ns, "ending", ending))]
