"""The pictures of a CARLA camera, by frame: threads of the package `carla` bring them, the camera node takes them."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Mapping
from typing import Any, Final

import numpy as np

from lavt.domain import CameraModel, Picture
from lavt.errors import VehicleError

MAX_KEPT: Final = 8
"""The newest pictures that are kept until they are requested."""


class PictureBox:
    """The newest pictures by CARLA's frame number, of the size of a camera."""

    def __init__(self, model: CameraModel) -> None:
        self._size_px = (model.width_px, model.height_px)
        self._wrong_size_px: tuple[int, int] | None = None
        """The size of the newest picture of another size."""
        self._changed = threading.Condition()
        self._pictures: dict[int, Picture] = {}
        self._counts = Counter({"pictures_read": 0, "pictures_replaced": 0, "pictures_malformed": 0})

    @property
    def counts(self) -> Mapping[str, int]:
        """The number of pictures by outcome."""
        with self._changed:
            return dict(self._counts)

    def put(self, image: Any) -> None:
        """Store a `carla.Image`; one of another size, or whose data have another length, is counted and dropped."""
        try:
            width_px, height_px = self._size_px
            if (image.width, image.height) != self._size_px:
                self._wrong_size_px = (image.width, image.height)
                raise ValueError
            bgra = np.frombuffer(image.raw_data, dtype=np.uint8).reshape(height_px, width_px, 4)
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

    def check_size(self, address: str) -> None:
        """Raise `VehicleError` if the server at an address has sent a picture of another size."""
        if self._wrong_size_px is not None:
            wrong, asked = ("x".join(map(str, size)) for size in (self._wrong_size_px, self._size_px))
            raise VehicleError(
                f"the CARLA server at {address} sends pictures of {wrong} pixels instead of {asked}: restart it"
            )

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
