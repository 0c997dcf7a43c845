"""The driver node, which turns received frames into commands.

Its steps are: picture and stamp (`picture_reader`), lane detection, decision, command.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import ClassVar, Literal, Protocol

from msgspec import Struct

from lavt.control.client_limits import ClientLimits
from lavt.control.drive_controller import DriveController
from lavt.control.lane_watch import LaneState, LaneWatch
from lavt.domain import Command, Decision, FramePayload, Lane, Mode, Now, SessionReply, State
from lavt.errors import BadMessage
from lavt.node import WAKE, Message, Send, Stage
from lavt.nodes.client_session import ClientSession
from lavt.nodes.payloads import DecodedFrame, LaneSeen, PathToken
from lavt.nodes.picture_reader import PictureReader
from lavt.perception.lane_detector import LONGEST_GAP_NS
from lavt.transport.messages import decode, encode

OperatorRequest = Literal["emergency_stop", "release"]
"""A request of the person at the client, on the channel `operator`."""


class LaneDetection(Protocol):
    """A lane detector for a sequence of pictures."""

    def forget(self) -> None:
        """Drop the memory of earlier pictures."""
        ...

    def detect(self, picture: FramePayload, /) -> Lane:
        """Return the lane in the next picture."""
        ...


class PerceivedFrame(Struct, frozen=True):
    """A decoded frame with the lane detected in it."""

    view: DecodedFrame
    stamp_ns: int
    lane: Lane


class DriverNode:
    """The node that drives by the received pictures and the reported speed only.

    Every access unit is decoded, but the lane is detected only in the newest waiting picture. A command is sent
    with each detection, and at the latest `limits.command_period_ns` after the previous command.
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
        self._lane_watch = LaneWatch()
        self._limits = limits
        self._sequence = 0
        self._view: DecodedFrame | None = None
        """The frame from which the newest decision was made."""
        self._view_ns = 0
        """When that decision was made."""
        self._detected_stamp_ns = 0
        self._decision: Decision | None = None
        self._lane_state: LaneState = "ok"
        self._server: int | None = None
        """Instance of the server process that sent the newest state."""
        self._vehicle_ns = 0
        """Time of the newest state on the vehicle's clock."""
        self._speed_mps = 0.0
        self._state_ns = 0
        """When the newest state arrived."""
        self._command_ns: int | None = None
        """When the next command is due; None: no command is due."""
        self.pipelines: Mapping[str, Sequence[Stage]] = {
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
        """Return the counts of the node and of its picture reader."""
        return {**self._reader.counts, **self._counts}

    def next_wake_ns(self) -> int | None:
        """Return when the next command or session request is due."""
        request_ns = self.session.next_wake_ns()
        if request_ns is None or self._command_ns is None:
            return request_ns if self._command_ns is None else self._command_ns
        return min(request_ns, self._command_ns)

    # Pictures.

    def _perceive(self, message: Message, _now: Now) -> PerceivedFrame:
        view: DecodedFrame = message.payload
        since_last_ns = view.stamp_ns - self._detected_stamp_ns
        self._detected_stamp_ns = view.stamp_ns
        # After a stop or a gap, another lane can be where the lane was. The gap between the stamps is the time in which
        # the car moved. A negative gap comes from a clock that was set back, so the true gap is unknown.
        if self.session.phase != "driving" or not 0 <= since_last_ns <= LONGEST_GAP_NS:
            self._detector.forget()
        return PerceivedFrame(view, view.stamp_ns, self._detector.detect(view.received.picture))

    def _decide(self, perceived: PerceivedFrame, now: Now) -> PerceivedFrame:
        self._lane_state = self._lane_watch.check(perceived.lane.confidence, now.mono_ns)
        self._decision = self._controller.decide(perceived.lane, self._speed_mps, now.mono_ns)
        self._view, self._view_ns = perceived.view, now.mono_ns
        return perceived

    def _command_now(self, perceived: PerceivedFrame, now: Now) -> list[Send]:
        return [*self._command(now), Send("lane", LaneSeen(perceived.stamp_ns, perceived.lane))]

    # Commands.

    def _wake(self, _message: Message, now: Now) -> list[Send]:
        sends: list[Send] = []
        if self._command_ns is not None and now.mono_ns >= self._command_ns:
            sends += self._command(now)
        return sends + self._wake_session(now)

    def _wake_session(self, now: Now) -> list[Send]:
        request = self.session.take_request(now.mono_ns)
        return [] if request is None else [Send("session", encode(request))]

    def _command(self, now: Now) -> list[Send]:
        """Return the current command; nothing without control or without a picture."""
        self._command_ns = None
        if self._view is None or self._decision is None or not self.session.may_command:
            return []
        self._command_ns = now.mono_ns + self._limits.command_period_ns
        self._sequence += 1
        mode, decision = self._mode_and_decision(self._decision, now.mono_ns)
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

    def _mode_and_decision(self, decision: Decision, now_ns: int) -> tuple[Mode, Decision]:
        if self.session.emergency_stop:
            return "stop", Decision(decision.steering_rad, 0.0, 1.0, decision.path_curvature_per_m)
        if self.session.phase != "driving":
            return "arm", Decision(0.0, 0.0, 1.0, decision.path_curvature_per_m)
        frame_age_ns, state_age_ns = now_ns - self._view_ns, now_ns - self._state_ns
        limits = self._limits
        if (
            self._lane_state == "stop"
            or frame_age_ns >= limits.no_picture_stop_ns
            or state_age_ns >= limits.no_state_stop_ns
        ):
            return "stop", Decision(decision.steering_rad, 0.0, 1.0, decision.path_curvature_per_m)
        if (
            self._lane_state == "brake"
            or frame_age_ns >= limits.no_picture_brake_ns
            or state_age_ns >= limits.no_state_brake_ns
        ):
            brake = max(decision.brake, limits.brake)
            return "drive", Decision(decision.steering_rad, 0.0, brake, decision.path_curvature_per_m)
        return "drive", decision

    # Requests of the operator.

    def _accept_operator(self, message: Message, now: Now) -> list[Send]:
        return self._OPERATOR_REQUESTS[message.payload](self, now)

    def _raise_emergency_stop(self, now: Now) -> list[Send]:
        """Send an emergency stop: at once as a request, and from now on in every command."""
        return [Send("session", encode(self.session.raise_emergency_stop(now))), *self._command(now)]

    def _release(self, now: Now) -> list[Send]:
        """Release control: the vehicle stops, and no more commands are sent."""
        self.session.release(now.mono_ns)
        return self._wake_session(now)

    _OPERATOR_REQUESTS: ClassVar[dict[OperatorRequest, Callable[..., list[Send]]]] = {
        "emergency_stop": _raise_emergency_stop,
        "release": _release,
    }

    # Messages from the vehicle.

    def _note_state(self, message: Message, now: Now) -> None:
        try:
            state = decode(State, message.payload)
        except BadMessage:
            self._counts["states_unreadable"] += 1
            return
        if state.instance != self._server or state.state_mono_ns > self._vehicle_ns:
            self._server, self._vehicle_ns = state.instance, state.state_mono_ns
            self._speed_mps, self._state_ns = state.speed_mps, now.mono_ns
        else:
            self._counts["states_not_newer"] += 1
        self.session.handle_state(state, now.mono_ns)

    def _note_condition(self, message: Message, _now: Now) -> None:
        self.session.handle_condition(message.payload)

    def _note_reply(self, message: Message, now: Now) -> list[Send]:
        try:
            reply = decode(SessionReply, message.payload)
        except BadMessage:
            self._counts["session_replies_unreadable"] += 1
            return []
        self.session.handle_reply(reply, now.mono_ns)
        return [Send("path_token", PathToken(reply.token, reply.video_port))] if reply.granted and reply.token else []
