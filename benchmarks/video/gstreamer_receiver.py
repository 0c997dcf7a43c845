"""GStreamer's receiving process, which pulls pictures from `appsink` and reads their stamps without copying them."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Any

import numpy as np
from benchmarks.video.gstreamer import load_gstreamer, receiver_pipeline
from benchmarks.video.picture_log import PictureLog
from benchmarks.video.run import Run, exclude_objects_from_gc, print_json, requested_run, wait_for_line, wall_ns

from lavt.transport.video.stamp import read_stamp


def main() -> None:
    """Receive until a line arrives on stdin."""
    run = requested_run()
    gst = load_gstreamer()
    pipeline = gst.parse_launch(receiver_pipeline(run))
    pipeline.set_state(gst.State.PLAYING)
    pipeline.get_state(5 * gst.SECOND)
    log = PictureLog(run)
    ended = threading.Event()
    exclude_objects_from_gc()
    print_json({"port": pipeline.get_by_name("socket").get_property("port")})
    threading.Thread(target=_wait_for_end, args=(ended,), daemon=True).start()
    _receive(gst, run, pipeline.get_by_name("pictures"), log, ended)
    pipeline.set_state(gst.State.NULL)
    log.save(Path(run.folder) / "read.npz")
    print_json({"counts": {}})


def _wait_for_end(ended: threading.Event) -> None:
    wait_for_line()
    ended.set()


def _receive(gst: Any, run: Run, pictures: Any, log: PictureLog, ended: threading.Event) -> None:
    while not ended.is_set():
        sample = pictures.try_pull_sample(gst.SECOND // 2)
        if sample is None:
            continue
        buffer = sample.get_buffer()
        _, mapped = buffer.map(gst.MapFlags.READ)
        luma = np.frombuffer(mapped.data, np.uint8, run.width_px * run.height_px).reshape(run.height_px, run.width_px)
        stamp_ns = read_stamp(luma)
        log.note(stamp_ns, wall_ns(), luma)
        buffer.unmap(mapped)


if __name__ == "__main__":
    main()
