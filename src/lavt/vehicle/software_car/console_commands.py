"""Console commands for a software car: actions of its driver, and faults."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Final

from msgspec import Struct

from lavt.errors import UserError
from lavt.vehicle.software_car.gearbox import GEARS
from lavt.vehicle.software_car.kit import Kit, check_known
from lavt.vehicle.software_car.state import Gear

REMOTE_STATES: Final = {"emergency_stop": 0, "pause": 1, "remote": 2, "control_allowed": 3}
"""States of the remote's switch."""
HELP: Final = "help"
MAX_QUOTED = 40
"""The largest number of characters of the input that an error quotes."""


class ConsoleCommand(Struct, frozen=True):
    """A console command."""

    argument: str
    """Name of the argument in the help text; empty if the command takes none."""
    meaning: str
    """What the command does, for the help text."""
    execute: Callable[[Kit, str, int], None]
    """Executes the command on a kit, given the argument's text and the time in ns."""


def parse_number(text: str) -> float:
    """Parse a finite number. Raises `UserError`."""
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise UserError(f"{text[:MAX_QUOTED]!r} is not a number: write one, such as 0.5")
    return number


def parse_gear(text: str) -> Gear:
    """Parse the name of a gear. Raises `UserError` with the known names."""
    return Gear[check_known(text.upper(), {gear.name for gear in GEARS}, "gear of this car")]


def parse_remote_state(text: str) -> int:
    """Parse a state of the remote's switch. Raises `UserError` with the known states."""
    return REMOTE_STATES[check_known(text, set(REMOTE_STATES), "state of the remote's switch")]


def parse_source(text: str) -> tuple[str, float | None]:
    """Parse `SOURCE` or `SOURCE=NUMBER`. Raises `UserError` for an invalid number; the kit checks the source."""
    source, equals, number = text.partition("=")
    return source.strip(), parse_number(number) if equals else None


def scale_speed(kit: Kit, text: str, _: int) -> None:
    """Scale the speed of a source, for the text `SOURCE=FACTOR`. Raises `UserError`."""
    source, factor = parse_source(text)
    if factor is None:
        raise UserError(f"scale_speed {source[:MAX_QUOTED]!r} needs a factor: write SOURCE=0.5")
    kit.scale_speed(source, factor)


COMMANDS: Final[dict[str, ConsoleCommand]] = {
    "driver_steers": ConsoleCommand(
        "NM",
        "apply a torque to the steering wheel, left positive",
        lambda kit, text, now_ns: kit.driver_steers(parse_number(text), now_ns),
    ),
    "driver_brakes": ConsoleCommand(
        "FRACTION",
        "press the brake pedal, 0 to 1",
        lambda kit, text, now_ns: kit.driver_brakes(parse_number(text), now_ns),
    ),
    "driver_throttles": ConsoleCommand(
        "FRACTION",
        "press the throttle pedal, 0 to 1",
        lambda kit, text, now_ns: kit.driver_throttles(parse_number(text), now_ns),
    ),
    "driver_shifts": ConsoleCommand(
        "GEAR",
        "move the shifter to PARK, NEUTRAL or DRIVE",
        lambda kit, text, now_ns: kit.driver_shifts(parse_gear(text), now_ns),
    ),
    "fault": ConsoleCommand(
        "PART.BIT",
        "set a fault, such as steering.FLTPWR",
        lambda kit, text, now_ns: kit.set_fault(text, now_ns),
    ),
    "clear_fault": ConsoleCommand(
        "PART.BIT",
        "clear a fault",
        lambda kit, text, now_ns: kit.set_fault(text, now_ns, is_set=False),
    ),
    "unknown": ConsoleCommand(
        "VALUE",
        "report angle, speed or wheel_speed as unknown",
        lambda kit, text, _: kit.set_unknown(text),
    ),
    "known": ConsoleCommand(
        "VALUE",
        "report the value again",
        lambda kit, text, _: kit.set_unknown(text, is_unknown=False),
    ),
    "stick_speed": ConsoleCommand(
        "SOURCE[=M/S]",
        "keep reporting this speed, by default the present one. "
        "SOURCE is speed, wheel_speed or second_speed (generation 2 only)",
        lambda kit, text, _: kit.stick_speed(*parse_source(text)),
    ),
    "scale_speed": ConsoleCommand("SOURCE=FACTOR", "report a multiple of the speed", scale_speed),
    "drop_speed": ConsoleCommand(
        "SOURCE",
        "do not send the message that reports this speed",
        lambda kit, text, _: kit.drop_speed(text),
    ),
    "restore_speed": ConsoleCommand(
        "SOURCE",
        "report this speed correctly again",
        lambda kit, text, _: kit.restore_speed(text),
    ),
    "weaken_brake": ConsoleCommand(
        "SHARE",
        "let only a share of the brake's force reach the wheels; 1: all of it",
        lambda kit, text, _: kit.weaken_brake(parse_number(text)),
    ),
    "inhibit": ConsoleCommand(
        "REASON",
        "make generation 2 not ready: seat belt, door, speed, acceleration or reverse",
        lambda kit, text, now_ns: kit.inhibit(text, now_ns),
    ),
    "clear_inhibit": ConsoleCommand(
        "",
        "remove the inhibit reason",
        lambda kit, _, now_ns: kit.inhibit(None, now_ns),
    ),
    "switch_remote": ConsoleCommand(
        "STATE",
        f"set the remote's switch: {', '.join(REMOTE_STATES)}",
        lambda kit, text, now_ns: kit.switch_remote(parse_remote_state(text), now_ns),
    ),
    "bus_off": ConsoleCommand(
        "",
        "disconnect the kit from the bus",
        lambda kit, _, now_ns: kit.set_bus_off(now_ns),
    ),
    "bus_on": ConsoleCommand(
        "",
        "reconnect the kit to the bus",
        lambda kit, _, now_ns: kit.set_bus_off(now_ns, is_off=False),
    ),
    "no_watchdog": ConsoleCommand(
        "",
        "disable the watchdog's braking",
        lambda kit, _, now_ns: kit.set_watchdog(now_ns, is_enabled=False),
    ),
    "watchdog": ConsoleCommand(
        "",
        "enable the watchdog's braking",
        lambda kit, _, now_ns: kit.set_watchdog(now_ns),
    ),
}


def help_lines() -> list[str]:
    """Return one line for each command with its argument and meaning."""
    usages = {f"{name} {command.argument}".strip(): command.meaning for name, command in COMMANDS.items()}
    usages[HELP] = "list the commands"
    width = max(map(len, usages))
    return [f"{usage:{width}}  {meaning}" for usage, meaning in usages.items()]


def execute(kit: Kit, line: str, now_ns: int) -> None:
    """Execute a command line. If it is invalid, raises `UserError` and changes nothing."""
    name, _, rest = line.strip().partition(" ")
    text = rest.strip()
    if name not in COMMANDS:
        raise UserError(f"unknown command {name[:MAX_QUOTED]!r}: {HELP} lists the commands")
    command = COMMANDS[name]
    if command.argument and not text:
        raise UserError(f"{name} needs {command.argument}: {command.meaning}")
    if text and not command.argument:
        raise UserError(f"{name} takes no argument: leave out {text[:MAX_QUOTED]!r}")
    command.execute(kit, text, now_ns)
