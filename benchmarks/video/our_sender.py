"""The sending process of ours: the camera node in its runtime."""

from __future__ import annotations

import threading
from typing import Any

import numpy as np
from benchmarks.video.product import Ends, sender_nodes
from benchmarks.video.run import TOKEN, Run, Table, cpu_ns, requested_run, save_units, tell, wait_for_line

from lavt.domain import Now


class SentFrames:
    """In the place of the record: writes the table of what was sent, and keeps access units."""

    def __init__(self, run: Run) -> None:
        self.done = threading.Event()
        self.cpu_ns = np.full(run.frames, -1, np.int64)
        self.sent = 0
        self.units: list[bytes] = []
        self._table: Table = run.table()
        self._run = run

    def write(self, topic: str, payload: Any, now: Now) -> None:  # noqa: ARG002 (the recorder's)
        """Note a frame that was sent."""
        sent = self.sent
        if sent >= self._run.frames:
            return
        if topic == "frame":
            self._table[sent, 1] = payload.number
            self._table[sent, 0] = payload.stamp_ns
        elif topic == "video":
            if self._run.keep:
                self.units.append(payload.data)
            self.cpu_ns[sent] = cpu_ns()
            self.sent = sent + 1
            if sent + 1 == self._run.frames:
                self.done.set()


def main() -> None:
    """Send as many frames as asked from when it is told to begin."""
    run = requested_run()
    sent = SentFrames(run)
    ends = Ends("feedback", sent)
    tell({"port": ends.port})
    wait_for_line()
    runtime = ends.start(sender_nodes(run, ends.clock, ends.port))
    runtime.deliver("video_token", TOKEN, ends.clock.now())
    while not sent.done.wait(0.5) and not runtime.stopped.is_set():
        pass
    ends.close()
    save_units(run, sent.units)
    tell({"cpu_ns": sent.cpu_ns[: sent.sent].tolist()})


if __name__ == "__main__":
    main()
