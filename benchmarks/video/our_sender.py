"""LAVT's sending process: the camera node in the real-time runtime."""

from __future__ import annotations

import threading
from typing import Any

import numpy as np
from benchmarks.video.our_nodes import ProcessRuntime, build_sender_nodes
from benchmarks.video.run import (
    NUMBER_COLUMN,
    STAMP_COLUMN,
    TOKEN,
    Run,
    Table,
    cpu_ns,
    print_json,
    requested_run,
    save_units,
    wait_for_line,
)

from lavt.domain import Now


class SentFrameRecorder:
    """A recorder that writes the table of sent frames and keeps access units."""

    def __init__(self, run: Run) -> None:
        self.all_sent = threading.Event()
        self.cpu_ns = np.full(run.frames, -1, np.int64)
        """The process's CPU time after each frame."""
        self.sent = 0
        self.units: list[bytes] = []
        self._table: Table = run.map_sent_table()
        self._run = run

    def write(self, topic: str, payload: Any, now: Now) -> None:  # noqa: ARG002 (part of the protocol)
        """Note a frame's number and stamp and then, after encoding, its access unit and the CPU time."""
        sent = self.sent
        if sent >= self._run.frames:
            return
        if topic == "frame":
            self._table[sent, NUMBER_COLUMN] = payload.number
            self._table[sent, STAMP_COLUMN] = payload.stamp_ns
        elif topic == "video":
            if self._run.saves_units_and_picture_errors:
                self.units.append(payload.data)
            self.cpu_ns[sent] = cpu_ns()
            self.sent = sent + 1
            if sent + 1 == self._run.frames:
                self.all_sent.set()


def main() -> None:
    """Send the requested number of frames after a line arrives on stdin."""
    run = requested_run()
    recorder = SentFrameRecorder(run)
    process = ProcessRuntime(channel="feedback", recorder=recorder)
    print_json({"port": process.port})
    wait_for_line()
    runtime = process.start(build_sender_nodes(run, process.clock, process.port))
    runtime.deliver("video_token", TOKEN, process.clock.now())
    while not recorder.all_sent.wait(0.5) and not runtime.stopped.is_set():
        pass
    process.close()
    save_units(run, recorder.units)
    print_json({"cpu_ns": recorder.cpu_ns[: recorder.sent].tolist()})


if __name__ == "__main__":
    main()
