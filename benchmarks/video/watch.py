"""What a receiving process notes of each picture, for either side alike."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from benchmarks.video.pictures import picture_of, planes_loop, squared_error
from benchmarks.video.run import ROOM, Run, cpu_ns
from numpy.typing import NDArray


class Watch:
    """Notes for each picture its stamp, when that had been read, the CPU time by then and, if asked, its error."""

    def __init__(self, run: Run) -> None:
        self._rows = np.full((ROOM, 3), -1, np.int64)  # of this process's memory nothing grows but what is looked for
        self._errors = np.full(ROOM, -1.0)
        self._noted = 0
        self._table = run.table()
        self._numbers: dict[int, int] = {}
        self._filmed = planes_loop(run.loop) if run.keep else None

    def note(self, stamp_ns: int, read_ns: int, luma: NDArray[np.uint8] | None) -> None:
        """Note a picture; one whose stamp is none that was sent counts for nothing."""
        error = -1.0
        if self._filmed is not None and luma is not None:
            number = self._number_of(stamp_ns)
            if number is None:
                return
            error = squared_error(luma, picture_of(self._filmed, number))
        if self._noted < ROOM:
            self._rows[self._noted] = stamp_ns, read_ns, cpu_ns()
            self._errors[self._noted] = error
            self._noted += 1

    def save(self, path: Path) -> None:
        """Write all down: int64 rows of stamp, time of reading and CPU time, and the errors beside them."""
        np.savez(path, rows=self._rows[: self._noted], errors=self._errors[: self._noted])

    def _number_of(self, stamp_ns: int) -> int | None:
        while sent_ns := int(self._table[len(self._numbers), 0]):
            self._numbers[sent_ns] = int(self._table[len(self._numbers), 1])
        return self._numbers.get(stamp_ns)
