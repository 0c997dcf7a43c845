"""The shipped DBC files agree with the vectors worked out by hand, and mark everything that is not published."""

from __future__ import annotations

import math
from functools import partial
from importlib.resources import files
from typing import Any

import cantools
import pytest
from cantools.database import EncodeError
from cantools.database.can import Database, Message, Signal
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.vehicle.dbw.rig import vector_file

from lavt.vehicle.dbw.crc8 import frame_crc8

PROFILES = ("dataspeed_gen1", "dataspeed_gen2")


def load_database(profile: str) -> Database:
    text = (files("lavt.vehicle.dbw") / "profiles" / f"{profile}.dbc").read_text("ascii")
    database = cantools.database.load_string(text, "dbc")
    assert isinstance(database, Database)
    return database


DATABASES = {profile: load_database(profile) for profile in PROFILES}
VECTOR_FILES = {profile: vector_file(profile) for profile in PROFILES}

CASES = [
    pytest.param(DATABASES[profile].get_message_by_name(vector["message"]), vector, id=f"{profile}: {vector['name']}")
    for profile in PROFILES
    for vector in VECTOR_FILES[profile]["vectors"]
]
MESSAGES = [
    pytest.param(message, id=f"{profile}: {message.name}")
    for profile, database in DATABASES.items()
    for message in database.messages
]


def selected(message: Message, selector: int) -> list[Signal]:
    """Return the signals of a frame whose multiplexer is `selector`, a number or a name."""
    return [signal for signal in message.signals if selector in (signal.multiplexer_ids or [selector])]


def selector_of(message: Message) -> Signal | None:
    return next((signal for signal in message.signals if signal.is_multiplexer), None)


def is_unverified(signal: Signal) -> bool:
    assert signal.dbc is not None
    mark = signal.dbc.attributes.get("Unverified")
    return mark is not None and mark.value == 1


def with_all_signals(message: Message, values: dict[str, float]) -> dict[str, float]:
    """Return the values of all signals of a frame: `values`, and 0 for all other signals."""
    multiplexer = selector_of(message)
    selector = int(values.get(multiplexer.name, 0)) if multiplexer else 0
    return {signal.name: 0 for signal in selected(message, selector)} | values


def encoded(message: Message, signals: dict[str, float]) -> bytes:
    """Return a frame's bytes, with its CRC if it has one."""
    data = bytes(message.encode(with_all_signals(message, signals)))
    if any(signal.name == "CRC" for signal in message.signals):
        return data[:-1] + bytes([frame_crc8(message.frame_id, data[:-1])])
    return data


@pytest.mark.parametrize(("message", "vector"), CASES)
def test_encoded(message: Message, vector: dict[str, Any]) -> None:
    """A command or report is encoded to the bytes worked out by hand; a short frame is the start of the full frame."""
    data = bytes.fromhex(vector["data"])
    assert message.frame_id == vector["id"]
    assert not message.is_extended_frame
    assert encoded(message, vector["signals"])[: len(data)] == data
    assert len(data) in (message.length, 4)


@pytest.mark.parametrize(("message", "vector"), CASES)
def test_decoded(message: Message, vector: dict[str, Any]) -> None:
    """The bytes worked out by hand are decoded to the vector's values within half a step."""
    data = bytes.fromhex(vector["data"])
    decoded = message.decode(data, decode_choices=False, allow_truncated=True)
    assert isinstance(decoded, dict)
    is_full = len(data) == message.length
    expected = with_all_signals(message, vector["signals"]) if is_full else vector["signals"]
    for name, value in expected.items():
        if name != "CRC":
            step = abs(message.get_signal_by_name(name).conversion.scale)
            assert decoded[name] == pytest.approx(value, abs=step / 2 + 1e-9), name


@pytest.mark.parametrize(
    "vector", [vector for vector in VECTOR_FILES["dataspeed_gen2"]["vectors"] if "registers" in vector]
)
def test_crc_by_hand(vector: dict[str, Any]) -> None:
    """The last byte of a frame of generation 2 is its CRC."""
    *data, crc = bytes.fromhex(vector["data"])
    assert frame_crc8(vector["id"], bytes(data)) == crc == bytes.fromhex(vector["registers"])[-1] ^ 0xFF


@pytest.mark.parametrize(("message", "vector"), CASES)
def test_marked(message: Message, vector: dict[str, Any]) -> None:
    """A vector is unverified, with its assumption, exactly if it sets a signal that is marked as unverified."""
    marked = any(is_unverified(message.get_signal_by_name(name)) for name, value in vector["signals"].items() if value)
    assert vector.get("unverified", False) is marked
    assert ("assumption" in vector) is marked


@pytest.mark.parametrize("message", MESSAGES)
@given(data=st.data())
@settings(max_examples=25)
def test_round_trip(message: Message, data: st.DataObject) -> None:
    """Encoded values within a signal's range are decoded unchanged, and unused bits are 0."""
    multiplexer = selector_of(message)
    selectors = sorted({n for signal in message.signals for n in signal.multiplexer_ids or []})
    selector = data.draw(st.sampled_from(selectors)) if multiplexer else 0
    raw = {
        signal.name: selector if signal is multiplexer else data.draw(raw_of(signal), signal.name)
        for signal in selected(message, selector)
    }
    scaled = {
        signal.name: signal.conversion.raw_to_scaled(raw[signal.name], decode_choices=False)
        for signal in selected(message, selector)
    }
    frame = message.encode(scaled)
    assert len(frame) == message.length
    assert message.decode(frame, decode_choices=False, scaling=False) == raw
    assert int.from_bytes(frame, "little") == sum(
        (raw[signal.name] & ((1 << signal.length) - 1)) << signal.start for signal in selected(message, selector)
    )


def raw_of(signal: Signal) -> st.SearchStrategy[int]:
    """Return raw numbers within the signal's range, or of all its bits if it has no range."""
    if signal.minimum is None or signal.maximum is None:
        half = 1 << (signal.length - 1)
        return st.integers(-half, half - 1) if signal.is_signed else st.integers(0, 2 * half - 1)
    step = signal.conversion.scale
    return st.integers(math.ceil(signal.minimum / step - 1e-6), math.floor(signal.maximum / step + 1e-6))


def unverified(profile: str) -> set[str]:
    return {
        f"{message.name}.{signal.name}"
        for message in DATABASES[profile].messages
        for signal in message.signals
        if is_unverified(signal)
    }


def test_unverified_of_generation_1() -> None:
    """In generation 1 only the parking brake has a position that is not published."""
    assert unverified("dataspeed_gen1") == {"MiscCmd.PBRKCMD"}


def test_unverified_of_generation_2() -> None:
    """In generation 2 only the CRC of commands has a published position."""
    everything = {
        f"{message.name}.{signal.name}"
        for message in DATABASES["dataspeed_gen2"].messages
        for signal in message.signals
    }
    kinds = [("Remote", "User"), ("Remote", "User", "Ulc"), ("Remote", "User", "Ulc"), ("Remote", "User", "Ulc")]
    commands = [
        source + name
        for sources, name in zip(kinds, ("SteerCmd", "BrakeCmd", "ThrtlCmd", "GearCmd"), strict=True)
        for source in sources
    ]
    assert everything - unverified("dataspeed_gen2") == {f"{name}.CRC" for name in [*commands, "SystemCmd"]}


@pytest.mark.parametrize("profile", PROFILES)
def test_unverified_signals_have_a_comment(profile: str) -> None:
    """Exactly the unverified signals have a comment with their assumption."""
    for message in DATABASES[profile].messages:
        for signal in message.signals:
            assert (signal.comment or "").startswith("Unverified") is is_unverified(signal), (message.name, signal.name)


@pytest.mark.parametrize("limit", VECTOR_FILES["dataspeed_gen1"]["limits"], ids=lambda limit: limit["signal"])
def test_limits(limit: dict[str, Any]) -> None:
    """A command is encoded at the published limits and rejected one step beyond."""
    message = DATABASES["dataspeed_gen1"].get_message_by_name(limit["message"])
    signal = message.get_signal_by_name(limit["signal"])
    multiplexer = selector_of(message)
    assert multiplexer is not None
    encode = partial(encoded, message)
    selector = {multiplexer.name: (signal.multiplexer_ids or [0])[0]}
    for end, beyond in ((limit["lowest"], -1), (limit["highest"], 1)):
        encode({**selector, signal.name: end})
        with pytest.raises(EncodeError):
            encode({**selector, signal.name: end + beyond * signal.conversion.scale})


TIMES = {  # (period, timeout) in ms
    "dataspeed_gen1": dict.fromkeys(("BrakeCmd", "ThrottleCmd", "SteeringCmd"), (20, 100)),
    "dataspeed_gen2": {
        **{f"{source}{name}Cmd": (None, 100) for source in ("Remote", "User", "Ulc") for name in ("Brake", "Thrtl")},
        "RemoteSteerCmd": (None, 100),
        "UserSteerCmd": (None, 100),
        "SystemCmd": (None, 100),
        "UlcCmd": (20, 100),
        "UlcCfg": (200, 1000),
        "TurnSignalCmd": (50, 250),
        "SteerReport1": (10, 100),
        "BrakeReport1": (20, 100),
        "ThrtlReport1": (20, 100),
        "GearReport1": (100, 350),
        "SystemReport": (100, None),
        "VehicleVelocity": (20, 200),
        "Accel": (10, None),
        "Gyro": (10, None),
        "WheelSpeed": (10, None),
        "WheelPosition": (20, None),
        "RemoteReport": (100, 250),
    },
}


@pytest.mark.parametrize("profile", PROFILES)
def test_times(profile: str) -> None:
    """The DBC files have exactly the published periods and timeouts."""
    times_by_message = {}
    for message in DATABASES[profile].messages:
        assert message.dbc is not None
        timeout = message.dbc.attributes.get("TimeoutMs")
        times = (message.cycle_time, timeout.value if timeout else None)
        if times != (None, None):
            times_by_message[message.name] = times
    assert times_by_message == TIMES[profile]


def test_marks_of_invalid_values() -> None:
    """A report's number for "not valid" is decoded as a name, not as a value."""
    report = DATABASES["dataspeed_gen1"].get_message_by_name("SteeringReport")
    decoded = report.decode(bytes.fromhex("00 80 00 00 00 80 80 00"))
    assert isinstance(decoded, dict)
    assert [str(decoded[name]) for name in ("ANGLE", "VEH_VEL", "TORQUE")] == ["INVALID"] * 3
