"""`lavt can test-watchdog`: test that a by-wire kit brakes when its commands stop."""

from __future__ import annotations

import dataclasses
import sys
from contextlib import closing
from pathlib import Path
from typing import Annotated, Final

import typer

from lavt.assembly.dbw import load_profile
from lavt.assembly.dbw_check import real_bus_inhibit_reasons
from lavt.assembly.watchdog_proof import new_proof
from lavt.cli import console
from lavt.clock import MachineClock
from lavt.config import ServerConfig
from lavt.config.dbw import DbwConfig
from lavt.config_file import load_config
from lavt.errors import UserError, WorkError
from lavt.runtime import process_priority
from lavt.vehicle.can_frame import BusGone
from lavt.vehicle.dbw.bus import CanPort
from lavt.vehicle.dbw.profile import OwnBrake, Profile
from lavt.vehicle.dbw.virtual_bus import is_virtual
from lavt.vehicle.dbw.watchdog_test import BRAKE, BRAKE_WITHIN_NS, WatchdogTest

POLL_PERIOD_S: Final = 0.002
PREPARATION: Final = f"""The test enables the kit and commands a brake of {BRAKE} (1 is full braking).
Then it stops sending commands, and the kit's watchdog must brake.
Prepare the car first: it is stationary in park or neutral, with its wheels off the ground; nobody touches the wheel,
the pedals or the shifter; and somebody is ready to press the kit's own emergency stop."""


def run_watchdog_test(
    config: Annotated[Path, typer.Argument(help="A server config in YAML whose vehicle is by wire.")],
    changes: console.SetOption = None,
    out: Annotated[
        Path | None,
        typer.Option(help="The proof file to write.", show_default="vehicle.dbw.watchdog_proof of the config"),
    ] = None,
    yes: Annotated[
        bool, typer.Option("--yes", help="Confirm that the car is prepared, so that the command does not ask.")
    ] = False,
    as_json: console.JsonOption = False,
) -> None:
    """Test that the kit's watchdog brakes when commands stop.

    If the test passes, the command writes the proof file that arming requires. If it fails, the command writes no file
    and exits with 1.

    Example: lavt can test-watchdog server.yaml --out watchdog_proof.json
    """
    settings = load_config(ServerConfig, config, changes or [])
    if settings.vehicle.kind != "dbw":
        raise UserError(
            f"the vehicle of {config} is of kind {settings.vehicle.kind}, not dbw: name a config of a by-wire vehicle"
        )
    dbw = settings.vehicle.dbw
    proof_file = out or Path(dbw.watchdog_proof or "watchdog_proof.json")
    profile, own_brake = _load_testable(dbw)
    process_priority.raise_priority()
    with closing(CanPort(dbw.interface, dbw.channel, dbw.options, clock=MachineClock())) as port:
        if not yes:
            _confirm(dbw)
        _remove_old_proof(proof_file)
        test = WatchdogTest(profile, own_brake, start_ns=MachineClock().now().mono_ns)
        _run(test, port)
    if test.observation is None:
        raise WorkError(f"the watchdog test failed: {test.failure}")
    proof = new_proof(test.observation, test.gear, profile, dbw, MachineClock().now().wall_ns)
    _write_proof(proof_file, proof.model_dump_json(indent=1))
    if as_json:
        console.print_json({"file": str(proof_file), **proof.model_dump()})
        return
    console.print_result(
        f"the kit disengaged {proof.release_ms:g} ms after the last frame and braked after {proof.braked_ms:g} ms "
        f"(limit {BRAKE_WITHIN_NS // 1_000_000} ms) in gear {proof.gear} ({proof.said}); proof: {proof_file}"
    )
    console.print_result("the kit brakes until a driver overrides it by pressing the brake pedal")


def _load_testable(dbw: DbwConfig) -> tuple[Profile, OwnBrake]:
    """Return the profile and the signal that reports the kit's own braking.

    Raises `UserError` if bus or profile is unsuitable.
    """
    if dbw.interface == "inside":
        raise UserError("a bus inside the server's process cannot be reached from here: name another interface")
    profile = load_profile(dbw.profile, dbw.dbc, dbw.steering_sign)
    own_brake = profile.watchdog
    if own_brake is None:
        raise UserError(f"{dbw.profile} names no signal of the kit's own braking: set watchdog.signal in the profile")
    if profile.car.steering_sign is None:  # the sign has no effect, because the test keeps the steering angle
        profile = dataclasses.replace(profile, car=dataclasses.replace(profile.car, steering_sign=1))
    reasons = []
    if not is_virtual(dbw.interface, dbw.channel, dbw.options):
        reasons = real_bus_inhibit_reasons(profile)
        if not dbw.car:
            reasons.append("the proof must name the car: set vehicle.dbw.car to its serial number or VIN")
    if reasons:
        raise UserError(f"{dbw.profile} must not be used on {dbw.interface} {dbw.channel}: {'; '.join(reasons)}")
    return profile, own_brake


def _confirm(dbw: DbwConfig) -> None:
    """Ask on the terminal whether the car is prepared; raise `UserError` unless the answer is yes."""
    if sys.stdin is None or not sys.stdin.isatty():
        raise UserError("no terminal to ask whether the car is prepared: prepare it and pass --yes")
    console.print_message(f"{PREPARATION}\nType yes to begin on {dbw.interface} {dbw.channel}:")
    if sys.stdin.readline().strip() != "yes":
        raise UserError("nothing was sent, because the answer was not yes: prepare the car, then answer yes")


def _run(test: WatchdogTest, port: CanPort) -> None:
    """Run the test until it has a result."""
    clock = MachineClock()
    with console.stop_on_signals() as stop:
        while not test.is_done:
            if stop.wait(POLL_PERIOD_S):
                raise WorkError("stopped without a result; if the kit brakes, press the brake pedal to override it")
            try:
                for received in port.take(clock.now().mono_ns):
                    test.receive(received.frame, received.arrived_ns)
                now_ns = clock.now().mono_ns
                frames = test.frames_due(now_ns)
                written = port.send(frames, now_ns)
                if written < len(frames):
                    test.on_bus_gone(f"it accepted only {written} of {len(frames)} frames")
            except BusGone as error:
                test.on_bus_gone(str(error))


def _remove_old_proof(file: Path) -> None:
    """Remove an older proof, because the new test can fail; raise `UserError` if `file` is not writable."""
    try:
        file.touch()
        file.unlink()
    except OSError as error:
        raise UserError(f"{file} cannot be written ({error.strerror}): name another file with --out") from error


def _write_proof(file: Path, text: str) -> None:
    try:
        file.write_text(text + "\n")
    except OSError as error:
        raise WorkError(f"{file} cannot be written ({error.strerror}): name another file with --out") from error
