"""How a picture gets its stamp, becomes an access unit, and comes back: as H.264, or in virtual time by a shorter way.

What stands for H.264 on the two shorter ways is one small access unit that needs no other: RTP packets, order, delay
and loss act on it as on video. It is text, which holds neither a start code nor a zero byte.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable
from typing import Any, Final, Protocol

import numpy as np
from numpy.typing import NDArray

from lavt.domain import FramePayload, Lane, Picture, SeenLane
from lavt.errors import BadPacket
from lavt.transport.video.h264 import DecodedPicture, Decoder, Encoder
from lavt.transport.video.stamp import STAMP_PX, read_stamp, write_stamp, write_stamp_i420
from lavt.value import value

_STANDS_ALONE: Final = b"\x00\x00\x00\x01\x09\xf0\x00\x00\x00\x01\x65"
"""An access unit delimiter, and the header of a slice that refers to nothing (H.264, table 7-1)."""
_LANE: Final = struct.Struct("!Qq7d")
Planes = NDArray[np.uint8]
"""A picture in I420: (height * 3 / 2, width), the luma first."""
LEAST_BIT_RATE_BPS: Final = 50_000
"""Whatever is asked for: below it is no picture that anybody could drive by."""
CHECKED_ROWS: Final = 16
KEPT_PICTURES: Final = 300
"""Pictures that are on their way at most: 10 s of them at 30 Hz, and 280 MB."""


class ReceivedPicture(Protocol):
    """What came of an access unit."""

    @property
    def picture(self) -> FramePayload:
        """What a detector looks at; it may be made only now."""
        ...

    @property
    def corrupt(self) -> bool:
        """Parts of it were made up."""
        ...


class PictureSender(Protocol):
    """The camera's end."""

    def prepare(self, picture: FramePayload) -> tuple[FramePayload, int]:
        """Give what the stamp goes into, and a number that tells the picture, without it, from the one before."""
        ...

    def write_stamp(self, prepared: FramePayload, stamp_ns: int) -> FramePayload:
        """Put the stamp into the picture, in place where it is pixels, and return it."""
        ...

    def encode(self, stamped: FramePayload, *, keyframe: bool) -> bytes:
        """Make an access unit of a stamped picture; a keyframe where one is asked for."""
        ...

    def limit_bit_rate(self, limit_bps: int | None) -> None:
        """Keep to a bit rate from the next picture on, where what is sent has one; None: to its own."""
        ...


class PictureReceiver(Protocol):
    """The driver's end."""

    def decode(self, access_unit: bytes) -> ReceivedPicture | None:
        """Give the picture of an access unit; None when there is none."""
        ...

    def read_stamp(self, received: Any) -> int:
        """Read the stamp of what `decode` gave; raises `BadPacket` for a picture that cannot be looked at."""
        ...


class VideoSender:
    """Converts pictures to I420 in a buffer that is used again, stamps them there, and encodes them as H.264.

    Those of a camera that gives I420 itself are stamped and encoded where they are.
    """

    def __init__(self, encoder: Encoder) -> None:
        self._encoder = encoder
        self._bit_rate_bps = encoder.bit_rate_bps

    def prepare(self, picture: Picture) -> tuple[Planes, int]:
        """Convert the picture where it is not in I420 already; the number is a CRC-32 of its luma below the stamp.

        That of every sixteenth row: a live camera's noise is in each of them, and a frozen one's pixels change in none.
        """
        planes = picture if picture.ndim == 2 else self._encoder.to_planes(picture)
        return planes, zlib.crc32(planes[STAMP_PX : planes.shape[0] * 2 // 3 : CHECKED_ROWS].tobytes())

    def write_stamp(self, prepared: Planes, stamp_ns: int) -> Planes:
        """Write the stamp into the planes."""
        write_stamp_i420(prepared, stamp_ns)
        return prepared

    def encode(self, stamped: Planes, *, keyframe: bool) -> bytes:
        """Encode one picture."""
        return self._encoder.encode_planes(stamped, keyframe=keyframe)

    def limit_bit_rate(self, limit_bps: int | None) -> None:
        """Keep to the lower one of the limit and the encoder's own bit rate, and to the least one at least."""
        wanted_bps = self._bit_rate_bps if limit_bps is None else min(limit_bps, self._bit_rate_bps)
        self._encoder.set_bit_rate(max(wanted_bps, LEAST_BIT_RATE_BPS))


class VideoReceiver:
    """Decodes H.264; pictures must be of the `shape` that was configured, (height, width); None: of any.

    `read` reads the stamp from the luma: `read_stamp`, or `read_clear_stamp` for a check that is weaker.
    """

    def __init__(
        self,
        decoder: Decoder,
        shape: tuple[int, int] | None,
        read: Callable[[NDArray[np.uint8]], int] = read_stamp,
    ) -> None:
        self._decoder = decoder
        self._shape = shape
        self._read = read

    def decode(self, access_unit: bytes) -> DecodedPicture | None:
        """Decode one access unit."""
        return self._decoder.decode(access_unit)

    def read_stamp(self, received: DecodedPicture) -> int:
        """Read the stamp from the luma."""
        if self._shape is not None and received.luma.shape != self._shape:
            height_px, width_px = received.luma.shape
            raise BadPacket(f"a picture of {width_px} x {height_px} pixels, which is not what was configured")
        return self._read(received.luma)


@value
class RenderedPicture:
    """A picture as it was rendered."""

    picture: Picture
    corrupt: bool = False


class InMemoryFrameCodec:
    """Both ends for pictures as they were rendered: the access unit is a key, the pixels wait here until it arrives.

    Access units arrive in order: what is older than one that arrived was lost, and goes.
    """

    def __init__(self) -> None:
        self._pictures: dict[int, Picture] = {}
        self._key = 0

    def prepare(self, picture: Picture) -> tuple[Picture, int]:
        """Take the picture itself: a camera that gives the same buffer again gives it with its stamp.

        The number is a CRC-32 of the pixels around the stamp.
        """
        crc = zlib.crc32(np.ascontiguousarray(picture[STAMP_PX:]).data)
        return picture, zlib.crc32(np.ascontiguousarray(picture[:STAMP_PX, STAMP_PX:]).data, crc)

    def write_stamp(self, prepared: Picture, stamp_ns: int) -> Picture:
        """Write the stamp into the pixels."""
        write_stamp(prepared, stamp_ns)
        return prepared

    def encode(self, stamped: Picture, *, keyframe: bool) -> bytes:  # noqa: ARG002 (each one is)
        """Keep a copy of the picture, as a camera may use its buffer again, and give its key."""
        self._key += 1
        self._pictures[self._key] = stamped.copy()
        self._pictures.pop(self._key - KEPT_PICTURES, None)
        return _STANDS_ALONE + str(self._key).encode()

    def limit_bit_rate(self, limit_bps: int | None) -> None:
        """There is none."""

    def decode(self, access_unit: bytes) -> RenderedPicture | None:
        """Give the picture of a key."""
        text = access_unit.removeprefix(_STANDS_ALONE)
        key = int(text) if text.isdigit() else 0
        picture = self._pictures.get(key)
        if picture is None:
            return None
        self._pictures = {each: kept for each, kept in self._pictures.items() if each > key}
        return RenderedPicture(picture)

    def read_stamp(self, received: RenderedPicture) -> int:
        """Read the stamp: black and white are so in each colour, green is as good as luma."""
        return read_stamp(received.picture[:, :, 1])


@value
class ReceivedLane:
    """A lane that came in the place of a picture."""

    picture: SeenLane
    corrupt: bool = False


class LaneSender:
    """Puts the lane itself into the access unit, with its stamp and time: no pixels."""

    def prepare(self, picture: SeenLane) -> tuple[SeenLane, int]:
        """Take its time for the number: the noise of two differs, even where the car stands; these differ by time."""
        return picture, picture.at_ns & 0xFFFFFFFF

    def write_stamp(self, prepared: SeenLane, stamp_ns: int) -> SeenLane:
        """Give the same with the stamp."""
        return SeenLane(stamp_ns, prepared.at_ns, prepared.lane)

    def encode(self, stamped: SeenLane, *, keyframe: bool) -> bytes:  # noqa: ARG002 (each one is)
        """Write it in hexadecimal digits."""
        return _STANDS_ALONE + _packed(stamped).hex().encode()

    def limit_bit_rate(self, limit_bps: int | None) -> None:
        """There is none."""


class LaneReceiver:
    """Takes a lane out of its access unit."""

    def decode(self, access_unit: bytes) -> ReceivedLane | None:
        """Read the digits; None where they are not those of a lane."""
        try:
            packed = bytes.fromhex(access_unit.removeprefix(_STANDS_ALONE).decode())
            stamp_ns, at_ns, c0, c1, c2, *rest = _LANE.unpack(packed)
        except (ValueError, struct.error):
            return None
        return ReceivedLane(SeenLane(stamp_ns, at_ns, Lane((c0, c1, c2), *rest)))

    def read_stamp(self, received: ReceivedLane) -> int:
        """Give the stamp."""
        return received.picture.stamp_ns


def _packed(seen: SeenLane) -> bytes:
    lane = seen.lane
    return _LANE.pack(seen.stamp_ns, seen.at_ns, *lane.centre, lane.width_m, lane.near_m, lane.far_m, lane.confidence)
