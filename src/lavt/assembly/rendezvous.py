"""The construction of a side's sockets, with or without a rendezvous, and of the rendezvous itself."""

from __future__ import annotations

from pathlib import Path

from lavt.clock import Clock
from lavt.config import ClientConfig, RendezvousConfig, ServerConfig
from lavt.errors import UserError
from lavt.transport.messages import NAME
from lavt.transport.rendezvous.forwarder import Address, FlowName, Forwarder, encode_registration
from lavt.transport.rendezvous.link import RendezvousLink, RendezvousPort
from lavt.transport.security.keys import load_private, load_public
from lavt.transport.udp_link import UdpLink, resolve_host


def open_flow(
    config: ServerConfig | ClientConfig,
    clock: Clock,
    flow: FlowName,
    channel: str,
    *,
    bind: Address,
    remote: Address | None,
) -> UdpLink | RendezvousLink:
    """Open a side's socket for a flow. If a server's config names a rendezvous, the socket also works through it.

    Raises `UserError` for a port that cannot be opened, an unknown host, and a key that cannot be read.
    """
    if not isinstance(config, ServerConfig) or not config.rendezvous.host:
        return UdpLink(clock, channel, bind=bind, remote=remote, name=flow)
    rendezvous = config.rendezvous
    key = load_private(Path(config.security.key), clock.now().wall_ns) if config.security.key else None
    host = resolve_host("rendezvous.host", rendezvous.host)
    return RendezvousLink(
        clock,
        channel,
        bind=bind,
        name=flow,
        rendezvous=(host, {"video": rendezvous.video_port, "probe": rendezvous.probe_port}[flow]),
        registration=lambda wall_ns: encode_registration(config.vehicle_id, flow, wall_ns, key),
    )


def open_rendezvous(config: RendezvousConfig, clock: Clock) -> dict[FlowName, RendezvousPort]:
    """Open the ports of both flows; raise `UserError` for a port in use, an invalid name, and an unreadable key."""
    vehicle = config.vehicle_id
    if not NAME.match(vehicle):
        raise UserError(f"the vehicle {vehicle!r} has an invalid name: use up to 32 of A-Z, a-z, 0-9, - and _")
    key = load_public(Path(config.vehicle_key), clock.now().wall_ns) if config.vehicle_key else None
    ports: dict[FlowName, int] = {"video": config.video_port, "probe": config.probe_port}
    opened: dict[FlowName, RendezvousPort] = {}
    try:
        for flow, port in ports.items():
            opened[flow] = RendezvousPort(clock, Forwarder(vehicle, flow, key), bind=(config.bind, port), name=flow)
    except UserError:
        for opened_port in opened.values():
            opened_port.close()
        raise
    return opened
