"""Test that the adapter's frames equal the vectors: frames worked out by hand from the published sources."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
from tests.vehicle.dbw.rig import START_NS, profile, vector_file

from lavt.vehicle.can_frame import CanFrame
from lavt.vehicle.dbw.profile import AXES, Axis, Profile
from lavt.vehicle.dbw.sending import DriveCommand, FrameSender, KitCommands

NAMES = ("dataspeed_gen1", "dataspeed_gen2", "dataspeed_gen2:user")
NO_AXES: frozenset[Axis] = frozenset()


def vectors(name: str) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = vector_file(name.partition(":")[0])["vectors"]
    return found


def adapter_frame(name: str, vector: dict[str, Any]) -> CanFrame | None:
    """Return the adapter's frame for a vector, or None if the adapter never sends such a frame."""
    base_profile, signals, message = profile(name), dict(vector["signals"]), vector["message"]
    sender = FrameSender(base_profile, START_NS)
    if signals.pop("CLEAR", 0):
        return clearing_frame(base_profile, message, signals)
    for axis in AXES:
        if base_profile.axes[axis].message == message:
            return axis_command(base_profile, axis, signals)
    if base_profile.gear.message == message and set(signals) == {base_profile.gear.value}:
        gears = {code: gear for gear, code in base_profile.gear.codes.items()}
        gear = gears.get(signals[base_profile.gear.value])
        return sender.gear_frame(gear) if gear else None
    if base_profile.system and message == base_profile.system.message and signals:
        sender._frame_counts[message] = signals["RC"] - 1
        return sender._system_frame(base_profile.system, "enable" if signals["CMD"] == 1 else "disable")
    return None


def axis_command(base_profile: Profile, axis: Axis, signals: dict[str, Any]) -> CanFrame | None:
    """Return an axis's command, or None if the vector has a type that the profile does not use.

    Signals that the adapter never changes become constants of the profile.
    """
    command = base_profile.axes[axis]
    kind, number = next(iter(command.constants.items()))
    if command.value not in signals or signals.get(kind, 0) != number:
        return None
    varied = {command.value, command.enable, command.count}
    constants = {kind: number} | {name: value for name, value in signals.items() if name not in varied}
    sender = FrameSender(
        replace(base_profile, axes={**base_profile.axes, axis: replace(command, constants=constants)}), START_NS
    )
    sender._frame_counts[command.message] = signals.get(command.count, 0) + command.modulus - 1
    is_enabled = bool(signals.get(command.enable, 0))
    return sender.axis_frame(axis, signals[command.value] / command.per_unit, is_enabled=is_enabled)


def clearing_frame(base_profile: Profile, message: str, signals: dict[str, Any]) -> CanFrame | None:
    """Return a frame that clears overrides."""
    if message not in {command.message for command in base_profile.axes.values()} | {base_profile.gear.message}:
        return None
    sender = FrameSender(base_profile, START_NS)
    sender._frame_counts[message] = signals.get("RC", 0) - 1
    frames = sender.frames(KitCommands(NO_AXES, is_clearing=True), DriveCommand(0.0, 0.0, 0.0), 0.0, START_NS)
    identifier = base_profile.codec.messages[message].identifier
    return next(frame for frame in frames if frame.identifier == identifier)


CASES = [
    pytest.param(frame, vector, id=f"{name}: {vector['name']}")
    for name in NAMES
    for vector in vectors(name)
    if (frame := adapter_frame(name, vector)) is not None
]


@pytest.mark.parametrize(("frame", "vector"), CASES)
def test_frames_equal_the_vectors(frame: CanFrame, vector: dict[str, Any]) -> None:
    """A frame of the adapter has the bytes worked out by hand, including counter and checksum."""
    assert frame == CanFrame(vector["id"], bytes.fromhex(vector["data"]))


def test_every_sent_message_has_a_vector() -> None:
    """Every message that the adapter sends has a vector, except two whose vectors have no signals."""
    checked = {(name, vector["message"]) for name in NAMES for vector in vectors(name) if adapter_frame(name, vector)}
    missing = set()
    for name in NAMES:
        base_profile = profile(name)
        messages = {command.message for command in base_profile.axes.values()} | {base_profile.gear.message}
        messages |= {base_profile.system.message} if base_profile.system else set()
        missing |= {(name, message) for message in messages} - checked
    assert missing == {("dataspeed_gen2:user", "UserGearCmd"), ("dataspeed_gen2:user", "UserThrtlCmd")}
