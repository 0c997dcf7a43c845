"""The host's record of stalls, for the tests in the first machine.

    python -m tests.kernel.lane.host_stalls < QUESTIONS > ANSWERS

A probe inside a machine cannot run while the host stalls that machine. So this program runs on the host, starts one
lateness probe for each processor, and answers through pipes that the first machine sees as a serial line. The clocks of
host and machines differ, but all read the same counter of the processor. So each answer contains the host's time
together with the counter, and `HostProbe` converts the times to those of its machine.
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

POLL_S = 0.5
"""Polling period. If a clock is slewed by 500 ppm, the error in this time is 0.3 ms."""
STALLS_PER_ANSWER = 40
"""Maximum number of stalls in an answer. After its serial line was full once (4 KB), a user-mode kernel receives
nothing more on that line."""


def serve() -> None:
    """Answer each byte on standard input with one line, until the end of input."""
    stalls = Stalls.start_probes()
    try:
        while os.read(0, 1):
            sys.stdout.write(json.dumps(_answer(stalls)) + "\n")
            sys.stdout.flush()
    finally:
        stalls.end()


def _answer(stalls: Stalls) -> dict[str, Any]:
    """Return the present time, and the oldest stalls that were in no earlier answer."""
    counter, mono_ns = clocks.read_monotonic_clock()
    try:
        stalls.collect()
    except ProbeEnded as error:
        return {"ended": str(error)}
    oldest = [[stall.processor, stall.begin_ns, stall.end_ns] for stall in stalls.recorded[:STALLS_PER_ANSWER]]
    del stalls.recorded[:STALLS_PER_ANSWER]
    has_priority = all(probe.has_realtime_priority for probe in stalls.probes)
    return {
        "counter": counter,
        "mono_ns": mono_ns,
        "stalls": oldest,
        "more": bool(stalls.recorded),
        "has_realtime_priority": has_priority,
        "processor_times": stalls.processor_times(),
    }


class HostProbe:
    """All probes of the host as one probe, with times on this machine's CLOCK_MONOTONIC.

    A thread queries the host twice a second, so that a slewed clock makes only a small error.
    """

    def __init__(self, device: str | Path) -> None:
        self._line = os.open(device, os.O_RDWR | os.O_NOCTTY)
        if os.isatty(self._line):
            tty.setraw(self._line)
        self._lock = threading.Lock()
        self._recorded: list[Stall] = []
        self._processor_times = ""
        self._stopping = threading.Event()
        self.has_realtime_priority = bool(self._query_all()["has_realtime_priority"])
        self._thread = threading.Thread(target=self._poll, daemon=True)
        self._thread.start()

    def report(self) -> tuple[int, list[Stall]]:
        """Return the time up to which the record is complete, and the stalls since the last report."""
        with self._lock:
            reported_ns = int(self._query_all()["mono_ns"])
            recorded, self._recorded = self._recorded, []
        return reported_ns, recorded

    def processor_times(self) -> str:
        """Return the first line of the host's /proc/stat from the last answer, even after the record has ended."""
        return self._processor_times

    def end(self) -> None:
        """Stop the thread and close the line."""
        self._stopping.set()
        self._thread.join()
        os.close(self._line)

    def _poll(self) -> None:
        while not self._stopping.wait(POLL_S):
            try:
                with self._lock:
                    self._query_all()
            except ProbeEnded:
                return  # the next report raises `ProbeEnded` again

    def _query_all(self) -> dict[str, Any]:
        """Query until the host has no more stalls, keep them, and return the last answer in this machine's time."""
        answer = self._query()
        while answer["more"]:
            answer = self._query()
        return answer

    def _query(self) -> dict[str, Any]:
        data = b""
        try:
            os.write(self._line, b"?")
            while not data.endswith(b"\n"):
                chunk = os.read(self._line, 65536)
                if not chunk:
                    raise ProbeEnded("the host's record of stalls ended")
                data += chunk
        except OSError as error:
            raise ProbeEnded(f"the host's record of stalls ended: {error}") from None
        answer: dict[str, Any] = json.loads(data)
        if "ended" in answer:
            raise ProbeEnded(answer["ended"])
        self._processor_times = str(answer["processor_times"])
        offset_ns = clocks.offset_ns(clocks.read_monotonic_clock(), (answer["counter"], answer["mono_ns"]))
        self._recorded += [
            Stall(processor, begin_ns + offset_ns, end_ns + offset_ns)
            for processor, begin_ns, end_ns in answer["stalls"]
        ]
        return {**answer, "mono_ns": answer["mono_ns"] + offset_ns}


if __name__ == "__main__":
    with suppress(BrokenPipeError):  # the first machine has ended
        serve()
