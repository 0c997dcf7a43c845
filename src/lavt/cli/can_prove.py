"""`lavt can prove`: that a frozen computer leaves a car that brakes."""

from __future__ import annotations

import dataclasses
import sys
from contextlib import closing
from pathlib import Path
from typing import Annotated, Final

import typer

from lavt.assembly.dbw import load_profile
from lavt.assembly.dbw_check import hindrances_on_a_real_bus
from lavt.assembly.dbw_proof import proof_of
from lavt.cli import console
from lavt.clock import MachineClock
from lavt.config import ServerConfig
from lavt.config.dbw import DbwConfig
from lavt.config_file import load_config
from lavt.errors import UserError, WorkError
from lavt.runtime import process_priority
from lavt.vehicle.can_frame import BusGone
from lavt.vehicle.dbw.bus import CanPort, is_virtual
from lavt.vehicle.dbw.profile import OwnBrake, Profile
from lavt.vehicle.dbw.watchdog_test import BRAKE, BRAKE_WITHIN_NS, WatchdogTest

LOOK_EVERY_S: Final = 0.002
BEFOREHAND: Final = f"""The kit is enabled with the brake at {BRAKE}, then left alone: its watchdog has to brake.
Before it: the car stands in park or neutral, its wheels are off the ground, nobody's hands or feet are on wheel,
pedals or shifter, and somebody has the kit's own emergency stop at hand."""


def prove(
    config: Annotated[Path, typer.Argument(help="The server's config, in YAML, whose vehicle is by wire.")],
    changes: console.Set = None,
    out: Annotated[
        Path | None,
        typer.Option(help="The file of the proof.", show_default="vehicle.dbw.watchdog_proof of the config"),
    ] = None,
    yes: Annotated[bool, typer.Option("--yes", help="All is prepared: do not ask.")] = False,
    as_json: console.Json = False,
) -> None:
    """Prove that the kit's watchdog brakes when nothing is sent any more, and write the file that arming asks for.

    Ends with 1, and without a file, where the kit did not brake.

    Example: lavt can prove server.yaml --out watchdog_proof.json
    """
    settings = load_config(ServerConfig, config, changes or [])
    if settings.vehicle.kind != "dbw":
        raise UserError(
            f"the vehicle of {config} is of kind {settings.vehicle.kind}, not dbw: name a config of one by wire"
        )
    dbw = settings.vehicle.dbw
    file = out or Path(dbw.watchdog_proof or "watchdog_proof.json")
    profile, watchdog = _provable(dbw)
    process_priority.raise_priority()
    with closing(CanPort(dbw.interface, dbw.channel, dbw.options, clock=MachineClock())) as port:
        if not yes:
            _ask(dbw)
        _forget(file)
        proving = WatchdogTest(profile, watchdog, start_ns=MachineClock().now().mono_ns)
        _go(proving, port)
    if proving.observation is None:
        raise WorkError(f"nothing is proved: {proving.failure}")
    proof = proof_of(proving.observation, proving.gear, profile, dbw, MachineClock().now().wall_ns)
    _write(file, proof.model_dump_json(indent=1))
    if as_json:
        console.show_json({"file": str(file), **proof.model_dump()})
        return
    console.show(
        f"the kit let go {proof.release_ms:g} ms after the last frame and braked after {proof.braked_ms:g} ms, within "
        f"{BRAKE_WITHIN_NS // 1_000_000} ms, in gear {proof.gear} ({proof.said}); proof: {file}"
    )
    console.show("the kit brakes until somebody takes over: press the brake pedal")


def _provable(dbw: DbwConfig) -> tuple[Profile, OwnBrake]:
    """Give the profile, and by what its kit is seen to brake, where both will do for a kit that is on this bus."""
    if dbw.interface == "inside":
        raise UserError("a bus inside the server's process cannot be reached from here: name another interface")
    profile = load_profile(dbw.profile, dbw.dbc, dbw.steering_sign)
    watchdog = profile.watchdog
    if watchdog is None:
        raise UserError(f"{dbw.profile} does not say how the kit's own braking is seen: give it watchdog.signal")
    if profile.car.steering_sign is None:  # the wheel is asked to stay where it is, whichever way it is counted
        profile = dataclasses.replace(profile, car=dataclasses.replace(profile.car, steering_sign=1))
    hindrances = [] if is_virtual(dbw.interface, dbw.channel) else hindrances_on_a_real_bus(profile)
    if hindrances:
        raise UserError(f"{dbw.profile} may not be used on {dbw.interface} {dbw.channel}: {'; '.join(hindrances)}")
    return profile, watchdog


def _ask(dbw: DbwConfig) -> None:
    if sys.stdin is None or not sys.stdin.isatty():
        raise UserError("nobody can be asked whether the car is prepared: see to it, and give --yes")
    console.say(f"{BEFOREHAND}\nType yes to begin on {dbw.interface} {dbw.channel}:")
    if sys.stdin.readline().strip() != "yes":
        raise UserError("nothing was sent: prepare the car, and say yes")


def _go(proving: WatchdogTest, port: CanPort) -> None:
    """Let the attempt go on until there is a result."""
    clock = MachineClock()
    with console.until_told() as told:
        while not proving.is_done:
            if told.wait(LOOK_EVERY_S):
                raise WorkError("stopped; nothing is proved, and the kit may brake: take over by the brake pedal")
            try:
                for heard in port.take(clock.now().mono_ns):
                    proving.receive(heard.frame, heard.arrived_ns)
                now_ns = clock.now().mono_ns
                port.send(proving.frames_due(now_ns), now_ns)
            except BusGone as gone:
                proving.on_bus_gone(str(gone))


def _forget(file: Path) -> None:
    """Take an older proof away, which is not to outlive an attempt that fails, and see that one can be written."""
    try:
        file.touch()
        file.unlink()
    except OSError as error:
        raise UserError(f"{file} cannot be written ({error.strerror}): name another file with --out") from error


def _write(file: Path, text: str) -> None:
    try:
        file.write_text(text + "\n")
    except OSError as error:
        raise WorkError(f"{file} cannot be written ({error.strerror}): name another file with --out") from error
