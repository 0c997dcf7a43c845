"""Zenoh sessions of vehicles, clients and a watcher, which dial one router in the cloud; and their messages."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final, Literal

import zenoh

from lavt.config_file import shipped
from lavt.domain import State
from lavt.transport.messages import encode
from lavt.transport.zenoh_config import SessionSettings
from lavt.transport.zenoh_link import RECEIVE_RING_LENGTH, REPLY_CHANNELS, STATE

Topology = Literal["routers", "clients"]
"""routers: each vehicle and each client has an embedded router, as is LAVT's default, which dials the cloud's router.
clients: each has a session with the cloud's router, as with `zenoh.router: udp/...`."""
LINK: Final = "udp/127.0.0.1:{port}?rel=1;mixed_rel=1"
OPEN_TIMEOUT_MS: Final = 30_000
SAMPLED: Final = 10
"""The number of light vehicles whose states are received one by one, to measure their latency."""


def settings(topology: Topology, port: int) -> SessionSettings:
    """Return the settings of a session that dials the cloud's router at this port of the loopback."""
    endpoints = [LINK.format(port=port)]
    timeout = {"transport/unicast/open_timeout": OPEN_TIMEOUT_MS}  # many sessions are opened at the same time
    if topology == "clients":
        changes: dict[str, Any] = {"connect/endpoints": endpoints, "connect/timeout_ms": -1, **timeout}
        return SessionSettings(shipped("zenoh-configs/session.json5"), changes)
    changes = {"listen/endpoints": [], "connect/endpoints": endpoints, **timeout}
    return SessionSettings(shipped("zenoh-configs/router-server-to-cloud.json5"), changes, is_router=True)


def open_session(topology: Topology, port: int) -> zenoh.Session:
    """Open a session as `lavt.transport.zenoh_link` does, without its threads."""
    chosen = settings(topology, port)
    config = zenoh.Config.from_file(str(Path(chosen.path)))
    for key, value in chosen.changes.items():
        config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)


def light_name(number: int) -> str:
    """Return the name of a light vehicle."""
    return f"{'sampled' if number < SAMPLED else 'light'}-{number}"


class LightVehicle:
    """A session with everything that a server declares, which publishes states and handles nothing that it receives."""

    def __init__(self, topology: Topology, port: int, number: int) -> None:
        self.is_sampled = number < SAMPLED
        base = f"lavt/{light_name(number)}"
        self._session = open_session(topology, port)
        qos: dict[str, Any] = STATE
        self.publisher = self._session.declare_publisher(f"{base}/state", **qos)
        ring: Any = zenoh.handlers.RingChannel(RECEIVE_RING_LENGTH)
        self._declared: list[Any] = [self._session.declare_subscriber(f"{base}/control", ring)]
        for channel in REPLY_CHANNELS:
            queries: Any = zenoh.handlers.RingChannel(RECEIVE_RING_LENGTH)
            self._declared.append(self._session.declare_queryable(f"{base}/{channel}", queries))
        self._declared.append(self._session.liveliness().declare_token(f"{base}/alive/server"))

    def is_connected(self) -> bool:
        """Return whether the watcher's subscription has reached this vehicle."""
        status: Any = self.publisher.matching_status  # an object, although its type is said to be bool
        return bool(status.matching)


def state(wall_ns: int, applied_sequence: int = 1_000_000) -> bytes:
    """Encode a state like a driving vehicle's, with numbers and texts that are as long on the wire as in a drive."""
    return encode(
        State(
            *(wall_ns, wall_ns - 1, 7.123, 0.0123, "drive", "driving", "armed by operator-1", applied_sequence, "", ""),
            active_operator="operator-1",
            active_operator_instance=2**63 + 7,
            instance=2**63 + 9,
        )
    )


def matching_count(vehicles: Sequence[LightVehicle]) -> int:
    """Return the number of connected vehicles."""
    return sum(vehicle.is_connected() for vehicle in vehicles)
