"""The nodes that have delay injected, and what a condition means to them."""

from __future__ import annotations

from lavt.config import ClientInjectionConfig, Condition, ServerInjectionConfig
from lavt.config_file import condition
from lavt.nodes.injection import InjectionClient, InjectionNode
from lavt.transport.netem import Flow, Law

NO_CONDITION = Condition(video_ms=0, control_ms=0)


def laws_of(asked: Condition) -> tuple[Law, Law]:
    """Give what a condition does to the video and to the control."""
    return Law(asked.video_ms), Law(asked.control_ms)


def injection_node(config: ServerInjectionConfig, *, simulated: bool, video_port: int) -> InjectionNode:
    """Make the server's node."""
    return InjectionNode(
        allowed=config.remote,
        simulated=simulated,
        video_port=video_port,
        control=(config.control_protocol, config.control_port),
    )


def injection_client(config: ClientInjectionConfig, who: str, instance: int, start_ns: int) -> InjectionClient:
    """Make the client's node; raises `UserError` for a condition that does not exist."""
    video, control = laws_of(condition(config.condition) if config.condition else NO_CONDITION)
    return InjectionClient(
        who,
        instance,
        condition=config.condition,
        control=Flow("control", config.control_protocol, config.control_port, "destination", control),
        video=video,
        state_delay_ms=video.delay_ms if config.state_delay == "with_video" else 0.0,
        start_ns=start_ns,
    )
