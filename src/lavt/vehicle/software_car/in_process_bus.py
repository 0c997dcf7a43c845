"""A CAN bus to a software car in the same process, for virtual time."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from typing import Final

from lavt.domain import NS_PER_US, GroundTruth, VehicleEvent
from lavt.vehicle.can_frame import BusGone, CanFrame, ReceivedCanFrame
from lavt.vehicle.software_car.car import SoftwareCar

FRAME_NS: Final = 250 * NS_PER_US
"""Transmission time of a frame of 8 data bytes at 500 kbit/s. Depending on its stuff bits such a frame has between 111
and 135 bits; 125 are assumed."""


class BusDirection:
    """One direction of a bus. Frames are transmitted one at a time, each in `delay_ns`."""

    def __init__(self, delay_ns: int) -> None:
        self._delay_ns, self._free_ns = delay_ns, 0
        self._frames: deque[ReceivedCanFrame] = deque()

    def put(self, frames: Sequence[CanFrame], now_ns: int) -> None:
        """Send frames at `now_ns`."""
        for frame in frames:
            self._free_ns = max(self._free_ns, now_ns) + self._delay_ns
            self._frames.append(ReceivedCanFrame(frame, self._free_ns))

    def take_arrived(self, now_ns: int) -> list[ReceivedCanFrame]:
        """Return the frames that have arrived by `now_ns`."""
        arrived: list[ReceivedCanFrame] = []
        while self._frames and self._frames[0].arrived_ns <= now_ns:
            arrived.append(self._frames.popleft())
        return arrived

    def next_arrival_ns(self) -> int | None:
        """Return the arrival time of the first frame in transit, or None."""
        return self._frames[0].arrived_ns if self._frames else None

    def last_arrival_ns(self) -> int | None:
        """Return the arrival time of the last frame in transit, or None."""
        return self._frames[-1].arrived_ns if self._frames else None

    def clear(self) -> None:
        """Drop all frames in transit."""
        self._frames.clear()


class InProcessPort:
    """A `BusPort` to a software car in the same process. The car advances lazily, when the port is used.

    The port reads no clock: the same calls give the same frames at the same times, and the frequency of calls does not
    affect the car. Times must not decrease.
    """

    def __init__(self, car: SoftwareCar, *, delay_ns: int = FRAME_NS) -> None:
        self.car = car
        self._to_car, self._from_car = BusDirection(delay_ns), BusDirection(delay_ns)
        self._now_ns = 0
        """The time up to which the car has advanced."""
        self._returned_events = 0
        """Number of the car's events that were returned."""
        self._cut_reason = ""
        """Why the bus is cut; empty if it is not."""

    @property
    def counts(self) -> Mapping[str, int]:
        """Empty, because no frame gets lost."""
        return {}

    def send(self, frames: Sequence[CanFrame], made_ns: int) -> int:
        """Send frames made at `made_ns` and return their number. Raises `BusGone` if the bus is cut."""
        if self._cut_reason:
            raise BusGone(self._cut_reason)
        self._to_car.put(frames, max(made_ns, self._now_ns))
        return len(frames)

    def take(self, now_ns: int) -> list[ReceivedCanFrame]:
        """Advance the car and return the frames received from it. Raises `BusGone` if the bus is cut."""
        self._advance(now_ns)
        if self._cut_reason:
            raise BusGone(self._cut_reason)
        return self._from_car.take_arrived(now_ns)

    def next_wake_ns(self) -> int:
        """Return when all frames in transit have arrived or, if there are none, when the kit sends next."""
        last_ns = self._from_car.last_arrival_ns()
        return self.car.kit.next_wake_ns() if last_ns is None else last_ns

    def close(self) -> None:
        """Do nothing, because there is no connection to close."""

    def truth(self, now_ns: int) -> tuple[GroundTruth, list[VehicleEvent]]:
        """Advance the car, and return its ground truth and its events since the last call."""
        self._advance(now_ns)
        start, self._returned_events = self._returned_events, len(self.car.events)
        return self.car.simulator.ground_truth(), self.car.events[start:]

    def cut(self, reason: str) -> None:
        """Cut the bus, or restore it if `reason` is empty; in both cases drop all frames in transit."""
        self._cut_reason = reason
        self._to_car.clear()
        self._from_car.clear()

    def _advance(self, now_ns: int) -> None:
        """Advance the car from wake time to wake time, so that each frame is sent when it is due."""
        while True:
            arrival_ns, wake_ns = self._to_car.next_arrival_ns(), self.car.next_wake_ns()
            at_ns = wake_ns if arrival_ns is None else min(arrival_ns, wake_ns)
            if at_ns > now_ns:
                break
            sent = self.car.advance(at_ns)
            for received in self._to_car.take_arrived(at_ns):
                sent += self.car.receive(received.frame, at_ns)
            self._from_car.put(sent, at_ns)
        self._now_ns = now_ns
