"""What one run of either side is told, and what its two processes tell of it."""

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
GOP_FRAMES = 30
TOKEN = bytes(16)
"""Opens the path of our video; in a drive it comes with the session."""
ROOM = 1 << 17
"""So many frames fit into the table of what was sent: more than an hour of them."""

Table = NDArray[np.int64]
"""A row for each frame that was sent, (stamp_ns, number), zero until then; both processes have it in memory."""


@dataclass(frozen=True)
class Run:
    """One run: what is sent where, and what is kept of it."""

    folder: str
    width_px: int
    height_px: int
    bit_rate_bps: int
    frames: int
    """So many are sent, those of the warm-up among them."""
    port: int = 0
    """The other end's; known to the process that is started second."""
    keep: bool = False
    """Write down access units, and how far each received picture is from what was filmed."""
    jitter_ms: int = 0
    """GStreamer's jitter buffer."""
    synchronous: bool = False
    """GStreamer shows each picture when it is due, not when it is there."""

    @property
    def loop(self) -> Path:
        """The folder's pictures of this size, without the end of their names."""
        return Path(self.folder) / f"{self.width_px}x{self.height_px}"

    def table(self) -> Table:
        """Map the table of what was sent into memory."""
        return np.asarray(np.load(Path(self.folder) / "sent.npy", mmap_mode="r+"))


def new_table(folder: Path) -> None:
    """Begin a new run's table."""
    np.save(folder / "sent.npy", np.zeros((ROOM, 2), np.int64))


def save_units(run: Run, units: Sequence[bytes]) -> None:
    """Write down the access units of a run, in the order of its table."""
    sizes = np.array([len(each) for each in units], np.int64)
    np.savez(Path(run.folder) / "units.npz", data=np.frombuffer(b"".join(units), np.uint8), sizes=sizes)


def load_units(run: Run) -> list[bytes]:
    """Read them again."""
    with np.load(Path(run.folder) / "units.npz") as saved:
        ends = np.cumsum(saved["sizes"]).tolist()
        data = saved["data"].tobytes()
    return [data[begin:end] for begin, end in zip([0, *ends], ends, strict=False)]


def requested_run() -> Run:
    """Take the run from the command line."""
    return Run(**json.loads(sys.argv[1]))


def told(run: Run) -> str:
    """Write a run for the command line of a process."""
    return json.dumps(asdict(run))


def tell(entries: Mapping[str, object]) -> None:
    """Print a line for the program that started this process."""
    print(json.dumps(entries), flush=True)


def wait_for_line() -> None:
    """Wait until the program that started this process says so, or has ended."""
    sys.stdin.readline()


def freeze() -> None:
    """What `RealRuntime` does about garbage: what exists by now stays."""
    gc.collect()
    gc.freeze()


def cpu_ns() -> int:
    """CPU time of this process so far."""
    return time.process_time_ns()


def wall_ns() -> int:
    """The wall clock, in which stamps are."""
    return time.time_ns()


class Pace:
    """Due times of frames, from the number each time."""

    def __init__(self) -> None:
        self._begin_ns = time.monotonic_ns()

    def wait_for(self, number: int) -> None:
        """Sleep until a frame is due."""
        due_ns = self._begin_ns + number * NS_PER_S // RATE_HZ
        pause_ns = due_ns - time.monotonic_ns()
        if pause_ns > 0:
            time.sleep(pause_ns / NS_PER_S)
