"""The driver node, which turns received frames into commands.

Its steps are: picture and stamp (`picture_reader`), lane detection, decision, command (`commander`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Protocol

from msgspec import Struct
from msgspec.structs import replace

from lavt.control.client_limits import ClientLimits
from lavt.control.drive_controller import DriveController, LoopReader, StampReader
from lavt.control.lane_watch import LANE_CONFIDENCE, LaneState, LaneWatch
from lavt.domain import Decision, FramePayload, Lane, Mode, Now
from lavt.node import Message, Send, Stage
from lavt.nodes.client_session import ClientSession
from lavt.nodes.commander import Commander, braking, stopping
from lavt.nodes.payloads import DecodedFrame, LaneSeen
from lavt.nodes.picture_reader import PictureReader
from lavt.perception.lane_detector import LONGEST_GAP_NS


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


class DriverNode(Commander):
    """The node that drives by the received pictures and the reported speed only.

    Every access unit is decoded, but the lane is detected only in the newest waiting picture. A command is sent
    with each detection, and at the latest `limits.command_period_ns` after the previous command. A lane with less than
    `lane_confidence` is treated as lost.
    """

    def __init__(
        self,
        reader: PictureReader,
        detector: LaneDetection,
        controller: DriveController,
        session: ClientSession,
        limits: ClientLimits,
        *,
        lane_confidence: float = LANE_CONFIDENCE,
    ) -> None:
        super().__init__(session, limits)
        self._reader = reader
        self._detector = detector
        self._controller = controller
        self._stamp_reader = controller if isinstance(controller, StampReader) else None
        self._history = controller.history if isinstance(controller, LoopReader) else None
        self._lane_watch = LaneWatch(lane_confidence)
        self._detected_stamp_ns = 0
        self._decision: Decision | None = None
        self._lane_state: LaneState = "ok"
        self.pipelines: Mapping[str, Sequence[Stage]] = {
            "access_unit": reader.stages,
            "view": (("perceive", self._perceive), ("decide", self._decide), ("command", self._command_now)),
            **self._session_pipelines,
        }

    @property
    def counts(self) -> Mapping[str, int]:
        """Return the counts of the node and of its picture reader."""
        return {**self._reader.counts, **self._counts}

    # Pictures.

    def _perceive(self, message: Message, _now: Now) -> PerceivedFrame:
        view: DecodedFrame = message.payload
        since_last_ns = view.stamp_ns - self._detected_stamp_ns
        self._detected_stamp_ns = view.stamp_ns
        # After a stop or a gap, another lane can be where the lane was. The gap between the stamps is the time in which
        # the car moved. A negative gap comes from a clock that was set back, so the true gap is unknown.
        if self.session.phase != "driving" or not 0 <= since_last_ns <= LONGEST_GAP_NS:
            self._detector.forget()
        return PerceivedFrame(view, view.stamp_ns, self._finite(self._detector.detect(view.received.picture)))

    def _finite(self, lane: Lane) -> Lane:
        """Return a detected lane; one of a detector of the user's own that is not finite counts as no lane."""
        if all(map(math.isfinite, (*lane.centre, lane.width_m, lane.confidence))):
            return lane
        self._counts["lanes_not_finite"] += 1
        return replace(lane, centre=(0.0, 0.0, 0.0), width_m=0.0, confidence=0.0)

    def _decide(self, perceived: PerceivedFrame, now: Now) -> PerceivedFrame:
        self._lane_state = self._lane_watch.check(perceived.lane.confidence, now.mono_ns)
        if self._stamp_reader is not None:
            self._stamp_reader.note_stamp(perceived.stamp_ns)
        self._decision = self._controller.decide(perceived.lane, self._speed_mps, now.mono_ns)
        self._view, self._view_ns = perceived.view, now.mono_ns
        return perceived

    def _command_now(self, perceived: PerceivedFrame, now: Now) -> list[Send]:
        return [*self._command(now), Send("lane", LaneSeen(perceived.stamp_ns, perceived.lane))]

    def _choose(self, now_ns: int) -> tuple[Mode, Decision] | None:
        decision = self._decision
        if decision is None:
            return None
        if self.session.emergency_stop:
            return "stop", stopping(decision)
        if self.session.phase != "driving":
            return "arm", Decision(0.0, 0.0, 1.0, decision.path_curvature_per_m)
        mode, limited = self._limited_by_age(decision, now_ns)
        if mode == "stop" or self._lane_state == "stop":
            return "stop", stopping(decision)
        if self._lane_state == "brake":
            return "drive", braking(decision, self._limits.brake)
        return mode, limited

    # What a controller that knows its loop gets.

    def _note_command(self, decision: Decision, now: Now) -> None:
        if self._history is not None:
            self._history.note_command(self._sequence, decision.steering_rad, now.mono_ns)

    def _handle_newer_state(self, now: Now) -> None:
        if self._history is None or self._newest_state is None:
            return
        if self.session.has_control:
            self._history.note_state(self._newest_state, now.mono_ns)
        else:
            self._history.forget()
