"""GStreamer and ffmpeg: whether they are here, and how they are run so that none outlives its test."""

from __future__ import annotations

import functools
import shutil
import subprocess
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

PACKAGES = (
    "gstreamer1.0-tools",
    "gstreamer1.0-plugins-base",
    "gstreamer1.0-plugins-good",
    "gstreamer1.0-plugins-bad",
    "gstreamer1.0-plugins-ugly",
    "gstreamer1.0-libav",
    "ffmpeg",
    "python3-gst-1.0",
    "gir1.2-gst-plugins-base-1.0",
)
"""Debian's; .ci/run installs them."""
PROGRAMS = ("gst-launch-1.0", "gst-inspect-1.0", "ffmpeg")
ELEMENTS = (
    "udpsrc", "rtpjitterbuffer", "rtph264depay", "avdec_h264", "videoconvert", "fdsink",
    "filesrc", "rawvideoparse", "x264enc", "rtph264pay", "udpsink", "rtpsession",
)  # fmt: skip
DEBIANS_PYTHON = "/usr/bin/python3"
"""For which Debian's modules of GStreamer are made."""
MODULES = "import gi; gi.require_version('GstApp', '1.0'); from gi.repository import Gst, GstApp"
LIMIT_S = 60.0
"""By then a tool that works has ended long ago, on however busy a machine."""


@functools.cache
def missing() -> tuple[str, ...]:
    """Name the programs, Python modules and elements of GStreamer that are not here."""
    if absent := tuple(program for program in PROGRAMS if shutil.which(program) is None):
        return absent
    python = shutil.which(DEBIANS_PYTHON)
    if python is None or subprocess.run([python, "-c", MODULES], check=False, capture_output=True).returncode:
        return ("GStreamer's modules for Debian's Python",)
    requested = ["gst-inspect-1.0", "--exists"]
    return tuple(each for each in ELEMENTS if subprocess.run([*requested, each], check=False).returncode)


@contextmanager
def running(command: list[str], said: Path, *, output: bool = False) -> Iterator[subprocess.Popen[bytes]]:
    """Run a tool, what it says going to the file `said`; with `output` its standard output is a pipe.

    It is killed at the end, and after `LIMIT_S`, so that nothing waits for it for ever.
    """
    with said.open("wb") as err:
        out = subprocess.PIPE if output else err
        tool = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=out, stderr=err)
    watchdog = threading.Timer(LIMIT_S, tool.kill)
    watchdog.daemon = True
    watchdog.start()
    try:
        yield tool
    finally:
        watchdog.cancel()
        tool.kill()
        tool.wait()
        if tool.stdout is not None:
            tool.stdout.close()


def read_frames(output: IO[bytes], frame_bytes: int, count: int) -> Iterator[bytes]:
    """Give raw frames as a tool writes them, until there are `count`; fewer where it ends before."""
    for _ in range(count):
        frame = output.read(frame_bytes)
        if len(frame) < frame_bytes:
            return
        yield frame
