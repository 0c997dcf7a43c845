"""The guard of a car in a world that runs by itself: a process that brakes the car if LAVT's process hangs or dies.

The server keeps the last control of a client that is gone, so only another client can brake the car. LAVT's process
writes into the guard's standard input all the time. If that stops, the guard brakes until it goes on; if the pipe is
closed without a farewell, the guard brakes for some seconds, and the server keeps the brake. If the guard loses its
connection, it connects anew, because the process may have lost its own at the same time.

A state that the package `carla` cannot read aborts each process that reads the world's states. So the guard reads none:
it gets the steer to keep from LAVT's process, and sends its controls with `apply_batch`, which needs no world.
"""

from __future__ import annotations

import os
import re
import select
import signal
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from typing import Final

from lavt.clock import Clock, MachineClock, pause
from lavt.domain import NS_PER_S
from lavt.errors import LavtError, VehicleError
from lavt.operating_system import HANGUP
from lavt.vehicle.carla.guard_link import GuardLink, connector
from lavt.vehicle.carla.library import load_library
from lavt.vehicle.carla.settings import CarlaSettings

BEAT: Final = b"."
"""The guard's answer. A beat of LAVT's process is the steer of its last control in angle brackets."""
STEER: Final = re.compile(rb"<(-?[01]\.\d+)>")
FAREWELL: Final = b"e"
READY: Final = b"ready\n"
TRIAL_STEER: Final = 0.01
"""The guard brakes once at its start, with this steer, by which LAVT's process recognizes its control."""
TRIAL_STATES: Final = 150
"""In so many states of the world this control must be in force."""
BEAT_TIMEOUT_S: Final = 0.3
"""The guard brakes if it has read nothing for this long. The process itself brakes after 0.2 s if only its actuator
hangs."""
REPEAT_S: Final = 0.1
LAST_BRAKINGS: Final = 100
"""After the death of the process, the guard brakes this often; with the last one it pulls the hand brake. Only those
count after which the server answered."""
MAX_UNREACHED: Final = 60
"""After the death of the process, the guard looks so often for a server that does not answer: one to four minutes."""
LOOK_AGAIN_S: Final = 1.0
IGNORED_SIGNALS: Final = (signal.SIGINT, signal.SIGTERM, *HANGUP)
"""The guard ends after LAVT's process, and not before it, although a service manager sends both the same signal."""
START_TIMEOUT_S: Final = 30.0
END_TIMEOUT_S: Final = 2.0
MAX_UNANSWERED: Final = 150
"""The guard answers what it reads. After so many beats without an answer, one to three seconds, it is not there."""
CALL_NS: Final = NS_PER_S
"""The guard asks the server something this often, because a lost connection shows only in an answer."""


class Guard:
    """The guard's process, as LAVT's process sees it; `steer` returns the steer to keep when it brakes.

    Raises `VehicleError` if the guard does not find the server.
    """

    def __init__(self, settings: CarlaSettings, car: int, steer: Callable[[], float]) -> None:
        self._steer = steer
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
            raise VehicleError("the guard, which brakes the car if LAVT dies, did not find the server: restart CARLA")
        for pipe in (self._input, self._output):
            os.set_blocking(pipe.fileno(), False)
        self._unanswered = 0

    def beat(self) -> None:
        """Tell the guard that this process is alive; raise `VehicleError` if the guard has ended or does not answer."""
        if self._input is None or self._output is None or self._process.poll() is not None:
            raise VehicleError("the guard, which brakes the car if LAVT dies, has ended: start the run again")
        with suppress(BlockingIOError, BrokenPipeError):  # full: the guard is frozen; broken: the next call raises
            os.write(self._input.fileno(), b"<%.6f>" % self._steer())
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


def guard(beats: int, brake: CarBrake, answer: Callable[[], None] = lambda: None) -> None:
    """Brake while nothing can be read from the file descriptor `beats`; return after a farewell.

    At the end of the pipe, brake `LAST_BRAKINGS` times, and return; give up after `MAX_UNREACHED` brakings that did not
    reach the car. `answer` is called after each reading.
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
        brake.read_steer(text)
        answer()
        timeout_s = BEAT_TIMEOUT_S
    braked = unreached = 0
    while braked < LAST_BRAKINGS and unreached < MAX_UNREACHED:
        is_reached = brake(hand_brake=braked == LAST_BRAKINGS - 1)
        braked, unreached = braked + is_reached, unreached + (not is_reached)
        pause(round((REPEAT_S if is_reached else LOOK_AGAIN_S) * NS_PER_S))


def await_trial(next_steering_rad: Callable[[], float], max_steering_rad: float) -> None:
    """Wait until the guard's first control is in force; raise `VehicleError` if it is not.

    `next_steering_rad` waits for the car's next state, and returns the angle of the control in it; until the guard
    brakes it is 0.
    """
    for _ in range(TRIAL_STATES):
        if next_steering_rad() < -0.3 * TRIAL_STEER * max_steering_rad:  # not exactly, because of the steering curve
            return
    raise VehicleError("the guard, which brakes the car if LAVT dies, does not reach the car: restart CARLA")


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
    """The brake of an actor, which `send` gives a control; each call brakes once.

    `send` returns whether the server answered afterwards.
    """

    def __init__(self, send: Callable[[float, bool], bool]) -> None:
        self._send = send
        self._steer = TRIAL_STEER

    def read_steer(self, beats: bytes) -> None:
        """Keep the steer of the newest whole beat, if there is one."""
        if steers := STEER.findall(beats):
            self._steer = float(steers[-1])

    def __call__(self, *, hand_brake: bool = False) -> bool:
        """Brake with the wheels where they were commanded; return whether the control reached the server."""
        return self._send(self._steer, hand_brake)


def main() -> int:
    """Guard the car with the actor number of the arguments; return the exit code."""
    for signal_number in IGNORED_SIGNALS:
        signal.signal(signal_number, signal.SIG_IGN)
    host, port, timeout_s, number = sys.argv[1:]
    try:
        carla = load_library()
        link = GuardLink(connector(carla, CarlaSettings(host, int(port), 0.1, None, timeout_s=float(timeout_s))))

        def send(steer: float, hand_brake: bool) -> bool:
            control = carla.VehicleControl(throttle=0.0, steer=steer, brake=1.0, hand_brake=hand_brake)
            braking = [carla.command.ApplyVehicleControl(int(number), control)]
            return link.reach(lambda client: client.apply_batch(braking))

        brake = CarBrake(send)
        brake(hand_brake=True)
        os.write(sys.stdout.fileno(), READY)
        guard(sys.stdin.fileno(), brake, BeatAnswer(link.ask, MachineClock(), sys.stdout.fileno()))
    except (LavtError, RuntimeError, OSError):  # no server at the start, its world is another one, or LAVT has ended
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
