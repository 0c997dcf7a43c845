"""`lavt software-car`: a by-wire kit on a CAN bus whose wheels are the built-in simulator's."""

from __future__ import annotations

import os
import select
import signal
import socket
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any, Final

import typer

from lavt.assembly.addresses import resolved_address
from lavt.assembly.dbw import load_profile
from lavt.assembly.software_car import GENERATIONS, build_software_car
from lavt.cli import console
from lavt.clock import MachineClock
from lavt.config import ServerConfig
from lavt.config.dbw import DbwConfig
from lavt.config_file import load_config
from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.errors import UserError
from lavt.runtime import process_priority
from lavt.vehicle.dbw.bus import CanPort, is_virtual
from lavt.vehicle.dbw.profile import Profile
from lavt.vehicle.sim.road.road import load_road
from lavt.vehicle.software_car.event_log import KitEvent
from lavt.vehicle.software_car.runner import SoftwareCarRunner

LONGEST_LINE: Final = 1000
INSIDE: Final = "inside"


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("software-car")(software_car)


def software_car(
    config: Annotated[Path, typer.Argument(help="The config of the server that drives it, in YAML.")],
    changes: console.Set = None,
    as_json: console.Json = False,
) -> None:
    """Be a car with a by-wire kit on the bus of vehicle.dbw, until Ctrl-C; words on standard input act on it.

    It runs on the server's machine and tells it the truth at vehicle.dbw.truth. `help` lists the words.

    Example: lavt software-car configs/server-by-wire.yaml --set vehicle.dbw.channel=vcan0
    """
    process_priority.raise_priority(process_priority.VEHICLE_NICENESS)
    settings = load_config(ServerConfig, config, changes or [])
    dbw = settings.vehicle.dbw
    if dbw.interface == INSIDE:
        raise UserError(
            f"vehicle.dbw.interface {INSIDE} is a software car in the server itself: name a bus, such as udp_multicast"
        )
    profile = load_profile(dbw.profile, dbw.dbc, dbw.steering_sign)
    road = load_road(settings.vehicle.route)
    truth = resolved_address("vehicle.dbw.truth", dbw.truth) if dbw.truth else None
    clock = MachineClock()
    build_software_car(settings, profile, road, start_ns=0)  # what is wrong with it is wrong before the bus is opened
    port = CanPort(dbw.interface, dbw.channel, dbw.options, clock=clock)
    try:
        if not is_virtual(dbw.interface, dbw.channel):
            console.say(f"lavt: {dbw.channel} is no virtual bus: see to it that no real kit is on it")
        start_ns = clock.now().mono_ns
        runner = SoftwareCarRunner(build_software_car(settings, profile, road, start_ns), port, start_ns=start_ns)
        tell = _tell_json if as_json else _tell_in_words(start_ns)
        with console.until_told() as told, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as speaker:
            speaker.setblocking(False)
            _show_ready(profile, dbw, as_json=as_json)
            _live(runner, clock, told, InputLines(), tell, lambda datagram: _send(speaker, truth, datagram))
    finally:
        port.close()
    if as_json:
        counts = {**runner.counts, **port.counts}
        console.show_json({"counts": counts, "latest_ms": runner.latest_ns / NS_PER_MS})


def _live(
    runner: SoftwareCarRunner,
    clock: MachineClock,
    told: console.StopEvent,
    lines: InputLines,
    tell: Callable[[KitEvent], None],
    send: Callable[[bytes], None],
) -> None:
    """Let the car live until told to stop."""
    while not told.is_set():
        now_ns = clock.now().mono_ns
        runner.step(now_ns)
        datagram = runner.make_truth_datagram()
        if datagram is not None:
            send(datagram)
        for events in runner.take_events():
            tell(events)
        pause_ns = max(runner.next_wake_ns() - clock.now().mono_ns, 0)
        for line in lines.wait(told, pause_ns / NS_PER_S):
            runner.execute(line, clock.now().mono_ns)


class InputLines:
    """Lines on standard input, as long as there is one; in the background nobody reads the terminal."""

    def __init__(self) -> None:
        self._is_open = sys.stdin is not None
        self._begun = b""
        signal.signal(signal.SIGTTIN, signal.SIG_IGN)

    def wait(self, told: console.StopEvent, pause_s: float) -> list[str]:
        """Wait for lines, at most so long."""
        if not self._is_open:
            told.wait(pause_s)
            return []
        ready, _, _ = select.select([sys.stdin], [], [], pause_s)
        return self._read() if ready else []

    def _read(self) -> list[str]:
        try:
            came = os.read(sys.stdin.fileno(), 4096)
        except OSError:
            came = b""
        self._is_open = bool(came)
        *lines, self._begun = (self._begun + came).split(b"\n")
        if len(self._begun) > LONGEST_LINE:
            lines, self._begun = [*lines, self._begun], b""
        return [line.decode(errors="replace") for line in lines]


def _send(speaker: socket.socket, truth: tuple[str, int] | None, datagram: bytes) -> None:
    if truth is not None:
        with suppress(OSError):  # the next one says it again
            speaker.sendto(datagram, truth)


def _show_ready(profile: Profile, dbw: DbwConfig, *, as_json: bool) -> None:
    generation = GENERATIONS[profile.kit]
    if as_json:
        keys = {"interface": dbw.interface, "channel": dbw.channel, "truth": dbw.truth}
        ready: dict[str, Any] = {"generation": generation, "commands": profile.commands, **keys}
        console.show_json({"ready": ready})
        return
    commands = f", {profile.commands} commands" if profile.commands else ""
    console.show(
        f"a car with a kit of generation {generation}{commands} on {dbw.interface} {dbw.channel}; "
        f"the truth goes {f'to {dbw.truth}' if dbw.truth else 'nowhere'}; help lists the words, Ctrl-C ends it"
    )


def _tell_json(events: KitEvent) -> None:
    console.show_json({"mono_ns": events.mono_ns, "kind": events.kind, "text": events.text})


def _tell_in_words(start_ns: int) -> Callable[[KitEvent], None]:
    """Tell news with the time since the start."""

    def tell(events: KitEvent) -> None:
        at = "" if events.kind == "help" else f"{(events.mono_ns - start_ns) / NS_PER_S:9.3f} s  "
        console.show(f"{at}{events.text}")

    return tell
