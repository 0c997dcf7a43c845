"""GStreamer's sending process, which pushes each frame into `appsrc` when the frame is due."""

from __future__ import annotations

from typing import Any

import numpy as np
from benchmarks.video.gstreamer import load_gstreamer, sender_pipeline
from benchmarks.video.pictures import memory_map_pictures, picture_of
from benchmarks.video.run import (
    NUMBER_COLUMN,
    RATE_HZ,
    STAMP_COLUMN,
    Pace,
    Run,
    cpu_ns,
    exclude_objects_from_gc,
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
    pictures = memory_map_pictures(run.pictures_stem)
    print_json({})
    wait_for_line()
    cpu_after_each_frame_ns = _send(gst, run, pipeline.get_by_name("source"), pictures)
    pipeline.get_by_name("source").end_of_stream()
    pipeline.get_bus().timed_pop_filtered(5 * gst.SECOND, gst.MessageType.EOS | gst.MessageType.ERROR)
    save_units(run, _pull_units(gst, pipeline) if run.saves_units_and_picture_errors else [])
    pipeline.set_state(gst.State.NULL)
    print_json({"cpu_ns": cpu_after_each_frame_ns})


def _send(gst: Any, run: Run, source: Any, pictures: NDArray[np.uint8]) -> list[int]:
    """Send all frames; return the process's total CPU time at the end of each frame."""
    sent_table = run.map_sent_table()
    cpu_after_each_frame_ns = []
    exclude_objects_from_gc()
    pace = Pace()
    for number in range(run.frames):
        pace.wait_for(number)
        buffer = gst.Buffer.new_allocate(None, pictures[0].size, None)
        _, mapped = buffer.map(gst.MapFlags.WRITE)
        planes = np.frombuffer(mapped.data, np.uint8).reshape(pictures[0].shape)
        planes[:] = picture_of(pictures, number)
        stamp_ns = wall_ns()
        write_stamp_i420(planes, stamp_ns)
        buffer.unmap(mapped)
        buffer.pts = buffer.dts = number * NS_PER_S // RATE_HZ
        buffer.duration = NS_PER_S // RATE_HZ
        sent_table[number, NUMBER_COLUMN] = number
        sent_table[number, STAMP_COLUMN] = stamp_ns
        source.push_buffer(buffer)
        cpu_after_each_frame_ns.append(cpu_ns())
    return cpu_after_each_frame_ns


def _pull_units(gst: Any, pipeline: Any) -> list[bytes]:
    """Return the access units that the pipeline's appsink `units` has queued."""
    units = []
    while (sample := pipeline.get_by_name("units").try_pull_sample(0)) is not None:
        buffer = sample.get_buffer()
        _, mapped = buffer.map(gst.MapFlags.READ)
        units.append(bytes(mapped.data))
        buffer.unmap(mapped)
    return units


if __name__ == "__main__":
    main()
