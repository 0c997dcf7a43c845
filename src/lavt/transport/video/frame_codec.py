"""Codecs that stamp a picture, encode it as an access unit and decode it: H.264, and two shortcuts for virtual time.

A shortcut replaces the H.264 data of a picture by one small access unit that depends on no other. RTP sender, network
and receiver treat it like video, with delay, reordering and loss. It begins like a keyframe of H.264 (`_IDR_PREFIX`).
The rest is ASCII digits, which never look like a start code and have no zero bytes, which RTP would cut off.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable
from typing import Any, Final, Protocol

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from lavt.domain import FramePayload, Lane, Picture, ReceivedPicture, SeenLane
from lavt.errors import BadPacket
from lavt.transport.video.h264 import DecodedPicture, Decoder, Encoder
from lavt.transport.video.stamp import STAMP_PX, read_stamp, write_stamp, write_stamp_i420

_IDR_PREFIX: Final = b"\x00\x00\x00\x01\x09\xf0\x00\x00\x00\x01\x65"
"""An access unit delimiter, and the header of an IDR slice (H.264, table 7-1): a slice that refers to no other
picture."""
_LANE: Final = struct.Struct("!Qq7d")
"""A lane in an access unit: stamp, `at_ns`, and the seven numbers of the lane in the order of `_pack`."""
Planes = NDArray[np.uint8]
"""A picture in I420: (height * 3 / 2, width), luma first."""
MIN_BIT_RATE_BPS: Final = 50_000
"""A lower limit of the receiver is raised to this bit rate, because nobody could drive with a worse picture."""
CHECKSUM_ROW_STEP: Final = 16
"""The checksum of a picture covers every sixteenth row."""
MAX_STORED_PICTURES: Final = 300
"""Largest number of pictures in transit: 10 s at 30 Hz, and 280 MB."""


class PictureSender(Protocol):
    """The codec at the camera's end."""

    def prepare(self, picture: FramePayload) -> tuple[FramePayload, int]:
        """Return the picture to stamp, and a checksum of the picture without its stamp."""
        ...

    def write_stamp(self, prepared: FramePayload, stamp_ns: int) -> FramePayload:
        """Write the stamp into the picture, in place if it consists of pixels, and return it."""
        ...

    def encode(self, stamped: FramePayload, *, keyframe: bool) -> bytes:
        """Encode a stamped picture as an access unit, on request as a keyframe."""
        ...

    def limit_bit_rate(self, limit_bps: int | None) -> None:
        """Limit the bit rate from the next picture on, if the codec has a bit rate; None: use the configured rate."""
        ...


class PictureReceiver(Protocol):
    """The codec at the driver's end."""

    def decode(self, access_unit: bytes) -> ReceivedPicture | None:
        """Return the picture of an access unit, or None if no picture can be decoded."""
        ...

    def read_stamp(self, received: Any) -> int:
        """Read the stamp of a decoded picture; raises `BadPacket` for a picture that cannot have one."""
        ...


class VideoSender:
    """An H.264 sender that converts pictures to I420 in a reused buffer, stamps them there and encodes them.

    Pictures that a camera delivers in I420 are stamped and encoded in place.
    """

    def __init__(self, encoder: Encoder) -> None:
        self._encoder = encoder
        self._bit_rate_bps = encoder.bit_rate_bps

    def prepare(self, picture: Picture) -> tuple[Planes, int]:
        """Convert to I420 unless the picture already is I420; the checksum is a CRC-32 of the luma below the stamp.

        The checksum covers every sixteenth row, which is enough to detect a frozen camera: a live camera's noise
        changes each row.
        """
        planes = picture if picture.ndim == 2 else self._encoder.to_planes(picture)
        return planes, zlib.crc32(planes[STAMP_PX : planes.shape[0] * 2 // 3 : CHECKSUM_ROW_STEP].tobytes())

    def write_stamp(self, prepared: Planes, stamp_ns: int) -> Planes:
        """Write the stamp into the planes."""
        write_stamp_i420(prepared, stamp_ns)
        return prepared

    def encode(self, stamped: Planes, *, keyframe: bool) -> bytes:
        """Encode one picture."""
        return self._encoder.encode_planes(stamped, keyframe=keyframe)

    def limit_bit_rate(self, limit_bps: int | None) -> None:
        """Use the lower of the limit and the configured bit rate, but at least `MIN_BIT_RATE_BPS`."""
        bit_rate_bps = self._bit_rate_bps if limit_bps is None else min(limit_bps, self._bit_rate_bps)
        self._encoder.set_bit_rate(max(bit_rate_bps, MIN_BIT_RATE_BPS))


class VideoReceiver:
    """An H.264 receiver for pictures of the configured `shape`, (height, width); None: of any shape.

    `read` reads the stamp from the luma. It is `read_stamp` for LAVT's own sender, whose RTP timestamps confirm each
    stamp with a tolerance of 12 us. For a foreign sender it is `read_clear_stamp`, because the check of its stamps has
    a tolerance of milliseconds, and a cell that is half old and half new could pass that check.
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
            raise BadPacket(f"a picture of {width_px} x {height_px} pixels: not the configured size")
        return self._read(received.luma)


class RenderedPicture(Struct, frozen=True):
    """A received picture that is exactly the rendered picture."""

    picture: Picture
    corrupt: bool = False


class InMemoryFrameCodec:
    """Both ends of a codec that keeps the rendered pictures in memory; the access unit is a key to them.

    Access units arrive in order, so when one has arrived, all older pictures were lost and are dropped.
    """

    def __init__(self) -> None:
        self._pictures: dict[int, Picture] = {}
        self._key = 0

    def prepare(self, picture: Picture) -> tuple[Picture, int]:
        """Return the picture itself, and a CRC-32 of all pixels outside of the stamp.

        A camera that reuses its buffer can deliver a picture with the previous stamp in it.
        """
        crc = zlib.crc32(np.ascontiguousarray(picture[STAMP_PX:]).data)
        return picture, zlib.crc32(np.ascontiguousarray(picture[:STAMP_PX, STAMP_PX:]).data, crc)

    def write_stamp(self, prepared: Picture, stamp_ns: int) -> Picture:
        """Write the stamp into the pixels."""
        write_stamp(prepared, stamp_ns)
        return prepared

    def encode(self, stamped: Picture, *, keyframe: bool) -> bytes:  # noqa: ARG002 (every access unit is a keyframe)
        """Store a copy of the picture, because the camera can reuse its buffer, and return its key."""
        self._key += 1
        self._pictures[self._key] = stamped.copy()
        self._pictures.pop(self._key - MAX_STORED_PICTURES, None)
        return _IDR_PREFIX + str(self._key).encode()

    def limit_bit_rate(self, limit_bps: int | None) -> None:
        """Do nothing: this codec has no bit rate."""

    def decode(self, access_unit: bytes) -> RenderedPicture | None:
        """Return the picture of the key in an access unit; each picture is returned once."""
        text = access_unit.removeprefix(_IDR_PREFIX)
        key = int(text) if text.isdigit() else 0
        picture = self._pictures.get(key)
        if picture is None:
            return None
        self._pictures = {stored_key: stored for stored_key, stored in self._pictures.items() if stored_key > key}
        return RenderedPicture(picture)

    def read_stamp(self, received: RenderedPicture) -> int:
        """Read the stamp from the green channel: black and white are the same in each colour."""
        return read_stamp(received.picture[:, :, 1])


class ReceivedLane(Struct, frozen=True):
    """A lane that was received instead of a picture."""

    picture: SeenLane
    """The lane; named as in `ReceivedPicture`."""
    corrupt: bool = False


class LaneSender:
    """A sender that writes a lane, with stamp and time, into the access unit instead of a picture."""

    def prepare(self, picture: SeenLane) -> tuple[SeenLane, int]:
        """Return the lane, and its time as the checksum.

        The checksum must change with each frame even if the car is stationary: in pictures noise changes it.
        """
        return picture, picture.at_ns & 0xFFFFFFFF

    def write_stamp(self, prepared: SeenLane, stamp_ns: int) -> SeenLane:
        """Return a copy of the lane with the stamp."""
        return SeenLane(stamp_ns, prepared.at_ns, prepared.lane)

    def encode(self, stamped: SeenLane, *, keyframe: bool) -> bytes:  # noqa: ARG002 (every access unit is a keyframe)
        """Encode the lane in hexadecimal digits."""
        return _IDR_PREFIX + _pack(stamped).hex().encode()

    def limit_bit_rate(self, limit_bps: int | None) -> None:
        """Do nothing: this codec has no bit rate."""


class LaneReceiver:
    """A receiver that reads the lane from an access unit of `LaneSender`."""

    def decode(self, access_unit: bytes) -> ReceivedLane | None:
        """Decode a lane; return None if the access unit does not contain a lane."""
        try:
            packed = bytes.fromhex(access_unit.removeprefix(_IDR_PREFIX).decode())
            stamp_ns, at_ns, c0, c1, c2, *rest = _LANE.unpack(packed)
        except (ValueError, struct.error):
            return None
        return ReceivedLane(SeenLane(stamp_ns, at_ns, Lane((c0, c1, c2), *rest)))

    def read_stamp(self, received: ReceivedLane) -> int:
        """Return the stamp."""
        return received.picture.stamp_ns


def _pack(seen: SeenLane) -> bytes:
    lane = seen.lane
    return _LANE.pack(seen.stamp_ns, seen.at_ns, *lane.centre, lane.width_m, lane.near_m, lane.far_m, lane.confidence)
