"""GStreamer's Python modules, and the two pipelines of the benchmark."""

from __future__ import annotations

import sys
from typing import Any

from benchmarks.video.run import GOP_FRAMES, RATE_HZ, VBV_MS, Run

from lavt.errors import UserError

DEBIAN_PACKAGES = "/usr/lib/python3/dist-packages"
INSTALL_HINT = (
    "this benchmark needs GStreamer: apt-get install python3-gst-1.0 gir1.2-gst-plugins-base-1.0 "
    "gstreamer1.0-plugins-{base,good,bad,ugly} gstreamer1.0-libav"
)
ELEMENTS = (
    "appsrc",
    "appsink",
    "x264enc",
    "rtph264pay",
    "rtph264depay",
    "rtpjitterbuffer",
    "avdec_h264",
    "udpsrc",
    "udpsink",
)
BUFFER_BYTES = 4 * 1024 * 1024
"""The size of the receiving socket's buffer, the same as in LAVT."""


def load_gstreamer() -> Any:
    """Import and initialize GStreamer from Debian's folder; raise `UserError` if a part of it is missing."""
    if DEBIAN_PACKAGES not in sys.path:
        sys.path.append(DEBIAN_PACKAGES)
    try:
        import gi  # noqa: PLC0415 (it can be found only now)

        gi.require_version("Gst", "1.0")
        gi.require_version("GstApp", "1.0")
        from gi.repository import Gst, GstApp  # noqa: F401, PLC0415 (GstApp gives appsrc and appsink their methods)
    except (ImportError, ValueError) as error:
        raise UserError(INSTALL_HINT) from error
    Gst.init(None)
    missing = [name for name in ELEMENTS if Gst.ElementFactory.find(name) is None]
    if missing:
        raise UserError(f"{INSTALL_HINT} (missing elements: {', '.join(missing)})")
    return Gst


def sender_pipeline(run: Run) -> str:
    """Return the sender's pipeline: no look-ahead, one thread, and LAVT's bit rate, VBV size and GOP.

    If the run saves access units, the pipeline also sends a copy of each to an appsink.
    """
    copy_to_appsink = ""
    if run.saves_units_and_picture_errors:
        copy_to_appsink = "! tee name=copies copies. ! appsink name=units sync=false copies. "
    return (
        "appsrc name=source is-live=true format=time max-bytes=0 "
        f"caps=video/x-raw,format=I420,width={run.width_px},height={run.height_px},framerate={RATE_HZ}/1 "
        f"! x264enc tune=zerolatency speed-preset=ultrafast threads=1 bitrate={run.bit_rate_bps // 1000} "
        f"vbv-buf-capacity={VBV_MS} key-int-max={GOP_FRAMES} aud=false "
        "! video/x-h264,profile=constrained-baseline,stream-format=byte-stream,alignment=au "
        f"{copy_to_appsink}"
        "! rtph264pay mtu=1200 config-interval=-1 pt=96 aggregate-mode=zero-latency "
        f"! udpsink host=127.0.0.1 port={run.port} sync=false async=false"
    )


def receiver_pipeline(run: Run) -> str:
    """Return the receiver's pipeline."""
    return (
        f"udpsrc name=socket address=127.0.0.1 port=0 buffer-size={BUFFER_BYTES} "
        "caps=application/x-rtp,media=video,clock-rate=90000,encoding-name=H264,payload=96 "
        f"! rtpjitterbuffer latency={run.jitter_buffer_ms} ! rtph264depay ! avdec_h264 max-threads=1 max-errors=-1 "
        f"! appsink name=pictures max-buffers=0 sync={str(run.synchronous).lower()}"
    )
