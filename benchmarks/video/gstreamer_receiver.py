"""The receiving process of GStreamer: pictures out of `appsink`, each looked at where it lies."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Any

import numpy as np
from benchmarks.video.gstreamer import gstreamer, receiving
from benchmarks.video.run import Run, freeze, requested_run, tell, wait_for_line, wall_ns
from benchmarks.video.watch import Watch

from lavt.transport.video.stamp import read_stamp


def main() -> None:
    """Receive until it is told to end."""
    run = requested_run()
    gst = gstreamer()
    pipeline = gst.parse_launch(receiving(run))
    pipeline.set_state(gst.State.PLAYING)
    pipeline.get_state(5 * gst.SECOND)
    watch = Watch(run)
    ended = threading.Event()
    freeze()
    tell({"port": pipeline.get_by_name("socket").get_property("port")})
    threading.Thread(target=_wait_for_end, args=(ended,), daemon=True).start()
    _receive(gst, run, pipeline.get_by_name("pictures"), watch, ended)
    pipeline.set_state(gst.State.NULL)
    watch.save(Path(run.folder) / "read.npz")
    tell({"counts": {}})


def _wait_for_end(ended: threading.Event) -> None:
    wait_for_line()
    ended.set()


def _receive(gst: Any, run: Run, pictures: Any, watch: Watch, ended: threading.Event) -> None:
    while not ended.is_set():
        sample = pictures.try_pull_sample(gst.SECOND // 2)
        if sample is None:
            continue
        buffer = sample.get_buffer()
        _, mapped = buffer.map(gst.MapFlags.READ)
        luma = np.frombuffer(mapped.data, np.uint8, run.width_px * run.height_px).reshape(run.height_px, run.width_px)
        stamp_ns = read_stamp(luma)
        watch.note(stamp_ns, wall_ns(), luma)
        buffer.unmap(mapped)


if __name__ == "__main__":
    main()
