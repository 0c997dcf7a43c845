from __future__ import annotations

import numpy as np
import pytest
from msgspec.structs import replace
from tests.nodes.stand_ins import MONO_NS, WALL_NS, at, deliver, payloads

from lavt.domain import NS_PER_S
from lavt.nodes.payloads import PictureRead, ReceivedUnit
from lavt.nodes.picture_reader import PictureReader
from lavt.nodes.watcher import WatcherNode
from lavt.transport.video.frame_codec import VideoReceiver
from lavt.transport.video.h264 import Decoder, Encoder
from lavt.transport.video.stamp import read_clear_stamp, rtp_timestamp, write_stamp

SIZES = [(128, 96), (320, 240)]


def units(count: int, size: tuple[int, int] = SIZES[0], *, contrast: float = 1.0) -> list[ReceivedUnit]:
    """Return encoded grey pictures with stamps a second apart, the first one a keyframe."""
    width_px, height_px = size
    encoder = Encoder(width_px, height_px, rate_hz=30, bit_rate_bps=4_000_000, gop_frames=30)
    units = []
    for number in range(count):
        picture = np.full((height_px, width_px, 3), 90, np.uint8)
        write_stamp(picture, WALL_NS + number * NS_PER_S)
        faded = (128 + (picture.astype(float) - 128) * contrast).astype(np.uint8)
        timestamp = rtp_timestamp(WALL_NS + number * NS_PER_S)
        units.append(ReceivedUnit(encoder.encode(faded), timestamp, True, number == 0, MONO_NS))
    return units


def read_unit(node: WatcherNode, unit: ReceivedUnit) -> PictureRead:
    (picture,) = payloads(deliver(node, "access_unit", unit, at(0)), "picture")
    assert isinstance(picture, PictureRead)
    return picture


def test_pictures_of_any_size() -> None:
    """A watcher without a configured size reads and counts pictures of any size."""
    node = WatcherNode(PictureReader(VideoReceiver(Decoder(), None)))
    pictures = [read_unit(node, units(1, size)[0]) for size in SIZES]
    assert [picture.stamp_ns for picture in pictures] == [WALL_NS, WALL_NS]
    assert (node.counts["frames_decoded"], node.counts["frames_unreadable"]) == (2, 0)


def test_a_decoded_picture_is_dropped() -> None:
    """A watcher drops decoded pictures, because it has no perception."""
    node = WatcherNode(PictureReader(VideoReceiver(Decoder(), None)))
    (decoded,) = payloads(deliver(node, "access_unit", units(1)[0], at(0)), "view")
    assert deliver(node, "view", decoded, at(1)) == []


@pytest.mark.parametrize("reads_doubtful", [True, False])
def test_pictures_in_doubt(reads_doubtful: bool) -> None:
    """Only with `reads_doubtful` are stamps of pictures in doubt read; the next keyframe ends the doubt."""
    checked: list[int] = []

    def agrees(stamp_ns: int, _timestamp: int) -> bool:
        checked.append((stamp_ns - WALL_NS) // NS_PER_S)
        return True

    node = WatcherNode(PictureReader(VideoReceiver(Decoder(), None), agrees, reads_doubtful=reads_doubtful))
    first, second, third = units(3)
    keyframe = units(1)[0]
    pictures = [read_unit(node, unit) for unit in (first, replace(second, complete=False), third, keyframe)]
    assert [picture.in_doubt for picture in pictures] == [False, True, True, False]
    assert checked == ([0, 1, 2, 0] if reads_doubtful else [0, 0])
    assert [picture.readable for picture in pictures] == [True, reads_doubtful, reads_doubtful, True]


def test_only_clear_stamps() -> None:
    """The strict reader rejects a stamp whose cells are neither black nor white."""
    (grey,) = units(1, contrast=0.2)
    assert read_unit(WatcherNode(PictureReader(VideoReceiver(Decoder(), None))), grey).stamp_ns == WALL_NS
    strict = read_unit(WatcherNode(PictureReader(VideoReceiver(Decoder(), None, read_clear_stamp))), grey)
    assert strict.stamp_ns is None
    assert "neither black nor white" in strict.reason
