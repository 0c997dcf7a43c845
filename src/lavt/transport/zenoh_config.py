"""Checks of a Zenoh config, and texts of Zenoh's errors; a config is an object of type `zenoh.Config`."""

from __future__ import annotations

import json
import re
import ssl
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from lavt.errors import UserError

PRIVATE_KEYS = ("transport/link/tls/listen_private_key", "transport/link/tls/connect_private_key")
"""Config keys of private key files; Zenoh does not check their permissions."""
TLS = "transport/link/tls/"
"""The beginning of the config keys of certificates and private keys."""
TLS_PROTOCOLS = ("tls", "quic")
PROTOCOLS = ("tcp", "tls", "quic", "udp", "ws")
"""Protocols of endpoints with a host and a port. They are checked here, because Zenoh reports an unknown protocol as
unreachable."""
PATH_PROTOCOLS = ("unixsock-stream", "unixpipe", "vsock", "serial")


@dataclass(frozen=True)
class SessionSettings:
    """What a link needs to open its session."""

    path: Path
    """The config file."""
    changes: Mapping[str, Any] = field(default_factory=dict)
    """Values that replace those of the file, by keys with slashes."""
    is_router: bool = False
    """Whether the session is a router itself. Otherwise it is a session with a router."""
    advice: str = "start one with `lavt router FILE.json5`, or use another endpoint"
    """What to do if no router answers."""


def check_private_keys(config: Any) -> None:
    """Raise `UserError` if other users have any permission on a private key of a config."""
    for key in PRIVATE_KEYS:
        file = json.loads(config.get_json(key))
        if file is not None and Path(file).is_file() and Path(file).stat().st_mode & 0o077:
            raise UserError(
                f"other users may read the private key {file}: chmod 600 it, and make new keys if somebody has read it"
            )


def check_tls_files(config: Any) -> None:
    """Raise `UserError` if a certificate or a private key that the config's endpoints need cannot be used.

    Zenoh does not name the file, and a router that only dials would try again for ever, without a message.
    """
    check_private_keys(config)
    used = [kind for kind in ("listen", "connect") if _uses_tls(config, kind)]
    if not used:
        return
    authority = _tls_file(config, "root_ca_certificate")
    if authority is not None:
        _try_ssl(f"{authority} is not a file of certificates", lambda context: context.load_verify_locations(authority))
    for kind in used:
        pair = _tls_file(config, f"{kind}_certificate"), _tls_file(config, f"{kind}_private_key")
        if None not in pair:
            _try_ssl(f"{pair[0]} and {pair[1]} are not a certificate and its private key", _load(*pair))


def used_certificates(config: Any) -> list[Path]:
    """Return the files of the certificates that the config's endpoints need."""
    files = [_tls_file(config, f"{kind}_certificate") for kind in ("listen", "connect") if _uses_tls(config, kind)]
    return [Path(file) for file in files if file is not None]


def _uses_tls(config: Any, kind: str) -> bool:
    """Return whether an endpoint at which the config listens, or that it connects to, needs certificates."""
    endpoints = config.get_json(f"{kind}/endpoints")
    return any(f'"{protocol}/' in endpoints for protocol in TLS_PROTOCOLS)


def _tls_file(config: Any, name: str) -> str | None:
    """Return the path of a file of the config, None if it names none; raise `UserError` if it cannot be read."""
    file: str | None = json.loads(config.get_json(TLS + name))
    try:
        if file is not None:
            Path(file).read_bytes()
    except OSError as error:
        raise UserError(
            f"{file} cannot be read ({error.strerror}): copy it here from the machine with the authority, or correct "
            f"transport.link.tls.{name} (docs/security.md)"
        ) from error
    return file


def _load(certificate: Any, key: Any) -> Callable[[ssl.SSLContext], None]:
    """Return a function that loads a certificate and its key; an encrypted key is an error, not a prompt."""
    return lambda context: context.load_cert_chain(certificate, key, password=bytes)


def _try_ssl(what: str, load: Callable[[ssl.SSLContext], None]) -> None:
    try:
        load(ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT))
    except (ssl.SSLError, ValueError) as error:
        raise UserError(f"{what}: copy what `lavt keys` has made again (docs/security.md)") from error


def error_text(error: BaseException) -> str:
    """Return an error text of Zenoh in one line, without Zenoh's source locations and type names."""
    text = " ".join(re.sub(r" at /\S+\.rs:\d+\.?", "", str(error)).split())
    text = re.sub(
        r"(?:Json5Err\()?Message \{ msg: \"(.*)\", location: .*? line: (\d+), column: (\d+) .*", r"\1 (line \2)", text
    )
    return re.sub(r"^Str\(\"(.*)\"\)$", r"\1", text)


def check_endpoints(config: Any, key: str) -> Any:
    """Return the endpoints that a session connects to; raise `UserError` that names `key` for an invalid one."""
    endpoints = json.loads(config.get_json("connect/endpoints"))
    for endpoint in endpoints if isinstance(endpoints, list) else []:
        protocol, _, address = endpoint.partition("/")
        port = re.split(r"[?#]", address)[0].rpartition(":")[2]
        if protocol in PATH_PROTOCOLS or (protocol in PROTOCOLS and port.isdecimal() and 0 < int(port) < 65_536):
            continue
        raise UserError(f"{key} cannot be {endpoint!r}: write PROTOCOL/HOST:PORT with one of {', '.join(PROTOCOLS)}")
    return endpoints


def with_host(endpoint: str, host: str, port: int | None = None) -> str:
    """Return an endpoint PROTOCOL/HOST:PORT with another host (and port); an endpoint that is a path is unchanged."""
    protocol, _, address = endpoint.partition("/")
    if protocol in PATH_PROTOCOLS:
        return endpoint
    parameters = address[len(re.split(r"[?#]", address)[0]) :]
    own_port = address.removesuffix(parameters).rpartition(":")[2]
    return f"{protocol}/{f'[{host}]' if ':' in host else host}:{port or own_port}{parameters}"


def with_address(endpoint: str, address: str) -> str:
    """Return an endpoint PROTOCOL/HOST:PORT with another HOST:PORT."""
    protocol, _, former = endpoint.partition("/")
    return f"{protocol}/{address}{former[len(re.split(r'[?#]', former)[0]) :]}"


def flatten(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return nested settings by Zenoh's keys, such as `connect/endpoints`."""
    flat: dict[str, Any] = {}
    for key, value in settings.items():
        if isinstance(value, Mapping) and value:
            flat |= {f"{key}/{inner_key}": inner for inner_key, inner in flatten(value).items()}
        else:
            flat[key] = value
    return flat
