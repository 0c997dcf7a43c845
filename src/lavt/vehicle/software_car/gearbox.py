"""The gearbox, which executes gear orders or rejects them with a reason."""

from __future__ import annotations

from typing import Final

from lavt.vehicle.software_car.state import MIN_PRESSED_PEDAL, Gear, GearOrder, GearRejection, KitState

GEARS: Final = {Gear.PARK, Gear.NEUTRAL, Gear.DRIVE}
"""The gears of the car. The simulator does not have reverse and low."""


def shift(state: KitState, order: GearOrder) -> None:
    """Execute a gear order, or record why it is rejected."""
    if not order.is_valid:  # the frame had a wrong checksum
        return
    if order.is_clearing:
        state.is_gear_overridden = False
    state.gear_order, state.gear_reject = order.gear, rejection_reason(state, order.gear)
    if order.gear != Gear.NONE and state.gear_reject == GearRejection.NONE:
        state.gear = Gear(order.gear)


def rejection_reason(state: KitState, gear: int) -> GearRejection:
    """Return why a gear cannot be engaged now; `GearRejection.NONE` if it can."""
    if gear in {Gear.NONE, state.gear}:
        return GearRejection.NONE
    if state.gear_faults:
        return GearRejection.FAULT
    if state.is_gear_overridden:
        return GearRejection.OVERRIDE
    if gear not in GEARS:
        return GearRejection.UNSUPPORTED
    if state.brake < MIN_PRESSED_PEDAL or (gear == Gear.PARK and not state.is_stationary):
        return GearRejection.BRAKE_OR_MOTION
    return GearRejection.NONE
