"""Message layouts of generation 2.

The published sources (docs/can.md) give the fields of every command in order, and most widths. Of reports they give
only the contents. `UNVERIFIED` lists the positions that we chose: they were never compared with a real kit. It is also
our choice that reports have a counter and a checksum if there is room.
"""

from __future__ import annotations

from typing import Final

from lavt.vehicle.software_car.frames import BitField, Layout

UNVERIFIED: Final = {
    **dict.fromkeys(
        (0x200, 0x201, 0x202, 0x210, 0x211, 0x212),
        "published: order and widths of the fields, checksum last; our choice: the counter in bits 48 to 51",
    ),
    **dict.fromkeys((0x203, 0x213), "published: 4-bit command first, checksum last; no counter, as none is listed"),
    0x216: "published: command, counter and checksum in this order; our assumption: 4 bits for each of the first two",
    **dict.fromkeys(
        (0x100, 0x101, 0x102, 0x103), "published: widths of the values; our choice: all positions and the pedals' steps"
    ),
    0x106: "our choice: all positions, and the codes of the reasons and of the mode",
    0x107: "our assumption: two consecutive speeds of 16 bits",
    0x2A4: "same layout as in generation 1",
    0x2D8: "our choice: all positions",
}
"""Our assumptions and choices, by identifier of the message."""

COMMAND_FIELDS = (
    BitField("type", 16, 4),
    BitField("enable", 20, 1),
    BitField("clear", 21, 1),
    BitField("ignore", 22, 1),
    BitField("count", 48, 4),
)
STEERING_COMMAND = Layout(8, (BitField("command", 0, 16, is_signed=True), *COMMAND_FIELDS, BitField("rate", 24, 8)))
PEDAL_COMMAND = Layout(8, (BitField("command", 0, 16), *COMMAND_FIELDS))
GEAR_COMMAND = Layout(4, (BitField("command", 0, 4),))
SYSTEM_COMMAND = Layout(2, (BitField("command", 0, 4), BitField("count", 4, 4)))

# `bad_crc`: a command had a wrong checksum; `bad_rc`: a command had a wrong counter ("rc" in the published sources).
FLAG_NAMES = (
    "ready",
    "enabled",
    "fault",
    "timeout",
    "bad_crc",
    "bad_rc",
    "override_active",
    "override_other",
    "override_latched",
    "external_control",
)
FLAGS = tuple(BitField(name, 40 + index, 1) for index, name in enumerate(FLAG_NAMES))
COUNT = BitField("count", 52, 4)
PEDAL_REPORT = Layout(
    8, (BitField("input", 0, 12), BitField("command", 12, 12), BitField("output", 24, 12), *FLAGS, COUNT)
)
WHEEL_SPEEDS = Layout(8, tuple(BitField(f"wheel_{index}", 16 * index, 16, is_signed=True) for index in range(4)))
REPORT_LAYOUTS: Final = {
    0x100: Layout(
        8,
        (
            BitField("angle", 0, 14, is_signed=True),
            BitField("command", 16, 14, is_signed=True),
            BitField("torque", 32, 8, is_signed=True),
            *FLAGS,
            COUNT,
        ),
    ),
    0x101: PEDAL_REPORT,
    0x102: PEDAL_REPORT,
    0x103: Layout(8, (BitField("gear", 0, 4), BitField("command", 4, 4), *FLAGS, COUNT)),
    0x106: Layout(
        8,
        (
            BitField("state", 0, 4),
            BitField("sync_mode", 4, 4),
            BitField("reason_disengage", 8, 8),
            BitField("reason_not_ready", 16, 8),
            COUNT,
        ),
    ),
    0x107: Layout(
        8,
        (
            # Two measurements of the car's speed: by the brakes, and by the propulsion.
            BitField("by_brakes", 0, 16, is_signed=True),
            BitField("by_propulsion", 16, 16, is_signed=True),
            BitField("direction_source", 32, 4),
            COUNT,
        ),
    ),
    0x2A4: WHEEL_SPEEDS,
    0x2D8: Layout(8, (BitField("mode", 0, 4), BitField("state", 4, 4), COUNT)),
}
