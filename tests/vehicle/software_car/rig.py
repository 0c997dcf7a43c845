"""Commands made by hand, bit by bit, and a kit that is driven with them."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Any

import pytest

from lavt.domain import NS_PER_MS, VehicleState
from lavt.vehicle.can_frame import CanFrame
from lavt.vehicle.software_car.kit import Kit

START_NS = 77_000_000_123
AXES = ("steering", "brake", "throttle")


def crc_by_division(identifier: int, data: bytes) -> int:
    """CRC-8 of J1850 as the remainder of one long division: 0x11D, first byte inverted, remainder inverted."""
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
class Asked:
    """What a command asks for."""

    angle_deg: float = 0.0
    throttle: float = 0.0
    brake: float = 0.0
    enable: bool = True
    clear: bool = False
    ignore: bool = False
    rate: int = 0


class Hand1:
    """Generation 1's commands."""

    def __init__(self) -> None:
        self.count = 0

    def commands(self, requested: Asked) -> list[CanFrame]:
        """Steering, brake and throttle, with the next counter."""
        self.count = (self.count + 1) % 256
        bits = requested.enable | requested.clear << 1 | requested.ignore << 2
        return [
            CanFrame(
                0x064,
                struct.pack("<hBBBBBB", round(requested.angle_deg * 10), bits, requested.rate, 0, 0, 0, self.count),
            ),
            CanFrame(0x060, struct.pack("<HBBBBBB", round(requested.brake * 65535), 2 << 4, bits, 0, 0, 0, self.count)),
            CanFrame(
                0x062, struct.pack("<HBBBBBB", round(requested.throttle * 65535), 2 << 4, bits, 0, 0, 0, self.count)
            ),
        ]

    def clearing(self) -> list[CanFrame]:
        """What takes back overrides."""
        return [
            CanFrame(0x064, bytes([0, 0, 2, 0])),
            CanFrame(0x060, bytes([0, 0, 0, 2])),
            CanFrame(0x062, bytes([0, 0, 0, 2])),
        ]

    def gear(self, gear: int, clear: bool = False) -> CanFrame:
        """A gear by its number."""
        return CanFrame(0x066, bytes([gear | clear << 7]))


class Hand2:
    """Generation 2's commands: of the remote's set, or of the user's."""

    def __init__(self, first: int = 0x200) -> None:
        self.count, self.first = 0, first

    def commands(self, requested: Asked) -> list[CanFrame]:
        """Steering, brake and throttle, with the next counter."""
        self.count = (self.count + 1) % 16
        bits = requested.enable << 4 | requested.clear << 5 | requested.ignore << 6
        tail = (0, 0, self.count)
        steering = struct.pack("<hBBBBB", round(requested.angle_deg * 10), 2 | bits, requested.rate, *tail)
        pedals = [(1, round(requested.brake * 10_000)), (2, round(requested.throttle * 4_000))]
        return [
            with_crc(self.first, steering),
            *(with_crc(self.first + part, struct.pack("<HBBBBB", raw, 14 | bits, 0, *tail)) for part, raw in pedals),
        ]

    def clearing(self) -> list[CanFrame]:
        """What takes back overrides."""
        return self.commands(Asked(enable=False, clear=True))

    def gear(self, gear: int, clear: bool = False) -> CanFrame:
        """A gear by its number."""
        assert not clear
        return with_crc(self.first + 3, bytes([gear, 0, 0]))

    def system(self, request: int) -> CanFrame:
        """A request to the system: 0 nothing, 1 enable, 2 disable."""
        self.count = (self.count + 1) % 16
        return with_crc(0x216, bytes([request | self.count << 4]))


class Rig:
    """A kit, who commands it, and the time."""

    def __init__(self, generation: int, *, speed_mps: float = 0.0, **keys: Any) -> None:
        self.generation = generation
        self.now_ns = START_NS
        self.hand: Hand1 | Hand2 = Hand1() if generation == 1 else Hand2()
        self.kit = Kit(1 if generation == 1 else 2, start_ns=START_NS, **keys)
        self.last: dict[int, bytes] = {}
        self.is_moving_at(speed_mps)

    def is_moving_at(self, speed_mps: float, steering_rad: float = 0.0) -> None:
        """Let the car have a speed and a road wheel angle."""
        self.kit.sense(VehicleState(self.now_ns, speed_mps, steering_rad, "drive"), self.now_ns)

    def send(self, *frames: CanFrame) -> None:
        """Put frames on the bus now."""
        for frame in frames:
            self.kit.receive(frame, self.now_ns)

    def command(self, **keys: Any) -> None:
        """Command all three axes; keys are those of `Asked`."""
        self.send(*self.hand.commands(Asked(**keys)))

    def ask(self, request: int = 1) -> None:
        """Tell generation 2's system to enable (1) or disable (2)."""
        if isinstance(self.hand, Hand2):
            self.send(self.hand.system(request))

    def enable(self, *, in_drive: bool = True) -> None:
        """Enable the kit by the whole sequence, and shift into drive."""
        self.command(brake=0.5)
        self.ask()
        assert self.enabled() == set(AXES)
        if in_drive:
            self.send(self.hand.gear(4))
            assert self.kit.state.gear == 4

    def wait_ms(self, duration_ms: float) -> None:
        """Let time pass, and keep the newest of each report in `last`."""
        self.now_ns += round(duration_ms * NS_PER_MS)
        for frame in self.kit.frames_due(self.now_ns):
            self.last[frame.identifier] = frame.data

    def drive_ms(self, duration_ms: int, **keys: Any) -> None:
        """Command every 20 ms."""
        for _ in range(duration_ms // 20):
            self.command(**keys)
            self.wait_ms(20)

    def enabled(self) -> set[str]:
        """Axes that obey."""
        return {axis for axis, actuator in self.kit.state.actuators.items() if actuator.is_enabled}

    def wheels(self) -> tuple[float, float, float]:
        """Steering wheel in degrees, throttle, brake: what reaches the wheels."""
        actuation = self.kit.actuation(self.now_ns)
        return (
            round(actuation.steering_rad * 14.8 * 57.29577951308232, 6),
            round(actuation.throttle, 4),
            round(actuation.brake, 4),
        )


def with_crc_broken(frame: CanFrame) -> CanFrame:
    return CanFrame(frame.identifier, frame.data[:-1] + bytes([frame.data[-1] ^ 1]))


ALL = set(AXES)
both = pytest.mark.parametrize("generation", [1, 2])


def driving(generation: int, **keys: Any) -> Rig:
    """A kit that is enabled, in drive and moving."""
    rig = Rig(generation, **keys)
    rig.enable()
    rig.is_moving_at(10.0)
    return rig
