"""CAN buses that exist in software only."""

from __future__ import annotations

import json
import socket
import subprocess
from collections.abc import Mapping
from typing import Any, Final

from lavt.vehicle.dbw.can_gateway import gateway_interfaces

VIRTUAL_INTERFACES: Final = frozenset({"inside", "virtual", "udp_multicast"})
"""Interfaces that exist in software only."""
SELF_RECEIVING_INTERFACE: Final = "udp_multicast"
"""The interface whose socket receives the frames that it sends, because it is a member of its multicast group. Sent
frames are marked, so that they can be recognised and dropped when they are received."""
IP_TIMEOUT_S: Final = 2
"""Time limit of the program `ip`."""


def is_virtual(interface: str, channel: str, options: Mapping[str, Any]) -> bool:
    """Return whether a bus exists in software only, so that no real kit can be on it; False if this is not known.

    A vcan in a gateway rule of the kernel is not virtual. A multicast that leaves this machine is not virtual, either.
    """
    if interface == SELF_RECEIVING_INTERFACE:
        return bool(options.get("hop_limit", 0) == 0)
    if interface in VIRTUAL_INTERFACES:
        return True
    return interface == "socketcan" and _link_kind(channel) == "vcan" and not _is_forwarded(channel)


def _is_forwarded(channel: str) -> bool:
    """Return whether a gateway rule names an interface; True if the rules cannot be read."""
    try:
        return socket.if_nametoindex(channel) in gateway_interfaces()
    except OSError:
        return True


def _link_kind(channel: str) -> str:
    """Return the kernel's name for the kind of a network interface; empty if the kind is not known."""
    try:
        output = subprocess.run(  # noqa: S603 (the arguments go through no shell)
            ["ip", "-details", "-json", "link", "show", "dev", channel],  # noqa: S607 (wherever the system has it)
            capture_output=True,
            check=True,
            timeout=IP_TIMEOUT_S,
        ).stdout
        (link,) = json.loads(output)
        return str(link["linkinfo"]["info_kind"])
    except (OSError, subprocess.SubprocessError, ValueError, LookupError, TypeError):
        return ""
