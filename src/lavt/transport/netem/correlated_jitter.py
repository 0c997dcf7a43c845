"""Correlated jitter by changing the delay in steps, because netem's own correlation has no effect (docs/netem.md).

Every 20 ms a flow gets a new delay: normally distributed around the impairment's delay, with `jitter_ms` as its
standard deviation, and correlated with the previous delay (a first-order Gauss-Markov process). LAVT gives every flow a
rate, and with a rate netem keeps packets in order, so no packet overtakes another when the delay becomes shorter. A
thread of the process that owns the impairments makes the steps, so this process must keep running.
"""

from __future__ import annotations

import subprocess
import threading
from collections.abc import Sequence
from contextlib import suppress
from typing import Final

from msgspec.structs import replace

from lavt.clock import Clock, MachineClock
from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.streams import stream
from lavt.transport.emulation.impairment import ImpairedFlow, Impairment
from lavt.transport.netem.tc import set_impairment

STEP_NS: Final = 20 * NS_PER_MS
STALLED_NS: Final = NS_PER_S
"""After this time without a step, correlated jitter has stopped."""
STOP_TIMEOUT_S: Final = 5.0


def next_deviation(
    impairment: Impairment, seed: int, name: str, index: int, previous: tuple[int, float] | None
) -> float:
    """Return the deviation of the delay at step `index`, in standard deviations.

    `previous` is the index and the deviation of the last step; None: this is the first step.
    """
    innovation = float(stream(seed, f"{name} wander", index).standard_normal())
    if previous is None:
        return innovation
    last_index, last_deviation = previous
    correlation = impairment.jitter_correlation ** (index - last_index)
    return correlation * last_deviation + float((1 - correlation**2) ** 0.5) * innovation


class CorrelatedJitter:
    """A thread that changes the delays of the flows with correlated jitter in steps, until `stop` is called.

    `environment` contains the environment variables for tc.
    """

    def __init__(
        self,
        interface: str,
        flows: Sequence[ImpairedFlow],
        environment: dict[str, str],
        *,
        seed: int,
        clock: Clock | None = None,
    ) -> None:
        self._interface = interface
        self._flows = [flow for flow in flows if flow.impairment.jitter_correlation]
        self._seed = seed
        self._clock = clock or MachineClock()
        self._stopping = threading.Event()
        self._failed = False
        self._last_step_ns = self._clock.now().mono_ns
        self._tc = subprocess.Popen(
            ["tc", "-force", "-batch", "-"],  # noqa: S607 (found by root's PATH, like every tc here)
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            text=True,
            env=environment,
            start_new_session=True,  # Ctrl-C must reach only this process, which stops tc
        )
        self._thread = threading.Thread(target=self._run, name=f"jitter {interface}", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Stop the steps; the delays keep their last values."""
        self._stopping.set()
        self._thread.join()
        if self._tc.stdin is not None:
            with suppress(OSError):  # tc has ended by itself
                self._tc.stdin.close()
        try:
            self._tc.wait(STOP_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            self._tc.kill()
            self._tc.wait()

    def problems(self) -> list[str]:
        """Return a message for each flow whose jitter has stopped: tc has ended, or there was no step for a second."""
        if not self._failed and self._clock.now().mono_ns - self._last_step_ns <= STALLED_NS:
            return []
        return [f"{flow.description}: its correlated jitter has stopped" for flow in self._flows]

    def _run(self) -> None:
        last_steps: dict[str, tuple[int, float]] = {}
        """Index and deviation of the last step, by flow."""
        begin_ns = self._clock.now().mono_ns
        while not self._stopping.is_set():
            index = (self._clock.now().mono_ns - begin_ns) // STEP_NS  # missed steps are skipped
            for flow in self._flows:
                deviation = next_deviation(flow.impairment, self._seed, flow.name, index, last_steps.get(flow.name))
                last_steps[flow.name] = index, deviation
                self._set_delay(flow, deviation)
            self._last_step_ns = self._clock.now().mono_ns
            next_ns = begin_ns + (index + 1) * STEP_NS
            self._stopping.wait(max(0, next_ns - self._clock.now().mono_ns) / NS_PER_S)

    def _set_delay(self, flow: ImpairedFlow, deviation: float) -> None:
        delay_ms = max(0.0, flow.impairment.delay_ms + deviation * flow.impairment.jitter_ms)
        impairment = replace(flow.impairment, delay_ms=delay_ms, jitter_ms=0.0, jitter_correlation=0.0)
        arguments = set_impairment(self._interface, flow.name, impairment, verb="change")[1:]
        try:
            assert self._tc.stdin is not None  # noqa: S101 (Popen was called with a pipe)
            self._tc.stdin.write(" ".join(arguments) + "\n")
            self._tc.stdin.flush()
        except OSError:
            self._failed = True
