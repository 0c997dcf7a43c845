"""The conversion of a condition to the flows that netem impairs, and the construction of the injection nodes."""

from __future__ import annotations

from typing import Final, Literal

from lavt.config import ClientInjectionConfig, Condition, ImpairmentConfig, ServerInjectionConfig
from lavt.config_file import condition
from lavt.domain import NetemRequest
from lavt.errors import BadMessage, UserError
from lavt.nodes.injection import InjectionClient, InjectionNode
from lavt.transport.emulation.impairment import QUEUE_PACKETS, ImpairedFlow, Impairment
from lavt.transport.messages import decode

NO_CONDITION: Final = Condition(video_ms=0, control_ms=0)
Role = Literal["server", "client", "both"]
Protocol = Literal["udp", "tcp"]
StateDelay = Literal["none", "with_video"]
FLOWS_SENT_BY: Final[dict[Role, tuple[str, ...]]] = {
    "server": ("video", "state"),
    "client": ("control",),
    "both": ("video", "control", "state"),
}
"""The flows that a machine of each role sends; with role both, server and client share one machine."""


def netem_flows(
    requested: Condition,
    role: Role,
    *,
    video_port: int,
    control_port: int,
    protocol: Protocol = "udp",
    state_delay: StateDelay = "none",
) -> list[ImpairedFlow]:
    """Return the flows that a machine of this role sends, with their impairments under a condition.

    `control_port` is the port of the server's router, to which the client's router connects with `protocol`. The result
    includes flows without an impairment, so that another condition can be applied later without packet loss.
    """
    flows = [
        ImpairedFlow("video", "udp", video_port, "source", build_netem_impairment(requested.video_ms, requested.video)),
        ImpairedFlow(
            "control",
            protocol,
            control_port,
            "destination",
            build_netem_impairment(requested.control_ms, requested.control),
        ),
    ]
    if state_delay == "with_video":
        flows.append(ImpairedFlow("state", protocol, control_port, "source", Impairment(delay_ms=requested.video_ms)))
    return [flow for flow in flows if flow.name in FLOWS_SENT_BY[role]]


def build_netem_impairment(delay_ms: float, impairment: ImpairmentConfig) -> Impairment:
    """Return the netem impairment of one flow; raise `UserError` for an impairment that netem does not support."""
    if impairment.trace:
        raise UserError(
            f"netem cannot replay the trace {impairment.trace!r}: choose network.injection relay or time virtual, or a "
            "condition without a trace"
        )
    if impairment.queue_packets != QUEUE_PACKETS:
        raise UserError(
            f"netem's queue has {QUEUE_PACKETS} packets, not queue_packets {impairment.queue_packets}: choose "
            "network.injection relay or time virtual, or leave queue_packets out"
        )
    return build_impairment(delay_ms, impairment)


def build_impairment(delay_ms: float, impairment: ImpairmentConfig) -> Impairment:
    """Return the impairment of one flow; its trace and the length of its queue are not part of it."""
    names = set(Impairment.__struct_fields__)
    return Impairment(delay_ms=delay_ms, **impairment.model_dump(include=names - {"delay_ms"}))


def injection_node(config: ServerInjectionConfig, *, simulated: bool, video_port: int) -> InjectionNode:
    """Build the server's injection node."""
    return InjectionNode(
        allowed=config.remote,
        simulated=simulated,
        video_port=video_port,
        control=(config.control_protocol, config.control_port),
    )


def injection_client(config: ClientInjectionConfig, who: str, instance: int, start_ns: int) -> InjectionClient:
    """Build the client's injection node; raise `UserError` for a condition that is unknown or cannot be requested."""
    requested = condition(config.condition) if config.condition else NO_CONDITION
    # A client sends only control, so the port of the video is not used.
    [control] = netem_flows(
        requested, "client", video_port=0, control_port=config.control_port, protocol=config.control_protocol
    )
    if not (config.interface or control.impairment.is_transparent):
        raise UserError(
            f"condition {config.condition} delays control, which this machine sends: set injection.interface to the "
            "interface towards the vehicle"
        )
    client = InjectionClient(
        who,
        instance,
        condition=config.condition,
        control=control,
        video=build_netem_impairment(requested.video_ms, requested.video),
        state_delay_ms=requested.video_ms if config.state_delay == "with_video" else 0.0,
        start_ns=start_ns,
    )
    try:
        decode(NetemRequest, client.request)
    except BadMessage as error:
        raise UserError(f"condition {config.condition} cannot be requested from a server: {error}") from error
    return client
