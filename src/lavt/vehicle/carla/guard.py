"""The guard of a car in a world that runs by itself: a process that brakes the car if LAVT's process hangs or dies.

The server keeps the last control of a client that is gone, so only another client can brake the car. LAVT's process
writes into the guard's standard input all the time. If that stops, the guard brakes until it goes on; if the pipe is
closed without a farewell, the guard brakes until the car is stationary.
"""

from __future__ import annotations

import os
import select
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from typing import Any, Final

from lavt.clock import Clock, MachineClock, pause
from lavt.domain import NS_PER_S
from lavt.errors import LavtError, VehicleError
from lavt.vehicle.carla.connection import connect
from lavt.vehicle.carla.library import load_library
from lavt.vehicle.carla.settings import CarlaSettings

BEAT: Final = b"."
FAREWELL: Final = b"e"
READY: Final = b"ready\n"
BEAT_TIMEOUT_S: Final = 0.3
"""The guard brakes if it has read nothing for this long. The process itself brakes after 0.2 s if only its actuator
hangs."""
REPEAT_S: Final = 0.1
MIN_BRAKINGS, MAX_BRAKINGS = 10, 600
"""After the death of the process, the guard brakes at least this often, because the newest state may be from before,
and at most this often, because the server may be dead, too."""
STATIONARY_MPS: Final = 0.05
START_TIMEOUT_S: Final = 30.0
END_TIMEOUT_S: Final = 2.0
MAX_UNANSWERED: Final = 150
"""The guard answers what it reads. After so many beats without an answer, one to three seconds, it is not there."""
CALL_NS: Final = NS_PER_S
"""The guard asks the server something this often, because a lost connection shows only in an answer."""
CALL_TIMEOUT_S: Final = 1.0


class Guard:
    """The guard's process, as LAVT's process sees it. Raises `VehicleError` if the guard does not find the car."""

    def __init__(self, settings: CarlaSettings, car: int) -> None:
        command = [sys.executable, "-m", __name__, settings.host, str(settings.port), str(settings.timeout_s), str(car)]
        # A session of its own: Ctrl-C in the terminal must not end it.
        self._process = subprocess.Popen(  # noqa: S603 (our own program)
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, bufsize=0, start_new_session=True
        )
        self._input, self._output = self._process.stdin, self._process.stdout
        assert self._input is not None  # noqa: S101 (for mypy: both are pipes)
        assert self._output is not None  # noqa: S101
        while select.select([self._output], [], [], START_TIMEOUT_S)[0]:
            if not (line := self._output.readline()) or line == READY:
                break
        else:
            line = b""
        if line != READY:
            self.end()
            raise VehicleError("the guard, which brakes the car if LAVT dies, did not find the car: restart CARLA")
        for pipe in (self._input, self._output):
            os.set_blocking(pipe.fileno(), False)
        self._unanswered = 0

    def beat(self) -> None:
        """Tell the guard that this process is alive; raise `VehicleError` if the guard has ended or does not answer."""
        if self._input is None or self._output is None or self._process.poll() is not None:
            raise VehicleError("the guard, which brakes the car if LAVT dies, has ended: start the run again")
        with suppress(BlockingIOError, BrokenPipeError):  # full: the guard is frozen; broken: the next call raises
            os.write(self._input.fileno(), BEAT)
        with suppress(BlockingIOError):
            self._unanswered += 1
            if os.read(self._output.fileno(), 4096):
                self._unanswered = 0
        if self._unanswered > MAX_UNANSWERED:
            raise VehicleError(
                "the guard, which brakes the car if LAVT dies, does not answer, or the server does not answer it: "
                "start the run again"
            )

    def end(self, *, is_car_gone: bool = True) -> None:
        """End the guard; if the car is still there, the guard first brakes it until it is stationary."""
        if self._input is None or self._output is None:
            return
        if is_car_gone:
            with suppress(OSError):
                os.write(self._input.fileno(), FAREWELL)
        for pipe in (self._input, self._output):
            with suppress(OSError):
                pipe.close()
        self._input = self._output = None
        if not is_car_gone:
            return
        try:
            self._process.wait(END_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


def guard(beats: int, brake: Callable[[], bool], answer: Callable[[], None] = lambda: None) -> None:
    """Brake while nothing can be read from the file descriptor `beats`; return after a farewell.

    At the end of the pipe, brake until the car is stationary, at most for a minute, and return. `brake` brakes once,
    and returns whether the car is stationary. `answer` is called after each reading.
    """
    timeout_s = BEAT_TIMEOUT_S
    while True:
        readable, _, _ = select.select([beats], [], [], timeout_s)
        if not readable:
            brake()
            timeout_s = REPEAT_S
            continue
        text = os.read(beats, 4096)
        if FAREWELL in text:
            return
        if not text:
            break
        answer()
        timeout_s = BEAT_TIMEOUT_S
    for count in range(1, MAX_BRAKINGS + 1):
        if brake() and count >= MIN_BRAKINGS:
            break
        pause(round(REPEAT_S * NS_PER_S))


class BeatAnswer:
    """The answer to a beat: written if the server has answered this process lately.

    Without it LAVT's process ends the run. The guard goes on, because it may be the last one that can brake.
    """

    def __init__(self, ask_server: Callable[[], object], clock: Clock, output: int) -> None:
        self._ask_server, self._clock, self._output = ask_server, clock, output
        self._asked_ns: int | None = None

    def __call__(self) -> None:
        """Ask the server every `CALL_NS`, and answer unless it is silent."""
        now_ns = self._clock.now().mono_ns
        with suppress(OSError, RuntimeError):  # LAVT's process is gone; the server does not answer
            if self._asked_ns is None or now_ns - self._asked_ns >= CALL_NS:
                self._ask_server()
                self._asked_ns = now_ns
            os.write(self._output, BEAT)


class CarBrake:
    """The brake of an actor; each call brakes once."""

    def __init__(self, carla: Any, car: Any) -> None:
        self._carla, self._car = carla, car
        self._calls = 0

    def __call__(self) -> bool:
        """Brake with the wheels where they were commanded; return whether the car is stationary."""
        self._calls += 1
        is_stationary = bool(self._car.get_velocity().length() < STATIONARY_MPS)
        steer = self._car.get_control().steer
        # The package does not send a control that is equal to the last one, so each is a little different.
        steer -= (self._calls % 2) * (1e-6 if steer >= 0.0 else -1e-6)
        self._car.apply_control(
            self._carla.VehicleControl(throttle=0.0, steer=steer, brake=1.0, hand_brake=is_stationary)
        )
        return is_stationary


def main() -> int:
    """Guard the car with the actor number of the arguments; return the exit code."""
    host, port, timeout_s, number = sys.argv[1:]
    try:
        carla = load_library()
        client = connect(carla, CarlaSettings(host, int(port), 0.1, None, timeout_s=float(timeout_s)))
        car = client.get_world().get_actor(int(number))
        if car is None:
            return 1
        client.set_timeout(CALL_TIMEOUT_S)
        os.write(sys.stdout.fileno(), READY)
        answer = BeatAnswer(client.get_server_version, MachineClock(), sys.stdout.fileno())
        guard(sys.stdin.fileno(), CarBrake(carla, car), answer)
    except (LavtError, RuntimeError):  # the server is gone, and with it the car
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
