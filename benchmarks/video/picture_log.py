"""The log of received pictures, which the receiving processes of both programs write."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from benchmarks.video.pictures import picture_of, planes_loop, squared_error
from benchmarks.video.run import MAX_FRAMES, Run, cpu_ns
from numpy.typing import NDArray


class PictureLog:
    """A log of pictures: stamp, time of reading, CPU time until then and, if requested, the error."""

    def __init__(self, run: Run) -> None:
        # Allocated in advance, so that the log does not look like a memory leak.
        self._rows = np.full((MAX_FRAMES, 3), -1, np.int64)
        self._errors = np.full(MAX_FRAMES, -1.0)
        self._noted = 0
        self._table = run.table()
        self._numbers: dict[int, int] = {}
        self._source = planes_loop(run.loop) if run.keep else None

    def note(self, stamp_ns: int, read_ns: int, luma: NDArray[np.uint8] | None) -> None:
        """Note a picture; if errors are requested, pictures with a stamp that was not sent are ignored."""
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
        """Write the log: int64 rows of stamp, time of reading and CPU time, and an array of the errors."""
        np.savez(path, rows=self._rows[: self._noted], errors=self._errors[: self._noted])

    def _number_of(self, stamp_ns: int) -> int | None:
        """Return the number of the frame that was sent with a stamp; None if no frame was."""
        while sent_ns := int(self._table[len(self._numbers), 0]):
            self._numbers[sent_ns] = int(self._table[len(self._numbers), 1])
        return self._numbers.get(stamp_ns)
