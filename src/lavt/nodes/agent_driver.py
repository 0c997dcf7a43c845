"""The driver node of an agent: it shows the agent what each picture contains, and commands what the agent chose.

It differs from the node of a controller (`driver`) in one point: between the detection of the lane and the decision it
waits for a message of the agent. In virtual time no time passes until this message, so that both nodes send the same
commands at the same times if the agent decides as the controller does. In real time nothing sends this message yet.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from msgspec import Struct

from lavt.control.agent import AgentController
from lavt.control.client_limits import ClientLimits
from lavt.control.lane_watch import LANE_CONFIDENCE
from lavt.domain import NS_PER_S, FramePayload, Lane, Now
from lavt.node import Message, Send, Stage
from lavt.nodes.client_session import ClientSession
from lavt.nodes.driver import DriverNode, LaneDetection, PerceivedFrame
from lavt.nodes.payloads import AgentAction, LaneSeen
from lavt.nodes.picture_reader import PictureReader


class AgentView(Struct, frozen=True):
    """What the client knows when it has detected the lane in a picture: all that an agent may observe."""

    stamp_ns: int
    """Stamp of the picture, on the vehicle's wall clock."""
    read_wall_ns: int
    """When the stamp was read, on the client's wall clock."""
    picture: FramePayload
    lane: Lane
    speed_mps: float
    """Reported speed."""
    steering_rad: float
    """Reported angle of the road wheels."""
    loop_delay_s: float | None
    """Time from the stamp until a command that is sent now takes effect, as the client measures it; None: not known."""


class AgentDriverNode(DriverNode):
    """The driver node of an agent.

    After each picture, `view` is what the agent may observe, and the entry `lane` is recorded. The node then sends no
    command until it gets an `AgentAction`. Without one, the vehicle stops by itself, as without any driver.
    """

    def __init__(
        self,
        reader: PictureReader,
        detector: LaneDetection,
        controller: AgentController,
        session: ClientSession,
        limits: ClientLimits,
        *,
        lane_confidence: float = LANE_CONFIDENCE,
    ) -> None:
        super().__init__(reader, detector, controller, session, limits, lane_confidence=lane_confidence)
        self.view: AgentView | None = None
        self._agent = controller
        self._perceived: PerceivedFrame | None = None
        self._loop_delay_s: float | None = None
        self.pipelines: Mapping[str, Sequence[Stage]] = {
            **self.pipelines,
            "view": (("perceive", self._perceive), ("observe", self._observe)),
            "agent_action": (("decide", self._decide_as_chosen), ("command", self._command_as_chosen)),
        }

    def _observe(self, perceived: PerceivedFrame, now: Now) -> list[Send]:
        self._command_ns = None  # the next command is the agent's
        self._perceived = perceived
        state = self._newest_state
        self.view = AgentView(
            perceived.stamp_ns,
            perceived.view.read_wall_ns,
            perceived.view.received.picture,
            perceived.lane,
            self._speed_mps,
            0.0 if state is None else state.steering_rad,
            self._measured_delay_s(perceived.stamp_ns, now.mono_ns),
        )
        return [Send("lane", LaneSeen(perceived.stamp_ns, perceived.lane))]

    def _measured_delay_s(self, stamp_ns: int, now_ns: int) -> float | None:
        """Return the loop delay for a picture, or the last known one if it cannot be measured now."""
        history = self._agent.history
        delay_ns = history.delay.at_ns(now_ns)
        if delay_ns is not None and history.is_comparable(stamp_ns, now_ns):
            self._loop_delay_s = (now_ns + delay_ns - stamp_ns) / NS_PER_S
        return self._loop_delay_s

    def _decide_as_chosen(self, message: Message, now: Now) -> PerceivedFrame | None:
        action: AgentAction = message.payload
        perceived = self._perceived
        if perceived is None or action.stamp_ns != perceived.stamp_ns:
            self._counts["actions_late"] += 1  # a newer picture has been shown
            return None
        self._agent.wanted_steering_rad, self._agent.wanted_speed_mps = action.steering_rad, action.speed_mps
        return self._decide(perceived, now)

    def _command_as_chosen(self, _perceived: PerceivedFrame, now: Now) -> list[Send]:
        return self._command(now)
