"""Our server's stream to a plain receiver, received by GStreamer and ffmpeg."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.interop.tools import read_frames, running
from tests.support.ports import free_port_pair

from lavt.assembly.entropy import MachineEntropy
from lavt.assembly.nodes import build_server
from lavt.clock import MachineClock
from lavt.config import ServerConfig
from lavt.config_file import load_config, shipped
from lavt.domain import Now
from lavt.node import Send
from lavt.runtime.realtime import RealRuntime
from lavt.transport.udp_link import UdpLink
from lavt.transport.video.stamp import read_stamp

SERVER = shipped("configs/server.yaml")
WIDTH_PX, HEIGHT_PX = 320, 240
FRAME_BYTES = WIDTH_PX * HEIGHT_PX * 3 // 2
FRAMES_TO_RECEIVE = 90
"""Three seconds of frames."""
GSTREAMER = (
    "gst-launch-1.0 -q udpsrc address=127.0.0.1 port={port} buffer-size=4194304"
    " caps=application/x-rtp,media=video,clock-rate=90000,encoding-name=H264,payload=96"
    " ! rtpjitterbuffer ! rtph264depay ! avdec_h264 ! videoconvert ! video/x-raw,format=I420 ! fdsink fd=1 sync=false"
)
FFMPEG = (
    "ffmpeg -nostdin -loglevel warning -protocol_whitelist file,udp,rtp -buffer_size 4194304 {flags} -i {sdp}"
    " -fps_mode passthrough -f rawvideo -pix_fmt yuv420p pipe:1"
)


class StampRecorder:
    """A recorder that keeps the stamps of the sent frames."""

    def __init__(self) -> None:
        self.sent: list[int] = []

    def write(self, topic: str, payload: Any, now: Now) -> None:  # noqa: ARG002 (the protocol's)
        """Record a message; frames are recorded before their packets are sent."""
        if topic == "frame":
            self.sent.append(payload.stamp_ns)


class AbsentClientLink:
    """A link to an absent client."""

    def send(self, *sends: Send) -> None:
        """Discard messages."""


def config_changes(port: int) -> list[str]:
    """Return changes of the shipped config: send the video to `port`, as small pictures with a keyframe every 0.5 s."""
    return [
        f"video.send_to=['127.0.0.1:{port}']",
        f"camera.width_px={WIDTH_PX}",
        f"camera.height_px={HEIGHT_PX}",
        "video.bit_rate_bps=1000000",
        "video.gop_frames=15",
        "clock.source=probe",
    ]


@contextmanager
def our_server(port: int) -> Iterator[StampRecorder]:
    """Run the server's nodes in real time with a real socket; no client has control, so the vehicle is stationary."""
    config = load_config(ServerConfig, SERVER, config_changes(port))
    clock, stamps = MachineClock(), StampRecorder()
    link = UdpLink(clock, "feedback", bind=("127.0.0.1", 0))
    nodes = build_server(config, clock.now, MachineEntropy(), host="here", video_port=link.port).all
    runtime = RealRuntime(clock, nodes, stamps, lambda: None)
    with closing(link):
        absent = AbsentClientLink()
        runtime.start({"video": link, "zenoh": absent, "probe": absent, "netem": absent})
        try:
            yield stamps
        finally:
            runtime.stop()
    assert runtime.failed is None


def receive_with(command: str, port: int, log: Path) -> tuple[list[int], list[int]]:
    """Run a tool until it has written enough raw frames; return the stamps sent and the stamps read."""
    with our_server(port) as stamps, running(command.split(), log, output=True) as tool:
        assert tool.stdout is not None
        frames = list(read_frames(tool.stdout, FRAME_BYTES, FRAMES_TO_RECEIVE))
    assert len(frames) == FRAMES_TO_RECEIVE, log.read_text(errors="replace")
    lumas = [np.frombuffer(frame, np.uint8)[: WIDTH_PX * HEIGHT_PX].reshape(HEIGHT_PX, WIDTH_PX) for frame in frames]
    return stamps.sent, [read_stamp(luma) for luma in lumas]


def check_each_in_order(sent_stamps: list[int], read_stamps: list[int]) -> None:
    """Assert that the tool returned every sent frame in order, from the first that it returned."""
    assert read_stamps[0] in sent_stamps
    begin = sent_stamps.index(read_stamps[0])
    assert read_stamps == sent_stamps[begin : begin + len(read_stamps)]


def test_gstreamer_receives_each_frame(tmp_path: Path) -> None:
    """GStreamer receives and decodes our stream, and each picture has the stamp of the sent frame."""
    port = free_port_pair()
    check_each_in_order(*receive_with(GSTREAMER.format(port=port), port, tmp_path / "log"))


@pytest.mark.parametrize("flags", ["", "-fflags nobuffer -flags low_delay"])
def test_ffmpeg_receives_each_frame_with_our_sdp(flags: str, tmp_path: Path) -> None:
    """With the output of `lavt sdp`, ffmpeg receives and decodes our stream; each picture has the frame's stamp."""
    port, sdp = free_port_pair(), tmp_path / "lavt.sdp"
    settings = [part for change in config_changes(port) for part in ("--set", change)]
    with sdp.open("wb") as file:
        subprocess.run([sys.executable, "-m", "lavt", "sdp", str(SERVER), *settings], stdout=file, check=True)
    check_each_in_order(*receive_with(FFMPEG.format(flags=flags, sdp=sdp), port, tmp_path / "log"))
