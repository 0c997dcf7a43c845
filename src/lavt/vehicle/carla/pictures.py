"""The pictures of a CARLA camera, by frame: threads of the package `carla` bring them, the camera node takes them."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Mapping
from typing import Any, Final

import numpy as np

from lavt.domain import Picture

MAX_KEPT: Final = 8
"""The newest pictures that are kept until they are requested."""


class PictureBox:
    """The newest pictures by CARLA's frame number."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._pictures: dict[int, Picture] = {}
        self._counts = Counter({"pictures_read": 0, "pictures_replaced": 0, "pictures_malformed": 0})

    @property
    def counts(self) -> Mapping[str, int]:
        """The number of pictures by outcome."""
        with self._changed:
            return dict(self._counts)

    def put(self, image: Any) -> None:
        """Store a `carla.Image`; one of an unexpected size is counted and dropped."""
        try:
            bgra = np.frombuffer(image.raw_data, dtype=np.uint8).reshape(image.height, image.width, 4)
        except (ValueError, BufferError):
            with self._changed:
                self._counts["pictures_malformed"] += 1
            return
        picture: Picture = np.ascontiguousarray(bgra[:, :, :3])
        with self._changed:
            self._counts["pictures_read"] += 1
            self._pictures[image.frame] = picture
            while len(self._pictures) > MAX_KEPT:
                del self._pictures[min(self._pictures)]
                self._counts["pictures_replaced"] += 1
            self._changed.notify_all()

    def take(self, frame: int, timeout_s: float) -> Picture | None:
        """Return the picture of a frame, waiting for it at most `timeout_s`; older pictures are dropped."""
        with self._changed:
            self._changed.wait_for(lambda: frame in self._pictures, timeout_s)
            picture = self._pictures.pop(frame, None)
            for older in [number for number in self._pictures if number < frame]:
                del self._pictures[older]
            return picture

    def take_newest(self, timeout_s: float) -> tuple[int, Picture] | None:
        """Return the newest picture with its frame, waiting for one at most `timeout_s`; older ones are dropped."""
        with self._changed:
            self._changed.wait_for(lambda: bool(self._pictures), timeout_s)
            if not self._pictures:
                return None
            frame = max(self._pictures)
            picture = self._pictures[frame]
            self._pictures.clear()
            return frame, picture

    def wait_for_any(self, timeout_s: float) -> bool:
        """Wait until there is a picture; return whether there is one."""
        with self._changed:
            return self._changed.wait_for(lambda: bool(self._pictures), timeout_s)
