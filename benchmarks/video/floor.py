"""The floor: the latency of encoding and decoding alone, in one process, with PyAV, at the frame rate of the runs."""

from __future__ import annotations

from fractions import Fraction

import av
import numpy as np
from av.codec.context import ThreadType
from av.video.codeccontext import VideoCodecContext
from av.video.frame import VideoFrame
from benchmarks.video.pictures import memory_map_pictures, picture_of
from benchmarks.video.run import (
    GOP_FRAMES,
    RATE_HZ,
    VBV_MS,
    Pace,
    Run,
    exclude_objects_from_gc,
    print_json,
    requested_run,
    wall_ns,
)

from lavt.transport.video.stamp import write_stamp_i420


def main() -> None:
    """Measure the requested number of frames."""
    run = requested_run()
    pictures = memory_map_pictures(run.pictures_stem)
    encoder, decoder = _open_encoder(run), open_decoder()
    planes = np.empty_like(pictures[0])
    took_ns = []
    exclude_objects_from_gc()
    pace = Pace()
    for number in range(run.frames):
        pace.wait_for(number)
        planes[:] = picture_of(pictures, number)
        begin_ns = wall_ns()
        write_stamp_i420(planes, begin_ns)
        frame = VideoFrame.from_numpy_buffer(planes, format="yuv420p")
        frame.pts = number
        for packet in encoder.encode(frame):
            decoder.decode(av.Packet(bytes(packet)))
        took_ns.append(wall_ns() - begin_ns)
    print_json({"took_ns": took_ns})


def _open_encoder(run: Run) -> VideoCodecContext:
    context = av.CodecContext.create("libx264", "w")
    context.width, context.height, context.pix_fmt = run.width_px, run.height_px, "yuv420p"
    context.time_base, context.framerate = Fraction(1, RATE_HZ), Fraction(RATE_HZ)
    context.thread_count, context.gop_size, context.max_b_frames = 1, GOP_FRAMES, 0
    context.bit_rate, context.profile = run.bit_rate_bps, "Constrained Baseline"
    rate = str(run.bit_rate_bps)
    buffer = str(run.bit_rate_bps * VBV_MS // 1000)
    context.options = {"preset": "ultrafast", "tune": "zerolatency", "maxrate": rate, "bufsize": buffer}
    return context


def open_decoder() -> VideoCodecContext:
    """Open FFmpeg's decoder with one thread, so that it returns each picture with its access unit."""
    context = av.CodecContext.create("h264", "r")
    context.thread_type, context.thread_count = ThreadType.SLICE, 1
    return context


if __name__ == "__main__":
    main()
