"""The description of a run, and what its processes exchange: arguments, lines of JSON, and shared files."""

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
"""Token that opens LAVT's video path; in a drive the client gets it with the session."""
MAX_FRAMES = 1 << 17
"""Capacity of the table of sent frames: more than an hour."""

Table = NDArray[np.int64]
"""The table of sent frames: a row for each frame, with zeros until the frame is sent. Both processes map the table."""
STAMP_COLUMN, NUMBER_COLUMN = 0, 1
"""Columns of the table: the frame's stamp (ns) and its number."""


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
    """Port to which a process that is started later sends."""
    saves_units_and_picture_errors: bool = False
    """Whether to save each sent access unit, and the squared error of each received picture."""
    jitter_buffer_ms: int = 0
    """The length of GStreamer's jitter buffer."""
    synchronous: bool = False
    """Whether GStreamer shows each picture when it is due, instead of immediately."""

    @property
    def pictures_stem(self) -> Path:
        """Path of the file of pictures, without suffix."""
        return Path(self.folder) / f"{self.width_px}x{self.height_px}"

    def map_sent_table(self) -> Table:
        """Map the table of sent frames into memory."""
        return np.asarray(np.load(Path(self.folder) / "sent.npy", mmap_mode="r+"))


def create_table(folder: Path) -> None:
    """Create an empty table of sent frames."""
    np.save(folder / "sent.npy", np.zeros((MAX_FRAMES, 2), np.int64))


def save_units(run: Run, units: Sequence[bytes]) -> None:
    """Save the access units of a run, in the order of the table of sent frames."""
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
    """Wait until the program that started this process sends a line or ends."""
    sys.stdin.readline()


def exclude_objects_from_gc() -> None:
    """Exclude all existing objects from later garbage collections, as `RealRuntime` does."""
    gc.collect()
    gc.freeze()


def cpu_ns() -> int:
    """Return the CPU time that this process has used."""
    return time.process_time_ns()


def wall_ns() -> int:
    """Return the time of the wall clock, which stamps contain."""
    return time.time_ns()


class Pace:
    """The times at which frames are due, counted from the creation of this object."""

    def __init__(self) -> None:
        self._begin_ns = time.monotonic_ns()

    def wait_for(self, number: int) -> None:
        """Sleep until a frame is due."""
        due_ns = self._begin_ns + number * NS_PER_S // RATE_HZ
        pause_ns = due_ns - time.monotonic_ns()
        if pause_ns > 0:
            time.sleep(pause_ns / NS_PER_S)
