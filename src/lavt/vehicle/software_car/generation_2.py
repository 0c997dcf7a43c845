"""The messages of Dataspeed's kits of generation 2: decoding of commands, and encoding of reports."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from lavt.vehicle.can_frame import CanFrame
from lavt.vehicle.software_car.frames import has_valid_crc, pack, unpack, with_crc
from lavt.vehicle.software_car.generation_2_layouts import (
    GEAR_COMMAND,
    PEDAL_COMMAND,
    REPORT_LAYOUTS,
    STEERING_COMMAND,
    SYSTEM_COMMAND,
    WHEEL_SPEEDS,
)
from lavt.vehicle.software_car.mechanics import (
    Mechanics,
    clamp,
    commanded_wheel_rad,
    hundredths_of_kmh,
    tenths_of_degree,
)
from lavt.vehicle.software_car.state import (
    AXES,
    Axis,
    AxisOrder,
    GearOrder,
    KitState,
    ReleaseReason,
    SystemOrder,
)

USER_SET, REMOTE_SET = 0x210, 0x200
"""The first identifier of each command set."""
PARTS: Final[tuple[Axis | None, ...]] = ("steering", "brake", "throttle", None)
"""The parts to which the successive identifiers of a command set belong; None is the gearbox."""
SYSTEM_COMMAND_ID = 0x216
UNKNOWN: Final = -0x8000
"""Value of a 16-bit field whose quantity is unknown."""
UNKNOWN_ANGLE: Final = -0x2000
"""Value of the 14-bit field of the steering wheel's angle if the angle is unknown."""

ALL_OR_NONE = 2
"""Code of the third published mode of synchronisation; the code is our choice."""
ANGLE, PERCENT = 2, 14
"""The command types that the kit accepts; more types are published."""
FULL_PEDAL = {"brake": 10_000, "throttle": 4_000}
"""The value of a percent command for a full pedal; a step is 0.01 % of the brake and 0.025 % of the throttle."""

FAULTS: dict[str, tuple[str, ...]] = {
    "steering": ("fault",),
    "brake": ("fault",),
    "throttle": ("fault",),
    "gear": ("fault",),
}


def parse_order(frame: CanFrame, mechanics: Mechanics, is_remote: bool) -> AxisOrder | GearOrder | SystemOrder | None:
    """Parse an order, or return None for a frame that is not for the kit or belongs to the other command set."""
    if frame.is_extended:
        return None
    if frame.identifier == SYSTEM_COMMAND_ID and len(frame.data) == SYSTEM_COMMAND.length:
        requested = unpack(SYSTEM_COMMAND, frame.data)
        return SystemOrder(has_valid_crc(frame), requested["command"], requested["count"])
    part = frame.identifier - (REMOTE_SET if is_remote else USER_SET)
    if not 0 <= part < len(PARTS):
        return None
    axis = PARTS[part]
    layout = GEAR_COMMAND if axis is None else STEERING_COMMAND if axis == "steering" else PEDAL_COMMAND
    if len(frame.data) != layout.length:
        return None
    requested = unpack(layout, frame.data)
    if axis is None:
        return GearOrder(has_valid_crc(frame), requested["command"])
    if axis == "steering":
        is_known, target = requested["type"] == ANGLE, commanded_wheel_rad(requested["command"])
    else:
        is_known, target = requested["type"] == PERCENT, clamp(requested["command"] / FULL_PEDAL[axis], 0.0, 1.0)
    return AxisOrder(
        axis,
        is_valid=has_valid_crc(frame),
        target=target,
        is_enabling=bool(requested["enable"]) and is_known,
        is_clearing=bool(requested["clear"]),
        ignores_driver=bool(requested["ignore"]),
        rate_radps=mechanics.rate_radps(requested.get("rate", 0), 4.0),
        count=requested["count"],
    )


def flag_fields(state: KitState, axis: Axis) -> dict[str, int]:
    """Return the flags that the reports of all three axes have."""
    actuator = state.actuators[axis]
    other_actuators = (state.actuators[other_axis] for other_axis in AXES if other_axis != axis)
    return {
        "ready": not (actuator.faults or actuator.is_overridden or actuator.driver_acts),
        "enabled": actuator.is_enabled,
        "fault": bool(actuator.faults),
        "timeout": actuator.has_timed_out,
        "bad_crc": actuator.is_crc_bad,
        "bad_rc": actuator.is_count_bad,
        "override_active": actuator.driver_acts,
        "override_other": state.is_gear_overridden or any(other.is_overridden for other in other_actuators),
        "override_latched": actuator.is_overridden,
        "external_control": actuator.is_enabled,
    }


def steering_report(state: KitState, _: Mechanics) -> dict[str, int]:
    """Return the fields of the steering report."""
    order = state.actuators["steering"].order
    return {
        "angle": UNKNOWN_ANGLE if "angle" in state.invalid else tenths_of_degree(state.wheel_rad),
        "command": tenths_of_degree(order.target) if order else 0,
        "torque": round(state.driver_torque_nm / 0.0625),
        **flag_fields(state, "steering"),
    }


def pedal_report(axis: Axis, state: KitState, driver: float, output: float) -> dict[str, int]:
    """Return the fields of a pedal's report, in steps of 0.025 %."""
    order = state.actuators[axis].order
    return {
        "input": round(driver * 4_000),
        "command": round(order.target * 4_000) if order else 0,
        "output": round(output * 4_000),
        **flag_fields(state, axis),
    }


def gear_report(state: KitState, _: Mechanics) -> dict[str, int]:
    """Return the fields of the gear report."""
    return {
        "gear": int(state.gear),
        "command": state.gear_order,
        "ready": not state.gear_faults,
        "fault": bool(state.gear_faults),
        "override_latched": state.is_gear_overridden,
    }


def reason_code(reason: ReleaseReason) -> int:
    """Return a reason's code, or 0 for a reason that a kit does not report."""
    return reason if reason <= ReleaseReason.LOCKOUT_REVERSE else 0


def system_report(state: KitState, _: Mechanics) -> dict[str, int]:
    """Return the fields of the system report."""
    return {
        "state": int(state.system),
        "reason_disengage": reason_code(state.disengage_reason),
        "reason_not_ready": reason_code(state.not_ready_reason),
        "sync_mode": ALL_OR_NONE,
    }


def velocity_report(state: KitState, _: Mechanics) -> dict[str, int]:
    """Return the fields of the velocity report."""
    if "speed" in state.invalid:
        return {"by_brakes": UNKNOWN, "by_propulsion": UNKNOWN}
    return {
        "by_brakes": hundredths_of_kmh(state.reported_mps("speed")),
        "by_propulsion": hundredths_of_kmh(state.reported_mps("second_speed")),
    }


def wheel_speeds(state: KitState, mechanics: Mechanics) -> dict[str, int]:
    """Return the fields of the report of wheel speeds, which are all equal."""
    speed = (
        UNKNOWN
        if "wheel_speed" in state.invalid
        else round(mechanics.tyre_radps(state.reported_mps("wheel_speed")) * 100)
    )
    return dict.fromkeys((f"wheel_{index}" for index in range(4)), speed)


def remote_report(state: KitState, _: Mechanics) -> dict[str, int]:
    """Return the fields of the remote report: the state of the remote's switch."""
    return {"state": state.remote_state}


def report_encoder(
    identifier: int, make_fields: Callable[[KitState, Mechanics], dict[str, int]]
) -> Callable[[KitState, Mechanics], bytes]:
    """Return a function that encodes a report, with a counter and a checksum if there is room."""
    layout = REPORT_LAYOUTS[identifier]
    if layout == WHEEL_SPEEDS:  # no room: the four speeds take all 8 bytes
        return lambda state, mechanics: pack(layout, make_fields(state, mechanics))

    def report(state: KitState, mechanics: Mechanics) -> bytes:
        count = {"count": state.sent.get(identifier, 0) % 16}
        return with_crc(identifier, pack(layout, make_fields(state, mechanics) | count))

    return report


SPEED_MESSAGES: Final = {"speed": 0x107, "second_speed": 0x107, "wheel_speed": 0x2A4}
"""For each source of speed, the identifier of the message that reports it."""

REPORTS: dict[int, tuple[int, Callable[[KitState, Mechanics], bytes]]] = {
    identifier: (period_ms, report_encoder(identifier, make_fields))
    for identifier, (period_ms, make_fields) in {
        0x100: (10, steering_report),
        0x101: (20, lambda state, _: pedal_report("brake", state, state.driver_brake, state.brake)),
        0x102: (20, lambda state, _: pedal_report("throttle", state, state.driver_throttle, state.throttle)),
        0x103: (100, gear_report),
        0x106: (100, system_report),
        0x107: (20, velocity_report),
        0x2A4: (10, wheel_speeds),
        0x2D8: (100, remote_report),
    }.items()
}
"""By identifier: the period in milliseconds, and the function that encodes the report."""
