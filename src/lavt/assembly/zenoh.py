"""The settings of the Zenoh sessions of a side and of other programs, from a side's config or a vehicle's address."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

from lavt.assembly.addresses import parse_host
from lavt.assembly.entropy import MachineEntropy
from lavt.config import ClientConfig, ServerConfig, ZenohConfig
from lavt.config_file import build_config, find_file, load_config
from lavt.errors import UserError
from lavt.transport.zenoh_config import SessionSettings, flatten, used_certificates, with_host
from lavt.transport.zenoh_session import configured_endpoints, load_zenoh_config

CONFIG_SUFFIXES: Final = (".yaml", ".yml")
SESSION_FILE = "zenoh-configs/session.json5"
LOCAL_ENDPOINTS = ("unixsock-stream/", "tcp/127.", "tcp/localhost:", "tcp/[::1]:")
"""Beginnings of endpoints at which a router listens for programs on its own machine."""
NO_LOCAL_ENDPOINT = (
    "the server's router has no endpoint for programs on its machine: add one to listen.endpoints, in {} or in "
    "zenoh.router_settings, such as tcp/127.0.0.1:7447"
)
AS_A_SESSION = {"mode": "client", "listen/endpoints": [], "connect/timeout_ms": 0, "connect/exit_on_failure": True}
"""Changes of a router's config for a session that makes one attempt to reach the router that this router dials."""
SCOUTED = {"scouting/multicast/enabled": True, "scouting/multicast/autoconnect": []}
"""Changes of a router's config so that it answers scouting, but connects to nobody that it finds."""

Config = ServerConfig | ClientConfig


def load_client_config(target: str, changes: Iterable[str]) -> ClientConfig:
    """Return a client's config: that in the file `target`, or the defaults for a vehicle at the host `target`.

    A host can have the port of the vehicle's router, as HOST:PORT. Raises `UserError` if `target` is neither.
    """
    path = Path(target)
    if target.endswith(CONFIG_SUFFIXES) or _is_file(path):
        return load_config(ClientConfig, path, changes)
    host, port = parse_host(target)
    values: dict[str, Any] = {"video": {"server": host}}
    if port is not None:
        dialled = configured_endpoints(_router_file(ClientConfig()), "connect/endpoints", {})
        endpoints = [with_host(endpoint, host, port) for endpoint in dialled]
        values["zenoh"] = {"router_settings": {"connect": {"endpoints": endpoints}}}
    return build_config(ClientConfig, values, changes, target)


def _is_file(path: Path) -> bool:
    with suppress(OSError, ValueError):  # a name that is too long, or has a zero byte
        return path.is_file()
    return False


def side_session(config: Config) -> SessionSettings:
    """Return the settings of the side's own session: a router, or a session with a separate one."""
    if not config.zenoh.is_embedded:
        return _separate(config)
    return SessionSettings(_router_file(config), _router_changes(config), is_router=True)


def check_certificates(settings: SessionSettings, now_wall_ns: int) -> None:
    """Raise `UserError` for a certificate of a session that has expired: peers would reject it without a message.

    Nothing is checked without the package `cryptography`, which is an extra.
    """
    try:
        from lavt.transport.security.certificates import check_expiry  # noqa: PLC0415 (an extra)
    except ImportError:
        return
    for path in used_certificates(load_zenoh_config(settings.path, settings.changes)):
        check_expiry(path, now_wall_ns)


def program_sessions(config: Config) -> list[SessionSettings]:
    """Return the settings with which another program on the side's machine, such as `lavt stop`, can open its session.

    The first one is for the router on this machine: the separate one, or the embedded one of the running side. A client
    also has a last one for the vehicle's router, which is independent of the running client.
    """
    if not config.zenoh.is_embedded:
        return [_separate(config)]
    path, changes = _router_file(config), _router_changes(config)
    advice = f"start `lavt {'server' if isinstance(config, ServerConfig) else 'client'}`"
    sessions = [
        SessionSettings(find_file(Path(SESSION_FILE)), {"connect/endpoints": [endpoint]}, advice=advice)
        for endpoint in _local_endpoints(config)
    ]
    if isinstance(config, ClientConfig):
        advice = "is `lavt server` running there, and is video.server the vehicle's address?"
        own_id = {"id": f"{MachineEntropy().number(64):x}"}  # the router of a running client has the id of the file
        sessions.append(SessionSettings(path, changes | AS_A_SESSION | own_id, advice=advice))
    if not sessions:
        raise UserError(NO_LOCAL_ENDPOINT.format(path))
    return sessions


def search_sessions(config: ClientConfig | None, routers: Sequence[str] = ()) -> list[SessionSettings]:
    """Return the settings of sessions that search for vehicles: at the endpoint `routers`, if they are named.

    Otherwise they are at the router that a client with this config would dial, or, without a config, at the routers of
    sides on this machine.
    """
    if config is None:
        local = [list(routers)] if routers else [_local_endpoints(ClientConfig()), _local_endpoints(ServerConfig())]
        advice = "is `lavt server` or a router running there?"
        path = find_file(Path(SESSION_FILE))
        return [SessionSettings(path, {"connect/endpoints": endpoints}, advice=advice) for endpoints in local]
    session = program_sessions(config)[-1]
    if routers:
        session = replace(session, changes={**session.changes, "connect/endpoints": list(routers)})
    return [session]


def _local_endpoints(config: Config) -> list[str]:
    """Return the first endpoint of the embedded router for programs on its machine, in a list; empty if none."""
    endpoints = configured_endpoints(_router_file(config), "listen/endpoints", _router_changes(config))
    return [endpoint for endpoint in endpoints if endpoint.startswith(LOCAL_ENDPOINTS)][:1]


def local_session(config: ServerConfig, locators: Sequence[str]) -> ZenohConfig:
    """Return the config of another process that uses the router of this server, which listens at `locators`."""
    if not config.zenoh.is_embedded:
        return config.zenoh
    local = [locator for locator in locators if locator.startswith(LOCAL_ENDPOINTS)]
    if not local:
        raise UserError(NO_LOCAL_ENDPOINT.format(_router_file(config)))
    return ZenohConfig(router=local[0])


def vehicle_endpoint(config: ClientConfig) -> str:
    """Return the endpoint of the vehicle's router, which the client's embedded router dials."""
    endpoints = configured_endpoints(_router_file(config), "connect/endpoints", _router_changes(config))
    if not config.zenoh.is_embedded or not endpoints:
        raise UserError("zenoh.router must be embedded, with one connect.endpoints: the vehicle's router")
    return endpoints[0]


def dialling(config: ClientConfig, endpoint: str) -> ZenohConfig:
    """Return the config of the client's embedded router that dials another endpoint, and does not listen."""
    settings = flatten(config.zenoh.router_settings) | {"connect/endpoints": [endpoint], "listen/endpoints": []}
    nested: dict[str, Any] = {}
    for key, value in settings.items():
        *sections, name = key.split("/")
        section = nested
        for part in sections:
            section = section.setdefault(part, {})
        section[name] = value
    return config.zenoh.model_copy(update={"router_settings": nested})


def _separate(config: Config) -> SessionSettings:
    zenoh = config.zenoh
    changes = {"connect/endpoints": [zenoh.router]} if zenoh.router else {}
    return SessionSettings(find_file(Path(zenoh.session or SESSION_FILE)), changes)


def _router_file(config: Config) -> Path:
    """Return the config of the embedded router: the file in the config, or the shipped one of this kind of side."""
    side = "server" if isinstance(config, ServerConfig) else "client"
    shipped_file = f"zenoh-configs/router-{side}{'-tls' if config.security.key else ''}.json5"
    return find_file(Path(config.zenoh.router_file or shipped_file))


def _router_changes(config: Config) -> dict[str, Any]:
    """Return the changes of the embedded router's config; with a shipped file, a client dials the vehicle's address."""
    changes = (SCOUTED if config.zenoh.scouting else {}) | flatten(config.zenoh.router_settings)
    if isinstance(config, ClientConfig) and not config.zenoh.router_file and "connect/endpoints" not in changes:
        dialled = configured_endpoints(_router_file(config), "connect/endpoints", {})
        changes["connect/endpoints"] = [with_host(endpoint, config.video.server) for endpoint in dialled]
    return changes
