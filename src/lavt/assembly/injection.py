"""From a condition to the flows that netem holds, by the role of the machine, and to the nodes that ask for them."""

from __future__ import annotations

from dataclasses import fields
from typing import Final, Literal

from lavt.config import ClientInjectionConfig, Condition, ImpairmentConfig, ServerInjectionConfig
from lavt.config_file import condition
from lavt.domain import NetemRequest
from lavt.errors import BadMessage, UserError
from lavt.nodes.injection import InjectionClient, InjectionNode
from lavt.transport.emulation.impairment import ImpairedFlow, Impairment
from lavt.transport.emulation.link import QUEUE_PACKETS
from lavt.transport.messages import decode

NO_CONDITION: Final = Condition(video_ms=0, control_ms=0)
Role = Literal["server", "client", "both"]
Protocol = Literal["udp", "tcp"]
StateDelay = Literal["none", "with_video"]
SENT_BY: Final[dict[Role, tuple[str, ...]]] = {
    "server": ("video", "state"),
    "client": ("control",),
    "both": ("video", "control", "state"),
}
"""Which flows leave a machine; both roles are on one machine, and its loopback, in a run on one machine."""


def netem_flows(
    requested: Condition,
    role: Role,
    *,
    video_port: int,
    control_port: int,
    protocol: Protocol = "udp",
    state_delay: StateDelay = "none",
) -> list[ImpairedFlow]:
    """Give the flows that a machine of this role has to hold under a condition.

    `control_port` is that of the server's router, to which the client's dials by `protocol`. A flow that nothing is to
    happen to is among them, so that another condition can follow without a packet being lost.
    """
    flows = [
        ImpairedFlow("video", "udp", video_port, "source", law(requested.video_ms, requested.video)),
        ImpairedFlow("control", protocol, control_port, "destination", law(requested.control_ms, requested.control)),
    ]
    if state_delay == "with_video":
        flows.append(ImpairedFlow("state", protocol, control_port, "source", Impairment(delay_ms=requested.video_ms)))
    return [flow for flow in flows if flow.name in SENT_BY[role]]


def law(delay_ms: float, impairment: ImpairmentConfig) -> Impairment:
    """Give the law by which netem does it to one flow; raises `UserError` for what no law of netem's says."""
    if impairment.trace:
        raise UserError(
            f"netem cannot replay the trace {impairment.trace!r}: choose network.injection relay or time virtual, or a "
            "condition without a trace"
        )
    if impairment.queue_packets != QUEUE_PACKETS:
        raise UserError(
            f"netem has room for {QUEUE_PACKETS} packets, not for queue_packets {impairment.queue_packets}: choose "
            "network.injection relay or time virtual, or leave queue_packets out"
        )
    return plain_law(delay_ms, impairment)


def plain_law(delay_ms: float, impairment: ImpairmentConfig) -> Impairment:
    """Give the law of one flow, which says nothing of a trace and of the queue."""
    said = {each.name for each in fields(Impairment)}
    return Impairment(delay_ms=delay_ms, **impairment.model_dump(include=said - {"delay_ms"}))


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
    requested = condition(config.condition) if config.condition else NO_CONDITION
    [control] = netem_flows(
        requested, "client", video_port=0, control_port=config.control_port, protocol=config.control_protocol
    )
    if not (config.interface or control.impairment.is_transparent):
        raise UserError(
            f"condition {config.condition} delays the control, which this machine must do: name the interface towards "
            "the vehicle in injection.interface"
        )
    client = InjectionClient(
        who,
        instance,
        condition=config.condition,
        control=control,
        video=law(requested.video_ms, requested.video),
        state_delay_ms=requested.video_ms if config.state_delay == "with_video" else 0.0,
        start_ns=start_ns,
    )
    try:
        decode(NetemRequest, client.request)
    except BadMessage as error:
        raise UserError(f"condition {config.condition} cannot be asked of a server: {error}") from error
    return client
