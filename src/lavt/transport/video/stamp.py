"""The stamp: the send time of a frame, written into its pixels.

The stamp has 64 bits: nanoseconds of the server's wall clock just before encoding. It is 8 x 8 cells of 8 x 8 pixels in
the top left corner, row by row, most significant bit first, white for 1. The cells lie on the grid of H.264's
transform, so the stamp survives a low bit rate. A concealed picture can carry a stamp that is readable but wrong. The
frame's RTP timestamp, which gives the same time in 90 kHz ticks, reveals this.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lavt.domain import Picture
from lavt.errors import BadPacket, UserError

STAMP_PX = 64
"""Width and height of the stamp."""

_CELLS = 8
_CELL_PX = STAMP_PX // _CELLS
_CENTRE = slice(_CELL_PX // 4, _CELL_PX - _CELL_PX // 4)
_CENTRE_PIXELS = (_CELL_PX // 2) ** 2
_THRESHOLD = 128
_BLACK_BELOW, _WHITE_ABOVE = 64, 192  # for `has_stamp`; a codec leaves the pixels of a stamp far from both values

_BLACK, _WHITE, _NEUTRAL = 16, 235, 128  # limited range (ITU-R BT.601), to which OpenCV converts 0 and 255
_CLEARLY_BLACK, _CLEARLY_WHITE = _BLACK + (_WHITE - _BLACK) // 3, _WHITE - (_WHITE - _BLACK) // 3
_INNERMOST = (_CELL_PX // 2 - 1, _CELL_PX // 2)
"""Two pixels in the middle of a cell: each number is the offset from the cell's corner both in rows and in columns."""
_UNCLEAR = b"?"
_DIGITS = b"0" * (_CLEARLY_BLACK + 1) + _UNCLEAR * (_CLEARLY_WHITE - _CLEARLY_BLACK - 1) + b"1" * (256 - _CLEARLY_WHITE)
"""The digit of a cell for each luma."""
_BITS_OF_BYTE = np.unpackbits(np.arange(256, dtype=np.uint8)[:, None], axis=1)
_LUMA_OF_BYTE = np.where(_BITS_OF_BYTE, _WHITE, _BLACK).astype(np.uint8).repeat(_CELL_PX, axis=1)
"""(256, STAMP_PX): one row of pixels for each byte of a stamp."""

_NS_PER_100_US = 100_000
_RTP_TICKS_PER_100_US = 9


def write_stamp(picture_bgr: Picture, stamp_ns: int) -> None:
    """Write `stamp_ns` into the top left corner of `picture_bgr`, in place.

    The picture is (height, width, 3), `stamp_ns` is in [0, 2^64). Raises `UserError` for a picture that is too small.
    """
    _check_room(*picture_bgr.shape[:2])
    stamp_bytes = np.frombuffer(stamp_ns.to_bytes(8, "big"), np.uint8)
    cells = np.unpackbits(stamp_bytes) * np.uint8(255)
    rows = cells.repeat(_CELL_PX * 3).reshape(_CELLS, 1, STAMP_PX, 3)
    corner = picture_bgr[:STAMP_PX, :STAMP_PX].reshape(_CELLS, _CELL_PX, STAMP_PX, 3)
    corner[...] = rows


def write_stamp_luma(luma: NDArray[np.uint8], stamp_ns: int) -> None:
    """Write `stamp_ns` into the top left corner of a luma plane (height, width), 16 black and 235 white, in place.

    The chroma there must be 128; otherwise black and white get a colour. `stamp_ns` is in [0, 2^64). Raises `UserError`
    for a plane that is too small.
    """
    _check_room(*luma.shape)
    rows = _LUMA_OF_BYTE[np.frombuffer(stamp_ns.to_bytes(8, "big"), np.uint8)]
    luma[:STAMP_PX, :STAMP_PX].reshape(_CELLS, _CELL_PX, STAMP_PX)[...] = rows[:, None]


def write_stamp_i420(planes: NDArray[np.uint8], stamp_ns: int) -> None:
    """Write `stamp_ns` into the top left corner of an I420 picture, in place.

    The result is the same as if `write_stamp` had stamped the picture and cv2 had converted it to I420 afterwards.

    `planes` is (height * 3 // 2, width) as in OpenCV, with even sides: luma, then the U and the V plane, each
    (height / 2, width / 2) without gaps between its rows. Raises `UserError` for a picture that is too small and
    `ValueError` for an array with gaps.
    """
    if not planes.flags.c_contiguous:
        raise ValueError("an I420 picture must be one block of memory: its chroma has rows of half the width")
    height, width = planes.shape[0] * 2 // 3, planes.shape[1]
    write_stamp_luma(planes[:height], stamp_ns)
    planes[height:].reshape(2, height // 2, width // 2)[:, : STAMP_PX // 2, : STAMP_PX // 2] = _NEUTRAL


def _check_room(height: int, width: int) -> None:
    """Raise `UserError` for a picture that is smaller than the stamp."""
    if height < STAMP_PX or width < STAMP_PX:
        raise UserError(f"a picture must be at least {STAMP_PX} x {STAMP_PX} pixels for the stamp; use a larger one")


def read_stamp(luma: NDArray[np.uint8]) -> int:
    """Read the stamp from the luma plane (height, width) of a decoded picture.

    If in each cell two pixels in the middle are both clearly black or both clearly white, these pixels decide.
    Otherwise the mean of each cell's centre half decides. Do not trust the result until `stamp_agrees` has confirmed
    it. Raises
    `BadPacket` for a picture that is too small for a stamp, and for an array that is not a plane.
    """
    _check_plane(luma)
    # The innermost pixels are nearly always clear; summing the centre half takes five times as long.
    digits, digits_again = (
        luma[offset:STAMP_PX:_CELL_PX, offset:STAMP_PX:_CELL_PX].tobytes().translate(_DIGITS) for offset in _INNERMOST
    )
    if digits == digits_again and _UNCLEAR not in digits:
        return int(digits, 2)
    return _to_number(_cell_sums(luma) > _THRESHOLD * _CENTRE_PIXELS)


def read_clear_stamp(luma: NDArray[np.uint8]) -> int:
    """Read the stamp as `read_stamp` does, but only if each cell is clearly black or clearly white.

    A cell that is half old and half new is rejected. This is necessary for a foreign sender's stamps, because their
    check (`LearnedBase`) tolerates errors of milliseconds; `stamp_agrees` tolerates microseconds only. Raises
    `BadPacket` also if a cell is in the middle third between black and white.
    """
    sums = _cell_sums(luma)
    white = sums > _CLEARLY_WHITE * _CENTRE_PIXELS
    if not (white | (sums < _CLEARLY_BLACK * _CENTRE_PIXELS)).all():
        raise BadPacket("a cell of the stamp is neither black nor white")
    return _to_number(white)


def _cell_sums(luma: NDArray[np.uint8]) -> NDArray[np.uint16]:
    """Return the sum of the pixels in the centre half of each cell, (8, 8)."""
    _check_plane(luma)
    cells = luma[:STAMP_PX, :STAMP_PX].reshape(_CELLS, _CELL_PX, _CELLS, _CELL_PX)
    sums: NDArray[np.uint16] = cells[:, _CENTRE, :, _CENTRE].sum(axis=(1, 3), dtype=np.uint16)
    return sums


def _check_plane(luma: NDArray[np.uint8]) -> None:
    if luma.ndim != 2 or min(luma.shape) < STAMP_PX:
        raise BadPacket(f"a picture of shape {luma.shape} has no room for a stamp")


def _to_number(white: NDArray[np.bool_]) -> int:
    return int.from_bytes(np.packbits(white).tobytes(), "big")


def has_stamp(picture_bgr: Picture) -> bool:
    """Return whether a picture, (height, width, 3), seems to carry a stamp: 64 cells, each black or white."""
    if picture_bgr.shape[0] < STAMP_PX or picture_bgr.shape[1] < STAMP_PX:
        return False
    corner = picture_bgr[:STAMP_PX, :STAMP_PX].mean(axis=2).reshape(_CELLS, _CELL_PX, _CELLS, _CELL_PX)
    cells = corner[:, _CENTRE, :, _CENTRE]
    black, white = (cells < _BLACK_BELOW).all(axis=(1, 3)), (cells > _WHITE_ABOVE).all(axis=(1, 3))
    return bool((black | white).all() and black.any() and white.any())


def rtp_timestamp(stamp_ns: int) -> int:
    """Return the RTP timestamp of a frame stamped `stamp_ns`: 90 kHz ticks, modulo 2^32 (RFC 6184, section 5.1)."""
    return stamp_ns * _RTP_TICKS_PER_100_US // _NS_PER_100_US % 2**32


def stamp_near(rtp_timestamp_of_frame: int, near_ns: int) -> int:
    """Return the stamp of a frame from its RTP timestamp, at most 12 us too early; `near_ns` is within 6 h of it."""
    ticks = (rtp_timestamp_of_frame - rtp_timestamp(near_ns) + 2**31) % 2**32 - 2**31
    near_ticks = near_ns * _RTP_TICKS_PER_100_US // _NS_PER_100_US
    return -((near_ticks + ticks) * -_NS_PER_100_US // _RTP_TICKS_PER_100_US)


def stamp_agrees(stamp_ns: int, rtp_timestamp_of_frame: int) -> bool:
    """Return whether a stamp read from a picture is the same time as the RTP timestamp of the picture's packets.

    Two different stamps agree with the same timestamp only if they are less than 12 us, or a multiple of 13.3 h, apart.
    """
    return rtp_timestamp(stamp_ns) == rtp_timestamp_of_frame
