"""Encoding and decoding of the kit's frames."""

import ast
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.vehicle.software_car.rig import START_NS, crc_by_division

import lavt.vehicle.software_car as package
from lavt.domain import NS_PER_MS
from lavt.vehicle.can_frame import CanFrame
from lavt.vehicle.software_car.frames import BitField, Layout, checksum, crc8, has_valid_crc, pack, unpack
from lavt.vehicle.software_car.generation_1 import BRAKE_REPORT, STEERING_REPORT
from lavt.vehicle.software_car.generation_2_layouts import REPORT_LAYOUTS, UNVERIFIED
from lavt.vehicle.software_car.kit import Kit

LETTERS = b"0123456789ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz"
COMMAND_IDENTIFIERS = (0x060, 0x062, 0x064, 0x066, 0x200, 0x201, 0x202, 0x203, 0x210, 0x211, 0x212, 0x213, 0x216)
identifiers = st.sampled_from(COMMAND_IDENTIFIERS) | st.integers(0, 0x7FF)


@pytest.mark.parametrize(("data", "crc"), [(b"", 0x00), (b"0", 0x71), (b"01", 0x28), (b"012", 0x24), (LETTERS, 0xA3)])
def test_the_crc_matches_the_published_values(data: bytes, crc: int) -> None:
    """The CRC of the published strings is as published."""
    assert crc8(data) == crc


def test_the_checksum_begins_with_the_identifier() -> None:
    """The checksum covers the identifier: for identifier 0 without data it is 0xBE, or 0x59 if 0 is extended."""
    assert (checksum(0, b""), checksum(0, b"", is_extended=True)) == (0xBE, 0x59)


@given(st.integers(0, 0x7FF), st.binary(max_size=7))
def test_the_checksum_detects_a_flipped_bit(identifier: int, data: bytes) -> None:
    """The checksum is the remainder of a long division, and detects each flipped bit of the data."""
    crc = crc_by_division(identifier, data)
    assert checksum(identifier, data) == crc
    assert has_valid_crc(CanFrame(identifier, data + bytes([crc])))
    for bit in range(8 * len(data)):
        flipped = bytes(byte ^ (1 << bit % 8 if index == bit // 8 else 0) for index, byte in enumerate(data))
        assert not has_valid_crc(CanFrame(identifier, flipped + bytes([crc])))


@given(st.data())
def test_unpack_inverts_pack(data: st.DataObject) -> None:
    """Values in range are unchanged by packing and unpacking, for every report's layout."""
    layout = data.draw(st.sampled_from([BRAKE_REPORT, STEERING_REPORT, *REPORT_LAYOUTS.values()]))
    values = {field.name: data.draw(st.integers(field.lowest_value, field.highest_value)) for field in layout.fields}
    assert unpack(layout, pack(layout, values)) == values


def test_values_out_of_range_are_clamped() -> None:
    """A value that does not fit its field is clamped and changes no other field."""
    layout = Layout(2, (BitField("low", 0, 4), BitField("signed", 4, 4, is_signed=True), BitField("high", 8, 8)))
    assert pack(layout, {"low": 99, "signed": -99, "high": 300}) == bytes([0x8F, 0xFF])
    with pytest.raises(KeyError, match="other"):
        pack(layout, {"other": 1})


def test_fields_do_not_overlap() -> None:
    """In every report no two fields overlap, and no field overlaps the checksum."""
    for identifier, layout in REPORT_LAYOUTS.items():
        bits = [bit for field in layout.fields for bit in range(field.bit, field.bit + field.width)]
        assert len(bits) == len(set(bits))
        assert max(bits) < (64 if identifier == 0x2A4 else 56)
        assert identifier in UNVERIFIED


@given(
    generation=st.sampled_from([1, 2]),
    frames=st.lists(st.tuples(identifiers, st.binary(max_size=8), st.booleans(), st.integers(0, 30)), max_size=40),
)
def test_random_frames_enable_nothing(generation: int, frames: list[tuple[int, bytes, bool, int]]) -> None:
    """Random frames without a valid checksum or without an enable bit raise no error and enable nothing."""
    kit = Kit(1 if generation == 1 else 2, start_ns=START_NS)
    now_ns = START_NS
    for identifier, data, is_extended, wait_ms in frames:
        frame = CanFrame(identifier, data, is_extended)
        if generation == 2 and has_valid_crc(frame):
            continue
        enable_byte = {0x060: 3, 0x062: 3, 0x064: 2}.get(identifier)
        if generation == 1 and enable_byte is not None and len(data) == 8 and not is_extended:
            data = bytes(byte & ~(index == enable_byte) for index, byte in enumerate(data))  # noqa: PLW2901
        now_ns += wait_ms * NS_PER_MS
        kit.receive(CanFrame(identifier, data, is_extended), now_ns)
        kit.frames_due(now_ns)
        assert not any(actuator.is_enabled for actuator in kit.state.actuators.values())
        assert kit.actuation(now_ns).throttle == 0.0
        assert kit.next_wake_ns() > now_ns


@given(
    generation=st.sampled_from([1, 2]),
    frames=st.lists(st.tuples(identifiers, st.binary(min_size=1, max_size=8), st.integers(0, 60)), max_size=60),
)
def test_valid_but_senseless_frames_raise_nothing(generation: int, frames: list[tuple[int, bytes, int]]) -> None:
    """Frames with valid checksums and random contents raise no error, and the actuation stays in range."""
    kit = Kit(1 if generation == 1 else 2, start_ns=START_NS)
    now_ns = START_NS
    for identifier, data, wait_ms in frames:
        now_ns += wait_ms * NS_PER_MS
        frame_data = data if generation == 1 else data[:-1] + bytes([checksum(identifier, data[:-1])])
        kit.receive(CanFrame(identifier, frame_data), now_ns)
        actuation = kit.actuation(now_ns)
        assert abs(actuation.steering_rad) <= 9.6 / 14.8
        assert 0.0 <= actuation.throttle <= 1.0
        assert 0.0 <= actuation.brake <= 1.0
        assert all(len(frame.data) <= 8 for frame in kit.frames_due(now_ns))


def test_the_software_car_shares_no_codec() -> None:
    """The software car imports neither the adapter nor python-can nor cantools."""
    for path in Path(package.__file__).parent.glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            assert not any(name.startswith(("lavt.vehicle.dbw", "can", "cantools")) for name in names), path
