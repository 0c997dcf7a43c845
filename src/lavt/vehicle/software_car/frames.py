"""The bits of CAN frames, and their checksum."""

from __future__ import annotations

from lavt.value import value
from lavt.vehicle.can_frame import CanFrame


@value
class Field:
    """Bits of a message: the lowest is `bit` of the message taken as one little-endian number."""

    name: str
    bit: int
    width: int
    is_signed: bool = False

    @property
    def least(self) -> int:
        """The smallest number that fits."""
        return -(1 << self.width - 1) if self.is_signed else 0

    @property
    def most(self) -> int:
        """The greatest number that fits."""
        return (1 << self.width - 1) - 1 if self.is_signed else (1 << self.width) - 1


@value
class Layout:
    """What a message is made of."""

    length: int
    """In bytes."""
    fields: tuple[Field, ...]


def pack(layout: Layout, values: dict[str, int]) -> bytes:
    """Put numbers into a message; a field that is not named is 0, a number out of range becomes the nearest in range.

    Raises `KeyError` for a name that the layout has not.
    """
    left, number = dict(values), 0
    for field in layout.fields:
        inside = min(max(left.pop(field.name, 0), field.least), field.most)
        number |= (inside & (1 << field.width) - 1) << field.bit
    if left:
        raise KeyError(", ".join(left))
    return number.to_bytes(layout.length, "little")


def unpack(layout: Layout, data: bytes) -> dict[str, int]:
    """Take the numbers out of a message of the layout's length."""
    number = int.from_bytes(data, "little")
    values: dict[str, int] = {}
    for field in layout.fields:
        bits = number >> field.bit & (1 << field.width) - 1
        values[field.name] = bits - (1 << field.width) if field.is_signed and bits > field.most else bits
    return values


def crc8(data: bytes) -> int:
    """Give the CRC-8 of SAE J1850: polynomial 0x1D, begun with 0xFF, inverted at the end."""
    remainder = 0xFF
    for byte in data:
        remainder ^= byte
        for _ in range(8):
            remainder = (remainder << 1 ^ 0x1D) & 0xFF if remainder & 0x80 else remainder << 1
    return remainder ^ 0xFF


def checksum(identifier: int, data: bytes, *, is_extended: bool = False) -> int:
    """Give the CRC-8 over an identifier, high byte first (2 bytes, extended 4), and the data before it."""
    return crc8(identifier.to_bytes(4 if is_extended else 2, "big") + data)


def with_crc(identifier: int, data: bytes) -> bytes:
    """Write the checksum into the last byte of a message with an 11-bit identifier."""
    return data[:-1] + bytes([checksum(identifier, data[:-1])])


def has_crc(frame: CanFrame) -> bool:
    """Tell whether the last byte is the right checksum."""
    return bool(frame.data) and frame.data[-1] == checksum(
        frame.identifier, frame.data[:-1], is_extended=frame.is_extended
    )
