"""The CRC of frames agrees with the published vectors and with those worked out by hand."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from lavt.vehicle.dbw.crc8 import crc8, frame_crc8

VECTORS: dict[str, Any] = yaml.safe_load((Path(__file__).parent / "vectors" / "crc8.yaml").read_text())
FRAMES = st.tuples(st.integers(0, 0x7FF), st.binary(max_size=7))


@pytest.mark.parametrize("vector", VECTORS["plain"], ids=lambda vector: vector["fact"])
def test_plain(vector: dict[str, Any]) -> None:
    """The CRC of bytes is as published."""
    assert crc8(bytes.fromhex(vector["data"])) == vector["crc"]


def test_alphanumeric() -> None:
    """The CRC of the 62 letters and digits is as published."""
    assert crc8(VECTORS["alphanumeric"]["text"].encode()) == VECTORS["alphanumeric"]["crc"]


@pytest.mark.parametrize("vector", VECTORS["frames"], ids=lambda vector: f"{vector['identifier']:X} {vector['data']}")
def test_frame(vector: dict[str, Any]) -> None:
    """The CRC of a frame covers its identifier, high byte first, and then its data."""
    crc = frame_crc8(vector["identifier"], bytes.fromhex(vector["data"]), extended=vector["extended"])
    assert crc == vector["crc"]


@pytest.mark.parametrize("vector", VECTORS["plain"] + VECTORS["frames"], ids=lambda vector: vector["registers"])
def test_inverted_once(vector: dict[str, Any]) -> None:
    """The CRC is the inverted register after the last byte."""
    registers = bytes.fromhex(vector["registers"])
    assert vector["crc"] == (registers[-1] if registers else 0xFF) ^ 0xFF


@given(frame=FRAMES, bit=st.integers(min_value=0))
def test_a_flipped_bit(frame: tuple[int, bytes], bit: int) -> None:
    """A frame with one flipped bit has another CRC."""
    identifier, data = frame
    if data:
        wrong = (int.from_bytes(data, "big") ^ 1 << bit % (8 * len(data))).to_bytes(len(data), "big")
        assert frame_crc8(identifier, wrong) != frame_crc8(identifier, data)


@given(frame=FRAMES, changed=st.integers(1, 0xFF) | st.integers(1, 7).map(lambda high: high << 8))
def test_another_identifier(frame: tuple[int, bytes], changed: int) -> None:
    """The same data under an identifier that differs in one byte has another CRC."""
    identifier, data = frame
    assert frame_crc8(identifier ^ changed, data) != frame_crc8(identifier, data)
