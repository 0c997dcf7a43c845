"""The frame buffer of an Xvfb, and the stamps of pictures in it."""

from __future__ import annotations

import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lavt.clock import pause
from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.errors import WorkError

CELLS: Final = 8
CELL_PX: Final = 8
BLACK_BELOW, WHITE_ABOVE = 85, 170
POLL_NS: Final = 20 * NS_PER_MS
START_LIMIT_NS: Final = 20 * NS_PER_S
BYTES_PER_LINE_FIELD, COLOURS_FIELD = 12, 19
"""Numbers of fields of the header of the XWD format; each field has 4 bytes, the most significant first."""
COLOUR_BYTES: Final = 12


@dataclass(frozen=True)
class Place:
    """Where a picture is on the screen: its left upper corner, and the size of its pixels."""

    x_px: float
    y_px: float
    scale: float = 1.0


class FrameBuffer:
    """The pixels of the screen of a running Xvfb, which are read without asking the X server."""

    def __init__(self, path: Path, display: str) -> None:
        self.display = display
        file = np.memmap(path, np.uint8, "r")
        header = np.frombuffer(bytes(file[:100]), ">u4")
        begin = int(header[0]) + COLOUR_BYTES * int(header[COLOURS_FIELD])
        rows = (len(file) - begin) // int(header[BYTES_PER_LINE_FIELD])
        end = begin + rows * int(header[BYTES_PER_LINE_FIELD])
        self._pixels = file[begin:end].reshape(rows, -1, 4)

    def read_stamp(self, place: Place) -> int | None:
        """Return the stamp of the picture at a place; None if a cell is neither black nor white."""
        middles = (np.arange(CELLS) + 0.5) * CELL_PX * place.scale
        rows, columns = (place.y_px + middles).astype(int), (place.x_px + middles).astype(int)
        green: NDArray[np.uint8] = self._pixels[rows[:, None], columns, 1]
        white = green > WHITE_ABOVE
        if not (white | (green < BLACK_BELOW)).all():
            return None
        return int.from_bytes(np.packbits(white).tobytes(), "big")


@contextmanager
def running_xvfb(directory: Path, width_px: int, height_px: int) -> Iterator[FrameBuffer]:
    """Run an Xvfb with one screen whose pixels are in a file of this directory."""
    number, screen = directory / "display", f"{width_px}x{height_px}x24"
    with number.open("w") as file:
        server = subprocess.Popen(
            ["Xvfb", "-displayfd", str(file.fileno()), "-fbdir", str(directory), "-screen", "0", screen],
            pass_fds=[file.fileno()],
            stderr=subprocess.DEVNULL,
        )
    try:
        for _ in range(START_LIMIT_NS // POLL_NS):
            if number.read_text().endswith("\n"):
                break
            pause(POLL_NS)
        else:
            raise WorkError("Xvfb has not started")
        yield FrameBuffer(directory / "Xvfb_screen0", f":{number.read_text().strip()}")
    finally:
        server.kill()
        server.wait()
