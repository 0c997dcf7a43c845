"""The host's record of stalls, for the tests in the first machine.

    python -m tests.kernel.lane.host_stalls < QUESTIONS > ANSWERS

A probe inside a machine could not run before the machine itself does. So this program runs on the host, starts one
lateness probe for each processor there, and answers through pipes that the first machine sees as a serial line. All
machines have clocks of their own: each answer has the host's time together with the processor's counter, which all of
them read, and `HostProbe` computes the machine's time from it.
"""

from __future__ import annotations

import json
import os
import sys
import threading
import tty
from contextlib import suppress
from pathlib import Path
from typing import Any

from tests.kernel.lane import clocks
from tests.support.stalls import ProbeEnded, Stall, Stalls

ASK_S = 0.5
"""A machine's clock may be slewed by 500 ppm: a stall that is told so much later is 0.3 ms off."""
AT_ONCE = 40
"""A user-mode kernel whose line was once full, with 4 KB, hears nothing on it any more."""


def serve() -> None:
    """Answer each byte on standard input with one line, until it ends."""
    stalls = Stalls.measured()
    try:
        while os.read(0, 1):
            sys.stdout.write(json.dumps(_answer(stalls)) + "\n")
            sys.stdout.flush()
    finally:
        stalls.end()


def _answer(stalls: Stalls) -> dict[str, Any]:
    """Return the time, and the stalls until then that no earlier answer had; the oldest, where there are many."""
    counter, mono_ns = clocks.monotonic_reading()
    try:
        stalls.collect()
    except ProbeEnded as ended:
        return {"ended": str(ended)}
    told = [[each.processor, each.begin_ns, each.end_ns] for each in stalls.recorded[:AT_ONCE]]
    del stalls.recorded[:AT_ONCE]
    above = all(probe.above for probe in stalls.probes)
    return {
        "counter": counter, "mono_ns": mono_ns, "stalls": told, "more": bool(stalls.recorded),
        "above": above, "processor_times": stalls.processor_times(),
    }  # fmt: skip


class HostProbe:
    """All probes of the host, as one. Its times are those of this machine's CLOCK_MONOTONIC.

    A thread asks twice a second, so that a clock that is slewed meanwhile has little time to go wrong.
    """

    def __init__(self, device: str | Path) -> None:
        self._line = os.open(device, os.O_RDWR | os.O_NOCTTY)
        if os.isatty(self._line):
            tty.setraw(self._line)
        self._one_at_a_time = threading.Lock()
        self._recorded: list[Stall] = []
        self._processor_times = ""
        self._over = threading.Event()
        self.above = bool(self._ask()["above"])
        self._thread = threading.Thread(target=self._ask_again_and_again, daemon=True)
        self._thread.start()

    def report(self) -> tuple[int, list[Stall]]:
        """Return the time up to which the record is complete, and the stalls since the last report."""
        with self._one_at_a_time:
            reported_ns = int(self._ask()["mono_ns"])
            recorded, self._recorded = self._recorded, []
        return reported_ns, recorded

    def processor_times(self) -> str:
        """Return the first line of the host's /proc/stat as it was told last, also where the record has ended."""
        return self._processor_times

    def end(self) -> None:
        """End the thread, and close the line."""
        self._over.set()
        self._thread.join()
        os.close(self._line)

    def _ask_again_and_again(self) -> None:
        while not self._over.wait(ASK_S):
            try:
                with self._one_at_a_time:
                    self._ask()
            except ProbeEnded:
                return  # the next report raises it, too

    def _ask(self) -> dict[str, Any]:
        """Ask until everything is told, keep the stalls, and return the last answer, its time being this machine's."""
        answer = self._answer()
        while answer["more"]:
            answer = self._answer()
        return answer

    def _answer(self) -> dict[str, Any]:
        said = b""
        try:
            os.write(self._line, b"?")
            while not said.endswith(b"\n"):
                piece = os.read(self._line, 65536)
                if not piece:
                    raise ProbeEnded("the host's record of stalls ended")
                said += piece
        except OSError as error:
            raise ProbeEnded(f"the host's record of stalls ended: {error}") from None
        answer: dict[str, Any] = json.loads(said)
        if "ended" in answer:
            raise ProbeEnded(answer["ended"])
        self._processor_times = str(answer["processor_times"])
        ahead_ns = clocks.ahead_ns(clocks.monotonic_reading(), (answer["counter"], answer["mono_ns"]))
        self._recorded += [
            Stall(processor, begin_ns + ahead_ns, end_ns + ahead_ns) for processor, begin_ns, end_ns in answer["stalls"]
        ]
        return {**answer, "mono_ns": answer["mono_ns"] + ahead_ns}


if __name__ == "__main__":
    with suppress(BrokenPipeError):  # the machine has ended
        serve()
