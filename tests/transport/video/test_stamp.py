from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lavt.errors import BadPacket, UserError
from lavt.streams import stream
from lavt.transport.video.stamp import (
    STAMP_PX,
    has_stamp,
    read_clear_stamp,
    read_stamp,
    rtp_timestamp,
    stamp_agrees,
    stamp_near,
    write_stamp,
    write_stamp_i420,
    write_stamp_luma,
)

STAMPS = st.integers(min_value=0, max_value=2**64 - 1)


@given(STAMPS)
def test_round_trip(stamp_ns: int) -> None:
    """A 64-bit time that is written into a picture is read back from it."""
    picture = np.full((STAMP_PX, STAMP_PX + 16, 3), 90, np.uint8)
    write_stamp(picture, stamp_ns)
    assert read_stamp(picture[..., 0]) == stamp_ns


@given(STAMPS, st.integers(min_value=0, max_value=100))
def test_noise(stamp_ns: int, seed: int) -> None:
    """The stamp is read despite noise of 40 grey levels on limited-range luma."""
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
    """The stamp changes nothing outside the corner of 64 x 64 pixels."""
    picture = np.full((96, 112, 3), 90, np.uint8)
    write_stamp(picture, 2**64 - 1)
    picture[:STAMP_PX, :STAMP_PX] = 90
    assert (picture == 90).all()


def test_part_of_a_larger_array() -> None:
    """A stamp is written in place into a picture that is a view of another array."""
    array = np.zeros((200, 300, 3), np.uint8)
    write_stamp(array[50:, 100:], 0xFFFF_0000_FFFF_0000)
    assert read_stamp(array[50:, 100:, 2]) == 0xFFFF_0000_FFFF_0000


def test_centre_of_the_cells() -> None:
    """Only the central 4 x 4 pixels of each cell are read, so a filter that changes the edges does no harm."""
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
    """A stamp in I420 is byte-for-byte the same as one written into BGR and converted, at every even size."""
    picture = stream(seed, "picture").integers(0, 256, (*size, 3), dtype=np.uint8)
    planes = np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2YUV_I420), np.uint8)
    write_stamp_i420(planes, stamp_ns)
    stamped = picture.copy()
    write_stamp(stamped, stamp_ns)
    assert np.array_equal(planes, cv2.cvtColor(stamped, cv2.COLOR_BGR2YUV_I420))
    assert read_stamp(planes[: size[0]]) == stamp_ns


def test_luma_alone() -> None:
    """A stamp is written in place, as 16 and 235, into a luma plane with gaps between its rows."""
    array = np.full((100, 200), 90, np.uint8)
    write_stamp_luma(array[10:, 20:130], 1 << 63 | 1)
    assert read_stamp(array[10:, 20:]) == 1 << 63 | 1
    assert set(np.unique(array[10:74, 20:84])) == {16, 235}
    array[10:74, 20:84] = 90
    assert (array == 90).all()


def test_i420_with_gaps() -> None:
    """An I420 array with gaps is rejected, since its chroma could not be made neutral."""
    with pytest.raises(ValueError, match="one block"):
        write_stamp_i420(np.zeros((96, 160), np.uint8)[:, :128], 1)


def test_too_small() -> None:
    """A picture without room for the stamp raises `UserError` when written and `BadPacket` when read."""
    with pytest.raises(UserError, match="64 x 64"):
        write_stamp(np.zeros((64, 63, 3), np.uint8), 1)
    with pytest.raises(UserError, match="64 x 64"):
        write_stamp_luma(np.zeros((63, 64), np.uint8), 1)
    with pytest.raises(UserError, match="64 x 64"):
        write_stamp_i420(np.zeros((93, 64), np.uint8), 1)
    with pytest.raises(BadPacket):
        read_stamp(np.zeros((63, 64), np.uint8))


SHAPES = st.lists(st.sampled_from([0, 1, 2, 63, 64, 65, 128]), max_size=4)


@given(SHAPES)
def test_any_shape(shape: list[int]) -> None:
    """An array of any shape is read as a stamp or raises `BadPacket`, and nothing else."""
    readable = len(shape) == 2 and min(shape) >= STAMP_PX
    for read in (read_stamp, read_clear_stamp):
        try:
            assert read(np.zeros(shape, np.uint8)) == 0
        except BadPacket:
            assert not readable
        else:
            assert readable


def test_clear_stamp() -> None:
    """A clear stamp has only cells in the darkest or the brightest third; reading any other raises `BadPacket`."""
    luma = np.zeros((64, 80), np.uint8)
    write_stamp_luma(luma, 0x0123_4567_89AB_CDEF)
    assert read_clear_stamp(luma) == 0x0123_4567_89AB_CDEF
    for grey, expected_ns in ((88, 0x0123_4567_89AB_CDEF), (163, 0x0123_4567_89AB_CDEF | 1 << 63)):
        luma[:8, :8] = grey
        assert read_clear_stamp(luma) == expected_ns
    for grey in (89, 128, 162):
        luma[:8, :8] = grey
        with pytest.raises(BadPacket, match="neither"):
            read_clear_stamp(luma)


@given(st.integers(2**60, 2**61), st.integers(-(10**13), 10**13))
def test_a_stamp_follows_from_the_rtp_timestamp(stamp_ns: int, since_ns: int) -> None:
    """With a time within some hours of it, the RTP timestamp tells the stamp, at most 12 us too early."""
    found_ns = stamp_near(rtp_timestamp(stamp_ns), stamp_ns + since_ns)
    assert 0 <= stamp_ns - found_ns < 12_000
    assert stamp_agrees(found_ns, rtp_timestamp(stamp_ns))


def test_rtp_timestamp() -> None:
    """The RTP timestamp is the stamp in units of 1/90000 s, and wraps at 32 bits."""
    assert rtp_timestamp(1_000_000_000) == 90_000
    assert rtp_timestamp(11_111) == 0
    assert rtp_timestamp(11_112) == 1
    assert rtp_timestamp(2**32 * 100_000 // 9 + 1) == 0


@given(STAMPS, st.integers(min_value=0, max_value=63))
def test_agreement(stamp_ns: int, bit: int) -> None:
    """A stamp agrees with its own timestamp, but not if a bit above the lowest 14 is wrong."""
    assert stamp_agrees(stamp_ns, rtp_timestamp(stamp_ns))
    if bit > 13:
        assert not stamp_agrees(stamp_ns ^ 1 << bit, rtp_timestamp(stamp_ns))


def stamp_error_ns(read_ns: int, true_ns: int) -> float:
    """Return the error of a stamp, modulo the wrap of the RTP timestamp (after 2^32 units of 1/90000 s, 13.3 h)."""
    ninths = abs(read_ns - true_ns) * 9 % (2**32 * 100_000)
    return min(ninths, 2**32 * 100_000 - ninths) / 9


@given(st.binary(min_size=64, max_size=64), st.integers(min_value=0, max_value=100), st.integers(-60_000, 60_000))
def test_any_picture(greys: bytes, seed: int, offset_ns: int) -> None:
    """For any pixels and any sent stamp, an accepted stamp differs from the sent stamp by less than 12 us."""
    cells = np.frombuffer(greys, np.uint8).reshape(8, 8).repeat(8, axis=0).repeat(8, axis=1)
    noise = stream(seed, "noise").integers(0, 256, cells.shape, dtype=np.uint8)
    for luma in (cells, noise, cells // 2 + noise // 2):
        read_ns = read_stamp(luma)
        for sent_ns in (abs(read_ns + offset_ns), int.from_bytes(greys[:8], "big")):
            assert not stamp_agrees(read_ns, rtp_timestamp(sent_ns)) or stamp_error_ns(read_ns, sent_ns) < 12_000


@given(STAMPS, st.lists(st.integers(min_value=0, max_value=63), max_size=4), st.integers(min_value=0, max_value=2**14))
def test_any_damage(stamp_ns: int, wrong_bits: list[int], low_bits: int) -> None:
    """Whichever cells of a stamp are damaged, an accepted stamp differs from the sent one by less than 12 us."""
    damaged_ns = stamp_ns ^ low_bits
    for bit in wrong_bits:
        damaged_ns ^= 1 << bit
    luma = np.full((STAMP_PX, STAMP_PX), 90, np.uint8)
    write_stamp_luma(luma, damaged_ns)
    assert not stamp_agrees(read_stamp(luma), rtp_timestamp(stamp_ns)) or stamp_error_ns(damaged_ns, stamp_ns) < 12_000


@given(STAMPS, st.integers(min_value=0, max_value=2**32 - 1))
def test_any_timestamp(stamp_ns: int, timestamp: int) -> None:
    """A stamp agrees with exactly one timestamp."""
    assert stamp_agrees(stamp_ns, timestamp) == (timestamp == rtp_timestamp(stamp_ns))


def test_stamped_pictures_are_recognized() -> None:
    """A corner of black and white cells is a stamp; plain and grey corners and tiny pictures have none."""
    picture = np.full((128, 160, 3), 90, dtype=np.uint8)
    assert not has_stamp(picture)
    assert not has_stamp(np.zeros_like(picture))
    assert not has_stamp(np.zeros((40, 40, 3), dtype=np.uint8))
    write_stamp(picture, 1_700_000_000_123_456_789)
    assert has_stamp(picture)
    picture[:64, :64] = picture[:64, :64] // 3 + 80
    assert not has_stamp(picture)
