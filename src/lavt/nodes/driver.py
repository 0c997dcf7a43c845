"""Steps 7 to 10 of the life of a frame: picture and stamp (`picture_reader`), lane, command."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import ClassVar, Literal, Protocol

from lavt.control.drive_controller import DriveController
from lavt.control.driver_limits import ClientLimits
from lavt.control.lane_watch import LaneState, LaneWatch
from lavt.domain import Command, Decision, Lane, Mode, Now, SessionReply, Sight, State
from lavt.errors import BadMessage
from lavt.node import WAKE, Hop, Message, Send
from lavt.nodes.client_session import ClientSession
from lavt.nodes.payloads import DecodedFrame, LaneSeen, PathToken
from lavt.nodes.picture_reader import PictureReader
from lavt.perception.lane_detector import FOLLOWS_FOR_NS
from lavt.transport.messages import decode, encode
from lavt.value import value

OperatorAsks = Literal["emergency_stop", "release"]
"""What a person beside the client can ask for, on the channel `operator`."""


class LaneDetection(Protocol):
    """Finds the lane in one picture after another."""

    def forget(self) -> None:
        """Take the next picture as the first one."""
        ...

    def detect(self, picture: Sight, /) -> Lane:
        """Give the lane in the next picture."""
        ...


@value
class PerceivedFrame:
    """A view and the lane that perception found in it."""

    view: DecodedFrame
    stamp_ns: int
    lane: Lane


class DriverNode:
    """Drives by the received pictures and the speed that the vehicle reports, and by nothing else.

    Every picture is decoded; when pictures wait, only the newest is looked at. A command leaves as soon as a picture
    has been looked at, and never later than `limits.command_period_ns` after the one before.
    """

    name = "driver"

    def __init__(
        self,
        reader: PictureReader,
        detector: LaneDetection,
        controller: DriveController,
        session: ClientSession,
        limits: ClientLimits,
    ) -> None:
        self.session = session
        self._counts: Counter[str] = Counter()
        self._reader = reader
        self._detector = detector
        self._controller = controller
        self._watch = LaneWatch()
        self._limits = limits
        self._sequence = 0
        self._view: DecodedFrame | None = None
        self._view_ns = 0
        self._looked_at_ns = 0
        self._decision: Decision | None = None
        self._lane_says: LaneState = "ok"
        self._speed_mps = 0.0
        self._state_ns = 0
        self._command_ns: int | None = None
        self.chains: Mapping[str, Sequence[Hop]] = {
            "access_unit": reader.stages,
            "view": (("perceive", self._perceive), ("decide", self._decide), ("command", self._command_now)),
            "state": (("note", self._note_state),),
            "session_reply": (("note", self._note_reply),),
            "operator": (("accept", self._accept_operator),),
            "condition_in_force": (("note", self._note_condition),),
            WAKE: (("command", self._wake),),
        }

    @property
    def counts(self) -> Mapping[str, int]:
        """What was counted here and of the pictures."""
        return {**self._reader.counts, **self._counts}

    def next_wake_ns(self) -> int | None:
        """When the next command or session query is due."""
        asks_ns = self.session.next_wake_ns()
        if asks_ns is None or self._command_ns is None:
            return asks_ns if self._command_ns is None else self._command_ns
        return min(asks_ns, self._command_ns)

    # A picture is looked at.

    def _perceive(self, message: Message, _now: Now) -> PerceivedFrame:
        view: DecodedFrame = message.payload
        since_last_ns = view.stamp_ns - self._looked_at_ns
        self._looked_at_ns = view.stamp_ns
        # After a stop or a gap, what lies where the lane was may be another one. A gap is one between
        # the times at which pictures were sent, as the car went on; of a clock put back nobody knows how long.
        if self.session.phase != "driving" or not 0 <= since_last_ns <= FOLLOWS_FOR_NS:
            self._detector.forget()
        return PerceivedFrame(view, view.stamp_ns, self._detector.detect(view.received.picture))

    def _decide(self, seen: PerceivedFrame, now: Now) -> PerceivedFrame:
        self._lane_says = self._watch.check(seen.lane.confidence, now.mono_ns)
        self._decision = self._controller.decide(seen.lane, self._speed_mps, now.mono_ns)
        self._view, self._view_ns = seen.view, now.mono_ns
        return seen

    def _command_now(self, seen: PerceivedFrame, now: Now) -> list[Send]:
        return [*self._command(now), Send("lane", LaneSeen(seen.stamp_ns, seen.lane))]

    # A command is due.

    def _wake(self, _message: Message, now: Now) -> list[Send]:
        sends: list[Send] = []
        if self._command_ns is not None and now.mono_ns >= self._command_ns:
            sends += self._command(now)
        return sends + self._wake_session(now)

    def _wake_session(self, now: Now) -> list[Send]:
        request = self.session.request_due(now.mono_ns)
        return [] if request is None else [Send("session", encode(request))]

    def _command(self, now: Now) -> list[Send]:
        """Make the command of this moment from what is known; none without a session or a picture."""
        self._command_ns = None
        if self._view is None or self._decision is None or not self.session.commanding:
            return []
        self._command_ns = now.mono_ns + self._limits.command_period_ns
        self._sequence += 1
        mode, decision = self._intention(self._decision, now.mono_ns)
        command = Command(
            epoch=self.session.epoch,
            sequence=self._sequence,
            sent_wall_ns=now.wall_ns,
            stamp_ns=self._view.stamp_ns,
            stamp_received_wall_ns=self._view.read_wall_ns,
            steering_rad=decision.steering_rad,
            throttle=decision.throttle,
            brake=decision.brake,
            path_curvature_per_m=decision.path_curvature_per_m,
            mode=mode,
            emergency_stop=self.session.emergency_stop,
        )
        return [Send("control", encode(command))]

    def _intention(self, decision: Decision, now_ns: int) -> tuple[Mode, Decision]:
        if self.session.emergency_stop:
            return "stop", Decision(decision.steering_rad, 0.0, 1.0, decision.path_curvature_per_m)
        if self.session.phase != "driving":
            return "arm", Decision(0.0, 0.0, 1.0, decision.path_curvature_per_m)
        frame_age_ns, state_age_ns = now_ns - self._view_ns, now_ns - self._state_ns
        limits = self._limits
        if (
            self._lane_says == "stop"
            or frame_age_ns >= limits.no_picture_stop_ns
            or state_age_ns >= limits.no_state_stop_ns
        ):
            return "stop", Decision(decision.steering_rad, 0.0, 1.0, decision.path_curvature_per_m)
        if (
            self._lane_says == "brake"
            or frame_age_ns >= limits.no_picture_brake_ns
            or state_age_ns >= limits.no_state_brake_ns
        ):
            brake = max(decision.brake, limits.brake)
            return "drive", Decision(decision.steering_rad, 0.0, brake, decision.path_curvature_per_m)
        return "drive", decision

    # The person beside it asks for something.

    def _accept_operator(self, message: Message, now: Now) -> list[Send]:
        return self._FOR_THE_OPERATOR[message.payload](self, now)

    def _stop_now(self, now: Now) -> list[Send]:
        """Raise an emergency stop: by a query at once, and by a flag in every command from now on."""
        return [Send("session", encode(self.session.stop_now(now))), *self._command(now)]

    def _release(self, now: Now) -> list[Send]:
        """Give the vehicle up: it stops, and no more commands are made."""
        self.session.release(now.mono_ns)
        return self._wake_session(now)

    _FOR_THE_OPERATOR: ClassVar[dict[OperatorAsks, Callable[..., list[Send]]]] = {
        "emergency_stop": _stop_now,
        "release": _release,
    }

    # The vehicle tells.

    def _note_state(self, message: Message, now: Now) -> None:
        try:
            state = decode(State, message.payload)
        except BadMessage:
            self._counts["states_unreadable"] += 1
            return
        self._speed_mps, self._state_ns = state.speed_mps, now.mono_ns
        self.session.note_state(state, now.mono_ns)

    def _note_condition(self, message: Message, _now: Now) -> None:
        self.session.note_condition(message.payload)

    def _note_reply(self, message: Message, now: Now) -> list[Send]:
        try:
            reply = decode(SessionReply, message.payload)
        except BadMessage:
            self._counts["session_replies_unreadable"] += 1
            return []
        self.session.note_reply(reply, now.mono_ns)
        return [Send("path_token", PathToken(reply.token, reply.video_port))] if reply.granted and reply.token else []
