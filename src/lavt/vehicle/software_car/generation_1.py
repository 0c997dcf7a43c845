"""The messages of Dataspeed's kits of generation 1: decoding of commands, and encoding of reports."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from lavt.vehicle.can_frame import CanFrame
from lavt.vehicle.software_car.frames import BitField, Layout, pack, unpack
from lavt.vehicle.software_car.mechanics import (
    Mechanics,
    clamp,
    commanded_wheel_rad,
    hundredths_of_kmh,
    tenths_of_degree,
)
from lavt.vehicle.software_car.state import AXES, Axis, AxisOrder, GearOrder, KitState, ReleaseReason, SystemOrder

FULL_PEDAL = 65535
FULL_TORQUE_NM = 3412
UNKNOWN: Final = -0x8000
"""Value of a 16-bit field whose quantity is unknown."""
CLEARING_LENGTH = 4
"""Length in bytes of a command without a counter, which can only clear an override and the watchdog."""

PEDAL_COMMAND = (
    BitField("command", 0, 16),
    BitField("type", 20, 4),
    BitField("enable", 24, 1),
    BitField("clear", 25, 1),
    BitField("ignore", 26, 1),
    BitField("count", 56, 8),
)
STEERING_COMMAND = (
    BitField("command", 0, 16, is_signed=True),
    BitField("enable", 16, 1),
    BitField("clear", 17, 1),
    BitField("ignore", 18, 1),
    BitField("type", 23, 1),
    BitField("rate", 24, 8),
    BitField("count", 56, 8),
)
COMMANDS: dict[int, tuple[Axis, Layout]] = {
    0x060: ("brake", Layout(8, PEDAL_COMMAND)),
    0x062: ("throttle", Layout(8, PEDAL_COMMAND)),
    0x064: ("steering", Layout(8, STEERING_COMMAND)),
}
GEAR_COMMAND_ID = 0x066
GEAR_COMMAND = Layout(1, (BitField("gear", 0, 3), BitField("clear", 7, 1)))

PEDAL_REPORT = (
    BitField("input", 0, 16),
    BitField("command", 16, 16),
    BitField("output", 32, 16),
    BitField("watchdog_source", 52, 4),
    BitField("enabled", 56, 1),
    BitField("override", 57, 1),
    BitField("driver", 58, 1),
    BitField("FLTWDC", 59, 1),
    BitField("FLT1", 60, 1),
    BitField("FLT2", 61, 1),
    BitField("FLTPWR", 62, 1),
    BitField("timeout", 63, 1),
)
BRAKE_REPORT = Layout(8, (*PEDAL_REPORT, BitField("watchdog_brakes", 51, 1)))
THROTTLE_REPORT = Layout(8, PEDAL_REPORT)
STEERING_REPORT = Layout(
    8,
    (
        BitField("angle", 0, 16, is_signed=True),
        BitField("command", 16, 15, is_signed=True),
        BitField("is_torque", 31, 1),
        BitField("speed", 32, 16, is_signed=True),
        BitField("torque", 48, 8, is_signed=True),
        BitField("enabled", 56, 1),
        BitField("override", 57, 1),
        BitField("FLTPWR", 58, 1),
        BitField("FLTWDC", 59, 1),
        BitField("FLTBUS1", 60, 1),
        BitField("FLTBUS2", 61, 1),
        BitField("FLTCAL", 62, 1),
        BitField("timeout", 63, 1),
    ),
)
GEAR_REPORT = Layout(
    2,
    (
        BitField("gear", 0, 3),
        BitField("override", 3, 1),
        BitField("command", 4, 3),
        BitField("FLTBUS", 7, 1),
        BitField("reject", 8, 3),
        BitField("ready", 15, 1),
    ),
)
WHEEL_SPEEDS = Layout(8, tuple(BitField(f"wheel_{index}", 16 * index, 16, is_signed=True) for index in range(4)))

FAULTS: dict[str, tuple[str, ...]] = {
    "steering": ("FLTPWR", "FLTBUS1", "FLTBUS2", "FLTCAL"),
    "brake": ("FLT1", "FLT2", "FLTPWR"),
    "throttle": ("FLT1", "FLT2", "FLTPWR"),
    "gear": ("FLTBUS",),
}
"""For each part, the bits that report its faults. FLTWDC is not among them, because the watchdog sets it."""

PEDAL_TRAVEL = {"brake": (0.15, 0.50), "throttle": (0.15, 0.80)}
"""For commands of type 1 (CMD_TYPE), the fractions of the full command at which a pedal is released and fully pressed.
"""

WATCHDOG_SOURCES: dict[tuple[Axis, ReleaseReason], int] = {
    (axis, reason): 1 + 4 * axis_index + reason_index
    for axis_index, axis in enumerate(AXES)
    for reason_index, reason in enumerate(
        (ReleaseReason.COUNTER, ReleaseReason.DISABLED, ReleaseReason.TIMEOUT, ReleaseReason.FAULT)
    )
}
"""The code that reports why the watchdog tripped (WDCSRC), for each axis and reason. It is published that the codes are
1 to 15, and for which kinds of reasons they are. Which code stands for which axis and reason is our choice."""


def pedal_fraction(axis: Axis, command_type: int, command: int, mechanics: Mechanics) -> float | None:
    """Return the requested fraction of a pedal, or None for a command type that the kit does not know."""
    if command_type == 1:
        released, full = PEDAL_TRAVEL[axis]
        return clamp((command / FULL_PEDAL - released) / (full - released), 0.0, 1.0)
    if command_type == 2:
        return command / FULL_PEDAL
    if axis == "brake" and command_type == 3:
        return clamp(command / FULL_TORQUE_NM, 0.0, 1.0)
    if axis == "brake" and command_type == 6:
        return clamp(min(command * 0.001, 10.0) / mechanics.max_braking_mps2, 0.0, 1.0)
    return None


def parse_order(frame: CanFrame, mechanics: Mechanics, _: bool) -> AxisOrder | GearOrder | SystemOrder | None:
    """Parse an order, or return None for a frame that is not for the kit."""
    if frame.is_extended:
        return None
    if frame.identifier == GEAR_COMMAND_ID and len(frame.data) == GEAR_COMMAND.length:
        requested = unpack(GEAR_COMMAND, frame.data)
        return GearOrder(is_valid=True, gear=requested["gear"], is_clearing=bool(requested["clear"]))
    if frame.identifier not in COMMANDS:
        return None
    axis, layout = COMMANDS[frame.identifier]
    if len(frame.data) == CLEARING_LENGTH:
        requested = unpack(layout, frame.data + bytes(layout.length - CLEARING_LENGTH))
        return AxisOrder(axis, is_valid=True, is_clearing=bool(requested["clear"]))
    if len(frame.data) != layout.length:
        return None
    requested = unpack(layout, frame.data)
    target: float | None
    if axis == "steering":
        target = commanded_wheel_rad(requested["command"]) if requested["type"] == 0 else None
    else:
        target = pedal_fraction(axis, requested["type"], requested["command"], mechanics)
    return AxisOrder(
        axis,
        is_valid=True,
        target=target or 0.0,
        is_enabling=bool(requested["enable"]) and target is not None,
        is_clearing=bool(requested["clear"]),
        ignores_driver=bool(requested["ignore"]),
        rate_radps=mechanics.rate_radps(requested.get("rate", 0), mechanics.steering_rate_step_deg),
        count=requested["count"],
    )


def flag_fields(state: KitState, axis: Axis) -> dict[str, int]:
    """Return the flags that the reports of all three axes have."""
    actuator = state.actuators[axis]
    return {
        "enabled": actuator.is_enabled,
        "override": actuator.is_overridden,
        "FLTWDC": state.watchdog_reason != ReleaseReason.NONE,
        "timeout": actuator.has_timed_out,
        **dict.fromkeys(actuator.faults, 1),
    }


def pedal_fields(state: KitState, axis: Axis, driver: float, output: float) -> dict[str, int]:
    """Return the fields that the reports of both pedals have."""
    actuator = state.actuators[axis]
    source = WATCHDOG_SOURCES.get((state.watchdog_axis, state.watchdog_reason), 0) if state.watchdog_axis else 0
    return {
        "input": round(driver * FULL_PEDAL),
        "command": round(actuator.order.target * FULL_PEDAL) if actuator.order else 0,
        "output": round(output * FULL_PEDAL),
        "watchdog_source": source,
        "driver": actuator.driver_acts,
        **flag_fields(state, axis),
    }


def brake_report(state: KitState, _: Mechanics) -> bytes:
    """Return the brake report."""
    values = pedal_fields(state, "brake", state.driver_brake, state.brake)
    return pack(BRAKE_REPORT, values | {"watchdog_brakes": state.watchdog_brakes})


def throttle_report(state: KitState, _: Mechanics) -> bytes:
    """Return the throttle report."""
    return pack(THROTTLE_REPORT, pedal_fields(state, "throttle", state.driver_throttle, state.throttle))


def steering_report(state: KitState, _: Mechanics) -> bytes:
    """Return the steering report, which also has the car's speed."""
    order = state.actuators["steering"].order
    values = {
        "angle": UNKNOWN if "angle" in state.invalid else tenths_of_degree(state.wheel_rad),
        "command": tenths_of_degree(order.target) if order else 0,
        "speed": UNKNOWN if "speed" in state.invalid else hundredths_of_kmh(state.reported_mps("speed")),
        "torque": round(clamp(state.driver_torque_nm / 0.0625, -127, 127)),
        **flag_fields(state, "steering"),
    }
    return pack(STEERING_REPORT, values)


def gear_report(state: KitState, _: Mechanics) -> bytes:
    """Return the gear report."""
    values = {
        "gear": int(state.gear),
        "override": state.is_gear_overridden,
        "command": state.gear_order,
        "reject": int(state.gear_reject),
        "ready": not state.gear_faults,
        **dict.fromkeys(state.gear_faults, 1),
    }
    return pack(GEAR_REPORT, values)


def wheel_speeds(state: KitState, mechanics: Mechanics) -> bytes:
    """Return the report of the wheel speeds, which are all equal."""
    speed = (
        UNKNOWN
        if "wheel_speed" in state.invalid
        else round(mechanics.tyre_radps(state.reported_mps("wheel_speed")) * 100)
    )
    return pack(WHEEL_SPEEDS, dict.fromkeys((f"wheel_{index}" for index in range(4)), speed))


SPEED_MESSAGES: Final = {"speed": 0x065, "wheel_speed": 0x06A}
"""For each source of speed, the identifier of the message that reports it."""

REPORTS: dict[int, tuple[int, Callable[[KitState, Mechanics], bytes]]] = {
    0x061: (20, brake_report),
    0x063: (20, throttle_report),
    0x065: (10, steering_report),
    0x067: (100, gear_report),
    0x06A: (10, wheel_speeds),
}
"""By identifier: the period in milliseconds, and the function that encodes the report. The periods are those of
generation 2, because no periods are published for generation 1."""
