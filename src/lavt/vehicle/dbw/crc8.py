"""The CRC of Dataspeed's second generation: the CRC-8 of SAE J1850, over a frame's identifier and then its data.

Polynomial 0x1D (x^8 + x^4 + x^3 + x^2 + 1), initial value 0xFF, inverted at the end. Sources and test vectors:
`docs/can.md`.
"""

from __future__ import annotations

from lavt.vehicle.can_frame import CanFrame

_POLYNOMIAL = 0x1D
_INITIAL = 0xFF
_FINAL_XOR = 0xFF

_STANDARD_BYTES = 2  # for an 11-bit identifier
_EXTENDED_BYTES = 4  # for a 29-bit identifier


def crc8(data: bytes) -> int:
    """Return the CRC of `data`, 0 to 255."""
    register = _INITIAL
    for byte in data:
        register = _TABLE[register ^ byte]
    return register ^ _FINAL_XOR


def frame_crc8(identifier: int, data: bytes, *, extended: bool = False) -> int:
    """Return the CRC of a frame, 0 to 255, where `data` is the data before the CRC.

    With `extended` the identifier has 29 bits. Raises OverflowError for an identifier that does not fit into its bytes.
    """
    length = _EXTENDED_BYTES if extended else _STANDARD_BYTES
    return crc8(identifier.to_bytes(length, "big") + data)


def has_valid_checksum(frame: CanFrame) -> bool:
    """Return whether the last byte of a frame is its CRC; the frame must not be empty."""
    return frame.data[-1] == frame_crc8(frame.identifier, frame.data[:-1], extended=frame.is_extended)


def _table_entry(register: int) -> int:
    for _ in range(8):
        register = (register << 1 & 0xFF) ^ (_POLYNOMIAL if register & 0x80 else 0)
    return register


_TABLE = bytes(_table_entry(register) for register in range(256))
