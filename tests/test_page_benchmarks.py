from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from benchmarks.page_flood import gaps
from benchmarks.pages.floods import PING, TEXT, frame
from benchmarks.pages.frame_buffer import FrameBuffer, Place

from lavt.domain import NS_PER_MS
from lavt.transport.video.stamp import write_stamp

STAMP_NS = 0x18A5_5A00_FF12_3456
HEADER_BYTES, COLOURS = 160, 256
WIDTH_PX, HEIGHT_PX = 300, 200


def screen_file(path: Path, picture: np.ndarray[tuple[int, ...], np.dtype[np.uint8]]) -> Path:
    """Write a file as Xvfb does: header, colours, and 4 bytes for each pixel."""
    header = np.zeros(HEADER_BYTES // 4, ">u4")
    header[0], header[12], header[19] = HEADER_BYTES, WIDTH_PX * 4, COLOURS
    pixels = np.zeros((HEIGHT_PX, WIDTH_PX, 4), np.uint8)
    pixels[..., :3] = picture
    path.write_bytes(header.tobytes() + bytes(12 * COLOURS) + pixels.tobytes())
    return path


@pytest.mark.parametrize("scale", [1, 2])
def test_the_stamp_is_read_from_the_screen(tmp_path: Path, scale: int) -> None:
    """The stamp of a picture is read from its place on the screen, also if the picture is scaled."""
    picture = np.zeros((64, 64, 3), np.uint8)
    write_stamp(picture, STAMP_NS)
    screen = np.full((HEIGHT_PX, WIDTH_PX, 3), 90, np.uint8)
    screen[20 : 20 + 64 * scale, 30 : 30 + 64 * scale] = picture.repeat(scale, 0).repeat(scale, 1)
    buffer = FrameBuffer(screen_file(tmp_path / "screen", screen), ":0")
    assert buffer.read_stamp(Place(30, 20, scale)) == STAMP_NS
    assert buffer.read_stamp(Place(100, 60, scale)) is None


def test_gaps_include_the_ends() -> None:
    """If no event comes during an attack, the gap is the whole attack."""
    times_ns = np.array([0, 10, 500]) * NS_PER_MS
    assert gaps("command", times_ns, 100 * NS_PER_MS, 400 * NS_PER_MS)["command_max_ms"] == 300
    assert gaps("command", times_ns, 0, 20 * NS_PER_MS)["command_max_ms"] == 10


def test_frames_are_masked() -> None:
    """A frame of a page has a mask, and its length in one or three bytes."""
    assert frame(PING) == bytes([0x89, 0x80, 0, 0, 0, 0])
    assert frame(TEXT, b"x" * 126)[:4] == bytes([0x81, 0xFE, 0, 126])
