"""The differences between the two generations of the kit."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from msgspec import Struct

from lavt.vehicle.can_frame import CanFrame
from lavt.vehicle.software_car import generation_1, generation_2
from lavt.vehicle.software_car.mechanics import Mechanics
from lavt.vehicle.software_car.state import AxisOrder, GearOrder, KitState, SystemOrder


class Generation(Struct, frozen=True):
    """The messages and rules of one generation of the kit."""

    parse_order: Callable[[CanFrame, Mechanics, bool], AxisOrder | GearOrder | SystemOrder | None]
    """Parses an order; the last argument is whether the remote command set is accepted, not the user set."""
    reports: dict[int, tuple[int, Callable[[KitState, Mechanics], bytes]]]
    """By identifier: the period in milliseconds, and the function that encodes the report."""
    faults: dict[str, tuple[str, ...]]
    """For each part, the names of its faults."""
    speed_messages: dict[str, int]
    """For each source of speed, the identifier of the message that reports it."""
    follows: Callable[[int, int], bool]
    """Returns whether the second counter is a valid successor of the first."""
    is_one_system: bool
    """Whether all axes are enabled and released together, and enabled only after an order to the system."""


GENERATIONS: Final = {
    1: Generation(
        generation_1.parse_order,
        generation_1.REPORTS,
        generation_1.FAULTS,
        generation_1.SPEED_MESSAGES,
        lambda previous, count: count == (previous + 1) % 256,
        is_one_system=False,
    ),
    2: Generation(
        generation_2.parse_order,
        generation_2.REPORTS,
        generation_2.FAULTS,
        generation_2.SPEED_MESSAGES,
        lambda previous, count: count != previous,
        is_one_system=True,
    ),
}
