from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lavt.errors import BadPacket, UserError
from lavt.streams import stream
from lavt.transport.stamp import (
    STAMP_PX,
    holds_stamp,
    read_stamp,
    rtp_timestamp,
    stamp_agrees,
    write_stamp,
    write_stamp_i420,
    write_stamp_luma,
)

STAMPS = st.integers(min_value=0, max_value=2**64 - 1)


@given(STAMPS)
def test_round_trip(stamp_ns: int) -> None:
    """Every 64-bit time that is written into a picture is read back from it."""
    picture = np.full((STAMP_PX, STAMP_PX + 16, 3), 90, np.uint8)
    write_stamp(picture, stamp_ns)
    assert read_stamp(picture[..., 0]) == stamp_ns


@given(STAMPS, st.integers(min_value=0, max_value=100))
def test_noise(stamp_ns: int, seed: int) -> None:
    """The stamp is read through noise of 40 grey levels on video range luma."""
    picture = np.zeros((STAMP_PX, STAMP_PX, 3), np.uint8)
    write_stamp(picture, stamp_ns)
    luma = 16 + picture[..., 0].astype(np.float64) * 219 / 255
    noisy = luma + stream(seed, "noise").normal(0, 40, luma.shape)
    assert read_stamp(noisy.clip(0, 255).astype(np.uint8)) == stamp_ns


def test_layout() -> None:
    """The stamp is 8 x 8 cells of 8 x 8 pixels, row by row, most significant bit first, white for 1."""
    picture = np.full((80, 80, 3), 90, np.uint8)
    write_stamp(picture, 1 << 63 | 1 << 54 | 1)
    white = np.argwhere(picture[:64, :64, 1] == 255)
    assert {(row // 8, column // 8) for row, column in white.tolist()} == {(0, 0), (1, 1), (7, 7)}
    assert len(white) == 3 * 64
    assert set(np.unique(picture[:64, :64])) == {0, 255}


def test_rest_of_the_picture() -> None:
    """Nothing outside the corner of 64 x 64 pixels changes."""
    picture = np.full((96, 112, 3), 90, np.uint8)
    write_stamp(picture, 2**64 - 1)
    picture[:STAMP_PX, :STAMP_PX] = 90
    assert (picture == 90).all()


def test_part_of_a_larger_array() -> None:
    """A stamp goes in place into a picture that is a view of another array."""
    array = np.zeros((200, 300, 3), np.uint8)
    write_stamp(array[50:, 100:], 0xFFFF_0000_FFFF_0000)
    assert read_stamp(array[50:, 100:, 2]) == 0xFFFF_0000_FFFF_0000


def test_centre_of_the_cells() -> None:
    """Only the centre half of each cell counts, so what a filter does to the edges does not matter."""
    picture = np.zeros((64, 64, 3), np.uint8)
    write_stamp(picture, 0x0123_4567_89AB_CDEF)
    luma = picture[..., 0].copy()
    edges = np.ones((8, 8), bool)
    edges[2:6, 2:6] = False
    luma[np.tile(edges, (8, 8))] ^= 255
    assert read_stamp(luma) == 0x0123_4567_89AB_CDEF


def test_threshold() -> None:
    """A cell is white when its mean is above 128, the middle between black and white."""
    picture = np.zeros((64, 64, 3), np.uint8)
    write_stamp(picture, 0x0123_4567_89AB_CDEF)
    assert read_stamp(np.where(picture[..., 0] > 0, 129, 128).astype(np.uint8)) == 0x0123_4567_89AB_CDEF


@given(STAMPS, st.sampled_from([(64, 64), (66, 130), (98, 134), (128, 160)]), st.integers(min_value=0, max_value=100))
def test_i420(stamp_ns: int, size: tuple[int, int], seed: int) -> None:
    """A stamp written into I420 gives the bytes that writing it into BGR and converting gives, at every even size."""
    picture = stream(seed, "picture").integers(0, 256, (*size, 3), dtype=np.uint8)
    planes = np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2YUV_I420), np.uint8)
    write_stamp_i420(planes, stamp_ns)
    stamped = picture.copy()
    write_stamp(stamped, stamp_ns)
    assert np.array_equal(planes, cv2.cvtColor(stamped, cv2.COLOR_BGR2YUV_I420))
    assert read_stamp(planes[: size[0]]) == stamp_ns


def test_luma_alone() -> None:
    """A stamp goes in place into a luma plane with gaps between its rows, 16 and 235, and changes only its corner."""
    array = np.full((100, 200), 90, np.uint8)
    write_stamp_luma(array[10:, 20:130], 1 << 63 | 1)
    assert read_stamp(array[10:, 20:]) == 1 << 63 | 1
    assert set(np.unique(array[10:74, 20:84])) == {16, 235}
    array[10:74, 20:84] = 90
    assert (array == 90).all()


def test_i420_with_gaps() -> None:
    """An I420 array with gaps is refused rather than left without neutral chroma."""
    with pytest.raises(ValueError, match="one block"):
        write_stamp_i420(np.zeros((96, 160), np.uint8)[:, :128], 1)


def test_too_small() -> None:
    """A picture without room for the stamp is the user's error when written and the peer's when read."""
    with pytest.raises(UserError, match="64 x 64"):
        write_stamp(np.zeros((64, 63, 3), np.uint8), 1)
    with pytest.raises(UserError, match="64 x 64"):
        write_stamp_luma(np.zeros((63, 64), np.uint8), 1)
    with pytest.raises(UserError, match="64 x 64"):
        write_stamp_i420(np.zeros((93, 64), np.uint8), 1)
    with pytest.raises(BadPacket):
        read_stamp(np.zeros((63, 64), np.uint8))


def test_rtp_timestamp() -> None:
    """The RTP timestamp counts 90 kHz ticks of the stamp and wraps at 32 bits."""
    assert rtp_timestamp(1_000_000_000) == 90_000
    assert rtp_timestamp(11_111) == 0
    assert rtp_timestamp(11_112) == 1
    assert rtp_timestamp(2**32 * 100_000 // 9 + 1) == 0


@given(STAMPS, st.integers(min_value=0, max_value=63))
def test_agreement(stamp_ns: int, bit: int) -> None:
    """A stamp agrees with its own timestamp, and one with a wrong bit above the lowest 13 does not."""
    assert stamp_agrees(stamp_ns, rtp_timestamp(stamp_ns))
    if bit > 13:
        assert not stamp_agrees(stamp_ns ^ 1 << bit, rtp_timestamp(stamp_ns))


def test_a_picture_with_a_stamp_is_told_from_one_without() -> None:
    """A corner of black and white cells is a stamp; plain, grey or noisy corners and tiny pictures hold none."""
    picture = np.full((128, 160, 3), 90, dtype=np.uint8)
    assert not holds_stamp(picture)
    assert not holds_stamp(np.zeros_like(picture))
    assert not holds_stamp(np.zeros((40, 40, 3), dtype=np.uint8))
    write_stamp(picture, 1_700_000_000_123_456_789)
    assert holds_stamp(picture)
    picture[:64, :64] = picture[:64, :64] // 3 + 80
    assert not holds_stamp(picture)
