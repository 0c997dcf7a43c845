"""In what the kit's two generations differ."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from lavt.value import value
from lavt.vehicle.can_frame import CanFrame
from lavt.vehicle.software_car import generation_1, generation_2
from lavt.vehicle.software_car.mechanics import Mechanics
from lavt.vehicle.software_car.state import GearOrder, KitState, Order, SystemOrder


@value
class Generation:
    """What a kit of one generation reads, writes and demands."""

    read: Callable[[CanFrame, Mechanics, bool], Order | GearOrder | SystemOrder | None]
    reports: dict[int, tuple[int, Callable[[KitState, Mechanics], bytes]]]
    """By identifier: every how many milliseconds, and what."""
    faults: dict[str, tuple[str, ...]]
    follows: Callable[[int, int], bool]
    """Whether a counter may come after another."""
    is_one_system: bool
    """All axes are enabled together and let go together, and only after the system was told to enable."""


GENERATIONS: Final = {
    1: Generation(
        generation_1.read,
        generation_1.REPORTS,
        generation_1.FAULTS,
        lambda before, count: count == (before + 1) % 256,
        is_one_system=False,
    ),
    2: Generation(
        generation_2.read,
        generation_2.REPORTS,
        generation_2.FAULTS,
        lambda before, count: count != before,
        is_one_system=True,
    ),
}
