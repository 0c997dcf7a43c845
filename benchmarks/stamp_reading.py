"""Measure how many stamps can be read from decoded pictures, for four sizes and nine bit rates, with and without loss.

    python benchmarks/stamp_reading.py [--sizes 640x480 1920x1080] [--rates-kbps 460 3200] [--frames 300] [--json]

The simulator makes the pictures, at 30 Hz and with its sensor noise (2.2 LSB). They show a drive of 2 s, forward and
back, repeatedly. Encoder, packetizer, jitter buffer, depacketizer, decoder and stamp reader are LAVT's. Packets are
lost independently. After a loss, pictures are in doubt until the next complete keyframe. As long as they are, the
receiver requests a keyframe every 100 ms. The sender makes the keyframe two frames later (a round trip of 40 ms). A
frame is intact if all its packets arrived or were recovered.

Each stamp is checked in two ways. The check "own" is for stamps of LAVT's sender: it compares the stamp with the RTP
timestamp. The check "foreign" is for stamps of another sender, whose RTP timestamps begin at an unknown base and tell
the time of capture, up to 4 ms before the stamp. The check "foreign" is made three times: for all pictures; for
pictures whose stamp has only clear cells (clearly black or white, see `read_clear_stamp`); and for pictures whose stamp
has only clear cells and that are not in doubt.
"""

from __future__ import annotations

import argparse
import json
import os
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, field
from functools import lru_cache
from itertools import groupby
from multiprocessing import get_context

import numpy as np
from numpy.typing import NDArray

from lavt.domain import NS_PER_MS, NS_PER_S, CameraModel, Pose
from lavt.errors import BadPacket
from lavt.streams import stream
from lavt.transport.rtp.adaptive_hold import MIN_HOLD_NS
from lavt.transport.rtp.fec import RepairReceiver, RepairSender
from lavt.transport.rtp.jitter_buffer import JitterBuffer, Ordered
from lavt.transport.rtp.rtp import VIDEO_PAYLOAD_TYPE, AccessUnit, Depacketizer, Packetizer, parse_packet
from lavt.transport.video.h264 import DecodedPicture, Decoder, Encoder
from lavt.transport.video.stamp import read_clear_stamp, read_stamp, rtp_timestamp, stamp_agrees, write_stamp_i420
from lavt.transport.video.stamp_check import LearnedBase
from lavt.vehicle.sim.rendering.renderer import Renderer
from lavt.vehicle.sim.road.road import load_road

SIZES = ("320x240", "640x480", "1280x720", "1920x1080")
RATES_KBPS = (200, 350, 460, 700, 1000, 2000, 3200, 4000, 8000)
RATE_HZ = 30
GOP_FRAMES = 30
BUFFER_S = 0.1
"""The decoder buffer that the encoder's rate control assumes."""

ROUTE, FIRST_STATION_M, SPEED_MPS, SCENE_FRAMES = "b", 150.0, 8.33, 60

LINKS = ((0.0, 0), (0.01, 0), (0.01, 1), (0.05, 0), (0.05, 1), (0.05, 2))
"""For each link, the share of packets that are lost and the number of repair packets for each block of a frame."""
ROUND_TRIP_FRAMES = 2
REQUEST_PAUSE_FRAMES = 3
"""The shortest interval between two keyframe requests, as in `nodes/receiver.py`. Also the shortest interval between
two keyframes that are made on request, as in `nodes/camera.py`."""

FRAME_NS = NS_PER_S // RATE_HZ
START_NS = 1_760_000_000_123_456_789
STAMP_JITTER_NS = 3 * NS_PER_MS
"""The largest random delay of a stamp."""
FOREIGN_BASE = 4_294_000_000
"""The base of the foreign sender's RTP timestamps, chosen so that they soon wrap at 2^32."""
FOREIGN_JITTER_NS = 4 * NS_PER_MS
"""The longest time from a foreign sender's capture to its stamp."""

Planes = NDArray[np.uint8]


@dataclass
class AcceptedStamps:
    """Statistics of the stamps that a check accepted: their number, how many were wrong, and the largest error.

    A stamp that was read is wrong if it differs from the stamp that was sent.
    """

    accepted: int = 0
    wrong: int = 0
    largest_error_us: float = 0.0

    def note(self, read_ns: int, sent_ns: int) -> None:
        """Count an accepted stamp."""
        self.accepted += 1
        self.wrong += read_ns != sent_ns
        self.largest_error_us = max(self.largest_error_us, abs(read_ns - sent_ns) / 1000)

    def add(self, other: AcceptedStamps) -> None:
        """Add other statistics to these."""
        self.accepted += other.accepted
        self.wrong += other.wrong
        self.largest_error_us = max(self.largest_error_us, other.largest_error_us)


CHECKS = ("own", "own, not in doubt", "foreign", "foreign, clear cells", "foreign, clear cells, not in doubt")
"""The checks, each with the pictures for which it is made; without a restriction it is made for all pictures."""


@dataclass
class LinkResult:
    """The results for one picture size and bit rate over one link."""

    size: str
    rate_kbps: int
    loss: float
    """Share of packets that were lost."""
    repair: int
    """Number of repair packets for each block of a frame."""
    counts: Counter[str] = field(default_factory=Counter)
    checks: dict[str, AcceptedStamps] = field(default_factory=lambda: {name: AcceptedStamps() for name in CHECKS})

    @property
    def bit_per_px(self) -> float:
        """Bits per pixel and frame."""
        width, height = map(int, self.size.split("x"))
        return self.rate_kbps * 1000 / (width * height * RATE_HZ)

    @property
    def rejected_share(self) -> float:
        """Share of frames whose stamp was not accepted by the check "own"."""
        return 1 - self.counts["accepted"] / self.counts["frames"]

    @property
    def usable_share_of_intact(self) -> float:
        """Share of the intact frames whose stamp was accepted and which were not in doubt."""
        return self.counts["intact_usable"] / max(1, self.counts["intact"])


@lru_cache(maxsize=1)
def render_scene(size: str) -> list[Planes]:
    """Return the pictures of the drive in I420, first forward and then back."""
    width, height = map(int, size.split("x"))
    road = load_road(ROUTE)
    renderer = Renderer(road, CameraModel(width, height), seed=1, scenery="full", light="low_sun")
    to_planes = Encoder(width, height, rate_hz=RATE_HZ, bit_rate_bps=1_000_000, gop_frames=GOP_FRAMES).to_planes
    pictures = []
    for number in range(SCENE_FRAMES):
        x_m, y_m, heading_rad, _ = (
            float(value) for value in road.centre_at(FIRST_STATION_M + number * SPEED_MPS / RATE_HZ)
        )
        pictures.append(to_planes(renderer.render(Pose(0, x_m, y_m, heading_rad), number)).copy())
    return pictures + pictures[-2:0:-1]


class StampedFrameSender:
    """A sender that encodes frames, makes datagrams of them, and makes keyframes on request."""

    def __init__(self, result: LinkResult) -> None:
        width, height = map(int, result.size.split("x"))
        self.encoder = Encoder(
            width,
            height,
            rate_hz=RATE_HZ,
            bit_rate_bps=result.rate_kbps * 1000,
            gop_frames=GOP_FRAMES,
            buffer_s=BUFFER_S,
        )
        self.packetizer = Packetizer(ssrc=1, first_sequence=65_000)
        self.repair = RepairSender(ssrc=2, first_sequence=65_000)
        self.keyframe_due: int | None = None
        """The first frame that can be the requested keyframe; None without a pending request."""
        self.last_requested_keyframe = self.last_request = -REQUEST_PAUSE_FRAMES

    def request_keyframe(self, number: int) -> None:
        """Request a keyframe after frame `number`. The request takes effect a round trip later."""
        if number - self.last_request >= REQUEST_PAUSE_FRAMES:
            self.last_request = number
            self.keyframe_due = number + ROUND_TRIP_FRAMES

    def send(self, number: int, planes: Planes, stamp_ns: int) -> list[bytes]:
        """Stamp a frame and return its datagrams."""
        is_pause_over = number >= self.last_requested_keyframe + REQUEST_PAUSE_FRAMES
        keyframe = self.keyframe_due is not None and self.keyframe_due <= number and is_pause_over
        if keyframe:
            self.keyframe_due, self.last_requested_keyframe = None, number
        write_stamp_i420(planes, stamp_ns)
        return self.packetizer.packetize(self.encoder.encode_planes(planes, keyframe), rtp_timestamp(stamp_ns))


class AccessUnitReceiver:
    """A receiver that recovers lost packets, restores their order, and assembles access units."""

    def __init__(self) -> None:
        self.repair = RepairReceiver()
        self.jitter_buffer = JitterBuffer()
        self.depacketizer = Depacketizer()

    def receive(self, datagrams: Sequence[bytes], now_ns: int) -> tuple[int, list[AccessUnit]]:
        """Receive those datagrams of a frame that were not lost.

        Returns the number of media packets that arrived or were recovered, and the access units that are now ready: the
        complete ones, and incomplete ones for which the jitter buffer's hold is over. The hold is shorter than the
        interval of frames.
        """
        media_packets = 0
        ordered: Ordered = []
        for packet in map(parse_packet, datagrams):
            if packet.payload_type == VIDEO_PAYLOAD_TYPE:
                ordered += self.jitter_buffer.push(packet, now_ns)
                media_packets += 1
            for recovered in self.repair.push(packet, now_ns):
                ordered += self.jitter_buffer.push_recovered(recovered, now_ns)
                media_packets += 1
        ordered += self.jitter_buffer.expire(now_ns + MIN_HOLD_NS)
        return media_packets, [unit for packet in ordered for unit in self.depacketizer.push(*packet)]


class StampStudyReader:
    """A reader that decodes access units, reads their stamps, and compares these with the stamps that were sent.

    The keys of `sent_ns`, `foreign_timestamp` and `missing_packets` are the RTP timestamps of the frames.
    """

    def __init__(self, result: LinkResult) -> None:
        self.result = result
        self.sent_ns: dict[int, int] = {}
        self.foreign_timestamp: dict[int, int] = {}
        self.missing_packets: dict[int, int] = {}
        self.decoder = Decoder()
        self.learned_bases = {name: LearnedBase() for name in CHECKS if name.startswith("foreign")}
        self.in_doubt = True

    def read(self, unit: AccessUnit) -> None:
        """Decode an access unit and make all checks of its stamp."""
        picture = self.decoder.decode(unit.data)
        is_undamaged = unit.complete and picture is not None and not picture.corrupt
        self.in_doubt = not is_undamaged or (self.in_doubt and not unit.keyframe)
        if picture is not None:
            accepted = self._check_as_own(picture, unit.timestamp)
            intact = self.missing_packets[unit.timestamp] == 0
            self.result.counts.update(accepted=accepted, intact_usable=accepted and intact and not self.in_doubt)
            self._check_as_foreign(picture, unit.timestamp)

    def _check_as_own(self, picture: DecodedPicture, timestamp: int) -> bool:
        read_ns = read_stamp(picture.luma)
        accepted = stamp_agrees(read_ns, timestamp)
        for name in ("own",) if self.in_doubt else ("own", "own, not in doubt"):
            if accepted:
                self.result.checks[name].note(read_ns, self.sent_ns[timestamp])
        return accepted

    def _check_as_foreign(self, picture: DecodedPicture, timestamp: int) -> None:
        readings = {"foreign": read_stamp(picture.luma)}
        try:
            readings["foreign, clear cells"] = read_clear_stamp(picture.luma)
            if not self.in_doubt:
                readings["foreign, clear cells, not in doubt"] = readings["foreign, clear cells"]
        except BadPacket:
            pass  # the statistics contain accepted stamps only
        for name, read_ns in readings.items():
            if self.learned_bases[name].agrees(read_ns, self.foreign_timestamp[timestamp]):
                self.result.checks[name].note(read_ns, self.sent_ns[timestamp])


def study_link(size: str, rate_kbps: int, loss: float, repair: int, frames: int) -> LinkResult:
    """Send frames over one link, and return the statistics of their stamps."""
    result = LinkResult(size, rate_kbps, loss, repair)
    pictures = render_scene(size)
    sender, receiver, reader = StampedFrameSender(result), AccessUnitReceiver(), StampStudyReader(result)
    generator = stream(1, f"{size} {rate_kbps} {loss}")
    for number in range(frames):
        now_ns = number * FRAME_NS
        stamp_ns = START_NS + now_ns + int(generator.integers(STAMP_JITTER_NS))
        datagrams = sender.send(number, pictures[number % len(pictures)], stamp_ns)
        repair_datagrams = sender.repair.make_repair_packets(datagrams, repair)
        arrived = [datagram for datagram in (*datagrams, *repair_datagrams) if generator.random() >= loss]
        timestamp = rtp_timestamp(stamp_ns)
        captured_ns = stamp_ns - int(generator.integers(FOREIGN_JITTER_NS))
        reader.sent_ns[timestamp] = stamp_ns
        reader.foreign_timestamp[timestamp] = (rtp_timestamp(captured_ns) + FOREIGN_BASE) % 2**32
        media_packets, units = receiver.receive(arrived, now_ns)
        reader.missing_packets[timestamp] = len(datagrams) - media_packets
        result.counts.update(frames=1, intact=reader.missing_packets[timestamp] == 0)
        for unit in units:
            reader.read(unit)
        if reader.in_doubt:
            sender.request_keyframe(number)
    return result


def study_rate(size: str, rate_kbps: int, frames: int) -> list[LinkResult]:
    """Study one picture size at one bit rate over all links."""
    return [study_link(size, rate_kbps, loss, repair, frames) for loss, repair in LINKS]


def study_all(sizes: Sequence[str], rates_kbps: Sequence[int], frames: int, processes: int) -> list[LinkResult]:
    """Study all picture sizes at all bit rates, the largest pictures first."""
    largest_first = sorted(sizes, key=lambda size: -CameraModel(*map(int, size.split("x"))).width_px)
    cases = [(size, rate, frames) for size in largest_first for rate in rates_kbps]
    with ProcessPoolExecutor(processes, mp_context=get_context("spawn")) as pool:
        results_by_case = pool.map(study_rate, *zip(*cases, strict=True))
        results = [result for case_results in results_by_case for result in case_results]
    return sorted(results, key=lambda result: (sizes.index(result.size), result.rate_kbps))


def percent(share: float) -> str:
    """Format a share in percent, with one decimal: a few hundred frames give no higher precision."""
    return f"{100 * share:.1f} %"


def tables(results: Sequence[LinkResult]) -> Iterator[str]:
    """Yield the lines of one table for each picture size, and then of a table with a row for each check."""
    headers = [f"{loss:.0%} lost" + (f", {repair} repair" if repair else "") for loss, repair in LINKS[1:]]
    for size, size_results in groupby(results, key=lambda result: result.size):
        yield f"\n{size}: stamps not accepted without loss; with loss, intact frames that are accepted and not in doubt"
        yield "| kb/s | bit/px | not accepted | " + " | ".join(headers) + " |"
        yield "|---" * (3 + len(headers)) + "|"
        for rate, rate_results in groupby(size_results, key=lambda result: result.rate_kbps):
            loss_free, *lossy = rate_results
            shares = " | ".join(percent(result.usable_share_of_intact) for result in lossy)
            yield f"| {rate} | {loss_free.bit_per_px:.3f} | {percent(loss_free.rejected_share)} | {shares} |"
    yield "\n| check | accepted | of these wrong | largest error |"
    yield "|---" * 4 + "|"
    for name, stamps in totals(results).items():
        yield f"| {name} | {stamps.accepted} | {stamps.wrong} | {stamps.largest_error_us:.1f} us |"


def totals(results: Sequence[LinkResult]) -> dict[str, AcceptedStamps]:
    """Return the statistics of each check over all results."""
    by_check = {name: AcceptedStamps() for name in CHECKS}
    for result in results:
        for name, stamps in result.checks.items():
            by_check[name].add(stamps)
    return by_check


def to_json_line(results: Sequence[LinkResult]) -> str:
    """Return one line of JSON: `links` has an entry for each link at each size and bit rate, `checks` the totals."""
    entries = [
        {
            "size": result.size, "rate_kbps": result.rate_kbps, "loss": result.loss, "repair": result.repair,
            "bit_per_px": round(result.bit_per_px, 4), "rejected_share": round(result.rejected_share, 4),
            "usable_share_of_intact": round(result.usable_share_of_intact, 4), **result.counts,
            "checks": {name: asdict(stamps) for name, stamps in result.checks.items()},
        }
        for result in results
    ]  # fmt: skip
    return json.dumps({"links": entries, "checks": {name: asdict(stamps) for name, stamps in totals(results).items()}})


def main() -> None:
    """Study the requested picture sizes and bit rates, and print the results."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", nargs="+", choices=SIZES, default=list(SIZES))
    parser.add_argument("--rates-kbps", nargs="+", type=int, default=list(RATES_KBPS))
    parser.add_argument("--frames", type=int, default=300, help="for each size, bit rate and link")
    parser.add_argument("--processes", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--json", action="store_true", help="also print all results as JSON, in the last line")
    requested = parser.parse_args()
    results = study_all(requested.sizes, requested.rates_kbps, requested.frames, requested.processes)
    print("\n".join(tables(results)))
    if requested.json:
        print(to_json_line(results))


if __name__ == "__main__":
    main()
