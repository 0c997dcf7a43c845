"""A software car in real time, without I/O: the caller opens the bus and the console, and reads the clock."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from lavt.domain import NS_PER_S
from lavt.errors import UserError
from lavt.vehicle.can_frame import BusGone, BusPort, CanFrame, ReceivedCanFrame
from lavt.vehicle.ground_truth_wire import TruthSender
from lavt.vehicle.software_car.car import SoftwareCar
from lavt.vehicle.software_car.console_commands import HELP, execute, help_lines
from lavt.vehicle.software_car.event_log import KitEvent, StateObserver


class SoftwareCarRunner:
    """A runner that advances a software car and connects it to a bus port.

    Call `step` at each `next_wake_ns`, or later: a late call makes all steps since the last call, each with its due
    time. A received frame is processed at its arrival time. A frame that the car sends is given to the port with the
    time at which it was due, so that the port can reject a frame that is too old.
    """

    def __init__(self, car: SoftwareCar, port: BusPort, *, start_ns: int) -> None:
        self._car, self._port = car, port
        self._now_ns = self._truth_ns = start_ns
        self._logged_events = self._sent_events = 0
        """Number of the car's events that are in the log, and number of those that are in truth datagrams."""
        self._sender = TruthSender(start_ns)
        self._observer = StateObserver(car.kit.state)
        self._is_lost, self._lost_ns = False, 0
        self._events: list[KitEvent] = []
        self.counts: Counter[str] = Counter(frames_sent=0, frames_heard=0, frames_lost=0)
        self.max_delay_ns = 0
        """The largest lateness of any step so far."""

    def step(self, now_ns: int) -> None:
        """Process received frames, advance to `now_ns`, and send the frames due until then."""
        self.max_delay_ns = max(self.max_delay_ns, now_ns - self._car.next_wake_ns())
        for received in self._take_frames(now_ns):
            at_ns = min(max(received.arrived_ns, self._now_ns), now_ns)
            self._advance(at_ns)
            self._car.receive(received.frame, at_ns)
            self.counts["frames_heard"] += 1
            self._log_changes(at_ns)
        self._advance(now_ns)

    def next_wake_ns(self) -> int:
        """Return the time by which `step` should be called next."""
        return self._car.next_wake_ns()

    def execute(self, line: str, now_ns: int) -> None:
        """Execute a console command; the result is an event."""
        command = line.strip()
        if not command:
            return
        self.step(now_ns)
        if command == HELP:
            self._events += [KitEvent(now_ns, "help", help_line) for help_line in help_lines()]
            return
        try:
            execute(self._car.kit, command, now_ns)
        except UserError as error:
            self._events.append(KitEvent(now_ns, "rejected", str(error)))
            return
        self._events.append(KitEvent(now_ns, "done", command))
        self._log_changes(now_ns)

    def make_truth_datagram(self) -> bytes | None:
        """Return a datagram with the ground truth for the server, or None if the ground truth has not changed."""
        truth = self._car.simulator.ground_truth()
        if truth.mono_ns <= self._truth_ns:
            return None
        self._truth_ns = truth.mono_ns
        start, self._sent_events = self._sent_events, len(self._car.events)
        return self._sender.make_datagram(truth, self._car.events[start:])

    def take_events(self) -> list[KitEvent]:
        """Return the events since the last call."""
        events, self._events = self._events, []
        return events

    def _advance(self, to_ns: int) -> None:
        """Advance from wake time to wake time, so that each frame is sent with the time at which it was due."""
        while (wake_ns := self._car.next_wake_ns()) <= to_ns:
            frames = self._car.advance(wake_ns)
            if frames:
                self._send(frames, wake_ns)
            self._log_changes(wake_ns)
        self._now_ns = to_ns

    def _log_changes(self, now_ns: int) -> None:
        """Add an event for each change since the last call."""
        self._events += self._observer.observe(self._car.kit.state, now_ns)
        for event in self._car.events[self._logged_events :]:
            self._events.append(KitEvent(event.mono_ns, "event", f"{event.kind}: {event.detail}"))
        self._logged_events = len(self._car.events)

    def _take_frames(self, now_ns: int) -> Sequence[ReceivedCanFrame]:
        try:
            return self._port.take(now_ns)
        except BusGone as gone:
            self._note_bus_gone(str(gone), now_ns)
            return []

    def _send(self, frames: Sequence[CanFrame], made_ns: int) -> None:
        try:
            written = self._port.send(frames, made_ns)
        except BusGone as gone:
            written = gone.written
            self._note_bus_gone(str(gone), made_ns)
        else:
            self._note_bus_back(made_ns)
        self.counts["frames_sent"] += written
        self.counts["frames_lost"] += len(frames) - written

    def _note_bus_gone(self, reason: str, now_ns: int) -> None:
        if not self._is_lost:
            self._events.append(KitEvent(now_ns, "bus", f"the bus is gone: {reason}"))
        self._is_lost, self._lost_ns = True, now_ns

    def _note_bus_back(self, now_ns: int) -> None:
        """Log that the bus is back, once nothing has failed for 1 s."""
        if self._is_lost and now_ns - self._lost_ns >= NS_PER_S:
            self._is_lost = False
            self._events.append(KitEvent(now_ns, "bus", "the bus is back"))
