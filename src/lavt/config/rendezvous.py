"""The schema of a rendezvous (`lavt rendezvous`), through which clients reach a vehicle behind NAT."""

from __future__ import annotations

from pydantic import Field

from lavt.config.section import Section
from lavt.transport.clock_sync import probe


class ServerRendezvousConfig(Section):
    """The rendezvous in the server's config; clients can still reach the vehicle directly."""

    host: str = ""
    """The host of the rendezvous; empty: no rendezvous."""
    video_port: int = Field(5600, ge=1, le=65535)
    """The rendezvous's UDP port for video."""
    probe_port: int = Field(probe.DEFAULT_PORT, ge=1, le=65535)
    """The rendezvous's UDP port for the clock probe."""


class RendezvousConfig(Section):
    """The rendezvous itself: two UDP ports for one vehicle."""

    vehicle_id: str = "vehicle-1"
    """The vehicle's name."""
    vehicle_key: str = ""
    """The file of the vehicle's key (NAME.sign.pub of `lavt keys`); empty: anyone can register as the vehicle."""
    bind: str = "0.0.0.0"  # noqa: S104 (clients connect from anywhere)
    """The address on which to receive. On a machine with several addresses, set the public one, because a NAT admits
    only replies from the address to which the vehicle sent."""
    video_port: int = Field(5600, ge=0, le=65535)
    """The rendezvous's UDP port for video."""
    probe_port: int = Field(probe.DEFAULT_PORT, ge=0, le=65535)
    """The rendezvous's UDP port for the clock probe."""
