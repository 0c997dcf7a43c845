"""The description of a run, and the exchange with its processes: arguments, lines of JSON and shared files."""

from __future__ import annotations

import gc
import json
import sys
import time  # noqa: TID251 (latency and CPU time are what is measured)
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lavt.domain import NS_PER_S

RATE_HZ = 30
VBV_MS = 100
"""The decoder buffer (VBV) that the encoder's rate control assumes."""
GOP_FRAMES = 30
TOKEN = bytes(16)
"""Token of our video path; in a drive it comes with the session."""
MAX_FRAMES = 1 << 17
"""Capacity of the table of sent frames: more than an hour."""

Table = NDArray[np.int64]
"""A row (stamp_ns, number) for each frame; zeros until the frame is sent. Both processes map the table into memory."""


@dataclass(frozen=True)
class Run:
    """The description of one run."""

    folder: str
    width_px: int
    height_px: int
    bit_rate_bps: int
    frames: int
    """Number of frames to send, including the warm-up."""
    port: int = 0
    """Port of the process that was started first."""
    keep: bool = False
    """Save the access units and the error of each received picture."""
    jitter_buffer_ms: int = 0
    """The length of GStreamer's jitter buffer."""
    synchronous: bool = False
    """GStreamer shows each picture when it is due, instead of immediately."""

    @property
    def loop(self) -> Path:
        """Path of the pictures of this size, without suffix."""
        return Path(self.folder) / f"{self.width_px}x{self.height_px}"

    def table(self) -> Table:
        """Map the table of sent frames into memory."""
        return np.asarray(np.load(Path(self.folder) / "sent.npy", mmap_mode="r+"))


def create_table(folder: Path) -> None:
    """Create an empty table of sent frames."""
    np.save(folder / "sent.npy", np.zeros((MAX_FRAMES, 2), np.int64))


def save_units(run: Run, units: Sequence[bytes]) -> None:
    """Save the access units of a run, in the order of its table."""
    sizes = np.array([len(unit) for unit in units], np.int64)
    np.savez(Path(run.folder) / "units.npz", data=np.frombuffer(b"".join(units), np.uint8), sizes=sizes)


def load_units(run: Run) -> list[bytes]:
    """Load the access units of a run."""
    with np.load(Path(run.folder) / "units.npz") as saved:
        ends = np.cumsum(saved["sizes"]).tolist()
        data = saved["data"].tobytes()
    return [data[begin:end] for begin, end in zip([0, *ends], ends, strict=False)]


def requested_run() -> Run:
    """Return the run described on the command line."""
    return Run(**json.loads(sys.argv[1]))


def to_json(run: Run) -> str:
    """Return a run as JSON for the command line of a process."""
    return json.dumps(asdict(run))


def print_json(entries: Mapping[str, object]) -> None:
    """Print a line of JSON for the program that started this process."""
    print(json.dumps(entries), flush=True)


def wait_for_line() -> None:
    """Wait for a line from the program that started this process, or for its end."""
    sys.stdin.readline()


def freeze() -> None:
    """Exclude existing objects from garbage collection, as `RealRuntime` does."""
    gc.collect()
    gc.freeze()


def cpu_ns() -> int:
    """Return the CPU time of this process."""
    return time.process_time_ns()


def wall_ns() -> int:
    """Return the wall clock, which stamps use."""
    return time.time_ns()


class Pace:
    """A pace of frames, whose due times are computed from the frame number."""

    def __init__(self) -> None:
        self._begin_ns = time.monotonic_ns()

    def wait_for(self, number: int) -> None:
        """Sleep until a frame is due."""
        due_ns = self._begin_ns + number * NS_PER_S // RATE_HZ
        pause_ns = due_ns - time.monotonic_ns()
        if pause_ns > 0:
            time.sleep(pause_ns / NS_PER_S)
