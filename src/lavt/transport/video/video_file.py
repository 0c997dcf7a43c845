"""Video files from pictures: H.264 in MP4 or Matroska, and animated WebP, all of which web browsers play."""

from __future__ import annotations

from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path
from typing import Final, cast

import av
import av.logging
from av.video.frame import VideoFrame
from av.video.stream import VideoStream

from lavt.domain import Picture
from lavt.errors import WorkError

H264_OPTIONS: Final = {"crf": "26", "preset": "veryfast", "threads": "2", "x264-params": "mbtree=0"}
"""A fixed number of threads, and no macroblock tree (mbtree), so that the bytes are reproducible: with mbtree, 4 of 12
files of the same pictures had other bytes (libx264 in PyAV 18.1); without it, none of 60."""
VIDEO_CODECS: Final = {
    ".mp4": ("libx264", H264_OPTIONS, {"movflags": "faststart"}),
    ".mkv": ("libx264", H264_OPTIONS, {}),
    ".webp": ("libwebp_anim", {"quality": "60", "compression_level": "4"}, {"loop": "0"}),
}
"""For each suffix of a file: the codec, its options, and those of the container."""

av.logging.set_level(None)


def write_video(out: Path, pictures: Iterable[Picture], rate_hz: float) -> int:
    """Write pictures (height, width, 3) of one even size to a file, and return how many; its suffix chooses the codec.

    Raises `WorkError` if the file cannot be written.
    """
    codec, codec_options, container_options = VIDEO_CODECS[out.suffix.lower()]
    count = 0
    try:
        with av.open(str(out), "w", options=container_options) as container:
            rate = Fraction(rate_hz).limit_denominator(1001)
            stream = cast("VideoStream", container.add_stream(codec, rate=rate, options=codec_options))
            stream.pix_fmt = "yuv420p"
            for count, picture in enumerate(pictures, start=1):
                if count == 1:
                    stream.height, stream.width, _ = picture.shape
                container.mux(stream.encode(VideoFrame.from_ndarray(picture, format="bgr24")))
            container.mux(stream.encode(None))
    except (av.FFmpegError, OSError) as error:
        raise WorkError(f"{out} could not be written ({error.strerror}): is there space on the disk?") from error
    return count
