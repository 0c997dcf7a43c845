"""The software car: a by-wire kit and the simulator, living together."""

from __future__ import annotations

from lavt.domain import Actuation, VehicleEvent
from lavt.vehicle.can_frame import CanFrame
from lavt.vehicle.sim.simulator import Simulator
from lavt.vehicle.software_car.kit import Kit


class SoftwareCar:
    """A kit whose wheels are a simulator's.

    The simulator takes its steps of 1/240 s; at each the kit senses it and says what reaches the wheels.
    """

    def __init__(self, kit: Kit, simulator: Simulator) -> None:
        self.kit, self.simulator = kit, simulator
        self.events: list[VehicleEvent] = []
        """What has happened to the car so far."""
        self._applied: Actuation | None = None

    def advance(self, to_ns: int) -> list[CanFrame]:
        """Live on to a time and give the frames that left on the way, in order; they say nothing of their times."""
        frames: list[CanFrame] = []
        while (wake_ns := self.next_wake_ns()) <= to_ns:
            self.events += self.simulator.advance(wake_ns)
            self.kit.sense(self.simulator.state(), wake_ns)
            frames += self.kit.frames_due(wake_ns)
            actuation = self.kit.actuation(wake_ns)
            if actuation != self._applied:
                self.simulator.apply(actuation, wake_ns)
                self._applied = actuation
        return frames

    def receive(self, frame: CanFrame, now_ns: int) -> list[CanFrame]:
        """Take a frame from the bus at a time, and give those that left until then."""
        left = self.advance(now_ns)
        self.kit.receive(frame, now_ns)
        return left

    def next_wake_ns(self) -> int:
        """Tell when to call `advance` at the latest."""
        return min(self.kit.next_wake_ns(), self.simulator.next_wake_ns())
