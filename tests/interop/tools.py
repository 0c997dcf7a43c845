"""Check that GStreamer and ffmpeg are installed, and run them so that no tool outlives its test."""

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
"""Debian packages; .ci/run installs them."""
PROGRAMS = ("gst-launch-1.0", "gst-inspect-1.0", "ffmpeg")
ELEMENTS = (
    "udpsrc",
    "rtpjitterbuffer",
    "rtph264depay",
    "avdec_h264",
    "videoconvert",
    "fdsink",
    "filesrc",
    "rawvideoparse",
    "x264enc",
    "rtph264pay",
    "udpsink",
    "rtpsession",
)
DEBIAN_PYTHON = "/usr/bin/python3"
"""The Python of Debian's GStreamer modules."""
MODULES = "import gi; gi.require_version('GstApp', '1.0'); from gi.repository import Gst, GstApp"
LIMIT_S = 60.0
"""Longest run of a tool: more than a working tool needs, even on a busy machine."""


@functools.cache
def missing_tools() -> tuple[str, ...]:
    """Return the missing programs, Python modules and GStreamer elements."""
    if absent := tuple(program for program in PROGRAMS if shutil.which(program) is None):
        return absent
    python = shutil.which(DEBIAN_PYTHON)
    if python is None or subprocess.run([python, "-c", MODULES], check=False, capture_output=True).returncode:
        return ("GStreamer's modules for Debian's Python",)
    command = ["gst-inspect-1.0", "--exists"]
    return tuple(element for element in ELEMENTS if subprocess.run([*command, element], check=False).returncode)


@contextmanager
def running(command: list[str], log: Path, *, output: bool = False) -> Iterator[subprocess.Popen[bytes]]:
    """Run a tool with its messages in the file `log`; with `output` its standard output is a pipe.

    The tool is killed at the end, and after `LIMIT_S`, so that no test waits for it forever.
    """
    with log.open("wb") as err:
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
    """Yield up to `count` raw frames that a tool writes; fewer if the tool ends earlier."""
    for _ in range(count):
        frame = output.read(frame_bytes)
        if len(frame) < frame_bytes:
            return
        yield frame
