"""Parsing of network addresses: those in configs, and the host that a user names instead of a client's config."""

from __future__ import annotations

import ipaddress
import re
from typing import Final

from lavt.errors import UserError
from lavt.transport.udp_link import resolve_host

HOST_NAME: Final = re.compile(r"[A-Za-z0-9]([A-Za-z0-9._-]{0,251}[A-Za-z0-9])?\Z")


def parse_host(text: str) -> tuple[str, int | None]:
    """Return the host and the port (None: not named) in HOST, HOST:PORT, an IPv6 address, or [IPv6]:PORT."""
    if _is_ipv6(text):
        return text, None
    host, colon, port = text.rpartition(":")
    if not colon:
        host, port = text, ""
    elif host.startswith("[") and host.endswith("]") and _is_ipv6(host[1:-1]):
        host = host[1:-1]
    elif text.startswith("[") and text.endswith("]") and _is_ipv6(text[1:-1]):
        return text[1:-1], None
    is_port = re.fullmatch("[0-9]{1,5}", port) is not None and 0 < int(port) < 65_536
    if not (_is_ipv6(host) or HOST_NAME.match(host)) or (colon and not is_port):
        raise UserError(
            f"{text!r} is neither a config nor a host: name an existing file, or a host such as 192.0.2.7, "
            "vehicle.example or vehicle.example:7448"
        )
    return host, int(port) if colon else None


def _is_ipv6(text: str) -> bool:
    try:
        return "%" not in text and bool(ipaddress.IPv6Address(text))
    except ValueError:
        return False


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
