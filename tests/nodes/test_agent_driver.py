"""The driver node of an agent."""

from __future__ import annotations

import pytest
from tests.nodes.stand_ins import MONO_NS, WALL_NS, at, deliver, noise, payloads
from tests.nodes.test_driver_node import GRANTED, FakeLaneDetector, commands

from lavt.control.agent import AgentController
from lavt.control.client_limits import CLIENT_LIMITS
from lavt.control.preset import DESIGNED
from lavt.domain import NS_PER_MS, Command, State
from lavt.node import WAKE
from lavt.nodes.agent_driver import AgentDriverNode, AgentView
from lavt.nodes.client_session import ClientSession
from lavt.nodes.payloads import AgentAction, DecodedFrame
from lavt.nodes.picture_reader import PictureReader
from lavt.transport.messages import encode
from lavt.transport.video.frame_codec import InMemoryFrameCodec, RenderedPicture

VIDEO_NS, CONTROL_NS = 40 * NS_PER_MS, 30 * NS_PER_MS


def new_node() -> AgentDriverNode:
    return AgentDriverNode(
        PictureReader(InMemoryFrameCodec()),
        FakeLaneDetector(),
        AgentController(DESIGNED, wheelbase_m=2.8448),
        ClientSession("alice", 1, rearm=False, start_ns=MONO_NS),
        CLIENT_LIMITS,
    )


def deliver_state(node: AgentDriverNode, at_ms: int, applied_sequence: int) -> None:
    now = at(at_ms * NS_PER_MS)
    state = State(now.wall_ns, now.mono_ns, 4.0, 0.05, "drive", "driving", "", applied_sequence, "")
    deliver(node, "state", encode(state), now)


def driving_node() -> AgentDriverNode:
    """Return a node that has control of a driving vehicle."""
    node = new_node()
    deliver(node, "session_reply", encode(GRANTED), at(0))
    deliver_state(node, 0, -1)
    return node


def show(node: AgentDriverNode, at_ms: int) -> AgentView:
    """Deliver a picture that was stamped `VIDEO_NS` ago; the node must send no command."""
    now = at(at_ms * NS_PER_MS)
    frame = DecodedFrame(now.wall_ns - VIDEO_NS, now.wall_ns, RenderedPicture(noise(1)))
    sends = deliver(node, "view", frame, now)
    assert [send.channel for send in sends] == ["lane"]
    assert node.view is not None
    return node.view


def act(node: AgentDriverNode, at_ms: int, stamp_ns: int, steering_rad: float = 0.1) -> list[Command]:
    return commands(deliver(node, "agent_action", AgentAction(stamp_ns, steering_rad, 5.0), at(at_ms * NS_PER_MS)))


def test_a_picture_is_shown_and_the_action_is_commanded() -> None:
    """After a picture the agent can observe it, and its action becomes a command with the stamp of this picture."""
    node = driving_node()
    view = show(node, 50)
    assert (view.stamp_ns, view.speed_mps, view.steering_rad) == (WALL_NS + 50 * NS_PER_MS - VIDEO_NS, 4.0, 0.05)
    assert view.picture.shape == noise(1).shape
    [command] = act(node, 50, view.stamp_ns)
    assert (command.mode, command.steering_rad, command.stamp_ns) == ("drive", 0.1, view.stamp_ns)
    assert command.throttle > 0


def test_the_last_action_is_repeated_until_the_next_picture() -> None:
    """The command is repeated every 20 ms, and no more from the next picture on until the agent acts."""
    node = driving_node()
    act(node, 50, show(node, 50).stamp_ns)
    assert node.next_wake_ns() == at(70 * NS_PER_MS).mono_ns
    [repeated] = commands(deliver(node, WAKE, None, at(70 * NS_PER_MS)))
    assert repeated.steering_rad == 0.1
    show(node, 83)
    assert commands(deliver(node, WAKE, None, at(500 * NS_PER_MS))) == []


def test_an_action_for_an_earlier_picture_is_dropped() -> None:
    """An action from an earlier picture than the newest one is counted and not commanded."""
    node = driving_node()
    earlier = show(node, 50)
    newer = show(node, 83)
    assert act(node, 84, earlier.stamp_ns) == []
    assert node.counts["actions_late"] == 1
    assert len(act(node, 85, newer.stamp_ns)) == 1


def test_an_action_before_the_first_picture_is_dropped() -> None:
    """Without a picture, an action is counted and not commanded."""
    node = driving_node()
    assert act(node, 10, 1) == []
    assert node.counts["actions_late"] == 1


def test_the_view_contains_the_loop_delay_as_the_client_measures_it() -> None:
    """The loop delay is the time from a stamp until a command takes effect, from the reported sequence numbers."""
    node = driving_node()
    first = show(node, 50)
    assert first.loop_delay_s is None
    [command] = act(node, 50, first.stamp_ns)
    deliver_state(node, 70, -1)
    deliver_state(node, 90, command.sequence)
    # The command was applied 20 to 40 ms after it was sent, and the picture is 40 ms old.
    assert show(node, 95).loop_delay_s == pytest.approx((VIDEO_NS + CONTROL_NS) / 1e9)
    assert show(node, 5_000).loop_delay_s == pytest.approx((VIDEO_NS + CONTROL_NS) / 1e9), "the last known one"


def test_without_control_nothing_is_commanded() -> None:
    """A node without control shows pictures and commands nothing."""
    node = new_node()
    view = show(node, 50)
    assert payloads(deliver(node, "agent_action", AgentAction(view.stamp_ns, 0.1, 5.0), at(50)), "control") == []
