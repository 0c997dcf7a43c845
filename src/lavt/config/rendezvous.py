"""How a vehicle behind a NAT is reached: through a rendezvous, a machine that both ends reach (`lavt rendezvous`)."""

from __future__ import annotations

from pydantic import Field

from lavt.config.section import Section
from lavt.transport.clock_sync import probe


class ServerRendezvousConfig(Section):
    """The rendezvous as the vehicle knows it; clients that reach the vehicle directly go on doing so."""

    host: str = ""
    """Empty: there is none."""
    video_port: int = Field(5600, ge=1, le=65535)
    probe_port: int = Field(probe.DEFAULT_PORT, ge=1, le=65535)


class RendezvousConfig(Section):
    """The rendezvous itself: two UDP ports, for one vehicle."""

    vehicle_id: str = "vehicle-1"
    vehicle_key: str = ""
    """File of the vehicle's key (NAME.sign.pub of `lavt keys`); empty: whoever knows its name can stand in for it."""
    bind: str = "0.0.0.0"  # noqa: S104 (it is for whoever wants to reach the vehicle)
    """On a machine with several addresses the one that is dialled: a NAT lets in only what comes from there."""
    video_port: int = Field(5600, ge=0, le=65535)
    probe_port: int = Field(probe.DEFAULT_PORT, ge=0, le=65535)
