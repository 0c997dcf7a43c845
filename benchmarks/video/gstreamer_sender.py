"""GStreamer's sending process: it pushes a frame into `appsrc` whenever one is due."""

from __future__ import annotations

from typing import Any

import numpy as np
from benchmarks.video.gstreamer import load_gstreamer, sender_pipeline
from benchmarks.video.pictures import picture_of, planes_loop
from benchmarks.video.run import (
    RATE_HZ,
    Pace,
    Run,
    cpu_ns,
    freeze,
    print_json,
    requested_run,
    save_units,
    wait_for_line,
    wall_ns,
)
from numpy.typing import NDArray

from lavt.domain import NS_PER_S
from lavt.transport.video.stamp import write_stamp_i420


def main() -> None:
    """Send the requested number of frames after a line arrives on stdin."""
    run = requested_run()
    gst = load_gstreamer()
    pipeline = gst.parse_launch(sender_pipeline(run))
    pipeline.set_state(gst.State.PLAYING)
    loop = planes_loop(run.loop)
    print_json({})
    wait_for_line()
    cpu = _send(gst, run, pipeline.get_by_name("source"), loop)
    pipeline.get_by_name("source").end_of_stream()
    pipeline.get_bus().timed_pop_filtered(5 * gst.SECOND, gst.MessageType.EOS | gst.MessageType.ERROR)
    save_units(run, _pull_units(gst, pipeline) if run.keep else [])
    pipeline.set_state(gst.State.NULL)
    print_json({"cpu_ns": cpu})


def _send(gst: Any, run: Run, source: Any, loop: NDArray[np.uint8]) -> list[int]:
    table = run.table()
    cpu = []
    freeze()
    pace = Pace()
    for number in range(run.frames):
        pace.wait_for(number)
        buffer = gst.Buffer.new_allocate(None, loop[0].size, None)
        _, mapped = buffer.map(gst.MapFlags.WRITE)
        planes = np.frombuffer(mapped.data, np.uint8).reshape(loop[0].shape)
        planes[:] = picture_of(loop, number)
        stamp_ns = wall_ns()
        write_stamp_i420(planes, stamp_ns)
        buffer.unmap(mapped)
        buffer.pts = buffer.dts = number * NS_PER_S // RATE_HZ
        buffer.duration = NS_PER_S // RATE_HZ
        table[number, 1] = number
        table[number, 0] = stamp_ns
        source.push_buffer(buffer)
        cpu.append(cpu_ns())
    return cpu


def _pull_units(gst: Any, pipeline: Any) -> list[bytes]:
    units = []
    while (sample := pipeline.get_by_name("kept").try_pull_sample(0)) is not None:
        buffer = sample.get_buffer()
        _, mapped = buffer.map(gst.MapFlags.READ)
        units.append(bytes(mapped.data))
        buffer.unmap(mapped)
    return units


if __name__ == "__main__":
    main()
