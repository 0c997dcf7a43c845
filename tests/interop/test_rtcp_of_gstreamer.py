"""RTCP between GStreamer's `rtpsession` and our reports, in both directions."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
from tests.interop.tools import DEBIAN_PYTHON

from lavt.clock import MachineClock
from lavt.domain import NS_PER_S
from lavt.transport.rtp.ntp_time import ntp_to_short
from lavt.transport.rtp.rtcp import (
    ReceptionReport,
    SenderReport,
    parse_announcement,
    parse_feedback,
    picture_loss,
    receiver_report,
    sender_report,
)
from lavt.transport.rtp.rtp import RtpPacket

CLOCK = MachineClock()
OUR_SSRC, GSTREAMER_SSRC, RECEIVER_SSRC = 77, 99, 88

SESSION = """
import json, sys
import gi
gi.require_version("Gst", "1.0")
from gi.repository import Gst
Gst.init(None)
CAPS = "application/x-rtp,media=video,clock-rate=90000,encoding-name=H264,payload=96,rtcp-fb-nack-pli=true,ssrc=(uint)"
SOURCE = "is-live=true do-timestamp=true format=time"
pipeline = Gst.parse_launch(
    "rtpsession name=session rtp-profile=avpf"
    f' appsrc name=rtp {SOURCE} caps="{CAPS}77" ! session.recv_rtp_sink session.recv_rtp_src ! fakesink async=false'
    f' appsrc name=send {SOURCE} caps="{CAPS}99" ! session.send_rtp_sink session.send_rtp_src ! fakesink async=false'
    f" appsrc name=rtcp {SOURCE} caps=application/x-rtcp ! session.recv_rtcp_sink"
    " session.send_rtcp_src ! appsink name=out async=false sync=false emit-signals=true"
)
session, out = pipeline.get_by_name("session"), pipeline.get_by_name("out")
session.get_property("internal-session").set_property("rtcp-min-interval", 100_000_000)

def print_message(kind, content):
    print(json.dumps([kind, content]), flush=True)

def print_rtcp(_sink):
    buffer = out.emit("pull-sample").get_buffer()
    print_message("rtcp", buffer.extract_dup(0, buffer.get_size()).hex())
    return Gst.FlowReturn.OK

def print_event(_pad, info):
    structure = info.get_event().get_structure()
    if structure is not None:
        print_message("event", structure.get_name())
    return Gst.PadProbeReturn.OK

out.connect("new-sample", print_rtcp)
pad = pipeline.get_by_name("send").get_static_pad("src")
pad.add_probe(Gst.PadProbeType.EVENT_UPSTREAM, print_event)
pipeline.set_state(Gst.State.PLAYING)
NAMES = ("ssrc", "have-sr", "sr-ntptime", "sr-rtptime", "sr-octet-count", "sr-packet-count",
         "have-rb", "rb-ssrc", "rb-fractionlost", "rb-packetslost", "rb-exthighestseq", "rb-jitter", "rb-round-trip")
for line in sys.stdin:
    kind, *rest = line.split()
    if kind == "stats":
        stats = session.get_property("stats")
        sources = stats.get_value("source-stats")
        print_message(
            "stats", [{name: source.get_value(name) for name in NAMES if source.has_field(name)} for source in sources]
        )
    else:
        pipeline.get_by_name(kind).emit("push-buffer", Gst.Buffer.new_wrapped(bytes.fromhex(rest[0])))
pipeline.set_state(Gst.State.NULL)
"""


class GStreamerSession:
    """GStreamer's rtpsession in another process: it receives our stream 77 and sends its own stream 99."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self._process = process

    def push(self, kind: str, datagram: bytes = b"") -> None:
        """Push received RTP (`rtp`), received RTCP (`rtcp`) or RTP to send (`send`), or request `stats`."""
        assert self._process.stdin is not None
        self._process.stdin.write(f"{kind} {datagram.hex()}\n")
        self._process.stdin.flush()

    def read(self, kind: str) -> Any:
        """Wait for GStreamer's next message of a kind and return the content."""
        assert self._process.stdout is not None
        for line in self._process.stdout:
            message_kind, content = json.loads(line)
            if message_kind == kind:
                return content
        raise AssertionError("GStreamer has ended")


@contextmanager
def gstreamer() -> Iterator[GStreamerSession]:
    pipe = subprocess.PIPE
    with subprocess.Popen([DEBIAN_PYTHON, "-c", SESSION], stdin=pipe, stdout=pipe, text=True) as process:
        try:
            yield GStreamerSession(process)
        finally:
            process.kill()


def packet(sequence: int, ssrc: int) -> bytes:
    """Return an RTP packet with four bytes of payload."""
    return RtpPacket(96, sequence % 2**16, 3000 * sequence, ssrc, True, b"\x41abc").to_bytes()


def read_report_with_age(session: GStreamerSession, highest_sequence: int) -> ReceptionReport:
    """Return the first reception report that has a packet and the age of a sender report.

    GStreamer repeats its reports. It handles packets and sender reports in different threads, so either may come later.
    The age is 0 in a report that is sent when the sender report arrives.
    """
    while True:
        for block in parse_feedback(bytes.fromhex(session.read("rtcp"))).reports:
            if block.last_report_age_ns > 0 and block.highest_sequence == highest_sequence:
                return block


def read_sender_report(session: GStreamerSession, packets: int) -> SenderReport:
    """Return the first sender report after this many packets; GStreamer can send one before it has them all."""
    while True:
        for report in parse_announcement(bytes.fromhex(session.read("rtcp"))).reports:
            if report.packets == packets:
                return report


@pytest.mark.timeout(60)
def test_gstreamer_reads_our_sender_reports() -> None:
    """GStreamer's receiver parses all fields of our sender report and returns the report's time in short format."""
    with gstreamer() as session:
        for number in range(65_530, 65_540):
            session.push("rtp", packet(number, OUR_SSRC))
        wall_ns = 1_700_000_000_123_456_789
        report = sender_report(OUR_SSRC, wall_ns=wall_ns, rtp_timestamp=123, packets=10, octets=40, cname="camera@lavt")
        sent_ns = CLOCK.now().mono_ns
        session.push("rtcp", report)
        (sent,) = parse_announcement(report).reports
        block = read_report_with_age(session, highest_sequence=65_539)
        assert block.media_ssrc == OUR_SSRC
        assert block.last_report == ntp_to_short(sent.ntp_time)
        assert block.last_report_age_ns < CLOCK.now().mono_ns - sent_ns
        session.push("stats")
        (source,) = (source for source in session.read("stats") if source["ssrc"] == OUR_SSRC)
        names = ("have-sr", "sr-ntptime", "sr-rtptime", "sr-packet-count", "sr-octet-count")
        assert [source[name] for name in names] == [True, sent.ntp_time, 123, 10, 40]


@pytest.mark.timeout(60)
def test_gstreamer_reads_our_receiver_reports() -> None:
    """GStreamer's sender parses our receiver report, computes the round-trip time and accepts a picture loss."""
    with gstreamer() as session:
        for number in range(5):
            session.push("send", packet(number, GSTREAMER_SSRC))
        sent = read_sender_report(session, packets=5)
        assert (sent.ssrc, sent.octets) == (GSTREAMER_SSRC, 20)
        six_seconds_ago = (ntp_to_short(sent.ntp_time) - 6 * 65_536) % 2**32
        report = ReceptionReport(GSTREAMER_SSRC, 65_541, 0.25, 3, 17, six_seconds_ago, 5 * NS_PER_S)
        session.push("rtcp", receiver_report(RECEIVER_SSRC, report, clock_ns=NS_PER_S))
        session.push("rtcp", picture_loss(RECEIVER_SSRC, GSTREAMER_SSRC))
        while session.read("event") != "GstForceKeyUnit":
            pass
        session.push("stats")
        (source,) = (source for source in session.read("stats") if source["ssrc"] == RECEIVER_SSRC)
        names = ("have-rb", "rb-ssrc", "rb-fractionlost", "rb-packetslost", "rb-exthighestseq", "rb-jitter")
        assert [source[name] for name in names] == [True, GSTREAMER_SSRC, 0.25 * 256, 3, 65_541, 17]
        # The 6 s since the sender report, minus the 5 s that the receiver says it waited; in 1/65536 s.
        assert 65_536 <= source["rb-round-trip"] < 30 * 65_536
