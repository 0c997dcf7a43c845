"""The log of received pictures; both LAVT's and GStreamer's receiving processes write one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from benchmarks.video.pictures import memory_map_pictures, picture_of, squared_error
from benchmarks.video.run import MAX_FRAMES, NUMBER_COLUMN, STAMP_COLUMN, Run, cpu_ns
from numpy.typing import NDArray


class PictureLog:
    """A log of pictures: stamp, time when the stamp was read, CPU time until then and, on request, the error.

    `run.saves_units_and_picture_errors` requests the errors.
    """

    def __init__(self, run: Run) -> None:
        # Allocated in advance, because a growing log would look like a memory leak.
        self._rows = np.full((MAX_FRAMES, 3), -1, np.int64)
        self._errors = np.full(MAX_FRAMES, -1.0)
        self._noted = 0
        self._table = run.map_sent_table()
        self._number_by_stamp: dict[int, int] = {}
        self._source = memory_map_pictures(run.pictures_stem) if run.saves_units_and_picture_errors else None

    def note(self, stamp_ns: int, read_ns: int, luma: NDArray[np.uint8] | None) -> None:
        """Note a picture. If errors are requested, ignore a picture whose stamp was not sent."""
        error = -1.0
        if self._source is not None and luma is not None:
            number = self._number_of(stamp_ns)
            if number is None:
                return
            error = squared_error(luma, picture_of(self._source, number))
        if self._noted < MAX_FRAMES:
            self._rows[self._noted] = stamp_ns, read_ns, cpu_ns()
            self._errors[self._noted] = error
            self._noted += 1

    def save(self, path: Path) -> None:
        """Write the log as two arrays: rows of stamp, reading time and CPU time, and the errors (-1: not requested)."""
        np.savez(path, rows=self._rows[: self._noted], errors=self._errors[: self._noted])

    def _number_of(self, stamp_ns: int) -> int | None:
        """Return the number of the frame that was sent with a stamp; None if no frame was sent with it."""
        while sent_ns := int(self._table[len(self._number_by_stamp), STAMP_COLUMN]):  # add the frames sent since then
            self._number_by_stamp[sent_ns] = int(self._table[len(self._number_by_stamp), NUMBER_COLUMN])
        return self._number_by_stamp.get(stamp_ns)
