"""From a condition to the flows that netem holds, by the role of the machine."""

from __future__ import annotations

from typing import Final, Literal

from lavt.config import Condition, Impairment
from lavt.transport.netem import Flow, Law

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
    asked: Condition,
    role: Role,
    *,
    video_port: int,
    control_port: int,
    protocol: Protocol = "udp",
    state_delay: StateDelay = "none",
) -> list[Flow]:
    """Give the flows that a machine of this role has to hold under a condition.

    `control_port` is that of the server's router, to which the client's dials by `protocol`. A flow that nothing is to
    happen to is among them, so that another condition can follow without a packet being lost.
    """
    flows = [
        Flow("video", "udp", video_port, "source", law(asked.video_ms, asked.video)),
        Flow("control", protocol, control_port, "destination", law(asked.control_ms, asked.control)),
    ]
    if state_delay == "with_video":
        flows.append(Flow("state", protocol, control_port, "source", Law(delay_ms=asked.video_ms)))
    return [flow for flow in flows if flow.name in SENT_BY[role]]


def law(delay_ms: float, impairment: Impairment) -> Law:
    """Give the law of one flow."""
    return Law(delay_ms=delay_ms, **impairment.model_dump())
