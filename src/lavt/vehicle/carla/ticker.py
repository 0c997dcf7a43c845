"""The ticks of a CARLA world on a time grid of the server's monotonic clock.

The world's state after a tick is the state at the tick's due time. A tick is made at its due time, when all commands up
to then are known, and advances the world over the time since the tick before. So its actuation is the mean of the
actuations in force during that time, each weighted by how long it was in force: on average, commands are neither early
nor late by a part of a tick.

In virtual time, ticks are made inside `Ticker.tick_until`. In real time, a thread makes them, because a tick of a real
server takes tens of milliseconds while the actuator must go on admitting commands. If the actuator hangs, this thread
brakes the car.
"""

from __future__ import annotations

import threading
from collections import Counter, deque
from collections.abc import Mapping
from typing import Final, Protocol

from lavt.clock import Clock
from lavt.domain import NS_PER_MS, NS_PER_S, Actuation
from lavt.vehicle.carla.settings import CarlaEvent, Snapshot
from lavt.vehicle.carla.ticks import FULL_BRAKE, ActuatorWatch, Ticked, TickHistory

LATE_NS: Final = 2 * NS_PER_MS


class World(Protocol):
    """What is ticked."""

    def tick(self, actuation: Actuation, *, hand_brake: bool = False) -> Snapshot:
        """Advance the world by one tick under an actuation and return the car after it."""
        ...

    def take_events(self) -> list[CarlaEvent]:
        """Return the events since the last call."""
        ...


class CommandHistory:
    """The actuations that were commanded, for their mean over an interval."""

    def __init__(self, actuation: Actuation, at_ns: int) -> None:
        self._commands: deque[tuple[int, Actuation]] = deque([(at_ns, actuation)])

    def add(self, actuation: Actuation, at_ns: int) -> None:
        """Put an actuation in force from `at_ns` on; times must not decrease."""
        self._commands.append((max(at_ns, self._commands[-1][0]), actuation))

    def mean(self, from_ns: int, to_ns: int) -> Actuation:
        """Return the mean over an interval, and forget what was in force before its end."""
        steering, throttle, brake = 0.0, 0.0, 0.0
        commands = list(self._commands)
        ends_ns = [at_ns for at_ns, _ in commands[1:]] + [to_ns]
        for (begin_ns, actuation), end_ns in zip(commands, ends_ns, strict=True):
            share = max(0, min(end_ns, to_ns) - max(begin_ns, from_ns)) / (to_ns - from_ns)
            steering += share * actuation.steering_rad
            throttle += share * actuation.throttle
            brake += share * actuation.brake
        while len(self._commands) > 1 and self._commands[1][0] <= to_ns:
            self._commands.popleft()
        if commands[0][0] > from_ns:  # before the first command, the first one counts
            share = (min(commands[0][0], to_ns) - from_ns) / (to_ns - from_ns)
            first = commands[0][1]
            steering += share * first.steering_rad
            throttle += share * first.throttle
            brake += share * first.brake
        return Actuation(steering, min(throttle, 1.0), min(brake, 1.0))


class Ticker(TickHistory):
    """Ticks at `first_due_ns` and then every `period_s`. All methods may be called from any thread."""

    def __init__(self, world: World, *, first_due_ns: int, period_s: float, actuation: Actuation) -> None:
        super().__init__()
        self._world = world
        self._anchor_ns, self._count = first_due_ns, 0
        self._period_s = period_s
        self._commands = CommandHistory(actuation, first_due_ns - self._period_ns)
        self._last_due_ns = first_due_ns - self._period_ns
        self._hand_brake = True
        self._counts = Counter({"ticks": 0, "ticks_begun_late": 0, "ticks_skipped": 0})
        self._is_threaded = False
        self._watch = ActuatorWatch()
        self._stopped = threading.Event()
        self._failed: BaseException | None = None
        self._thread: threading.Thread | None = None

    @property
    def counts(self) -> Mapping[str, int]:
        """Return the numbers of ticks, of late and skipped ones, and of silences of the actuator that made it brake.

        A tick is late if it began more than `LATE_NS` after its due time.
        """
        return {**self._counts, "silences": self._watch.silences}

    @property
    def is_threaded(self) -> bool:
        """Whether a thread makes the ticks."""
        return self._is_threaded

    @property
    def next_due_ns(self) -> int:
        """The due time of the next tick."""
        return self._anchor_ns + round(self._count * self._period_s * NS_PER_S)

    @property
    def _period_ns(self) -> int:
        return round(self._period_s * NS_PER_S)

    def command(self, actuation: Actuation, at_ns: int, *, hand_brake: bool) -> None:
        """Put an actuation in force from `at_ns` on."""
        with self._lock:
            self._commands.add(actuation, at_ns)
            self._hand_brake = hand_brake

    def tick_until(self, to_ns: int) -> None:
        """Make all ticks that are due by `to_ns`; if a thread makes them, note that the actuator is alive.

        Raises `VehicleError`.
        """
        if self._is_threaded:
            self._watch.hear(to_ns)
            if self._failed is not None:
                raise self._failed
            return
        while self.next_due_ns <= to_ns:
            self._tick(self.next_due_ns)

    def brake_if_silent(self, now_ns: int) -> None:
        """Brake fully in the next tick if the actuator is silent."""
        if self._watch.is_silent(now_ns):
            self.command(FULL_BRAKE, self._last_due_ns, hand_brake=False)

    def start(self, clock: Clock) -> None:
        """Start the thread that makes the ticks in real time."""
        self._is_threaded = True
        self._thread = threading.Thread(target=self._run, args=(clock,), name="CARLA ticks", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Stop the thread; the world then stands still."""
        self._stopped.set()
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join()

    def _run(self, clock: Clock) -> None:
        try:
            while not self._stopped.is_set():
                late_ns = clock.now().mono_ns - self.next_due_ns
                if late_ns < 0:
                    self._stopped.wait(-late_ns / NS_PER_S)
                    continue
                if late_ns > self._period_ns // 2:
                    self.skip(late_ns)
                    continue
                self._counts["ticks_begun_late"] += late_ns > LATE_NS
                self.brake_if_silent(clock.now().mono_ns)
                self._tick(self.next_due_ns)
        except BaseException as error:  # the actuator node raises it and so ends the run
            self._failed = error

    def skip(self, late_ns: int) -> None:
        """Move the grid by whole periods, so that the next tick is due in the future and still at a frame's time.

        The world stood still meanwhile: it lost this time, and what was commanded then does not count.
        """
        periods = 1 + late_ns // self._period_ns
        with self._lock:
            self._anchor_ns += periods * self._period_ns
            self._last_due_ns = self.next_due_ns - self._period_ns
            self._counts["ticks_skipped"] += periods

    def _tick(self, due_ns: int) -> None:
        with self._lock:
            actuation, hand_brake = self._commands.mean(self._last_due_ns, due_ns), self._hand_brake
        snapshot = self._world.tick(actuation, hand_brake=hand_brake)
        with self._lock:
            self._last_due_ns = due_ns
            self._count += 1
            self._counts["ticks"] += 1
        self.add(Ticked(due_ns, snapshot), self._world.take_events())
