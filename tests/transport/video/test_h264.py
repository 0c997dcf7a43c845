from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lavt.domain import Picture
from lavt.errors import UserError
from lavt.streams import stream
from lavt.transport.rtp.rtp import split_nal_units
from lavt.transport.video.h264 import Decoder, Encoder
from lavt.transport.video.stamp import STAMP_PX, read_stamp, write_stamp

WIDTH, HEIGHT = 320, 240
GOP_FRAMES = 15
"""Access unit 15 of the tests is therefore the second keyframe."""
START_NS = 1_790_000_000_000_000_000
FRAME_NS = 33_333_333


def moving_pictures(count: int) -> list[Picture]:
    texture = stream(1, "texture").integers(0, 256, (HEIGHT, WIDTH + 4 * count, 3), dtype=np.uint8)
    texture = np.asarray(cv2.GaussianBlur(texture, (0, 0), 1.5), dtype=np.uint8)
    pictures = [texture[:, 4 * number : 4 * number + WIDTH].copy() for number in range(count)]
    for number, picture in enumerate(pictures):
        write_stamp(picture, START_NS + number * FRAME_NS)
    return pictures


def new_encoder(**changes: float) -> Encoder:
    encoder_settings = {"rate_hz": 30, "bit_rate_bps": 1_000_000, "gop_frames": GOP_FRAMES} | changes
    return Encoder(WIDTH, HEIGHT, **encoder_settings)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def pictures() -> list[Picture]:
    return moving_pictures(40)


@pytest.fixture(scope="module")
def access_units(pictures: list[Picture]) -> list[bytes]:
    encode = new_encoder().encode
    return [encode(picture) for picture in pictures]


def nal_types(access_unit: bytes) -> list[int]:
    return [unit[0] & 0x1F for unit in split_nal_units(access_unit)]


def test_each_picture_is_decoded_without_delay(pictures: list[Picture]) -> None:
    """Each picture gives one access unit, which decodes to that picture with its stamp, without a frame of delay."""
    sender, receiver = new_encoder(), Decoder()
    for number, picture in enumerate(pictures):
        access_unit = sender.encode(picture)
        assert sum(nal_type in {1, 5} for nal_type in nal_types(access_unit)) == 1
        decoded = receiver.decode(access_unit)
        assert decoded is not None
        assert read_stamp(decoded.luma) == START_NS + number * FRAME_NS
        assert not decoded.corrupt


def test_decoded_picture_resembles_the_original(pictures: list[Picture], access_units: list[bytes]) -> None:
    """A decoded picture has the size and channel order of the original and differs by a few grey levels."""
    decoded = Decoder().decode(access_units[0])
    assert decoded is not None
    assert decoded.picture.shape == (HEIGHT, WIDTH, 3)
    assert decoded.luma.shape == (HEIGHT, WIDTH)
    assert np.abs(decoded.picture.astype(int) - pictures[0]).mean() < 12
    plain = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    plain[:] = 200, 100, 50
    plain[:STAMP_PX, :STAMP_PX] = 255
    plain[-STAMP_PX:, -STAMP_PX:] = 0
    decoded_plain = Decoder().decode(new_encoder().encode(plain))
    assert decoded_plain is not None
    assert np.abs(decoded_plain.picture[120, 160].astype(int) - (200, 100, 50)).max() < 4
    assert abs(int(decoded_plain.luma[20, 20]) - 235) < 3
    assert abs(int(decoded_plain.luma[-20, -20]) - 16) < 3


def test_encoding_is_reproducible(pictures: list[Picture], access_units: list[bytes]) -> None:
    """Encoding is byte-for-byte reproducible by another encoder."""
    encode = new_encoder().encode
    assert [encode(picture) for picture in pictures] == access_units


def test_decoded_pictures_are_not_overwritten(pictures: list[Picture]) -> None:
    """A decoded picture is not overwritten when later pictures are encoded and decoded."""
    sender, receiver = new_encoder(), Decoder()
    first = receiver.decode(sender.encode(pictures[0]))
    assert first is not None
    copies = first.luma.copy(), first.picture.copy()
    for picture in pictures[1:5]:
        receiver.decode(sender.encode(picture))
    assert np.array_equal(first.luma, copies[0])
    assert np.array_equal(first.picture, copies[1])


def test_keyframes(access_units: list[bytes]) -> None:
    """A keyframe comes every `gop_frames` frames and carries its parameter sets in band."""
    for number, access_unit in enumerate(access_units):
        assert ({7, 8, 5} <= set(nal_types(access_unit))) == (number % GOP_FRAMES == 0)


def test_keyframe_on_request(pictures: list[Picture]) -> None:
    """A keyframe is sent with the frame for which it was requested, and decoding can begin with it."""
    sender = new_encoder(gop_frames=300)
    units = [sender.encode(picture, keyframe=number == 7) for number, picture in enumerate(pictures[:10])]
    assert [number for number, unit in enumerate(units) if 5 in nal_types(unit)] == [0, 7]
    assert nal_types(units[7])[:2] == [7, 8]
    receiver = Decoder()
    for number in range(7, 10):
        decoded = receiver.decode(units[number])
        assert decoded is not None
        assert read_stamp(decoded.luma) == START_NS + number * FRAME_NS


def test_bit_rate(pictures: list[Picture], access_units: list[bytes]) -> None:
    """The stream has about the requested bit rate; with a smaller decoder buffer the largest frame is smaller."""
    bits = 8 * sum(len(unit) for unit in access_units)
    assert 0.5e6 < bits / (len(access_units) / 30) < 1.3e6
    encode = new_encoder(buffer_s=1 / 30).encode
    assert max(len(encode(picture)) for picture in pictures) < max(len(unit) for unit in access_units)


def test_empty_access_unit(access_units: list[bytes]) -> None:
    """An empty access unit gives no picture and does not end the stream."""
    receiver = Decoder()
    assert receiver.decode(b"") is None
    assert receiver.decode(access_units[0]) is not None
    assert receiver.decode(b"") is None
    assert receiver.decode(access_units[1]) is not None


def test_no_picture_before_a_keyframe(access_units: list[bytes]) -> None:
    """Access units before the first keyframe give no picture."""
    receiver = Decoder()
    assert [receiver.decode(unit) for unit in access_units[1:4]] == [None, None, None]
    assert receiver.decode(access_units[GOP_FRAMES]) is not None


def test_truncated_access_unit(access_units: list[bytes]) -> None:
    """A truncated access unit gives a picture with concealed damage, marked as corrupt."""
    receiver = Decoder()
    receiver.decode(access_units[0])
    decoded = receiver.decode(access_units[1][: len(access_units[1]) // 2])
    assert decoded is not None
    assert decoded.corrupt


def test_keyframe_after_damage(access_units: list[bytes]) -> None:
    """A keyframe after a truncated picture decodes without any trace of the damage."""
    clean = Decoder().decode(access_units[GOP_FRAMES])
    assert clean is not None
    for kept_bytes in range(100, len(access_units[GOP_FRAMES - 1]), 97):
        receiver = Decoder()
        receiver.decode(access_units[0])
        receiver.decode(access_units[GOP_FRAMES - 1][:kept_bytes])
        decoded = receiver.decode(access_units[GOP_FRAMES])
        assert decoded is not None
        assert np.array_equal(decoded.picture, clean.picture)


def test_lost_access_units(access_units: list[bytes]) -> None:
    """After two lost access units each later one gives a picture, and the next keyframe gives the picture sent."""
    receiver = Decoder()
    receiver.decode(access_units[0])
    for number in range(3, GOP_FRAMES):
        decoded = receiver.decode(access_units[number])
        assert decoded is not None
    decoded = receiver.decode(access_units[GOP_FRAMES])
    assert decoded is not None
    assert read_stamp(decoded.luma) == START_NS + GOP_FRAMES * FRAME_NS


def test_sender_restarts_with_another_size(access_units: list[bytes]) -> None:
    """The decoder follows a sender that restarts with another picture size."""
    receiver = Decoder()
    receiver.decode(access_units[0])
    other = Encoder(128, 96, rate_hz=30, bit_rate_bps=500_000, gop_frames=15)
    decoded = receiver.decode(other.encode(np.zeros((96, 128, 3), np.uint8)))
    assert decoded is not None
    assert decoded.picture.shape == (96, 128, 3)


@settings(max_examples=60)
@given(st.binary(max_size=200), st.booleans())
def test_any_bytes(access_units: list[bytes], data: bytes, start_code: bool) -> None:
    """Arbitrary bytes raise nothing and do not prevent the decoder from decoding the next keyframe."""
    receiver = Decoder()
    receiver.decode(access_units[0])
    receiver.decode(b"\x00\x00\x00\x01" * start_code + data)
    decoded = receiver.decode(access_units[GOP_FRAMES])
    assert decoded is not None
    assert read_stamp(decoded.luma) == START_NS + GOP_FRAMES * FRAME_NS


@settings(max_examples=40)
@given(st.lists(st.tuples(st.integers(0, 14), st.integers(0, 10**6), st.integers(1, 255)), min_size=1, max_size=12))
def test_damage_is_deterministic(access_units: list[bytes], damage: list[tuple[int, int, int]]) -> None:
    """Decoding a damaged stream is reproducible: concealment does not depend on uninitialized memory."""
    units = [bytearray(unit) for unit in access_units[:GOP_FRAMES]]
    for number, position, flipped_bits in damage:
        units[number][position % len(units[number])] ^= flipped_bits
    first, second = Decoder(), Decoder()
    for unit in units:
        one, other = first.decode(bytes(unit)), second.decode(bytes(unit))
        assert (one is None) == (other is None)
        if one is not None and other is not None:
            assert np.array_equal(one.picture, other.picture)
            assert one.corrupt == other.corrupt


@pytest.mark.parametrize("size", [(321, 240), (320, 241), (62, 240), (320, 62), (8192, 8192)])
def test_invalid_sizes_are_rejected(size: tuple[int, int]) -> None:
    """Sizes that are odd, smaller than the stamp or larger than the decoder's limit are rejected."""
    with pytest.raises(UserError, match="choose"):
        Encoder(*size, rate_hz=30, bit_rate_bps=1_000_000, gop_frames=15)


@pytest.mark.parametrize(
    "change",
    [{"rate_hz": 0}, {"rate_hz": float("nan")}, {"bit_rate_bps": 0}, {"gop_frames": 0}, {"buffer_s": 0.0}],
)
def test_invalid_rates_are_rejected(change: dict[str, float]) -> None:
    """Rates, keyframe intervals and buffers of zero are rejected."""
    with pytest.raises(UserError, match="choose"):
        new_encoder(**change)


def test_unknown_preset_is_rejected() -> None:
    """A preset that libx264 does not have is rejected, and the error names the valid ones."""
    with pytest.raises(UserError, match="ultrafast, superfast"):
        Encoder(WIDTH, HEIGHT, rate_hz=30, bit_rate_bps=1_000_000, gop_frames=15, preset="fastest")


def test_picture_of_another_size_is_rejected() -> None:
    """A picture of another size than the encoder's is rejected."""
    with pytest.raises(UserError, match="shape"):
        new_encoder().encode(np.zeros((WIDTH, HEIGHT, 3), np.uint8))


def test_nothing_is_printed(
    capfd: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture, access_units: list[bytes]
) -> None:
    """Neither a damaged stream nor the end of an encoder prints or logs anything."""
    receiver = Decoder()
    receiver.decode(access_units[1])
    receiver.decode(access_units[0][:500])
    sender = new_encoder()
    sender.encode(np.zeros((HEIGHT, WIDTH, 3), np.uint8))
    del sender
    assert capfd.readouterr() == ("", "")
    assert caplog.records == []
