"""Words by which somebody acts on a software car: as its driver, or as what breaks."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Final

from lavt.errors import UserError
from lavt.value import value
from lavt.vehicle.software_car.gearbox import GEARS
from lavt.vehicle.software_car.kit import Kit, known
from lavt.vehicle.software_car.state import Gear

SWITCH: Final = {"emergency_stop": 0, "pause": 1, "remote": 2, "control_allowed": 3}
"""States of the remote's switch."""
HELP: Final = "help"
LONGEST_SHOWN = 40


@value
class ConsoleCommand:
    """A word, what it takes, and what it does to a kit at a time."""

    takes: str
    """Empty: nothing."""
    meaning: str
    act: Callable[[Kit, str, int], None]


def number(text: str) -> float:
    """Read a number; raises `UserError`."""
    try:
        read = float(text)
    except ValueError:
        read = math.nan
    if not math.isfinite(read):
        raise UserError(f"{text[:LONGEST_SHOWN]!r} is no number")
    return read


def gear(text: str) -> Gear:
    """Read the name of a gear; raises `UserError` with the known ones."""
    return Gear[known(text.upper(), {each.name for each in GEARS}, "gear of this car")]


def switch(text: str) -> int:
    """Read a state of the remote's switch; raises `UserError` with the known ones."""
    return SWITCH[known(text, set(SWITCH), "state of the remote's switch")]


WORDS: Final[dict[str, ConsoleCommand]] = {
    "driver_steers": ConsoleCommand(
        "NM", "hands on the wheel, with so much torque, left positive",
        lambda kit, text, now_ns: kit.driver_steers(number(text), now_ns),
    ),
    "driver_brakes": ConsoleCommand(
        "FRACTION", "a foot on the brake, 0 to 1",
        lambda kit, text, now_ns: kit.driver_brakes(number(text), now_ns),
    ),
    "driver_throttles": ConsoleCommand(
        "FRACTION", "a foot on the throttle, 0 to 1",
        lambda kit, text, now_ns: kit.driver_throttles(number(text), now_ns),
    ),
    "driver_shifts": ConsoleCommand(
        "GEAR", "PARK, NEUTRAL or DRIVE by the shifter",
        lambda kit, text, now_ns: kit.driver_shifts(gear(text), now_ns),
    ),
    "fault": ConsoleCommand(
        "PART.BIT", "break a part, as in steering.FLTPWR",
        lambda kit, text, now_ns: kit.set_fault(text, now_ns),
    ),
    "mend": ConsoleCommand(
        "PART.BIT", "mend it",
        lambda kit, text, now_ns: kit.set_fault(text, now_ns, is_set=False),
    ),
    "unknown": ConsoleCommand(
        "VALUE", "report angle, speed or wheel_speed as unknown",
        lambda kit, text, _: kit.set_unknown(text),
    ),
    "known": ConsoleCommand(
        "VALUE", "report it again",
        lambda kit, text, _: kit.set_unknown(text, is_unknown=False),
    ),
    "inhibit": ConsoleCommand(
        "WHAT", "generation 2 is not ready, because of: seat belt, door, speed, acceleration, reverse",
        lambda kit, text, now_ns: kit.inhibit(text, now_ns),
    ),
    "unhinder": ConsoleCommand(
        "", "it is ready again",
        lambda kit, _, now_ns: kit.inhibit(None, now_ns),
    ),
    "switch_remote": ConsoleCommand(
        "STATE", f"the remote's switch: {', '.join(SWITCH)}",
        lambda kit, text, now_ns: kit.switch_remote(switch(text), now_ns),
    ),
    "bus_off": ConsoleCommand(
        "", "the kit says and hears nothing any more",
        lambda kit, _, now_ns: kit.bus_off(now_ns),
    ),
    "bus_on": ConsoleCommand(
        "", "it does again",
        lambda kit, _, now_ns: kit.bus_off(now_ns, is_off=False),
    ),
    "no_watchdog": ConsoleCommand(
        "", "a kit without the watchdog that brakes",
        lambda kit, _, now_ns: kit.switch_watchdog(now_ns, is_there=False),
    ),
    "watchdog": ConsoleCommand(
        "", "with it again",
        lambda kit, _, now_ns: kit.switch_watchdog(now_ns),
    ),
}  # fmt: skip


def help_lines() -> list[str]:
    """List all words with what they take and mean."""
    calls = {f"{name} {word.takes}".strip(): word.meaning for name, word in WORDS.items()} | {HELP: "this list"}
    widest = max(map(len, calls))
    return [f"{call:{widest}}  {meaning}" for call, meaning in calls.items()]


def act(kit: Kit, line: str, now_ns: int) -> None:
    """Do what a line says; raises `UserError` with one sentence for one that cannot be done, and does nothing then."""
    name, _, rest = line.strip().partition(" ")
    text = rest.strip()
    if name not in WORDS:
        raise UserError(f"there is no word {name[:LONGEST_SHOWN]!r}: {HELP} lists them")
    word = WORDS[name]
    if word.takes and not text:
        raise UserError(f"{name} needs a {word.takes}: {word.meaning}")
    if text and not word.takes:
        raise UserError(f"{name} takes nothing after it, not {text[:LONGEST_SHOWN]!r}")
    word.act(kit, text, now_ns)
