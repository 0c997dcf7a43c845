"""A software car's kit under test, and senders that encode commands for it without the kit's code."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Any, NamedTuple

import pytest

from lavt.domain import NS_PER_MS, VehicleState
from lavt.vehicle.can_frame import CanFrame
from lavt.vehicle.software_car.kit import Kit

START_NS = 77_000_000_123
AXES = ("steering", "brake", "throttle")
STEERING_RATIO = 14.8
"""Angle of the steering wheel divided by the angle of the road wheels."""
DEGREES_PER_RAD = 57.29577951308232
DRIVE = 4
"""The number of the gear."""
STEERING_1, BRAKE_1, THROTTLE_1, GEAR_1 = 0x064, 0x060, 0x062, 0x066
"""The identifiers of generation 1's commands."""
PERCENT_OF_GENERATION_1 = 2
PERCENT_OF_GENERATION_2 = 14
"""The command type (CMD_TYPE) of a pedal's percentage."""
ANGLE_OF_GENERATION_2 = 2
"""The command type of the steering wheel's angle."""


def crc_by_division(identifier: int, data: bytes) -> int:
    """Return the CRC-8 of J1850 by long division: by 0x11D, with the first byte and the remainder inverted."""
    message = identifier.to_bytes(2, "big") + data
    number = int.from_bytes(message, "big") << 8
    number ^= 0xFF << 8 * len(message)
    for bit in range(8 * len(message) + 7, 7, -1):
        if number >> bit & 1:
            number ^= 0x11D << bit - 8
    return number ^ 0xFF


def with_crc(identifier: int, data: bytes) -> CanFrame:
    return CanFrame(identifier, data + bytes([crc_by_division(identifier, data)]))


@dataclass(frozen=True)
class CommandValues:
    """The values of a set of commands."""

    angle_deg: float = 0.0
    throttle: float = 0.0
    brake: float = 0.0
    enable: bool = True
    clear: bool = False
    ignore_override: bool = False
    """Bit IGNORE: the driver's acts do not release the axes."""
    rate: int = 0
    """The limit of the steering rate, in the units of the command; 0: the car's own limit."""


class ExecutedActuation(NamedTuple):
    """What the kit makes the car do: the angle of the steering wheel, and the pedals between 0 and 1."""

    steering_wheel_deg: float
    throttle: float
    brake: float

    @property
    def throttle_and_brake(self) -> tuple[float, float]:
        """The positions of both pedals."""
        return self.throttle, self.brake


class Sender1:
    """An encoder for generation 1's commands."""

    def __init__(self) -> None:
        self.count = 0

    def commands(self, values: CommandValues) -> list[CanFrame]:
        """Return the commands for steering, brake and throttle, with the next counter."""
        self.count = (self.count + 1) % 256
        bits = values.enable | values.clear << 1 | values.ignore_override << 2
        angle, pedal_type = round(values.angle_deg * 10), PERCENT_OF_GENERATION_1 << 4
        steering = struct.pack("<hBBBBBB", angle, bits, values.rate, 0, 0, 0, self.count)
        brake, throttle = (
            struct.pack("<HBBBBBB", round(fraction * 65535), pedal_type, bits, 0, 0, 0, self.count)
            for fraction in (values.brake, values.throttle)
        )
        return [CanFrame(STEERING_1, steering), CanFrame(BRAKE_1, brake), CanFrame(THROTTLE_1, throttle)]

    def clearing(self) -> list[CanFrame]:
        """Return the frames that clear overrides."""
        return [
            CanFrame(STEERING_1, bytes([0, 0, 2, 0])),
            CanFrame(BRAKE_1, bytes([0, 0, 0, 2])),
            CanFrame(THROTTLE_1, bytes([0, 0, 0, 2])),
        ]

    def gear(self, gear: int, clear: bool = False) -> CanFrame:
        """Return the command for a gear."""
        return CanFrame(GEAR_1, bytes([gear | clear << 7]))


class Sender2:
    """An encoder for generation 2's commands, by default of the remote set; the user set begins at identifier 0x210."""

    def __init__(self, first_identifier: int = 0x200) -> None:
        self.count, self.first_identifier = 0, first_identifier

    def commands(self, values: CommandValues) -> list[CanFrame]:
        """Return the commands for steering, brake and throttle, with the next counter."""
        self.count = (self.count + 1) % 16
        bits = values.enable << 4 | values.clear << 5 | values.ignore_override << 6
        angle, tail = round(values.angle_deg * 10), (0, 0, self.count)
        steering = struct.pack("<hBBBBB", angle, ANGLE_OF_GENERATION_2 | bits, values.rate, *tail)
        pedal_type = PERCENT_OF_GENERATION_2 | bits
        pedals = [(1, round(values.brake * 10_000)), (2, round(values.throttle * 4_000))]
        return [
            with_crc(self.first_identifier, steering),
            *(
                with_crc(self.first_identifier + part, struct.pack("<HBBBBB", raw, pedal_type, 0, *tail))
                for part, raw in pedals
            ),
        ]

    def clearing(self) -> list[CanFrame]:
        """Return the frames that clear overrides."""
        return self.commands(CommandValues(enable=False, clear=True))

    def gear(self, gear: int, clear: bool = False) -> CanFrame:
        """Return the command for a gear."""
        assert not clear
        return with_crc(self.first_identifier + 3, bytes([gear, 0, 0]))

    def system(self, request: int) -> CanFrame:
        """Return a request to the system: 0 none, 1 enable, 2 disable."""
        self.count = (self.count + 1) % 16
        return with_crc(0x216, bytes([request | self.count << 4]))


class KitRig:
    """A kit, a sender of commands, and a clock. `kit_arguments` are passed to `Kit`."""

    def __init__(self, generation: int, *, speed_mps: float = 0.0, **kit_arguments: Any) -> None:
        self.generation = generation
        self.now_ns = START_NS
        self.sender: Sender1 | Sender2 = Sender1() if generation == 1 else Sender2()
        self.kit = Kit(1 if generation == 1 else 2, start_ns=START_NS, **kit_arguments)
        self.newest_reports: dict[int, bytes] = {}
        """The newest report of each identifier."""
        self.set_motion(speed_mps)

    def set_motion(self, speed_mps: float, steering_rad: float = 0.0) -> None:
        """Set the car's speed and road wheel angle."""
        self.kit.sense(VehicleState(self.now_ns, speed_mps, steering_rad, "drive"), self.now_ns)

    def send(self, *frames: CanFrame) -> None:
        """Send frames to the kit now."""
        for frame in frames:
            self.kit.receive(frame, self.now_ns)

    def command(self, **values: Any) -> None:
        """Command all three axes; `values` are fields of `CommandValues`."""
        self.send(*self.sender.commands(CommandValues(**values)))

    def request_system(self, request: int = 1) -> None:
        """Request generation 2's system to enable (1) or disable (2); 0 requests nothing."""
        if isinstance(self.sender, Sender2):
            self.send(self.sender.system(request))

    def enable(self, *, in_drive: bool = True) -> None:
        """Enable the kit, and shift into drive."""
        self.command(brake=0.5)
        self.request_system()
        assert self.enabled() == set(AXES)
        if in_drive:
            self.send(self.sender.gear(DRIVE))
            assert self.kit.state.gear == DRIVE

    def wait_ms(self, duration_ms: float) -> None:
        """Let time pass, and note the kit's reports in `newest_reports`."""
        self.now_ns += round(duration_ms * NS_PER_MS)
        for frame in self.kit.frames_due(self.now_ns):
            self.newest_reports[frame.identifier] = frame.data

    def drive_ms(self, duration_ms: int, **values: Any) -> None:
        """Send commands every 20 ms."""
        for _ in range(duration_ms // 20):
            self.command(**values)
            self.wait_ms(20)

    def enabled(self) -> set[str]:
        """Return the enabled axes."""
        return {axis for axis, actuator in self.kit.state.actuators.items() if actuator.is_enabled}

    def executed(self) -> ExecutedActuation:
        """Return what the kit makes the car do now."""
        actuation = self.kit.actuation(self.now_ns)
        return ExecutedActuation(
            round(actuation.steering_rad * STEERING_RATIO * DEGREES_PER_RAD, 6),
            round(actuation.throttle, 4),
            round(actuation.brake, 4),
        )


def with_crc_broken(frame: CanFrame) -> CanFrame:
    return CanFrame(frame.identifier, frame.data[:-1] + bytes([frame.data[-1] ^ 1]))


ALL_AXES = set(AXES)
both_generations = pytest.mark.parametrize("generation", [1, 2])


def driving_rig(generation: int, **rig_arguments: Any) -> KitRig:
    """Return a kit that is enabled, in drive and moving."""
    rig = KitRig(generation, **rig_arguments)
    rig.enable()
    rig.set_motion(10.0)
    return rig
