"""A software car at the other end of a bus that is in this very process: for virtual time."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from typing import Final

from lavt.domain import NS_PER_US, GroundTruth, VehicleEvent
from lavt.vehicle.can_frame import BusGone, CanFrame, ReceivedCanFrame
from lavt.vehicle.software_car.car import SoftwareCar

FRAME_NS: Final = 250 * NS_PER_US
"""What a frame of 8 bytes takes at 500 kbit/s: 125 bits, of 111 to 135 with its stuff bits."""


class BusDirection:
    """One direction of a bus: frames come one after another, each `delay_ns` after it left or after the one before."""

    def __init__(self, delay_ns: int) -> None:
        self._delay_ns, self._free_ns = delay_ns, 0
        self._frames: deque[ReceivedCanFrame] = deque()

    def put(self, frames: Sequence[CanFrame], now_ns: int) -> None:
        """Let frames leave at a time."""
        for frame in frames:
            self._free_ns = max(self._free_ns, now_ns) + self._delay_ns
            self._frames.append(ReceivedCanFrame(frame, self._free_ns))

    def come(self, now_ns: int) -> list[ReceivedCanFrame]:
        """Take those that have come by a time."""
        came: list[ReceivedCanFrame] = []
        while self._frames and self._frames[0].arrived_ns <= now_ns:
            came.append(self._frames.popleft())
        return came

    def next_ns(self) -> int | None:
        """When the first of those under way comes."""
        return self._frames[0].arrived_ns if self._frames else None

    def last_ns(self) -> int | None:
        """When the last of those under way comes."""
        return self._frames[-1].arrived_ns if self._frames else None

    def clear(self) -> None:
        """Lose all that is under way."""
        self._frames.clear()


class InProcessPort:
    """A `lavt.vehicle.can_frame.Port` to a software car that lives when somebody looks.

    It reads no clock: the same calls give the same frames at the same times, and how often it is asked makes no
    difference to what the car does. Call with times that never go back.
    """

    def __init__(self, car: SoftwareCar, *, delay_ns: int = FRAME_NS) -> None:
        self.car = car
        self._there, self._back = BusDirection(delay_ns), BusDirection(delay_ns)
        self._now_ns = 0
        """Until when the car has lived."""
        self._told = 0
        """Events of the car that were told."""
        self._cut = ""

    @property
    def counts(self) -> Mapping[str, int]:
        """Nothing is counted: nothing gets lost by itself."""
        return {}

    def send(self, frames: Sequence[CanFrame], made_ns: int) -> None:
        """Send frames that were made at a time; raises `BusGone` while the bus is cut."""
        if self._cut:
            raise BusGone(self._cut)
        self._there.put(frames, max(made_ns, self._now_ns))

    def take(self, now_ns: int) -> list[ReceivedCanFrame]:
        """Let the car live on to a time and take what has come from it by then; raises `BusGone` as `send` does."""
        self._live(now_ns)
        if self._cut:
            raise BusGone(self._cut)
        return self._back.come(now_ns)

    def next_wake_ns(self) -> int:
        """When all that is under way has come or, if nothing is, when the kit says something next."""
        last_ns = self._back.last_ns()
        return self.car.kit.next_wake_ns() if last_ns is None else last_ns

    def close(self) -> None:
        """Nothing has to be let go of."""

    def truth(self, now_ns: int) -> tuple[GroundTruth, list[VehicleEvent]]:
        """Let the car live on to a time, and tell the truth and what has happened since it was told last."""
        self._live(now_ns)
        told, self._told = self._told, len(self.car.events)
        return self.car.simulator.ground_truth(), self.car.events[told:]

    def cut(self, why: str) -> None:
        """Cut the bus, for a reason in words; empty: mend it. What is under way is lost."""
        self._cut = why
        self._there.clear()
        self._back.clear()

    def _live(self, now_ns: int) -> None:
        """Let the car live on, wake by wake, so that it is known when each frame leaves."""
        while True:
            came_ns, wake_ns = self._there.next_ns(), self.car.next_wake_ns()
            at_ns = wake_ns if came_ns is None else min(came_ns, wake_ns)
            if at_ns > now_ns:
                break
            left = self.car.advance(at_ns)
            for heard in self._there.come(at_ns):
                left += self.car.receive(heard.frame, at_ns)
            self._back.put(left, at_ns)
        self._now_ns = now_ns
