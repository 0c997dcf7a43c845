"""Addresses as configs write them."""

from __future__ import annotations

from lavt.errors import UserError
from lavt.transport.udp_link import resolve_host


def parse_address(key: str, text: str) -> tuple[str, int]:
    """Read `host:port`; raises `UserError` naming `key`."""
    host, colon, port = text.rpartition(":")
    if not colon or not host or not (port.isascii() and port.isdigit()) or len(port) > 5 or int(port) > 65535:
        raise UserError(f"{key}: {text!r} is not an address: write it as host:port")
    return host, int(port)


def resolved_address(key: str, text: str) -> tuple[str, int]:
    """Read `host:port` and look the host up; raises `UserError` naming `key`."""
    host, port = parse_address(key, text)
    return resolve_host(key, host), port
