"""`lavt vehicles`: list the vehicles that answer, with their state, who has control, and the latency."""

from __future__ import annotations

import secrets
import statistics
from collections import Counter
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Annotated, Any

import typer

import lavt
from lavt.assembly.zenoh import load_client_config, search_sessions
from lavt.cli import console
from lavt.clock import Clock, MachineClock, pause
from lavt.config import ClientConfig
from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.errors import UserError
from lavt.transport.messages import VERSION
from lavt.transport.security.envelope import verify_info
from lavt.transport.security.gateway import INFO_NONCE_BYTES
from lavt.transport.security.keys import load_public
from lavt.transport.vehicle_search import FoundVehicle, FoundVehicles, SearchSession, scout
from lavt.transport.zenoh_config import SessionSettings
from lavt.transport.zenoh_session import quiet_logs

QUERIES = 5
"""The number of queries to each router; the latency is the median of their round trips."""
QUERY_PERIOD_S = 0.05
QUERY_TIMEOUT_S = 1.0
TIMEOUT_S = 5.0
SCOUT_S = 1.0
"""How long to wait for the answers of routers to scouting; they answer at once."""

ScoutOption = Annotated[
    bool,
    typer.Option(
        "--scout", help="Also ask the local network by multicast; servers answer only with zenoh.scouting: true."
    ),
]


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("vehicles")(vehicles)


def vehicles(
    target: Annotated[
        str | None,
        typer.Argument(
            metavar="[HOST|CONFIG]",
            help="The vehicle's machine, or a client config; default: the routers on this machine.",
            show_default=False,
        ),
    ] = None,
    router: Annotated[
        str | None, typer.Option(help="The endpoint of another router to ask, such as tcp/192.0.2.7:7447.")
    ] = None,
    use_scouting: ScoutOption = False,
    timeout: Annotated[
        float,
        typer.Option(
            min=0.1, max=86_400, help="How long to search, in s; an address that does not answer can take longer."
        ),
    ] = TIMEOUT_S,
    changes: console.SetOption = None,
    as_json: console.JsonOption = False,
) -> None:
    """List the vehicles that answer: state, who has control, and latency.

    The command asks all vehicles behind a router, acquires no control and moves nothing. With keys, name the client
    config: its certificate opens the router, and the vehicle's key verifies its answer.

    Example: lavt vehicles 192.0.2.7
    """
    if target is None and changes:
        raise UserError("--set changes a value of a config: name a host or a config before it")
    console.reserve_stdout()
    config = None if target is None else load_client_config(target, changes or [])
    list_vehicles(config, router, use_scouting=use_scouting, timeout_s=timeout, as_json=as_json)


def list_vehicles(
    config: ClientConfig | None, router: str | None, *, use_scouting: bool, timeout_s: float, as_json: bool
) -> list[FoundVehicle]:
    """Search for vehicles, print and return them.

    Raises `UserError` if a named router does not answer, and there is no other one.
    """
    quiet_logs()
    clock = MachineClock()
    end_ns = clock.now().mono_ns + round(timeout_s * NS_PER_S)
    found = FoundVehicles(_verify_functions(config))
    is_named = config is not None or router is not None
    sessions = search_sessions(config, [router] if router else []) if is_named or not use_scouting else []
    if use_scouting:
        for locators in scout(clock, min(SCOUT_S, timeout_s)):
            sessions += search_sessions(config, locators)
    errors = _query_all(clock, sessions, found, end_ns)
    if is_named and not use_scouting and errors:
        raise errors[0]
    listed = found.vehicles()
    if as_json:
        console.print_json({"vehicles": [describe(vehicle) for vehicle in listed], "rejected": dict(found.counts)})
    else:
        for line in table_lines(listed):
            console.print_result(line)
    for message in _messages(listed, found, use_scouting=use_scouting):
        console.print_message(f"lavt: {message}")
    return listed


def _verify_functions(config: ClientConfig | None) -> dict[str, Any]:
    """Return the function that verifies the answers of the config's vehicle, by the vehicle's name; empty: no key."""
    if config is None or not config.security.key:
        return {}
    key = load_public(Path(config.security.vehicle))

    def verify(vehicle: str, nonce: bytes, data: bytes) -> bytes | None:
        return verify_info(vehicle, key, nonce, data)

    return {config.vehicle_id: verify}


def _query_all(clock: Clock, sessions: Sequence[SessionSettings], found: FoundVehicles, end_ns: int) -> list[UserError]:
    """Query the vehicles behind each router until `end_ns`; return the errors of the routers that do not answer.

    Vehicles whose keys are known are also queried by name, so that the answers of others cannot hide them.
    """
    errors: list[UserError] = []
    for settings in sessions:
        if clock.now().mono_ns >= end_ns:
            break
        try:
            session = SearchSession(clock, settings)
        except UserError as error:  # scouting can also return an endpoint that Zenoh rejects
            errors.append(error)
            continue
        with closing(session):
            for name in (*found.known_names, "*") * QUERIES:
                left_s = (end_ns - clock.now().mono_ns) / NS_PER_S
                if left_s <= 0:
                    break
                answers = session.query(secrets.token_bytes(INFO_NONCE_BYTES), min(left_s, QUERY_TIMEOUT_S), name)
                found.add_all(answers, session.router)
                pause(round(QUERY_PERIOD_S * NS_PER_S))
    return errors


def _messages(listed: Sequence[FoundVehicle], found: FoundVehicles, *, use_scouting: bool) -> list[str]:
    """Return the messages about a list of vehicles."""
    names = Counter(vehicle.name for vehicle in listed)
    messages = [
        f"several servers have the name {name}: give each another vehicle_id"
        for name, count in names.items()
        if count > 1
    ]
    if found.counts["answers_forged"]:
        messages.append("answers that the vehicle's key has not signed were ignored: do the keys match?")
    ignored = found.counts["answers_unreadable"] + found.counts["answers_beyond_limit"]
    if ignored or found.counts["answers_cut_off"]:
        messages.append(
            f"{ignored} answers were ignored, and {found.counts['answers_cut_off']} queries had more answers than are "
            "read: another program answers in the name of vehicles, and may hide them"
        )
    if not listed:
        advice = "" if use_scouting else ", or search the local network with --scout"
        messages.append(
            "no vehicle answers: start `lavt server` on the vehicle's machine, and name that machine "
            f"(`lavt vehicles HOST`){advice}"
        )
    return messages


def describe(vehicle: FoundVehicle) -> dict[str, Any]:
    """Return a vehicle as `--json` prints it."""
    info = vehicle.info
    return {
        "vehicle": vehicle.name,
        "router": vehicle.router,
        "safety": None if info is None else info.safety,
        "reason": None if info is None else info.reason,
        "active_operator": None if info is None else info.active_operator,
        "speed_mps": None if info is None else info.speed_mps,
        "state_age_ms": None if info is None else info.state_age_ns / NS_PER_MS,
        "instance": None if info is None else info.instance,
        "round_trip_ms": statistics.median(vehicle.round_trips_ns) / NS_PER_MS,
        "round_trips": len(vehicle.round_trips_ns),
        "lavt_version": vehicle.lavt_version,
        "message_version": vehicle.message_version,
        "is_compatible": info is not None,
        "is_authentic": vehicle.is_authentic,
    }


def table_lines(listed: Sequence[FoundVehicle]) -> list[str]:
    """Return the lines of the table of vehicles, without control characters; empty without vehicles."""
    if not listed:
        return []
    rows = [("vehicle", "router", "state", "control", "round trip", "state age", "LAVT", "verified")]
    for vehicle in listed:
        info = vehicle.info
        version = vehicle.lavt_version
        if info is None:
            version += f" (messages {vehicle.message_version}, here {VERSION} of {lavt.__version__})"
        rows.append(
            (
                vehicle.name,
                vehicle.router,
                "-" if info is None else info.safety,
                "-" if info is None else info.active_operator or "nobody",
                f"{statistics.median(vehicle.round_trips_ns) / NS_PER_MS:.1f} ms",
                "-" if info is None else f"{info.state_age_ns / NS_PER_MS:.0f} ms",
                version,
                "yes" if vehicle.is_authentic else "no",
            )
        )
    rows = [tuple(map(printable, row)) for row in rows]  # type: ignore[misc]
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    return ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]


def printable(text: str) -> str:
    """Return a text with a question mark for each character that could control a terminal."""
    return "".join(character if character.isprintable() else "?" for character in text)
