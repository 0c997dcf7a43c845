"""How well stamps are read from decoded pictures: at four sizes and nine bit rates, without loss and with.

    python benchmarks/stamp_reading.py [--sizes 640x480 1920x1080] [--rates-kbps 460 3200] [--frames 300] [--json]

The simulator's pictures, with its sensor noise (2.2 LSB), at 30 Hz: a drive of 2 s there and back again and again.
Encoder, packets, reorder buffer, depacketizer, decoder and reader are the product's; packets are lost independently;
as long as pictures are in doubt, from a loss to the next whole keyframe, one is asked for every 100 ms and comes two
frames later (a round trip of 40 ms). A frame is intact when all its packets arrived or were made again.

Each stamp is checked by its RTP timestamp, as ours are, and again as a foreign sender's would be: against timestamps
with a base of their own, of pictures taken up to 4 ms before they were stamped. That check is shown all pictures; those
whose cells are clear; and of these those that are not in doubt.
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

ROUTE, FROM_M, SPEED_MPS, SCENE_FRAMES = "b", 150.0, 8.33, 60

LINKS = ((0.0, 0), (0.01, 0), (0.01, 1), (0.05, 0), (0.05, 1), (0.05, 2))
"""Share of packets lost, and repair packets for each block of a frame."""
ROUND_TRIP_FRAMES = 2
PAUSE_FRAMES = 3
"""Neither asks the receiver nor answers the sender more often: `nodes/receiver.py`, `nodes/camera.py`."""

FRAME_NS = NS_PER_S // RATE_HZ
START_NS = 1_760_000_000_123_456_789
STAMP_JITTER_NS = 3 * NS_PER_MS
FOREIGN_BASE = 4_294_000_000
FOREIGN_JITTER_NS = 4 * NS_PER_MS

Planes = NDArray[np.uint8]


@dataclass
class Worst:
    """Accepted stamps of one kind: how many, how many were not the one that was sent, the largest error of these."""

    accepted: int = 0
    wrong: int = 0
    largest_error_us: float = 0.0

    def note(self, read_ns: int, sent_ns: int) -> None:
        """Note an accepted stamp."""
        self.accepted += 1
        self.wrong += read_ns != sent_ns
        self.largest_error_us = max(self.largest_error_us, abs(read_ns - sent_ns) / 1000)

    def add(self, other: Worst) -> None:
        """Put another one's figures to these."""
        self.accepted += other.accepted
        self.wrong += other.wrong
        self.largest_error_us = max(self.largest_error_us, other.largest_error_us)


CHECKS = ("own", "own, not in doubt", "foreign", "foreign, clear cells", "foreign, clear cells, not in doubt")


@dataclass
class Found:
    """What was found in one cell of the study, over one link."""

    size: str
    rate_kbps: int
    loss: float
    repair: int
    counts: Counter[str] = field(default_factory=Counter)
    checks: dict[str, Worst] = field(default_factory=lambda: {name: Worst() for name in CHECKS})

    @property
    def bit_per_px(self) -> float:
        """Bits for each pixel of each frame."""
        width, height = map(int, self.size.split("x"))
        return self.rate_kbps * 1000 / (width * height * RATE_HZ)

    @property
    def unread_share(self) -> float:
        """Share of frames whose stamp was not accepted."""
        return 1 - self.counts["accepted"] / self.counts["frames"]

    @property
    def good_of_intact(self) -> float:
        """Of the intact frames, the share that was accepted and not in doubt."""
        return self.counts["intact_good"] / max(1, self.counts["intact"])


@lru_cache(maxsize=1)
def scene(size: str) -> list[Planes]:
    """Render the drive, in I420."""
    width, height = map(int, size.split("x"))
    road = load_road(ROUTE)
    renderer = Renderer(road, CameraModel(width, height), seed=1, scenery="full", light="low_sun")
    to_planes = Encoder(width, height, rate_hz=RATE_HZ, bit_rate_bps=1_000_000, gop_frames=GOP_FRAMES).to_planes
    pictures = []
    for number in range(SCENE_FRAMES):
        x_m, y_m, heading_rad, _ = (float(value) for value in road.centre_at(FROM_M + number * SPEED_MPS / RATE_HZ))
        pictures.append(to_planes(renderer.render(Pose(0, x_m, y_m, heading_rad), number)).copy())
    return pictures + pictures[-2:0:-1]


class Sender:
    """Makes datagrams of frames, and keyframes when asked."""

    def __init__(self, found: Found) -> None:
        width, height = map(int, found.size.split("x"))
        self.encoder = Encoder(
            width,
            height,
            rate_hz=RATE_HZ,
            bit_rate_bps=found.rate_kbps * 1000,
            gop_frames=GOP_FRAMES,
            buffer_s=BUFFER_S,
        )
        self.packetizer = Packetizer(ssrc=1, first_sequence=65_000)
        self.repair = RepairSender(ssrc=2, first_sequence=65_000)
        self.requested_for: int | None = None
        self.answered = self.requested = -PAUSE_FRAMES

    def ask(self, number: int) -> None:
        """Ask for a keyframe, which is heard after a round trip, from frame `number` on."""
        if number - self.requested >= PAUSE_FRAMES:
            self.requested = number
            self.requested_for = number + ROUND_TRIP_FRAMES

    def send(self, number: int, planes: Planes, stamp_ns: int) -> list[bytes]:
        """Stamp a frame and make its datagrams."""
        keyframe = self.requested_for is not None and self.requested_for <= number >= self.answered + PAUSE_FRAMES
        if keyframe:
            self.requested_for, self.answered = None, number
        write_stamp_i420(planes, stamp_ns)
        return self.packetizer.packetize(self.encoder.encode_planes(planes, keyframe), rtp_timestamp(stamp_ns))


class Receiver:
    """Makes lost packets again, and puts packets in order and together."""

    def __init__(self) -> None:
        self.repair = RepairReceiver()
        self.reorder = JitterBuffer()
        self.depacketizer = Depacketizer()

    def receive(self, datagrams: Sequence[bytes], now_ns: int) -> tuple[int, list[AccessUnit]]:
        """Take what arrived of a frame; give the number of media packets that came of it and the access units over.

        That is after the hold of the reorder buffer, which is shorter than a frame.
        """
        media = 0
        ordered: Ordered = []
        for packet in map(parse_packet, datagrams):
            if packet.payload_type == VIDEO_PAYLOAD_TYPE:
                ordered += self.reorder.push(packet, now_ns)
                media += 1
            for recovered in self.repair.push(packet, now_ns):
                ordered += self.reorder.push_recovered(recovered, now_ns)
                media += 1
        ordered += self.reorder.expire(now_ns + MIN_HOLD_NS)
        return media, [unit for each in ordered for unit in self.depacketizer.push(*each)]


class Reader:
    """Decodes access units, reads their stamps and holds them against what was sent."""

    def __init__(self, found: Found) -> None:
        self.found = found
        self.sent_ns: dict[int, int] = {}
        self.foreign_timestamp: dict[int, int] = {}
        self.missing: dict[int, int] = {}
        self.decoder = Decoder()
        self.learned = {name: LearnedBase() for name in CHECKS if name.startswith("foreign")}
        self.in_doubt = True

    def read(self, unit: AccessUnit) -> None:
        """Read one."""
        picture = self.decoder.decode(unit.data)
        whole = unit.complete and picture is not None and not picture.corrupt
        self.in_doubt = not whole or (self.in_doubt and not unit.keyframe)
        if picture is not None:
            accepted = self._accepted(picture, unit.timestamp)
            intact = self.missing[unit.timestamp] == 0
            self.found.counts.update(accepted=accepted, intact_good=accepted and intact and not self.in_doubt)
            self._read_as_foreign(picture, unit.timestamp)

    def _accepted(self, picture: DecodedPicture, timestamp: int) -> bool:
        read_ns = read_stamp(picture.luma)
        accepted = stamp_agrees(read_ns, timestamp)
        for name in ("own",) if self.in_doubt else ("own", "own, not in doubt"):
            if accepted:
                self.found.checks[name].note(read_ns, self.sent_ns[timestamp])
        return accepted

    def _read_as_foreign(self, picture: DecodedPicture, timestamp: int) -> None:
        readings = {"foreign": read_stamp(picture.luma)}
        try:
            readings["foreign, clear cells"] = read_clear_stamp(picture.luma)
            if not self.in_doubt:
                readings["foreign, clear cells, not in doubt"] = readings["foreign, clear cells"]
        except BadPacket:
            pass  # counted by what was accepted
        for name, read_ns in readings.items():
            if self.learned[name].agrees(read_ns, self.foreign_timestamp[timestamp]):
                self.found.checks[name].note(read_ns, self.sent_ns[timestamp])


def study(found: Found, frames: int) -> Found:
    """Send frames over one link and count what is read."""
    pictures = scene(found.size)
    sender, receiver, reader = Sender(found), Receiver(), Reader(found)
    chance = stream(1, f"{found.size} {found.rate_kbps} {found.loss}")
    for number in range(frames):
        now_ns = number * FRAME_NS
        stamp_ns = START_NS + now_ns + int(chance.integers(STAMP_JITTER_NS))
        datagrams = sender.send(number, pictures[number % len(pictures)], stamp_ns)
        repair = sender.repair.repair(datagrams, found.repair)
        arrived = [datagram for datagram in (*datagrams, *repair) if chance.random() >= found.loss]
        timestamp = rtp_timestamp(stamp_ns)
        captured_ns = stamp_ns - int(chance.integers(FOREIGN_JITTER_NS))
        reader.sent_ns[timestamp] = stamp_ns
        reader.foreign_timestamp[timestamp] = (rtp_timestamp(captured_ns) + FOREIGN_BASE) % 2**32
        media, units = receiver.receive(arrived, now_ns)
        reader.missing[timestamp] = len(datagrams) - media
        found.counts.update(frames=1, intact=reader.missing[timestamp] == 0)
        for unit in units:
            reader.read(unit)
        if reader.in_doubt:
            sender.ask(number)
    return found


def study_rate(size: str, rate_kbps: int, frames: int) -> list[Found]:
    """Study one size at one bit rate over all links."""
    return [study(Found(size, rate_kbps, loss, repair), frames) for loss, repair in LINKS]


def study_all(sizes: Sequence[str], rates_kbps: Sequence[int], frames: int, processes: int) -> list[Found]:
    """Study all cells, the largest pictures first."""
    by_px = sorted(sizes, key=lambda size: -CameraModel(*map(int, size.split("x"))).width_px)
    cells = [(size, rate, frames) for size in by_px for rate in rates_kbps]
    with ProcessPoolExecutor(processes, mp_context=get_context("spawn")) as pool:
        found = [each for part in pool.map(study_rate, *zip(*cells, strict=True)) for each in part]
    return sorted(found, key=lambda each: (sizes.index(each.size), each.rate_kbps))


def percent(share: float) -> str:
    """Write a share with as many digits as a few hundred frames bear."""
    return f"{100 * share:.1f} %"


def tables(found: Sequence[Found]) -> Iterator[str]:
    """Write the table of each size, and of each check over everything."""
    headers = [f"{loss:.0%} lost" + (f", {repair} repair" if repair else "") for loss, repair in LINKS[1:]]
    for size, of_size in groupby(found, key=lambda each: each.size):
        yield f"\n{size}: unread without loss; of the intact frames, accepted and not in doubt"
        yield "| kb/s | bit/px | unread | " + " | ".join(headers) + " |"
        yield "|---" * (3 + len(headers)) + "|"
        for rate, links in groupby(of_size, key=lambda each: each.rate_kbps):
            whole, *lossy = links
            shares = " | ".join(percent(each.good_of_intact) for each in lossy)
            yield f"| {rate} | {whole.bit_per_px:.3f} | {percent(whole.unread_share)} | {shares} |"
    yield "\n| check | accepted | of these not the stamp sent | largest error |"
    yield "|---" * 4 + "|"
    for name, worst in totals(found).items():
        yield f"| {name} | {worst.accepted} | {worst.wrong} | {worst.largest_error_us:.1f} us |"


def totals(found: Sequence[Found]) -> dict[str, Worst]:
    """Put the figures of each check together over everything."""
    whole = {name: Worst() for name in CHECKS}
    for each in found:
        for name, worst in each.checks.items():
            whole[name].add(worst)
    return whole


def as_json(found: Sequence[Found]) -> str:
    """Write everything on one line."""
    cells = [
        {
            "size": each.size, "rate_kbps": each.rate_kbps, "loss": each.loss, "repair": each.repair,
            "bit_per_px": round(each.bit_per_px, 4), "unread_share": round(each.unread_share, 4),
            "good_of_intact": round(each.good_of_intact, 4), **each.counts,
            "checks": {name: asdict(worst) for name, worst in each.checks.items()},
        }
        for each in found
    ]  # fmt: skip
    return json.dumps({"cells": cells, "checks": {name: asdict(worst) for name, worst in totals(found).items()}})


def main() -> None:
    """Study everything that was asked for, and print it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", nargs="+", choices=SIZES, default=list(SIZES))
    parser.add_argument("--rates-kbps", nargs="+", type=int, default=list(RATES_KBPS))
    parser.add_argument("--frames", type=int, default=300)
    parser.add_argument("--processes", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--json", action="store_true", help="print everything on one last line, too")
    requested = parser.parse_args()
    found = study_all(requested.sizes, requested.rates_kbps, requested.frames, requested.processes)
    print("\n".join(tables(found)))
    if requested.json:
        print(as_json(found))


if __name__ == "__main__":
    main()
