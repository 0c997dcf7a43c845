"""Sessions and routers of Zenoh, from config files."""

from __future__ import annotations

import itertools
import json
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import zenoh

from lavt.errors import UserError
from lavt.transport.router_check import (
    MAX_REPORTS,
    REPORT_TIMEOUT_S,
    RouterCheck,
    end_process_later,
    parse_locators,
)
from lavt.transport.zenoh_config import check_endpoints, check_tls_files, error_text


class RouterUnreachable(UserError):
    """No router answers, or it rejects the session."""


def quiet_logs() -> None:
    """Restrict Zenoh's log, which goes to standard output, to errors, unless RUST_LOG is set."""
    zenoh.init_log_from_env_or("error")


def load_zenoh_config(path: Path, overrides: Mapping[str, Any]) -> zenoh.Config:
    """Read a config file and set `overrides` (keys with slashes) in it."""
    if not path.is_file():
        raise UserError(f"there is no Zenoh config {path}: the shipped ones are in zenoh-configs/")
    try:
        config = zenoh.Config.from_file(str(path))
    except zenoh.ZError as error:
        raise UserError(f"{path} is not a Zenoh config: {error_text(error)}") from error
    for key, value in overrides.items():
        try:
            config.insert_json5(key, json.dumps(value))
        except (zenoh.ZError, TypeError, ValueError) as error:
            raise UserError(
                f"{key.replace('/', '.')} cannot be {value!r} in a Zenoh config: {error_text(error)}"
            ) from error
    return config


def _check_listen_endpoints(config: zenoh.Config, path: Path, *, may_be_empty: bool) -> None:
    """Raise `UserError` if a router's config has no listen endpoints, or an empty list where that is not useful."""
    endpoints = config.get_json("listen/endpoints")
    is_default = endpoints == zenoh.Config().get_json("listen/endpoints")
    configured = json.loads(endpoints)
    configured = configured.get("router") if isinstance(configured, dict) else configured
    if is_default or configured is None or not (configured or may_be_empty):
        raise UserError(f"{path} has no listen endpoints, so Zenoh would listen on all interfaces: add one")


def open_zenoh(config: zenoh.Config) -> zenoh.Session:
    """Open a session; raise `zenoh.ZError` if it cannot be opened, and `UserError` if Zenoh panics at this config."""
    try:
        return zenoh.open(config)
    except Exception:
        raise
    except BaseException as error:
        if type(error).__name__ != "PanicException":  # its class cannot be imported, and is not an `Exception`
            raise
        raise UserError(f"Zenoh failed to open a session, so check its config: {error_text(error)}") from error


def open_router(path: Path, changes: Mapping[str, Any], *, must_listen: bool) -> zenoh.Session:
    """Open a session that is a router; raise `UserError` if the config is wrong or an endpoint cannot be used."""
    config = load_zenoh_config(path, changes)
    if json.loads(config.get_json("mode")) != "router":
        raise UserError(f'{path} is not the config of a router: set mode: "router"')
    _check_listen_endpoints(config, path, may_be_empty=not must_listen)
    if not json.loads(config.get_json("adminspace/enabled")):
        raise UserError(f"set adminspace: {{ enabled: true }} in {path}, or the router cannot report where it listens")
    check_endpoints(config, "connect.endpoints")
    check_tls_files(config)
    try:
        return open_zenoh(config)
    except zenoh.ZError as error:
        raise UserError(f"the router of {path} does not start: {error_text(error)}; use other endpoints") from error


def router_reports(session: zenoh.Session, selector: str = "") -> list[bytes]:
    """Query the reports of routers, by default that of the router in this process, and return the first answers."""
    selector = selector or f"@/{session.info.zid()}/router"
    replies: Any = session.get(selector, timeout=REPORT_TIMEOUT_S, consolidation=zenoh.ConsolidationMode.NONE)
    return [reply.ok.payload.to_bytes() for reply in itertools.islice(replies, MAX_REPORTS) if reply.ok is not None]


def configured_endpoints(path: Path, key: str, changes: Mapping[str, Any]) -> list[str]:
    """Return the endpoints at `key`, `listen/endpoints` or `connect/endpoints`, of a config file with `changes`."""
    endpoints = json.loads(load_zenoh_config(path, changes).get_json(key))
    if isinstance(endpoints, dict):
        endpoints = endpoints.get("router")
    return endpoints if isinstance(endpoints, list) else []


class Router:
    """A Zenoh router in this process, from a config file with `mode: "router"`."""

    def __init__(self, path: Path, overrides: Mapping[str, Any]) -> None:
        self._session = open_router(path, overrides, must_listen=True)
        self._check = RouterCheck(partial(router_reports, self._session))

    def check(self) -> None:
        """Raise `WorkError` if the router no longer answers."""
        self._check.run()

    def locators(self) -> list[str]:
        """Return the endpoints at which the router listens, with the actual port where the config has 0."""
        return parse_locators(router_reports(self._session))

    def close(self) -> None:
        """Stop routing."""
        if self._check.has_failed:
            end_process_later()
        close_session(self._session)


def close_session(session: zenoh.Session) -> None:
    """Close a session; if a peer keeps its router so busy that it does not close in time, let the process end."""
    try:
        session.close()
    except zenoh.ZError:
        end_process_later()
