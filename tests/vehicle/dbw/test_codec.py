"""Values are encoded to the bytes worked out by hand, and any frame of a bus is decoded or counted."""

from __future__ import annotations

import math
from importlib.resources import as_file, files
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.vehicle.dbw.rig import vector_file

from lavt.errors import UserError
from lavt.vehicle.can_frame import CanFrame
from lavt.vehicle.dbw import codec as codec_module
from lavt.vehicle.dbw.codec import Codec

PROFILES = ("dataspeed_gen1", "dataspeed_gen2")


def shipped(profile: str) -> Codec:
    with as_file(files("lavt.vehicle.dbw") / "profiles" / f"{profile}.dbc") as path:
        return Codec(path)


CODECS = {profile: shipped(profile) for profile in PROFILES}
GENERATION_1, GENERATION_2 = CODECS.values()

VECTORS = [
    pytest.param(CODECS[profile], vector, id=f"{profile}: {vector['name']}")
    for profile in PROFILES
    for vector in vector_file(profile)["vectors"]
]

AWKWARD = """VERSION ""
BS_:
BU_: A
BO_ 2566844671 Far: 8 A
 SG_ TEMPERATURE : 0|8@1+ (0.5,-40) [-30|80] "C" A
 SG_ REAL : 8|32@1- (1,0) [0|0] "" A
BO_ 16 Nested: 8 A
 SG_ OUTER M : 0|4@1+ (1,0) [0|15] "" A
 SG_ INNER m1M : 4|4@1+ (1,0) [0|15] "" A
 SG_ DEEP m2 : 8|8@1+ (1,0) [0|255] "" A
BO_ 17 Unlimited: 8 A
 SG_ UNSIGNED : 0|8@1+ (1,0) [0|0] "" A
 SG_ SIGNED : 8|8@1- (0.5,1) [0|0] "" A
SIG_VALTYPE_ 2566844671 REAL : 1;
SG_MUL_VAL_ 16 INNER OUTER 1-1;
SG_MUL_VAL_ 16 DEEP INNER 2-2;
"""


def awkward(tmp_path: Path) -> Codec:
    (tmp_path / "awkward.dbc").write_text(AWKWARD)
    return Codec(tmp_path / "awkward.dbc")


@pytest.mark.parametrize(("codec", "vector"), VECTORS)
def test_vectors(codec: Codec, vector: dict[str, Any]) -> None:
    """A vector's values are encoded to its frame, except for the CRC, and the frame is decoded to the values."""
    data = bytes.fromhex(vector["data"])
    encoded = codec.encode(vector["message"], vector["signals"], length=len(data))
    has_crc = "CRC" in codec.messages[vector["message"]].signals
    assert encoded[: len(data) - has_crc] == data[: len(data) - has_crc]
    decoded = codec.decode(CanFrame(vector["id"], data), short=True)
    assert decoded is not None
    message, decoded_values = decoded
    assert message == vector["message"]
    for name, signal in codec.messages[message].signals.items():
        value = vector["signals"].get(name)
        if value in signal.no_value:
            assert decoded_values[name] is None, name
        elif value is not None and name != "CRC":
            assert decoded_values[name] == pytest.approx(value, abs=abs(signal.scale) / 2 + 1e-9), name


@given(data=st.binary(max_size=8), identifier=st.one_of(st.integers(0, 0x1FFFFFFF), st.sampled_from([0x65, 0x200])))
@pytest.mark.parametrize("codec", CODECS.values(), ids=PROFILES)
@pytest.mark.parametrize("short", [False, True])
def test_any_frame_is_decoded_or_counted(codec: Codec, data: bytes, identifier: int, short: bool) -> None:
    """Any frame is decoded or counted exactly once, and raises nothing."""
    before = sum(codec.counts.values())
    decoded = codec.decode(CanFrame(identifier, data, identifier > 0x7FF), short=short)
    assert (decoded is None) == (sum(codec.counts.values()) == before + 1)
    assert all(value is None or math.isfinite(value) for value in (decoded or ("", {}))[1].values())


def test_counts() -> None:
    """Frames that cannot be decoded are counted by reason: identifier, length, multiplexer."""
    codec = shipped("dataspeed_gen1")
    assert codec.decode(CanFrame(0x555, bytes(8))) is None
    assert codec.decode(CanFrame(0x065, bytes(8), is_extended=True)) is None
    assert codec.decode(CanFrame(0x065, bytes(7))) is None
    assert codec.decode(CanFrame(0x067, bytes(3)), short=True) is None
    assert codec.decode(CanFrame(0x060, bytes([0, 0, 0x50, 0, 0, 0, 0, 0]))) is None  # type 5
    assert codec.counts == {"unknown_identifier": 2, "wrong_length": 2, "unknown_multiplexer": 1}


def test_short_frame() -> None:
    """A frame of four bytes is decoded, on request, to the signals that are complete in it."""
    clear = CanFrame(0x064, bytes([0, 0, 2, 0]))
    assert GENERATION_1.decode(clear) is None
    assert GENERATION_1.decode(clear, short=True) == (
        "SteeringCmd",
        {
            **dict.fromkeys(("SCMD_ANGLE", "EN", "IGNORE", "QUIET", "RES1", "ALERT", "CMD_TYPE", "SVEL"), 0),
            "CLEAR": 1,
        },
    )
    assert GENERATION_1.encode("SteeringCmd", {"CLEAR": 1}, length=4) == clear.data


def test_named_values() -> None:
    """A named value is decoded as a number, and as None if its name means "no value"."""
    report = GENERATION_1.decode(CanFrame(0x065, bytes.fromhex("00 80 00 00 00 80 80 00")))
    assert report is not None
    _, report_values = report
    assert [report_values[name] for name in ("ANGLE", "VEH_VEL", "TORQUE", "CMD")] == [None, None, None, 0]
    gear = GENERATION_1.decode(CanFrame(0x067, bytes([4, 0])))
    assert gear is not None
    _, gear_values = gear
    assert gear_values["STATE"] == 4
    assert GENERATION_1.messages["GearReport"].signals["STATE"].names[4] == "DRIVE"


REJECTED = [
    ("NoSuchCmd", {}, "the DBC has no message NoSuchCmd"),
    ("SteeringCmd", {"SPEED": 1}, "SteeringCmd has no signal SPEED"),
    ("SteeringCmd", {"SCMD_TORQUE": 1}, "SCMD_TORQUE of SteeringCmd is not in a frame with this multiplexer"),
    ("SteeringCmd", {"SCMD_ANGLE": 550.1}, "SCMD_ANGLE of SteeringCmd is 550.1, .*-550 to 550 deg"),
    ("SteeringCmd", {"SCMD_ANGLE": -550.1}, "SCMD_ANGLE of SteeringCmd is -550.1, .*-550 to 550 deg"),
    ("SteeringCmd", {"SCMD_ANGLE": math.nan}, "SCMD_ANGLE of SteeringCmd is nan, .*-550 to 550 deg"),
    ("SteeringCmd", {"EN": 2}, "EN of SteeringCmd is 2, .*0 to 1"),
    ("BrakeCmd", {"CMD_TYPE": 16}, "CMD_TYPE of BrakeCmd is 16, .*0 to 15"),
]


@pytest.mark.parametrize(("message", "values", "reason"), REJECTED)
def test_rejected(message: str, values: dict[str, float], reason: str) -> None:
    """Values that do not fit their message are rejected with the signal and the reason."""
    with pytest.raises(ValueError, match=reason):
        GENERATION_1.encode(message, values)


def test_description_of_a_message() -> None:
    """The description of a message contains its identifier, times and signals, and which of these are unverified."""
    report = GENERATION_2.messages["SteerReport1"]
    assert (report.identifier, report.is_extended, report.length) == (0x100, False, 8)
    assert (report.timeout_ns, report.period_ns) == (100_000_000, 10_000_000)
    assert report.senders == ("KIT",)
    angle = report.signals["ANGLE"]
    assert (angle.start, angle.bits, angle.is_signed, angle.scale, angle.unit) == (0, 14, True, 0.1, "deg")
    assert (angle.minimum, angle.maximum) == (-819.2, 819.1)
    assert angle.is_unverified
    command = GENERATION_2.messages["RemoteSteerCmd"]
    assert not command.signals["CRC"].is_unverified
    assert command.signals["CMD_ANGLE"].multiplexer == "TYPE"
    assert command.signals["CMD_ANGLE"].branches == {2}
    assert GENERATION_2.messages["Accel"].timeout_ns is None


def test_range_of_bits() -> None:
    """A signal without a range in the DBC has the range of its bits, even with a negative step."""
    lateral = GENERATION_1.messages["Accel"].signals["LATERAL"]
    assert (lateral.minimum, lateral.maximum) == (-327.67, 327.68)
    assert GENERATION_1.encode("Accel", {"LATERAL": 327.68})[:2] == bytes([0x00, 0x80])


def test_range_of_bits_by_sign(tmp_path: Path) -> None:
    """Without a range in the DBC, 8 bits range from 0 to 255, or from -128 to 127 if signed, before scaling."""
    codec = awkward(tmp_path)
    signals = codec.messages["Unlimited"].signals
    assert (signals["UNSIGNED"].minimum, signals["UNSIGNED"].maximum) == (0, 255)
    assert (signals["SIGNED"].minimum, signals["SIGNED"].maximum) == (-63, 64.5)
    assert codec.encode("Unlimited", {"UNSIGNED": 255, "SIGNED": -63})[:2] == bytes([0xFF, 0x80])
    for name, value in (("UNSIGNED", 256), ("UNSIGNED", -1), ("SIGNED", 65), ("SIGNED", -63.5)):
        with pytest.raises(ValueError, match=f"{name} of Unlimited is"):
            codec.encode("Unlimited", {name: value})


def test_offsets_nesting_and_reals(tmp_path: Path) -> None:
    """Signals not given are 0 whatever their offset, multiplexers can be nested, and non-finite values are None."""
    codec = awkward(tmp_path)
    assert codec.encode("Far", {}) == bytes(8)
    assert codec.encode("Far", {"TEMPERATURE": 0})[0] == 80
    far = codec.messages["Far"]
    assert far.is_extended
    decoded = codec.decode(CanFrame(far.identifier, bytes([80, 0, 0, 0xC0, 0x7F, 0, 0, 0]), is_extended=True))
    assert decoded == ("Far", {"TEMPERATURE": 0, "REAL": None})
    assert codec.encode("Nested", {"OUTER": 1, "INNER": 2, "DEEP": 7})[:2] == bytes([0x21, 7])
    with pytest.raises(ValueError, match="DEEP of Nested is not in a frame"):
        codec.encode("Nested", {"OUTER": 1, "INNER": 1, "DEEP": 7})


def test_no_dbc(tmp_path: Path) -> None:
    """A file that is missing, empty or not a DBC is rejected with an error of one line."""
    with pytest.raises(UserError, match=r"cannot be read \(No such file or directory\): name a DBC file"):
        Codec(tmp_path / "missing.dbc")
    for text in ("", 'VERSION ""', "BO_ what", "\x00\xff"):
        (tmp_path / "bad.dbc").write_text(text, "latin-1")
        with pytest.raises(UserError) as rejected:
            Codec(tmp_path / "bad.dbc")
        assert "\n" not in str(rejected.value)


def test_a_message_that_takes_too_long_to_load(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A DBC with a message longer than the longest of J1939 (1785 bytes) is rejected before it is loaded."""
    for length in (1785, 1786, 99_999, 10**30):
        text = AWKWARD.replace("Unlimited: 8", f"Unlimited: {length}")
        (tmp_path / "long.dbc").write_text(text)
        if length == 1785:
            assert Codec(tmp_path / "long.dbc").messages["Unlimited"].length == length
            monkeypatch.setattr("cantools.database.load_file", lambda *_, **__: pytest.fail("loaded"))
        else:
            with pytest.raises(UserError, match="1785"):
                Codec(tmp_path / "long.dbc")


def test_without_cantools(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Without cantools the error says how to install it."""

    def missing(name: str) -> None:
        raise ImportError(f"No module named {name!r}")

    monkeypatch.setattr(codec_module, "import_module", missing)
    with pytest.raises(UserError, match=r"pip install -e '\.\[can\]'"):
        Codec(tmp_path / "any.dbc")
