"""Correlated jitter, which netem's own correlation does not produce (see docs/netem.md), in steps of the delay.

Every 20 ms a flow gets a new delay: normally distributed around the impairment's delay, with its standard deviation,
and correlated with the delay before (a first-order Gauss-Markov process). netem keeps order, so no packet overtakes
another when the delay becomes shorter. The steps need a persistent process: they are a thread of the delay's owner.
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
    """Return the deviation of the delay at step `index`, in standard deviations; `previous` is an earlier step's."""
    innovation = float(stream(seed, f"{name} wander", index).standard_normal())
    if previous is None:
        return innovation
    correlation = impairment.jitter_correlation ** (index - previous[0])
    return correlation * previous[1] + float((1 - correlation**2) ** 0.5) * innovation


class CorrelatedJitter:
    """A thread that steps the delays of the flows with correlated jitter, until `stop` is called.

    `environment` is that of tc.
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
        self._stepped_ns = self._clock.now().mono_ns
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
        """Stop stepping; the delays keep their last values."""
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
        if not self._failed and self._clock.now().mono_ns - self._stepped_ns <= STALLED_NS:
            return []
        return [f"{flow.description}: its correlated jitter has stopped" for flow in self._flows]

    def _run(self) -> None:
        states: dict[str, tuple[int, float]] = {}
        begin_ns = self._clock.now().mono_ns
        while not self._stopping.is_set():
            index = (self._clock.now().mono_ns - begin_ns) // STEP_NS  # missed steps are skipped
            for flow in self._flows:
                deviation = next_deviation(flow.impairment, self._seed, flow.name, index, states.get(flow.name))
                states[flow.name] = index, deviation
                self._set_delay(flow, deviation)
            self._stepped_ns = self._clock.now().mono_ns
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
