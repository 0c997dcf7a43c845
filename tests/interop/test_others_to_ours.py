"""Streams of GStreamer and ffmpeg, received by our receiver."""

from __future__ import annotations

import json
import signal
import socket
import sys
from collections import Counter
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest
from tests.interop.tools import LIMIT_S, running

from lavt.clock import MachineClock
from lavt.domain import NS_PER_S, Picture
from lavt.streams import stream
from lavt.transport.rtp.jitter_buffer import JitterBuffer
from lavt.transport.rtp.rtp import AccessUnit, Depacketizer, RtpPacket, parse_packet, split_nal_units
from lavt.transport.udp_link import RECEIVE_BUFFER_BYTES
from lavt.transport.video.h264 import Decoder
from lavt.transport.video.stamp import read_stamp, rtp_timestamp, write_stamp
from lavt.transport.video.stamp_check import LEARNED_AFTER

WIDTH_PX, HEIGHT_PX, RATE_HZ = 640, 480, 30
COUNT = 60
"""Number of frames: two seconds, because the tools send them in real time."""
STAMPS_NS = [1_790_000_000 * NS_PER_S + number * NS_PER_S // RATE_HZ for number in range(COUNT)]

GSTREAMER = (
    "gst-launch-1.0 -q filesrc location={raw}"
    f" ! rawvideoparse format=i420 width={WIDTH_PX} height={HEIGHT_PX} framerate={RATE_HZ}/1"
    " ! x264enc tune=zerolatency bitrate=2000 key-int-max=15 threads=1 {encoder} ! video/x-h264,profile={profile}"
    " ! rtph264pay pt=96 mtu=1200 config-interval=-1 aggregate-mode={aggregate}"
    " ! udpsink host=127.0.0.1 port={port}"
)
FFMPEG = (
    "ffmpeg -nostdin -loglevel warning -re"
    f" -f rawvideo -pix_fmt yuv420p -s {WIDTH_PX}x{HEIGHT_PX} -r {RATE_HZ} -i {{raw}}"
    " -c:v libx264 -preset ultrafast -tune zerolatency -b:v 2M -g 15"
    " -f rtp rtp://127.0.0.1:{port}?pkt_size=1200"
)
SINGLE, STAP_A, FU_A = "single NAL unit", "STAP-A", "FU-A"
BASELINE, HIGH = (66, False), (100, True)
"""Profile, and whether the entropy coding is CABAC, as in the parameter sets."""


@dataclass(frozen=True, slots=True)
class GStreamerCase:
    """A GStreamer pipeline and the packets that it must send for the test to be valid."""

    encoder: str
    packets: tuple[str, ...]
    """Packet types that must occur; the first type must be the most frequent."""
    aggregate: str = "none"
    profile: str = "constrained-baseline"
    slices: int = 1
    """The smallest number of slices in each picture."""


FAST, WITH_CABAC = "speed-preset=ultrafast", "speed-preset=medium cabac=true dct8x8=true bframes=0"
CASES = {
    "single NAL units": GStreamerCase(f"{FAST} option-string=slice-max-size=1100", (SINGLE,)),
    "STAP-A without latency": GStreamerCase(f"{FAST} option-string=slice-max-size=500", (STAP_A,), "zero-latency"),
    "STAP-A of all that fits": GStreamerCase(f"{FAST} option-string=slice-max-size=300", (STAP_A,), "max-stap"),
    "FU-A": GStreamerCase(FAST, (FU_A, SINGLE)),
    "several slices": GStreamerCase(f"{FAST} option-string=slices=8", (FU_A, SINGLE, STAP_A), "zero-latency", slices=8),
    "slices by threads": GStreamerCase(f"{FAST} threads=4 sliced-threads=true", (FU_A,), "zero-latency", slices=4),
    "baseline": GStreamerCase(FAST, (FU_A, SINGLE, STAP_A), "zero-latency", "baseline"),
    "high": GStreamerCase(WITH_CABAC, (FU_A, SINGLE, STAP_A), "zero-latency", "high"),
}


@pytest.fixture(scope="module")
def raw(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write stamped pictures with motion to a file as raw I420, and return its path."""
    texture = stream(1, "texture").integers(40, 216, (HEIGHT_PX, WIDTH_PX, 3), dtype=np.uint8)
    smooth_texture = cv2.GaussianBlur(texture, (0, 0), 4.0)
    path = tmp_path_factory.mktemp("raw") / "frames.i420"
    with path.open("wb") as file:
        for number, stamp_ns in enumerate(STAMPS_NS):
            picture: Picture = np.roll(smooth_texture, 3 * number, axis=1)
            write_stamp(picture, stamp_ns)
            file.write(cv2.cvtColor(picture, cv2.COLOR_BGR2YUV_I420).tobytes())
    return path


def receive_from(command: str, raw: Path, log: Path) -> list[tuple[RtpPacket, int]]:
    """Run a tool that sends the pictures to us until it ends; return each packet with its time of arrival."""
    packets, clock = [], MachineClock()
    with closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as receiver:
        receiver.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER_BYTES)
        receiver.bind(("127.0.0.1", 0))
        receiver.settimeout(0.1)
        with running(command.format(raw=raw, port=receiver.getsockname()[1]).split(), log) as tool:
            while True:
                ended = tool.poll() is not None
                try:
                    packets.append((parse_packet(receiver.recv(65_535)), clock.now().mono_ns))
                except TimeoutError:
                    if ended:
                        break
            assert tool.returncode == 0, log.read_text(errors="replace")
    return packets


def reassemble(packets: Sequence[tuple[RtpPacket, int]]) -> list[AccessUnit]:
    """Return the access units of packets, as the receiver node reassembles them."""
    jitter_buffer, depacketizer = JitterBuffer(), Depacketizer()
    ordered = [
        ordered_packet for packet, arrived_ns in packets for ordered_packet in jitter_buffer.push(packet, arrived_ns)
    ]
    ordered += jitter_buffer.expire(packets[-1][1] + NS_PER_S)
    units = [unit for packet, lost_before in ordered for unit in depacketizer.push(packet, lost_before)]
    assert (jitter_buffer.lost, jitter_buffer.stray, depacketizer.malformed) == (0, 0, 0)
    return units


def count_types(packets: Sequence[tuple[RtpPacket, int]]) -> Counter[str]:
    """Count the packet types (RFC 6184, section 5.4)."""
    names = {**dict.fromkeys(range(1, 24), SINGLE), 24: STAP_A, 28: FU_A}
    return Counter(names[packet.payload[0] & 0x1F] for packet, _ in packets)


def check_each_picture(units: Sequence[AccessUnit]) -> None:
    """Assert that each sent picture arrived complete, in order and with its timestamp."""
    assert len(units) == COUNT
    assert all(unit.complete for unit in units)
    decoder = Decoder()
    pictures = [decoder.decode(unit.data) for unit in units]
    assert not any(picture is None or picture.corrupt for picture in pictures)
    assert [read_stamp(picture.luma) for picture in pictures if picture is not None] == STAMPS_NS
    # The sender's RTP clock begins at a random value and then runs like the stamps, within 1/90000 s: both are rounded.
    differences = [rtp_timestamp(stamp_ns) - unit.timestamp for stamp_ns, unit in zip(STAMPS_NS, units, strict=True)]
    assert {(difference - differences[0] + 1) % 2**32 for difference in differences} <= {0, 1, 2}


def count_slices(unit: AccessUnit) -> int:
    return sum(nal[0] & 0x1F in {1, 5} for nal in split_nal_units(unit.data))


def profile_and_cabac(keyframe: AccessUnit) -> tuple[int, bool]:
    """Return profile_idc and entropy_coding_mode_flag (H.264, 7.3.2.1 and 7.3.2.2).

    Two numbers of one bit each precede the flag.
    """
    nal_units = {nal[0] & 0x1F: nal for nal in split_nal_units(keyframe.data)}
    sequence_parameters, picture_parameters = nal_units[7], nal_units[8]
    return sequence_parameters[1], bool(picture_parameters[1] & 0x20)


@pytest.mark.parametrize("name", CASES)
def test_gstreamer_is_received(name: str, raw: Path, tmp_path: Path) -> None:
    """Each picture that GStreamer sends, with any packet types and H.264 profile, arrives complete with its stamp."""
    case = CASES[name]
    command = GSTREAMER.format(
        encoder=case.encoder, profile=case.profile, aggregate=case.aggregate, raw="{raw}", port="{port}"
    )
    packets = receive_from(command, raw, tmp_path / "log")
    units = reassemble(packets)
    check_each_picture(units)
    types = count_types(packets)
    assert types.keys() >= {*case.packets}
    assert types.most_common(1)[0][0] == case.packets[0]
    assert profile_and_cabac(units[0]) == (HIGH if case.profile == "high" else BASELINE)
    assert min(count_slices(unit) for unit in units) >= case.slices


def test_ffmpeg_is_received(raw: Path, tmp_path: Path) -> None:
    """Each picture that ffmpeg sends by RTP arrives complete with its stamp."""
    packets = receive_from(FFMPEG, raw, tmp_path / "log")
    check_each_picture(reassemble(packets))
    assert count_types(packets).keys() >= {FU_A, STAP_A}


def test_watch_accepts_the_stamps_of_gstreamer(raw: Path, tmp_path: Path) -> None:
    """`lavt watch` accepts the stamps of all pictures from GStreamer, except the first ones, from which it learns."""
    options = ["--bind", "127.0.0.1", "--port", "0", "--sender", "foreign", "--json"]
    program = [sys.executable, "-m", "lavt", "watch", *options]
    with running(program, tmp_path / "watched", output=True) as watching:
        assert watching.stdout is not None
        port = json.loads(watching.stdout.readline())["watching"]["port"]
        command = GSTREAMER.format(
            encoder=FAST, profile="constrained-baseline", aggregate="zero-latency", raw=raw, port=port
        )
        with running(command.split(), tmp_path / "log") as tool:
            assert tool.wait(LIMIT_S) == 0, (tmp_path / "log").read_text(errors="replace")
        pictures = 0
        while pictures < COUNT:
            pictures += json.loads(watching.stdout.readline())["second"]["pictures"]
        watching.send_signal(signal.SIGINT)
        out, _ = watching.communicate(timeout=LIMIT_S)
    summary = json.loads(out.splitlines()[-1])["summary"]
    assert watching.returncode == 0
    assert (summary["pictures"], summary["stamps_accepted"]) == (COUNT, COUNT - LEARNED_AFTER + 1)
    assert (summary["lost"], summary["stamps_unreadable"]) == (0, LEARNED_AFTER - 1)
    assert "weaker" in summary["check"]
