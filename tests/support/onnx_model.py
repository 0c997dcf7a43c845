"""Make a tiny ONNX model, written as Protobuf by hand, so that no package for ONNX is needed.

Field numbers are those of `onnx.proto` (ONNX 1.16, IR version 8).
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path

VARINT, BYTES = 0, 2
FLOAT = 1
"""ONNX's number of the data type float32."""
INTS = 7
"""ONNX's number of the attribute type list of integers."""


def write_pixel_model(
    path: Path, weights: Sequence[Sequence[float]], bias: Sequence[float], size: tuple[int, int]
) -> None:
    """Write a model that maps each pixel's three channels to classes: logits = weights x pixel + bias.

    `weights` is (classes, 3), `size` is (width, height). The input is `picture`, (1, 3, h, w), the output `lanes`,
    (1, classes, h, w). A second output, `other`, is the input itself.
    """
    width, height = size
    classes = len(bias)
    flat = [value for row in weights for value in row]
    convolution = _node("Conv", ["picture", "weights", "bias"], ["lanes"], [("kernel_shape", [1, 1])])
    graph = (
        _message(1, convolution)
        + _message(1, _node("Identity", ["picture"], ["other"], []))
        + _text(2, "pixels")
        + _message(5, _tensor("weights", [classes, 3, 1, 1], flat))
        + _message(5, _tensor("bias", [classes], list(bias)))
        + _message(11, _value("picture", [1, 3, height, width]))
        + _message(12, _value("lanes", [1, classes, height, width]))
        + _message(12, _value("other", [1, 3, height, width]))
    )
    opset = _text(1, "") + _integer(2, 13)
    path.write_bytes(_integer(1, 8) + _message(8, opset) + _message(7, graph))


def _varint(value: int) -> bytes:
    parts = []
    while value > 0x7F:
        parts.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*parts, value])


def _integer(field: int, value: int) -> bytes:
    return _varint(field << 3 | VARINT) + _varint(value)


def _message(field: int, content: bytes) -> bytes:
    return _varint(field << 3 | BYTES) + _varint(len(content)) + content


def _text(field: int, text: str) -> bytes:
    return _message(field, text.encode())


def _node(
    kind: str, inputs: Sequence[str], outputs: Sequence[str], attributes: Sequence[tuple[str, list[int]]]
) -> bytes:
    names = b"".join([*(_text(1, name) for name in inputs), *(_text(2, name) for name in outputs)])
    listed = [
        _text(1, name) + b"".join(_integer(8, value) for value in values) + _integer(20, INTS)
        for name, values in attributes
    ]
    return names + _text(3, kind.lower()) + _text(4, kind) + b"".join(_message(5, attribute) for attribute in listed)


def _tensor(name: str, shape: Sequence[int], values: Sequence[float]) -> bytes:
    dimensions = b"".join(_integer(1, size) for size in shape)
    return dimensions + _integer(2, FLOAT) + _text(8, name) + _message(9, struct.pack(f"<{len(values)}f", *values))


def _value(name: str, shape: Sequence[int]) -> bytes:
    dimensions = b"".join(_message(1, _integer(1, size)) for size in shape)
    tensor_type = _integer(1, FLOAT) + _message(2, dimensions)
    return _text(1, name) + _message(2, _message(1, tensor_type))
