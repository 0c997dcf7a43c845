"""H.264 encoder and decoder: one access unit for each picture, without a frame of delay on either side.

This module uses PyAV (libx264 and FFmpeg's decoder). The encoder uses constrained baseline, no look-ahead
and a constant bit rate with a small decoder buffer (VBV), so that no frame is much larger than its share. The decoder
uses one thread, since each of FFmpeg's frame threads adds one frame of delay.
"""

from __future__ import annotations

from fractions import Fraction
from typing import Final, cast

import av
import av.logging
import cv2
import numpy as np
from av.codec.context import Flags, ThreadType
from av.video.codeccontext import VideoCodecContext
from av.video.frame import PictureType, VideoFrame
from numpy.typing import NDArray

from lavt.domain import Picture
from lavt.errors import UserError
from lavt.transport.rtp.rtp import split_nal_units

_MIN_SIDE_PX: Final = 64
_MAX_DECODED_PX: Final = 4096 * 2304
"""The largest picture that the decoder accepts, so that a forged parameter set cannot make it allocate more memory."""
_KEYFRAME_NAL_TYPES: Final = {5, 7, 8}
"""An IDR slice, a sequence and a picture parameter set (H.264, table 7-1)."""
_PRESETS: Final = ("ultrafast", "superfast", "veryfast", "faster", "fast", "medium", "slow", "slower", "veryslow")

# FFmpeg's messages about a damaged stream are not needed, because the caller counts damage. Nor is libx264's summary.
av.logging.set_level(None)
# OpenCV's threads wait for more work by spinning: 1.5 ms of CPU time for each picture converted (measured).
cv2.setNumThreads(1)


class Encoder:
    """An H.264 encoder of one stream of pictures (libx264); its output is byte-for-byte reproducible.

    Over any period of `buffer_s` the stream keeps to `bit_rate_bps`. A keyframe comes every `gop_frames` and on
    request, each with its parameter sets in band. Each of several `threads` encodes a slice of every picture, so that
    no picture waits for another. Raises `UserError` for settings that are not possible.
    """

    def __init__(
        self,
        width_px: int,
        height_px: int,
        *,
        rate_hz: float,
        bit_rate_bps: int,
        gop_frames: int,
        preset: str = "ultrafast",
        buffer_s: float = 0.1,
        threads: int = 1,
    ) -> None:
        _check_size(width_px, height_px)
        _check_rates(rate_hz, bit_rate_bps, gop_frames, buffer_s)
        if preset not in _PRESETS:
            raise UserError(f"libx264 has no preset {preset!r}: choose one of {', '.join(_PRESETS)}")
        if not 1 <= threads <= 16:
            raise UserError(f"an encoder cannot have {threads} threads: choose 1 to 16")
        self._shape = (height_px, width_px, 3)
        self._planes = np.empty((height_px * 3 // 2, width_px), np.uint8)
        self._rate, self._gop_frames, self._buffer_s = Fraction(rate_hz).limit_denominator(1001), gop_frames, buffer_s
        self._preset, self._threads = preset, threads
        self._next_pts = 0
        self._context = self._open_context(bit_rate_bps)

    @property
    def bit_rate_bps(self) -> int:
        """The current bit rate."""
        return self._context.bit_rate or 0

    def set_bit_rate(self, bit_rate_bps: int) -> None:
        """Change the bit rate from the next picture on, which is a keyframe.

        The codec is reopened, which takes about 2 ms, because an open libx264 can neither exceed its first rate nor
        change its decoder buffer. Raises `UserError` for a rate that is not possible.
        """
        _check_rates(float(self._rate), bit_rate_bps, self._gop_frames, self._buffer_s)
        if bit_rate_bps != self.bit_rate_bps:
            self._context = self._open_context(bit_rate_bps)

    def to_planes(self, picture_bgr: Picture) -> NDArray[np.uint8]:
        """Convert a picture (height, width, 3) to I420, (height * 3 / 2, width), in a buffer that the next call reuses.

        Raises `UserError` for a picture of another size.
        """
        if picture_bgr.shape != self._shape:
            raise UserError(f"the encoder takes pictures of one shape: {self._shape}, not {picture_bgr.shape}")
        return cast("NDArray[np.uint8]", cv2.cvtColor(picture_bgr, cv2.COLOR_BGR2YUV_I420, dst=self._planes))

    def encode(self, picture_bgr: Picture, keyframe: bool = False) -> bytes:
        """Encode one picture (height, width, 3) and return its access unit (annex B).

        With `keyframe` the picture becomes an IDR picture. Raises `UserError` for a picture of another size.
        """
        return self.encode_planes(self.to_planes(picture_bgr), keyframe)

    def encode_planes(self, planes: NDArray[np.uint8], keyframe: bool = False) -> bytes:
        """Encode one picture in I420, as `to_planes` returns it. The picture is not copied or kept.

        Raises `UserError` for a picture of another size.
        """
        if planes.shape != self._planes.shape:
            raise UserError(f"the encoder takes I420 of one shape: {self._planes.shape}, not {planes.shape}")
        frame = VideoFrame.from_numpy_buffer(planes, format="yuv420p")
        frame.pts = self._next_pts
        self._next_pts += 1
        if keyframe:
            frame.pict_type = PictureType.I
        return b"".join(bytes(packet) for packet in self._context.encode(frame))

    def _open_context(self, bit_rate_bps: int) -> VideoCodecContext:
        context = av.CodecContext.create("libx264", "w")
        context.height, context.width, _ = self._shape
        context.pix_fmt = "yuv420p"
        context.thread_count = self._threads
        context.time_base = 1 / self._rate
        context.framerate = self._rate
        context.gop_size = self._gop_frames
        context.max_b_frames = 0
        context.bit_rate = bit_rate_bps
        context.profile = "Constrained Baseline"
        context.options = {
            "preset": self._preset,
            "tune": "zerolatency",
            "maxrate": str(bit_rate_bps),
            "bufsize": str(round(bit_rate_bps * self._buffer_s)),
        }
        context.open()
        return context


def _check_size(width_px: int, height_px: int) -> None:
    """Raise `UserError` for a size that libx264 rejects with an unclear message, or that `Decoder` would reject."""
    if min(width_px, height_px) < _MIN_SIDE_PX or width_px % 2 or height_px % 2:
        raise UserError(
            f"pictures cannot have {width_px} x {height_px} pixels: choose even sizes of at least {_MIN_SIDE_PX} pixels"
        )
    if width_px * height_px > _MAX_DECODED_PX:
        raise UserError(f"pictures cannot have {width_px} x {height_px} pixels: choose at most 4096 x 2304")


def _check_rates(rate_hz: float, bit_rate_bps: int, gop_frames: int, buffer_s: float) -> None:
    """Raise `UserError` for rates that libx264 rejects with an unclear message, or accepts but does not keep."""
    if not 1 <= rate_hz <= 1000:
        raise UserError(f"the frame rate cannot be {rate_hz} Hz: choose 1 to 1000 Hz")
    if not 10_000 <= bit_rate_bps <= 1_000_000_000:
        raise UserError(f"the bit rate cannot be {bit_rate_bps} bit/s: choose 10000 to 1000000000 bit/s")
    if gop_frames < 1:
        raise UserError(f"the keyframe interval cannot be {gop_frames} frames: choose 1 or more")
    if not 0.001 <= buffer_s <= 10:
        raise UserError(f"the decoder buffer cannot be {buffer_s} s: choose 0.001 to 10 s, and at least one frame")


class DecodedPicture:
    """A decoded picture in the decoder's memory; later pictures do not overwrite it.

    Attributes: `luma` is (height, width), from 16 (black) to 235 (white). `corrupt` is true if the decoder had to
    conceal parts of this picture; it is not set for later pictures that copy from it.
    """

    __slots__ = ("_frame", "corrupt", "luma")

    def __init__(self, frame: VideoFrame, corrupt: bool) -> None:
        self._frame = frame
        plane = frame.planes[0]
        rows = np.frombuffer(plane, np.uint8).reshape(frame.height, plane.line_size)  # type: ignore[call-overload]
        self.luma: NDArray[np.uint8] = rows[:, : frame.width]
        self.corrupt = corrupt

    @property
    def picture(self) -> Picture:
        """The picture in colour, converted on access: the conversion takes most of the time of decoding."""
        planes = cast("NDArray[np.uint8]", self._frame.to_ndarray())
        return cast("Picture", cv2.cvtColor(planes, cv2.COLOR_YUV2BGR_I420))


class Decoder:
    """An H.264 decoder of one stream with parameter sets in band; each call returns the picture of its access unit."""

    def __init__(self) -> None:
        self._context = _open_decoder()
        self._damaged = False

    def decode(self, access_unit: bytes) -> DecodedPicture | None:
        """Decode one access unit (annex B); return None if no picture can be decoded. No bytes make it raise.

        After the loss of a whole keyframe, or of two consecutive pictures where the 4-bit frame number wraps, FFmpeg
        can treat the next pictures as older ones. Then it returns no picture until the frame number has caught up
        (measured: up to 14 pictures), or until the next keyframe.
        """
        if not access_unit:
            return None  # FFmpeg treats an empty packet as the end of the stream, and returns no more pictures after it
        # FFmpeg keeps state of a damaged picture, which makes the next keyframe visibly wrong but not marked as
        # corrupt. Flushing does not help. A new context does, and takes less than 0.1 ms (measured).
        if self._damaged and _is_self_contained(access_unit):
            self._context = _open_decoder()
            self._damaged = False
        try:
            frames = self._context.decode(av.Packet(access_unit))
            decoded = DecodedPicture(_to_i420(frames[-1]), frames[-1].is_corrupt) if frames else None
        except (av.FFmpegError, ValueError):
            decoded = None
        self._damaged = self._damaged or decoded is None or decoded.corrupt
        return decoded


def _open_decoder() -> VideoCodecContext:
    """Open a decoder that returns each picture with its access unit."""
    context = av.CodecContext.create("h264", "r")
    context.thread_type = ThreadType.SLICE
    context.thread_count = 1
    context.flags |= Flags.low_delay
    context.options = {"max_pixels": str(_MAX_DECODED_PX)}
    return context


def _is_self_contained(access_unit: bytes) -> bool:
    """Return whether an access unit is a keyframe with its parameter sets."""
    types = {unit[0] & 0x1F for unit in split_nal_units(access_unit)}
    return types >= _KEYFRAME_NAL_TYPES


def _to_i420(frame: VideoFrame) -> VideoFrame:
    """Return a frame in 4:2:0; raises `ValueError` for odd sizes, which the chroma planes cannot represent."""
    if frame.width % 2 or frame.height % 2:
        raise ValueError("odd size")
    # A foreign sender can use full range or another chroma format.
    return frame if frame.format.name == "yuv420p" else frame.reformat(format="yuv420p")
