"""What GStreamer and ffmpeg send, as our receiver sees it."""

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
"""Frames, of two seconds; the tools send them in real time."""
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
"""Profile and whether the entropy coding is CABAC, as the parameter sets say them."""


@dataclass(frozen=True, slots=True)
class Case:
    """A GStreamer pipeline, and what it must have sent for its test to be about what it says."""

    encoder: str
    packets: tuple[str, ...]
    """Kinds of packets that occur; most are of the first."""
    aggregate: str = "none"
    profile: str = "constrained-baseline"
    slices: int = 1
    """In each picture, at least."""


FAST, WITH_CABAC = "speed-preset=ultrafast", "speed-preset=medium cabac=true dct8x8=true bframes=0"
CASES = {
    "single NAL units": Case(f"{FAST} option-string=slice-max-size=1100", (SINGLE,)),
    "STAP-A at once": Case(f"{FAST} option-string=slice-max-size=500", (STAP_A,), "zero-latency"),
    "STAP-A of all that fits": Case(f"{FAST} option-string=slice-max-size=300", (STAP_A,), "max-stap"),
    "FU-A": Case(FAST, (FU_A, SINGLE)),
    "several slices": Case(f"{FAST} option-string=slices=8", (FU_A, SINGLE, STAP_A), "zero-latency", slices=8),
    "slices by threads": Case(f"{FAST} threads=4 sliced-threads=true", (FU_A,), "zero-latency", slices=4),
    "baseline": Case(FAST, (FU_A, SINGLE, STAP_A), "zero-latency", "baseline"),
    "high": Case(WITH_CABAC, (FU_A, SINGLE, STAP_A), "zero-latency", "high"),
}


@pytest.fixture(scope="module")
def raw(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write stamped pictures of something that moves, as raw I420."""
    texture = stream(1, "texture").integers(40, 216, (HEIGHT_PX, WIDTH_PX, 3), dtype=np.uint8)
    soft = cv2.GaussianBlur(texture, (0, 0), 4.0)
    path = tmp_path_factory.mktemp("raw") / "frames.i420"
    with path.open("wb") as file:
        for number, stamp_ns in enumerate(STAMPS_NS):
            picture: Picture = np.roll(soft, 3 * number, axis=1)
            write_stamp(picture, stamp_ns)
            file.write(cv2.cvtColor(picture, cv2.COLOR_BGR2YUV_I420).tobytes())
    return path


def packets_from(command: str, raw: Path, said: Path) -> list[tuple[RtpPacket, int]]:
    """Run a tool that sends the pictures to us: each packet with the time when it came, until the tool has ended."""
    packets, clock = [], MachineClock()
    with closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as receiver:
        receiver.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER_BYTES)
        receiver.bind(("127.0.0.1", 0))
        receiver.settimeout(0.1)
        with running(command.format(raw=raw, port=receiver.getsockname()[1]).split(), said) as tool:
            while True:
                ended = tool.poll() is not None
                try:
                    packets.append((parse_packet(receiver.recv(65_535)), clock.now().mono_ns))
                except TimeoutError:
                    if ended:
                        break
            assert tool.returncode == 0, said.read_text(errors="replace")
    return packets


def units_of(packets: Sequence[tuple[RtpPacket, int]]) -> list[AccessUnit]:
    """Put packets in order and access units together, as the receiver's node does."""
    jitter_buffer, depacketizer = JitterBuffer(), Depacketizer()
    ordered = [each for packet, arrived_ns in packets for each in jitter_buffer.push(packet, arrived_ns)]
    ordered += jitter_buffer.expire(packets[-1][1] + NS_PER_S)
    units = [unit for packet, lost_before in ordered for unit in depacketizer.push(packet, lost_before)]
    assert (jitter_buffer.lost, jitter_buffer.stray, depacketizer.malformed) == (0, 0, 0)
    return units


def kinds_of(packets: Sequence[tuple[RtpPacket, int]]) -> Counter[str]:
    """Count the kinds of packets (RFC 6184, section 5.4)."""
    names = {**dict.fromkeys(range(1, 24), SINGLE), 24: STAP_A, 28: FU_A}
    return Counter(names[packet.payload[0] & 0x1F] for packet, _ in packets)


def check_each_picture(units: Sequence[AccessUnit]) -> None:
    """Each picture that was sent is there, whole, in its order and at its time."""
    assert len(units) == COUNT
    assert all(unit.complete for unit in units)
    decoder = Decoder()
    pictures = [decoder.decode(unit.data) for unit in units]
    assert not any(picture is None or picture.corrupt for picture in pictures)
    assert [read_stamp(picture.luma) for picture in pictures if picture is not None] == STAMPS_NS
    # The sender's RTP clock begins anywhere, and runs as the stamps do: to one tick, as both are rounded.
    ahead = [rtp_timestamp(stamp_ns) - unit.timestamp for stamp_ns, unit in zip(STAMPS_NS, units, strict=True)]
    assert {(ticks - ahead[0] + 1) % 2**32 for ticks in ahead} <= {0, 1, 2}


def slices_of(unit: AccessUnit) -> int:
    return sum(nal[0] & 0x1F in {1, 5} for nal in split_nal_units(unit.data))


def coding_of(keyframe: AccessUnit) -> tuple[int, bool]:
    """Read profile_idc and, after two numbers of one bit, entropy_coding_mode_flag (H.264, 7.3.2.1 and 7.3.2.2)."""
    sets = {nal[0] & 0x1F: nal for nal in split_nal_units(keyframe.data)}
    return sets[7][1], bool(sets[8][1] & 0x20)


@pytest.mark.parametrize("name", CASES)
def test_gstreamer_is_received(name: str, raw: Path, tmp_path: Path) -> None:
    """Whatever kinds of packets GStreamer makes of whatever H.264, each picture arrives whole and its stamp is read."""
    case = CASES[name]
    command = GSTREAMER.format(
        encoder=case.encoder, profile=case.profile, aggregate=case.aggregate, raw="{raw}", port="{port}"
    )
    packets = packets_from(command, raw, tmp_path / "said")
    units = units_of(packets)
    check_each_picture(units)
    kinds = kinds_of(packets)
    assert kinds.keys() >= {*case.packets}
    assert kinds.most_common(1)[0][0] == case.packets[0]
    assert coding_of(units[0]) == (HIGH if case.profile == "high" else BASELINE)
    assert min(slices_of(unit) for unit in units) >= case.slices


def test_ffmpeg_is_received(raw: Path, tmp_path: Path) -> None:
    """Each picture that ffmpeg sends by RTP arrives whole and its stamp is read."""
    packets = packets_from(FFMPEG, raw, tmp_path / "said")
    check_each_picture(units_of(packets))
    assert kinds_of(packets).keys() >= {FU_A, STAP_A}


def test_gstreamer_is_watched(raw: Path, tmp_path: Path) -> None:
    """`lavt watch` accepts the stamps of all that GStreamer sends, but for those that its base is learned from."""
    options = ["--bind", "127.0.0.1", "--port", "0", "--sender", "foreign", "--json"]
    program = [sys.executable, "-m", "lavt", "watch", *options]
    with running(program, tmp_path / "watched", output=True) as watching:
        assert watching.stdout is not None
        port = json.loads(watching.stdout.readline())["watching"]["port"]
        command = GSTREAMER.format(
            encoder=FAST, profile="constrained-baseline", aggregate="zero-latency", raw=raw, port=port
        )
        with running(command.split(), tmp_path / "said") as tool:
            assert tool.wait(LIMIT_S) == 0, (tmp_path / "said").read_text(errors="replace")
        seen = 0
        while seen < COUNT:
            seen += json.loads(watching.stdout.readline())["second"]["pictures"]
        watching.send_signal(signal.SIGINT)
        out, _ = watching.communicate(timeout=LIMIT_S)
    in_all = json.loads(out.splitlines()[-1])["summary"]
    assert watching.returncode == 0
    assert (in_all["pictures"], in_all["stamps_accepted"]) == (COUNT, COUNT - LEARNED_AFTER + 1)
    assert (in_all["lost"], in_all["stamps_unreadable"]) == (0, LEARNED_AFTER - 1)
    assert "the check is weaker" in in_all["check"]
