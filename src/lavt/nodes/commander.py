"""The part that all driver nodes share: the session, the states of the vehicle, and the commands.

A driver node derives from `Commander`. It sets `_view` to the frame from which it decides, and implements `_choose`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import ClassVar, Literal

from lavt.control.client_limits import ClientLimits
from lavt.domain import Command, Decision, Mode, Now, SessionReply, State
from lavt.errors import BadMessage
from lavt.node import WAKE, Message, Send, Stage
from lavt.nodes.client_session import ClientSession
from lavt.nodes.payloads import DecodedFrame, FrameStamp, PathToken
from lavt.transport.messages import decode, encode

OperatorRequest = Literal["emergency_stop", "release"]
"""A request of the person at the client, on the channel `operator`."""


class Commander(ABC):
    """The base of a driver node, which sends commands while the session allows it.

    A command is sent at the latest `limits.command_period_ns` after the previous command.
    """

    name = "driver"

    def __init__(self, session: ClientSession, limits: ClientLimits) -> None:
        self.session = session
        self._counts: Counter[str] = Counter()
        self._limits = limits
        self._sequence = 0
        self._view: DecodedFrame | FrameStamp | None = None
        """The frame from which the newest decision was made."""
        self._view_ns = 0
        """When this frame became the newest one."""
        self._server: int | None = None
        """Instance of the server process that sent the newest state."""
        self._vehicle_ns = 0
        """Time of the newest state on the vehicle's clock."""
        self._speed_mps = 0.0
        self._newest_state: State | None = None
        self._state_ns = 0
        """When the newest state arrived."""
        self._command_ns: int | None = None
        """When the next command is due; None: no command is due."""
        self._session_pipelines: Mapping[str, Sequence[Stage]] = {
            "state": (("note", self._note_state),),
            "session_reply": (("note", self._note_reply),),
            "operator": (("accept", self._accept_operator),),
            "condition_in_force": (("note", self._note_condition),),
            WAKE: (("command", self._wake),),
        }

    @abstractmethod
    def _choose(self, now_ns: int) -> tuple[Mode, Decision] | None:
        """Return the mode and the decision of the next command; None: send no command."""

    def _note_command(self, decision: Decision, now: Now) -> None:  # noqa: B027 (most driver nodes need nothing here)
        """Process the content of a command that is sent now."""

    def _handle_newer_state(self, now: Now) -> None:  # noqa: B027 (as above)
        """Process `_newest_state`, which is newer than all earlier ones."""

    def next_wake_ns(self) -> int | None:
        """Return when the next command or session request is due."""
        request_ns = self.session.next_wake_ns()
        if request_ns is None or self._command_ns is None:
            return request_ns if self._command_ns is None else self._command_ns
        return min(request_ns, self._command_ns)

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
        """Return the current command; nothing without control, without a picture or without a choice."""
        self._command_ns = None
        if self._view is None or not self.session.may_command:
            return []
        choice = self._choose(now.mono_ns)
        if choice is None:
            return []
        self._command_ns = now.mono_ns + self._limits.command_period_ns
        self._sequence += 1
        mode, decision = choice
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
        self._note_command(decision, now)
        return [Send("control", encode(command))]

    def _limited_by_age(self, decision: Decision, now_ns: int) -> tuple[Mode, Decision]:
        """Return a decision to drive or, if pictures or states are missing, to brake or stop."""
        frame_age_ns, state_age_ns = now_ns - self._view_ns, now_ns - self._state_ns
        limits = self._limits
        if frame_age_ns >= limits.no_picture_stop_ns or state_age_ns >= limits.no_state_stop_ns:
            return "stop", stopping(decision)
        if frame_age_ns >= limits.no_picture_brake_ns or state_age_ns >= limits.no_state_brake_ns:
            return "drive", braking(decision, limits.brake)
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
            self._newest_state, self._speed_mps, self._state_ns = state, state.speed_mps, now.mono_ns
            self._handle_newer_state(now)
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


def stopping(decision: Decision) -> Decision:
    """Return a decision with the same steering, without throttle and with full brake."""
    return Decision(decision.steering_rad, 0.0, 1.0, decision.path_curvature_per_m)


def braking(decision: Decision, brake: float) -> Decision:
    """Return a decision with the same steering, without throttle and with at least `brake`."""
    return Decision(decision.steering_rad, 0.0, max(decision.brake, brake), decision.path_curvature_per_m)
