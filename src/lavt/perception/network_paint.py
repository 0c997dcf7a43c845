"""A finder of paint that runs a neural network through OpenCV's dnn module.

The network gets a scaled picture, (1, 3, h, w), and returns one value for each class and pixel, (1, classes, h, w).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from lavt.domain import Picture
from lavt.errors import UserError

PADDING = 114
"""The grey of a letterbox beside the picture."""


@dataclass(frozen=True, slots=True)
class NetworkInput:
    """The picture as the network expects it: (value x scale - mean) / deviation."""

    width_px: int
    height_px: int
    is_letterbox: bool
    is_rgb: bool
    scale: float
    mean: tuple[float, float, float]
    deviation: tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class NetworkOutput:
    """The output that is used: its name, empty for the only one, and which of its classes are paint."""

    name: str
    is_paint: tuple[bool, ...]
    """For each class whether it is paint."""
    threshold: float
    """The threshold of a single class."""


class NetworkPaint:
    """A finder of paint by a neural network in an ONNX file."""

    def __init__(self, model: Path, network_input: NetworkInput, output: NetworkOutput) -> None:
        """Load the network and run it once.

        Raises `UserError` if the file is not a network that OpenCV can run, or if its input or output is another one.
        """
        self._model, self._input, self._output = model, network_input, output
        self._gain = network_input.scale / np.array(network_input.deviation, dtype=np.float32)[:, None, None]
        self._bias = (np.array(network_input.mean) / np.array(network_input.deviation)).astype(np.float32)[
            :, None, None
        ]
        if not model.is_file():
            raise UserError(f"{model} is not a file: correct the key model")
        cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)  # the messages below have one sentence each
        try:
            self._network = cv2.dnn.readNetFromONNX(str(model))
        except cv2.error as error:
            raise UserError(f"OpenCV cannot read {model} ({error.err}): name an ONNX file that it supports") from error
        names = list(self._network.getUnconnectedOutLayersNames())
        if not output.name and len(names) != 1:
            raise UserError(f"{model} has several outputs: set output.name to one of {', '.join(names)}")
        if output.name and output.name not in names:
            raise UserError(f"{model} has no output {output.name!r}: set output.name to one of {', '.join(names)}")
        self._output_name = output.name or names[0]
        self.find_paint(np.full((network_input.height_px, network_input.width_px, 3), PADDING, dtype=np.uint8))

    def find_paint(self, picture_bgr: Picture) -> NDArray[np.uint8]:
        """Return a mask, (h, w), of a picture, (h, w, 3): 255 where the network sees paint, 0 elsewhere."""
        height_px, width_px, _ = picture_bgr.shape
        inner = self._inner(width_px, height_px)
        self._network.setInput(self._blob(picture_bgr, inner))
        try:
            found: Any = self._network.forward(self._output_name)
        except cv2.error as error:
            raise UserError(
                f"{self._model} cannot process a picture of {self._input.width_px} x {self._input.height_px} "
                f"({error.err}): correct input.width_px and input.height_px"
            ) from error
        values = np.asarray(found)
        classes = len(self._output.is_paint)
        if values.ndim == 3:
            values = values[None]
        if values.ndim != 4 or values.shape[:2] != (1, classes):
            raise UserError(
                f"the output {self._output_name!r} of {self._model} has the shape {np.asarray(found).shape}, but "
                f"{classes} classes need (1, {classes}, height, width): correct output.name or output.classes"
            )
        mask = self._mask(values[0])
        # The output can be smaller than the input: cut out the picture's part in proportion.
        left, top, inner_width, inner_height = inner
        across, down = mask.shape[1] / self._input.width_px, mask.shape[0] / self._input.height_px
        rows = slice(round(top * down), round((top + inner_height) * down))
        columns = slice(round(left * across), round((left + inner_width) * across))
        scaled = cv2.resize(mask[rows, columns], (width_px, height_px), interpolation=cv2.INTER_LINEAR)
        return np.asarray(scaled, dtype=np.uint8)

    def _inner(self, width_px: int, height_px: int) -> tuple[int, int, int, int]:
        """Return left, top, width and height of the picture in the network's input."""
        own = self._input
        if not own.is_letterbox:
            return 0, 0, own.width_px, own.height_px
        factor = min(own.width_px / width_px, own.height_px / height_px)
        width, height = max(round(width_px * factor), 1), max(round(height_px * factor), 1)
        return (own.width_px - width) // 2, (own.height_px - height) // 2, width, height

    def _blob(self, picture_bgr: Picture, inner: tuple[int, int, int, int]) -> NDArray[np.float32]:
        left, top, width, height = inner
        scaled = cv2.resize(picture_bgr, (width, height), interpolation=cv2.INTER_LINEAR)
        padded = np.full((self._input.height_px, self._input.width_px, 3), PADDING, dtype=np.uint8)
        padded[top : top + height, left : left + width] = scaled
        channels = padded[..., ::-1] if self._input.is_rgb else padded
        return np.ascontiguousarray((channels.transpose(2, 0, 1) * self._gain - self._bias)[None])

    def _mask(self, values: NDArray[np.float32]) -> NDArray[np.uint8]:
        """Return the mask of values, (classes, h, w)."""
        if len(values) == 1:
            return np.where(values[0] > self._output.threshold, 255, 0).astype(np.uint8)
        grey_by_class = np.where(self._output.is_paint, 255, 0).astype(np.uint8)
        return np.asarray(grey_by_class[np.argmax(values, axis=0)])
