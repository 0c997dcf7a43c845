"""Pictures to H.264 and back, one access unit for one picture, with no frame of delay on either side.

The only module that knows PyAV (libx264 and FFmpeg's decoder). Encoding: constrained baseline, no look-ahead, constant
bit rate with a small decoder buffer (VBV), so that no frame is much larger than its share. Decoding: one thread, since
FFmpeg's frame threads buy speed with one frame of delay each.
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
"""A forged parameter set cannot make the decoder ask for more memory than pictures of this size need."""
_KEYFRAME_KINDS: Final = {5, 7, 8}
"""An IDR slice, a sequence and a picture parameter set (H.264, table 7-1)."""
_PRESETS: Final = ("ultrafast", "superfast", "veryfast", "faster", "fast", "medium", "slow", "slower", "veryslow")

# What FFmpeg says of a damaged stream the caller counts anyway, and libx264 sums itself up at every end.
av.logging.set_level(None)
# OpenCV's threads wait for more work by spinning: 1.5 ms of a processor for each picture converted (measured).
cv2.setNumThreads(1)


class Encoder:
    """H.264 encoder of one stream of pictures (libx264); the same pictures give the same bytes.

    `bit_rate_bps` is kept over any `buffer_s`; a keyframe comes every `gop_frames` and on request, each with its
    parameter sets in band. With several `threads` each encodes a slice of every picture: no picture waits for another.
    Raises `UserError` for what no stream can be made of.
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
            raise UserError(f"preset {preset!r} is none of libx264's: choose one of {', '.join(_PRESETS)}")
        if not 1 <= threads <= 16:
            raise UserError(f"an encoder of {threads} threads: choose 1 to 16")
        self._shape = (height_px, width_px, 3)
        self._planes = np.empty((height_px * 3 // 2, width_px), np.uint8)
        self._rate, self._gop_frames, self._buffer_s = Fraction(rate_hz).limit_denominator(1001), gop_frames, buffer_s
        self._preset, self._threads = preset, threads
        self._next_pts = 0
        self._context = self._opened(bit_rate_bps)

    @property
    def bit_rate_bps(self) -> int:
        """What is kept to now."""
        return self._context.bit_rate or 0

    def set_bit_rate(self, bit_rate_bps: int) -> None:
        """Keep to another bit rate from the next picture on, which is a keyframe.

        The codec is opened anew, in about 2 ms: libx264 cannot go beyond the rate it was opened with, nor change its
        decoder buffer. Raises `UserError` for a rate that no stream can be made of.
        """
        _check_rates(float(self._rate), bit_rate_bps, self._gop_frames, self._buffer_s)
        if bit_rate_bps != self.bit_rate_bps:
            self._context = self._opened(bit_rate_bps)

    def to_planes(self, picture_bgr: Picture) -> NDArray[np.uint8]:
        """Convert a picture (height, width, 3) to I420, (height * 3 / 2, width), in a buffer that the next one reuses.

        Raises `UserError` for a picture of another size.
        """
        if picture_bgr.shape != self._shape:
            raise UserError(f"the encoder was made for pictures of {self._shape}, not of {picture_bgr.shape}")
        return cast("NDArray[np.uint8]", cv2.cvtColor(picture_bgr, cv2.COLOR_BGR2YUV_I420, dst=self._planes))

    def encode(self, picture_bgr: Picture, keyframe: bool = False) -> bytes:
        """Encode one picture (height, width, 3) and return its access unit, annex B.

        `keyframe` makes it an IDR picture. Raises `UserError` for a picture of another size.
        """
        return self.encode_planes(self.to_planes(picture_bgr), keyframe)

    def encode_planes(self, planes: NDArray[np.uint8], keyframe: bool = False) -> bytes:
        """Encode one picture in I420, as `to_planes` gives it; nothing of it is copied or kept.

        Raises `UserError` for one of another size.
        """
        if planes.shape != self._planes.shape:
            raise UserError(f"the encoder was made for I420 of {self._planes.shape}, not of {planes.shape}")
        frame = VideoFrame.from_numpy_buffer(planes, format="yuv420p")
        frame.pts = self._next_pts
        self._next_pts += 1
        if keyframe:
            frame.pict_type = PictureType.I
        return b"".join(bytes(packet) for packet in self._context.encode(frame))

    def _opened(self, bit_rate_bps: int) -> VideoCodecContext:
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
    """Raise `UserError` for a size that libx264 refuses in its own words, or that our decoder would not take."""
    if min(width_px, height_px) < _MIN_SIDE_PX or width_px % 2 or height_px % 2:
        raise UserError(f"pictures of {width_px} x {height_px}: choose even sizes of at least {_MIN_SIDE_PX} pixels")
    if width_px * height_px > _MAX_DECODED_PX:
        raise UserError(f"pictures of {width_px} x {height_px}: choose at most 4096 x 2304")


def _check_rates(rate_hz: float, bit_rate_bps: int, gop_frames: int, buffer_s: float) -> None:
    """Raise `UserError` for rates that libx264 refuses in its own words or does not follow."""
    if not 1 <= rate_hz <= 1000:
        raise UserError(f"a frame rate of {rate_hz} Hz: choose 1 to 1000 Hz")
    if not 10_000 <= bit_rate_bps <= 1_000_000_000:
        raise UserError(f"a bit rate of {bit_rate_bps} bit/s: choose 10000 to 1000000000 bit/s")
    if gop_frames < 1:
        raise UserError(f"a keyframe every {gop_frames} frames: choose 1 or more")
    if not 0.001 <= buffer_s <= 10:
        raise UserError(f"a decoder buffer of {buffer_s} s: choose 0.001 to 10 s, and at least one frame")


class DecodedPicture:
    """A picture that came out of the decoder, and is in its memory still: the next pictures leave it alone.

    Attributes: `luma` is (height, width), 16 black to 235 white. `corrupt` says that the decoder had to make up parts
    of this very picture; later ones copy from it and say nothing.
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
        """The same in colour, made when it is asked for: most of the time of a decoded picture goes there."""
        planes = cast("NDArray[np.uint8]", self._frame.to_ndarray())
        return cast("Picture", cv2.cvtColor(planes, cv2.COLOR_YUV2BGR_I420))


class Decoder:
    """H.264 decoder of one stream: parameter sets in band, an access unit in, its picture out at once."""

    def __init__(self) -> None:
        self._context = _new_context()
        self._damaged = False

    def decode(self, access_unit: bytes) -> DecodedPicture | None:
        """Decode one access unit (annex B); None when it gives no picture, whatever its bytes.

        After the loss of a whole keyframe, or of two pictures in a row where the 4-bit frame number wraps, FFmpeg may
        take the next pictures for older than those before and give none until that number has caught up (measured: up
        to 14 pictures), or until the next keyframe.
        """
        if not access_unit:
            return None  # to FFmpeg an empty packet means the end of the stream: nothing would come out ever after
        # FFmpeg carries something of a damaged picture over into the next keyframe, which then is visibly wrong without
        # being called corrupt; flushing does not help. Measured: a new context does, and takes less than 0.1 ms.
        if self._damaged and _stands_alone(access_unit):
            self._context = _new_context()
            self._damaged = False
        try:
            frames = self._context.decode(av.Packet(access_unit))
            decoded = DecodedPicture(_in_i420(frames[-1]), frames[-1].is_corrupt) if frames else None
        except (av.FFmpegError, ValueError):
            decoded = None
        self._damaged = self._damaged or decoded is None or decoded.corrupt
        return decoded


def _new_context() -> VideoCodecContext:
    """Open a decoder that gives each picture as soon as its access unit is there."""
    context = av.CodecContext.create("h264", "r")
    context.thread_type = ThreadType.SLICE
    context.thread_count = 1
    context.flags |= Flags.low_delay
    context.options = {"max_pixels": str(_MAX_DECODED_PX)}
    return context


def _stands_alone(access_unit: bytes) -> bool:
    """Tell whether an access unit is a keyframe with its parameter sets."""
    kinds = {unit[0] & 0x1F for unit in split_nal_units(access_unit)}
    return kinds >= _KEYFRAME_KINDS


def _in_i420(frame: VideoFrame) -> VideoFrame:
    """Give a frame in 4:2:0. Raises `ValueError` for odd sizes, which its planes cannot hold."""
    if frame.width % 2 or frame.height % 2:
        raise ValueError("odd size")
    # A foreign sender's full range or other chroma.
    return frame if frame.format.name == "yuv420p" else frame.reformat(format="yuv420p")
