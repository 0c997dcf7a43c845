"""`lavt software-car`: simulate a car with a by-wire kit on a CAN bus."""

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
from lavt.assembly.simulators import GENERATIONS, build_software_car
from lavt.cli import console
from lavt.clock import MachineClock
from lavt.config import ServerConfig
from lavt.config.dbw import DbwConfig
from lavt.config_file import load_config
from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.errors import UserError
from lavt.runtime import process_priority
from lavt.vehicle.dbw.bus import CanPort
from lavt.vehicle.dbw.profile import Profile
from lavt.vehicle.dbw.virtual_bus import is_virtual
from lavt.vehicle.sim.road.road import load_road
from lavt.vehicle.software_car.event_log import KitEvent
from lavt.vehicle.software_car.runner import SoftwareCarRunner

MAX_LINE_BYTES: Final = 1000
"""Longer input without a line break is executed as one line, so that the memory for incomplete lines is bounded."""
INSIDE: Final = "inside"


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("software-car")(software_car)


def software_car(
    config: Annotated[Path, typer.Argument(help="The YAML config of the server that drives the car.")],
    changes: console.SetOption = None,
    as_json: console.JsonOption = False,
) -> None:
    """Simulate a car with a by-wire kit on a CAN bus.

    The car runs on the bus of vehicle.dbw until Ctrl-C. It accepts commands on standard input; `help` lists them. It
    runs on the server's machine and sends its true position to vehicle.dbw.truth.

    Example: lavt software-car configs/server-by-wire.yaml --set vehicle.dbw.channel=vcan0
    """
    process_priority.raise_priority(process_priority.VEHICLE_NICENESS)
    settings = load_config(ServerConfig, config, changes or [])
    dbw = settings.vehicle.dbw
    if dbw.interface == INSIDE:
        raise UserError(
            f"vehicle.dbw.interface {INSIDE} runs the software car in the server: name a bus, such as udp_multicast"
        )
    profile = load_profile(dbw.profile, dbw.dbc, dbw.steering_sign)
    road = load_road(settings.vehicle.route)
    truth_address = resolved_address("vehicle.dbw.truth", dbw.truth) if dbw.truth else None
    clock = MachineClock()
    build_software_car(settings, profile, road, start_ns=0)  # built only to report errors before the bus is opened
    port = CanPort(dbw.interface, dbw.channel, dbw.options, clock=clock)
    try:
        if not is_virtual(dbw.interface, dbw.channel, dbw.options):
            console.print_message(f"lavt: {dbw.channel} is not a virtual bus: make sure that no real kit is on it")
        start_ns = clock.now().mono_ns
        runner = SoftwareCarRunner(build_software_car(settings, profile, road, start_ns), port, start_ns=start_ns)
        print_event = _print_event_json if as_json else _event_printer(start_ns)
        with console.stop_on_signals() as stop, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            sender.setblocking(False)
            _print_ready(profile, dbw, as_json=as_json)
            _run(
                runner,
                clock,
                stop,
                InputLines(),
                print_event,
                lambda datagram: _send_truth(sender, truth_address, datagram),
            )
    finally:
        port.close()
    if as_json:
        counts = {**runner.counts, **port.counts}
        console.print_json({"counts": counts, "latest_ms": runner.max_delay_ns / NS_PER_MS})


def _run(
    runner: SoftwareCarRunner,
    clock: MachineClock,
    stop: console.StopEvent,
    lines: InputLines,
    print_event: Callable[[KitEvent], None],
    send_truth: Callable[[bytes], None],
) -> None:
    """Run the car until the stop event."""
    while not stop.is_set():
        now_ns = clock.now().mono_ns
        runner.step(now_ns)
        datagram = runner.make_truth_datagram()
        if datagram is not None:
            send_truth(datagram)
        for event in runner.take_events():
            print_event(event)
        pause_ns = max(runner.next_wake_ns() - clock.now().mono_ns, 0)
        for line in lines.wait(stop, pause_ns / NS_PER_S):
            runner.execute(line, clock.now().mono_ns)


class InputLines:
    """The lines on standard input, until it is closed.

    A background process gets an error when it reads the terminal; its input is then treated as closed.
    """

    def __init__(self) -> None:
        self._is_open = sys.stdin is not None
        self._incomplete = b""
        signal.signal(signal.SIGTTIN, signal.SIG_IGN)

    def wait(self, stop: console.StopEvent, timeout_s: float) -> list[str]:
        """Wait at most `timeout_s` for lines, and return the lines that arrived."""
        if not self._is_open:
            stop.wait(timeout_s)
            return []
        ready, _, _ = select.select([sys.stdin], [], [], timeout_s)
        return self._read() if ready else []

    def _read(self) -> list[str]:
        try:
            data = os.read(sys.stdin.fileno(), 4096)
        except OSError:
            data = b""
        self._is_open = bool(data)
        *lines, self._incomplete = (self._incomplete + data).split(b"\n")
        if len(self._incomplete) > MAX_LINE_BYTES:
            lines, self._incomplete = [*lines, self._incomplete], b""
        return [line.decode(errors="replace") for line in lines]


def _send_truth(sender: socket.socket, address: tuple[str, int] | None, datagram: bytes) -> None:
    if address is not None:
        with suppress(OSError):  # the next datagram replaces this one
            sender.sendto(datagram, address)


def _print_ready(profile: Profile, dbw: DbwConfig, *, as_json: bool) -> None:
    generation = GENERATIONS[profile.kit]
    if as_json:
        bus = {"interface": dbw.interface, "channel": dbw.channel, "truth": dbw.truth}
        ready: dict[str, Any] = {"generation": generation, "commands": profile.commands, **bus}
        console.print_json({"ready": ready})
        return
    commands = f", {profile.commands} commands" if profile.commands else ""
    console.print_result(
        f"a car with a kit of generation {generation}{commands} on {dbw.interface} {dbw.channel}; "
        f"its true position is {f'sent to {dbw.truth}' if dbw.truth else 'not sent'}; type help for the commands, "
        "Ctrl-C ends it"
    )


def _print_event_json(event: KitEvent) -> None:
    console.print_json({"mono_ns": event.mono_ns, "kind": event.kind, "text": event.text})


def _event_printer(start_ns: int) -> Callable[[KitEvent], None]:
    """Return a function that prints an event with the time since the start."""

    def print_event(event: KitEvent) -> None:
        elapsed = "" if event.kind == "help" else f"{(event.mono_ns - start_ns) / NS_PER_S:9.3f} s  "
        console.print_result(f"{elapsed}{event.text}")

    return print_event
