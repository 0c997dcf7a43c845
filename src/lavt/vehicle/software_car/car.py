"""The software car: a by-wire kit connected to the simulator."""

from __future__ import annotations

from lavt.domain import Actuation, VehicleEvent
from lavt.vehicle.can_frame import CanFrame
from lavt.vehicle.sim.simulator import Simulator
from lavt.vehicle.software_car.kit import Kit


class SoftwareCar:
    """A by-wire kit connected to a simulated car.

    At each of the simulator's steps of 1/240 s the kit reads the car's state and sets the car's actuation.
    """

    def __init__(self, kit: Kit, simulator: Simulator) -> None:
        self.kit, self.simulator = kit, simulator
        self.events: list[VehicleEvent] = []
        """All events of the car so far."""
        self._applied: Actuation | None = None

    def advance(self, to_ns: int) -> list[CanFrame]:
        """Advance to `to_ns` and return the frames sent until then, in order but without their times."""
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
        """Process a frame received at `now_ns`, and return the frames sent until then."""
        sent = self.advance(now_ns)
        self.kit.receive(frame, now_ns)
        return sent

    def next_wake_ns(self) -> int:
        """Return the time by which `advance` should be called next."""
        return min(self.kit.next_wake_ns(), self.simulator.next_wake_ns())
