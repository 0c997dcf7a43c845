"""A CARLA world that runs by itself: follow its states, send commands at once, and brake if the actuator hangs.

One thread waits for the world's states. Another one sends the command in force, and the full brake instead of it while
the actuator is silent. With each sending it tells the guard (`guard.py`), a process that brakes the car if this process
hangs or dies.
"""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Final, Protocol

from lavt.clock import Clock
from lavt.domain import NS_PER_MS, NS_PER_S, Actuation
from lavt.errors import VehicleError
from lavt.vehicle.carla.settings import CarlaEvent, Snapshot
from lavt.vehicle.carla.ticks import FULL_BRAKE, ActuatorWatch, Ticked, TickHistory
from lavt.vehicle.carla.world_time import WorldTime

CALIBRATION_TICKS: Final = 20
"""The times of so many states are only compared with the clock; the next ones are used."""
CALIBRATION_TIMEOUT_S: Final = 30.0
SENDING_PERIOD_S: Final = 0.02
"""The longest time until the actuator's silence is looked at, and the guard is told that this process is alive."""
RESEND_NS: Final = 100 * NS_PER_MS
"""An unchanged command is sent again after this time, because the guard may have braked."""


class RunningWorld(Protocol):
    """A world that runs by itself, with our car."""

    def apply(self, actuation: Actuation, *, hand_brake: bool = False) -> None:
        """Put an actuation in force, without waiting for the server."""
        ...

    def wait_for_state(self) -> Snapshot:
        """Return the next state of the car; raise `VehicleError` if none comes."""
        ...

    def take_events(self) -> list[CarlaEvent]:
        """Return the events since the last call."""
        ...


class Follower(TickHistory):
    """Follows a world; the vehicle and the camera use it as they use a `Ticker` whose thread ticks."""

    is_threaded = True

    def __init__(self, world: RunningWorld, *, beat: Callable[[], None] = lambda: None) -> None:
        super().__init__()
        self._world, self._beat = world, beat
        self._time = WorldTime()
        self._counts = Counter({"states": 0, "states_missed": 0, "states_late": 0})
        self._last_frame: int | None = None
        self._watch = ActuatorWatch()
        self._commanded = threading.Condition()
        self._command: tuple[Actuation, bool] = (FULL_BRAKE, True)
        self._is_new = True
        self._sent: tuple[Actuation, bool] | None = None
        self._sent_ns = 0
        self._stopped = threading.Event()
        self._failed: BaseException | None = None
        self._threads: list[threading.Thread] = []

    @property
    def counts(self) -> Mapping[str, int]:
        """Return the numbers of states, of those that did not arrive or have late times, and of actuator silences."""
        return {**self._counts, "silences": self._watch.silences}

    @property
    def next_due_ns(self) -> int:
        """The time of the newest state: when the next one comes, only the world knows."""
        with self._lock:
            return self._ticked[-1].due_ns if self._ticked else 0

    def command(self, actuation: Actuation, at_ns: int, *, hand_brake: bool) -> None:  # noqa: ARG002 (as a ticker's)
        """Put an actuation in force at once."""
        with self._commanded:
            self._command = (actuation, hand_brake)
            self._is_new = True
            self._commanded.notify()

    def tick_until(self, to_ns: int) -> None:
        """Note that the actuator is alive at `to_ns`; raise the `VehicleError` that ended a thread."""
        self._watch.hear(to_ns)
        if self._failed is not None:
            raise self._failed

    def start(self, clock: Clock) -> None:
        """Start the threads, and wait until the world's time is known; raise `VehicleError` if it stands still."""
        for name, work in (("CARLA states", self._follow), ("CARLA commands", self._send)):
            thread = threading.Thread(target=work, args=(clock,), name=name, daemon=True)
            thread.start()
            self._threads.append(thread)
        with self._changed:
            self._changed.wait_for(lambda: bool(self._ticked) or self._failed is not None, CALIBRATION_TIMEOUT_S)
            has_begun = bool(self._ticked)
        if self._failed is not None:
            raise self._failed
        if not has_begun:
            raise VehicleError(
                f"the CARLA server sent no {CALIBRATION_TICKS} states in {CALIBRATION_TIMEOUT_S:g} s: check that its "
                "world runs"
            )

    def stop(self) -> None:
        """Stop the threads; the last command stays in force, so the session brakes afterwards."""
        self._stopped.set()
        for thread in self._threads:
            if thread is not threading.current_thread():
                thread.join()

    def note(self, snapshot: Snapshot, arrived_ns: int) -> None:
        """Take a state with its time of arrival; the first `CALIBRATION_TICKS` only give the world's time."""
        due_ns = self._time.state_ns(round(snapshot.elapsed_s * NS_PER_S), arrived_ns)
        is_late = self._time.is_late(due_ns, round(snapshot.platform_s * NS_PER_S), arrived_ns)
        self._counts["states"] += 1
        if self._last_frame is not None:
            self._counts["states_missed"] += max(0, snapshot.frame - self._last_frame - 1)
        self._last_frame = snapshot.frame
        if self._counts["states"] <= CALIBRATION_TICKS:
            return
        self._counts["states_late"] += is_late
        events = self._world.take_events()
        if drift_ns := self._time.take_drift_ns():
            events.append(CarlaEvent(snapshot.frame, "late", f"{drift_ns // NS_PER_MS} ms"))
        with self._lock:
            last_ns = self._ticked[-1].due_ns if self._ticked else due_ns - 1
        self.add(Ticked(max(due_ns, last_ns + 1), snapshot), events)

    def send(self, now_ns: int) -> None:
        """Send the command in force if it is due: the actuator's, or the full brake while the actuator is silent."""
        with self._commanded:
            command, self._is_new = self._command, False
        if self._watch.is_silent(now_ns):
            command = (Actuation(command[0].steering_rad, 0.0, 1.0), False)
        if command != self._sent or now_ns - self._sent_ns >= RESEND_NS:
            self._world.apply(command[0], hand_brake=command[1])
            self._sent, self._sent_ns = command, now_ns
        self._beat()

    def _follow(self, clock: Clock) -> None:
        try:
            while not self._stopped.is_set():
                snapshot = self._world.wait_for_state()
                self.note(snapshot, clock.now().mono_ns)
        except BaseException as error:  # the actuator node raises it and so ends the run
            self._fail(error)

    def _send(self, clock: Clock) -> None:
        try:
            while not self._stopped.is_set() and self._failed is None:  # then the guard brakes, too
                with self._commanded:
                    self._commanded.wait_for(lambda: self._is_new, SENDING_PERIOD_S)
                self.send(clock.now().mono_ns)
        except BaseException as error:
            self._fail(error)

    def _fail(self, error: BaseException) -> None:
        with suppress(RuntimeError):  # the server may be gone
            self._world.apply(FULL_BRAKE)
        with self._changed:
            self._failed = error
            self._changed.notify_all()
