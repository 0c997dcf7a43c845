"""Parsing of the network addresses in configs."""

from __future__ import annotations

from lavt.errors import UserError
from lavt.transport.udp_link import resolve_host


def parse_address(key: str, text: str) -> tuple[str, int]:
    """Parse `host:port`; raise `UserError` that names `key` for invalid text."""
    host, colon, port = text.rpartition(":")
    if not colon or not host or not (port.isascii() and port.isdigit()) or len(port) > 5 or int(port) > 65535:
        raise UserError(f"{key}: {text!r} is not an address: write it as host:port")
    return host, int(port)


def resolved_address(key: str, text: str) -> tuple[str, int]:
    """Parse `host:port` and resolve the host; raise `UserError` that names `key` on failure."""
    host, port = parse_address(key, text)
    return resolve_host(key, host), port
