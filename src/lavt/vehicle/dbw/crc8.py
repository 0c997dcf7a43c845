"""The CRC of Dataspeed's second generation: SAE J1850, over a frame's identifier and then its data.

Polynomial 0x1D (x^8 + x^4 + x^3 + x^2 + 1), register 0xFF at the start, inverted once at the end. Facts and
vectors: `docs/can.md`.
"""

from __future__ import annotations

_POLYNOMIAL = 0x1D
_START = 0xFF
_INVERT = 0xFF

_STANDARD_BYTES = 2  # an identifier of 11 bits
_EXTENDED_BYTES = 4  # one of 29


def crc8(data: bytes) -> int:
    """The CRC of bytes, 0 to 255."""
    register = _START
    for byte in data:
        register = _AFTER[register ^ byte]
    return register ^ _INVERT


def frame_crc8(identifier: int, data: bytes, *, extended: bool = False) -> int:
    """The CRC of a frame, 0 to 255: `data` is what stands before it. `extended` says that the identifier has 29 bits.

    Raises OverflowError where the identifier does not fit into its bytes.
    """
    length = _EXTENDED_BYTES if extended else _STANDARD_BYTES
    return crc8(identifier.to_bytes(length, "big") + data)


def _shifted_eight_times(register: int) -> int:
    for _ in range(8):
        register = (register << 1 & 0xFF) ^ (_POLYNOMIAL if register & 0x80 else 0)
    return register


_AFTER = bytes(_shifted_eight_times(register) for register in range(256))
