"""A software car in real time, sans-IO: whoever has the bus, the words and the clock calls it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from lavt.domain import NS_PER_S
from lavt.errors import UserError
from lavt.vehicle.can_frame import BusGone, BusPort, CanFrame, ReceivedCanFrame
from lavt.vehicle.ground_truth_wire import TruthSender
from lavt.vehicle.software_car.car import SoftwareCar
from lavt.vehicle.software_car.console_commands import HELP, act, help_lines
from lavt.vehicle.software_car.event_log import KitEvent, StateObserver


class Runner:
    """Lets a software car live at a port.

    Call `step` at each `next_wake_ns`, or later: the car takes all its steps, at their own times, whenever it is
    called. Frames it hears have the times at which they came; frames it sends carry the time at which they were due, so
    that a port can refuse those that are too old.
    """

    def __init__(self, car: SoftwareCar, port: BusPort, *, start_ns: int) -> None:
        self._car, self._port = car, port
        self._now_ns = self._told_ns = start_ns
        self._events_seen = self._events_told = 0
        """How many events of the car are in the events, and in the truth."""
        self._sender = TruthSender(start_ns)
        self._observer = StateObserver(car.kit.state)
        self._is_lost, self._lost_ns = False, 0
        self._events: list[KitEvent] = []
        self.counts: Counter[str] = Counter(frames_sent=0, frames_heard=0, frames_lost=0)
        self.latest_ns = 0
        """How late a step was at worst."""

    def step(self, now_ns: int) -> None:
        """Take what was heard, live on to a time, and send what leaves on the way."""
        self.latest_ns = max(self.latest_ns, now_ns - self._car.next_wake_ns())
        for heard in self._heard(now_ns):
            at_ns = min(max(heard.arrived_ns, self._now_ns), now_ns)
            self._live(at_ns)
            self._car.receive(heard.frame, at_ns)
            self.counts["frames_heard"] += 1
            self._look(at_ns)
        self._live(now_ns)

    def next_wake_ns(self) -> int:
        """Tell when to call `step` at the latest."""
        return self._car.next_wake_ns()

    def act(self, line: str, now_ns: int) -> None:
        """Do what a line of words says; the events tell what became of it."""
        word = line.strip()
        if not word:
            return
        self.step(now_ns)
        if word == HELP:
            self._events += [KitEvent(now_ns, "help", each) for each in help_lines()]
            return
        try:
            act(self._car.kit, word, now_ns)
        except UserError as error:
            self._events.append(KitEvent(now_ns, "rejected", str(error)))
            return
        self._events.append(KitEvent(now_ns, "done", word))
        self._look(now_ns)

    def truth(self) -> bytes | None:
        """Give a datagram for the server, if the car has moved on since the last one."""
        truth = self._car.simulator.ground_truth()
        if truth.mono_ns <= self._told_ns:
            return None
        self._told_ns = truth.mono_ns
        told, self._events_told = self._events_told, len(self._car.events)
        return self._sender.datagram(truth, self._car.events[told:])

    def take_events(self) -> list[KitEvent]:
        """Take what has happened since the last call."""
        events, self._events = self._events, []
        return events

    def _live(self, to_ns: int) -> None:
        """Live on, wake by wake, so that each frame leaves with its time."""
        while (wake_ns := self._car.next_wake_ns()) <= to_ns:
            frames = self._car.advance(wake_ns)
            if frames:
                self._send(frames, wake_ns)
            self._look(wake_ns)
        self._now_ns = to_ns

    def _look(self, now_ns: int) -> None:
        """See what has happened."""
        self._events += self._observer.look(self._car.kit.state, now_ns)
        for event in self._car.events[self._events_seen :]:
            self._events.append(KitEvent(event.mono_ns, "event", f"{event.kind}: {event.detail}"))
        self._events_seen = len(self._car.events)

    def _heard(self, now_ns: int) -> Sequence[ReceivedCanFrame]:
        try:
            return self._port.take(now_ns)
        except BusGone as gone:
            self._is_gone(str(gone), now_ns)
            return []

    def _send(self, frames: Sequence[CanFrame], made_ns: int) -> None:
        try:
            self._port.send(frames, made_ns)
        except BusGone as gone:
            self._is_gone(str(gone), made_ns)
            self.counts["frames_lost"] += len(frames)
            return
        self.counts["frames_sent"] += len(frames)
        self._is_there(made_ns)

    def _is_gone(self, why: str, now_ns: int) -> None:
        if not self._is_lost:
            self._events.append(KitEvent(now_ns, "bus", f"the bus is gone: {why}"))
        self._is_lost, self._lost_ns = True, now_ns

    def _is_there(self, now_ns: int) -> None:
        """Tell that the bus is there again, once it has been so long enough: a full queue comes and goes."""
        if self._is_lost and now_ns - self._lost_ns >= NS_PER_S:
            self._is_lost = False
            self._events.append(KitEvent(now_ns, "bus", "the bus is there again"))
