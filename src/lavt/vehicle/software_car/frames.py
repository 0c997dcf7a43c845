"""Packing of CAN frames, and their checksum."""

from __future__ import annotations

from msgspec import Struct

from lavt.vehicle.can_frame import CanFrame


class BitField(Struct, frozen=True):
    """A bit field of a message."""

    name: str
    bit: int
    """The field's lowest bit, counted in the message as one little-endian number."""
    width: int
    is_signed: bool = False

    @property
    def lowest_value(self) -> int:
        """The lowest value of the field."""
        return -(1 << self.width - 1) if self.is_signed else 0

    @property
    def highest_value(self) -> int:
        """The highest value of the field."""
        return (1 << self.width - 1) - 1 if self.is_signed else (1 << self.width) - 1


class Layout(Struct, frozen=True):
    """The fields of a message."""

    length: int
    """In bytes."""
    fields: tuple[BitField, ...]


def pack(layout: Layout, values: dict[str, int]) -> bytes:
    """Encode a message. Missing fields are 0, and values out of range are clamped.

    Raises `KeyError` for a name that is not in the layout.
    """
    remaining, number = dict(values), 0
    for field in layout.fields:
        clamped = min(max(remaining.pop(field.name, 0), field.lowest_value), field.highest_value)
        number |= (clamped & (1 << field.width) - 1) << field.bit
    if remaining:
        raise KeyError(", ".join(remaining))
    return number.to_bytes(layout.length, "little")


def unpack(layout: Layout, data: bytes) -> dict[str, int]:
    """Decode a message, whose length must be that of the layout."""
    number = int.from_bytes(data, "little")
    values: dict[str, int] = {}
    for field in layout.fields:
        bits = number >> field.bit & (1 << field.width) - 1
        values[field.name] = bits - (1 << field.width) if field.is_signed and bits > field.highest_value else bits
    return values


def crc8(data: bytes) -> int:
    """Return the CRC-8 of SAE J1850: polynomial 0x1D, initial value 0xFF, inverted at the end."""
    remainder = 0xFF
    for byte in data:
        remainder ^= byte
        for _ in range(8):
            remainder = (remainder << 1 ^ 0x1D) & 0xFF if remainder & 0x80 else remainder << 1
    return remainder ^ 0xFF


def checksum(identifier: int, data: bytes, *, is_extended: bool = False) -> int:
    """Return the CRC-8 over an identifier and `data`, the bytes before the checksum.

    The identifier has 2 bytes, or 4 if it is extended, the high byte first.
    """
    return crc8(identifier.to_bytes(4 if is_extended else 2, "big") + data)


def with_crc(identifier: int, data: bytes) -> bytes:
    """Return a message with an 11-bit identifier whose last byte is replaced by the checksum."""
    return data[:-1] + bytes([checksum(identifier, data[:-1])])


def has_valid_crc(frame: CanFrame) -> bool:
    """Return whether the last byte is the frame's checksum."""
    return bool(frame.data) and frame.data[-1] == checksum(
        frame.identifier, frame.data[:-1], is_extended=frame.is_extended
    )
