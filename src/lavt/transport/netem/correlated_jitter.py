"""Correlated jitter: a delay that wanders. netem's own correlation does nothing (see docs/netem.md), so it is stepped.

Every 20 ms the delay of a flow becomes a new one: normal around the law's delay, with the law's standard deviation, and
correlated with the one before (Gauss and Markov's process of the first order). netem keeps order, so nothing overtakes
where the delay becomes shorter. It takes a process that stays: a thread of whoever owns the delay.
"""

from __future__ import annotations

import subprocess
import threading
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Final

from lavt.clock import Clock, MachineClock
from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.streams import stream
from lavt.transport.emulation.impairment import ImpairedFlow, Impairment
from lavt.transport.netem.tc import set_impairment

STEP_NS: Final = 20 * NS_PER_MS
LATE_NS: Final = NS_PER_S
"""A wander that has made no step for so long has stopped."""
END_S: Final = 5.0


def wandering(impairment: Impairment, seed: int, name: str, index: int, before: tuple[int, float] | None) -> float:
    """Give a delay's deviation at step `index`, in standard deviations; `before` is an earlier (index, deviation)."""
    drawn = float(stream(seed, f"{name} wander", index).standard_normal())
    if before is None:
        return drawn
    correlation = impairment.jitter_correlation ** (index - before[0])
    return correlation * before[1] + float((1 - correlation**2) ** 0.5) * drawn


class CorrelatedJitter:
    """A thread that steps the delays of the flows whose jitter is correlated, from now until it is told to end.

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
        self._told = threading.Event()
        self._failed = False
        self._stepped_ns = self._clock.now().mono_ns
        self._tc = subprocess.Popen(
            ["tc", "-force", "-batch", "-"],  # noqa: S607 (found as root's PATH says, like every tc here)
            stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, text=True, env=environment,
            start_new_session=True,  # Ctrl-C is for us: we end it
        )  # fmt: skip
        self._thread = threading.Thread(target=self._run, name=f"wander {interface}", daemon=True)
        self._thread.start()

    def end(self) -> None:
        """Step no more; the delays stay where they are."""
        self._told.set()
        self._thread.join()
        if self._tc.stdin is not None:
            with suppress(OSError):  # it has ended by itself
                self._tc.stdin.close()
        try:
            self._tc.wait(END_S)
        except subprocess.TimeoutExpired:
            self._tc.kill()
            self._tc.wait()

    def problems(self) -> list[str]:
        """Say in sentences which flows wander no more: tc has ended by itself, or there was no step for a second."""
        if not self._failed and self._clock.now().mono_ns - self._stepped_ns <= LATE_NS:
            return []
        return [f"{flow.description}: its correlated jitter has stopped" for flow in self._flows]

    def _run(self) -> None:
        at: dict[str, tuple[int, float]] = {}
        begin_ns = self._clock.now().mono_ns
        while not self._told.is_set():
            index = (self._clock.now().mono_ns - begin_ns) // STEP_NS  # what came late is left out, not caught up
            for flow in self._flows:
                deviations = wandering(flow.impairment, self._seed, flow.name, index, at.get(flow.name))
                at[flow.name] = index, deviations
                self._say(flow, deviations)
            self._stepped_ns = self._clock.now().mono_ns
            next_ns = begin_ns + (index + 1) * STEP_NS
            self._told.wait(max(0, next_ns - self._clock.now().mono_ns) / NS_PER_S)

    def _say(self, flow: ImpairedFlow, deviations: float) -> None:
        delay_ms = max(0.0, flow.impairment.delay_ms + deviations * flow.impairment.jitter_ms)
        impairment = replace(flow.impairment, delay_ms=delay_ms, jitter_ms=0.0, jitter_correlation=0.0)
        words = set_impairment(self._interface, flow.name, impairment, verb="change")[1:]
        try:
            assert self._tc.stdin is not None  # noqa: S101 (a pipe was asked for)
            self._tc.stdin.write(" ".join(words) + "\n")
            self._tc.stdin.flush()
        except OSError:
            self._failed = True
