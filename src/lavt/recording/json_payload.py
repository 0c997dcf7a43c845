"""Conversion of a record's payloads to JSON, and the JSON Schema of their types.

Bytes become base64 text. None and NaN become null. Times remain integers, and floats keep every digit.
"""

from __future__ import annotations

import base64
import functools
import json
import math
from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass
from enum import Enum
from typing import Any

import numpy as np
from pydantic import TypeAdapter
from pydantic.errors import PydanticUserError

Json = Any
"""A value that `json` reads and writes: dict, list, str, int, float, bool, None."""


@functools.cache
def _field_names(payload_type: type) -> tuple[str, ...]:
    return tuple(field.name for field in fields(payload_type))


def _to_simpler_type(value: Any) -> Json:
    """Convert a value that `json` cannot write by one level; the encoder calls this again for nested values."""
    if is_dataclass(value) and not isinstance(value, type):
        return {name: getattr(value, name) for name in _field_names(type(value))}
    if isinstance(value, bytes | bytearray | memoryview):
        return base64.b64encode(value).decode("ascii")
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, Enum):
        return value.value
    raise TypeError(f"a record cannot contain a {type(value).__name__}")


@functools.cache
def _serializer(payload_type: type) -> Callable[[Any], bytes] | None:
    """Return pydantic's compiled serializer of a dataclass; None for other types and for a dataclass with bytes.

    Pydantic does not encode bytes as base64.
    """
    if not is_dataclass(payload_type) or b"base64" in json_schema(payload_type):
        return None
    try:
        adapter: TypeAdapter[Any] = TypeAdapter(payload_type)
    except PydanticUserError:
        return None
    return functools.partial(adapter.serializer.to_json, warnings=False)


_ENCODER = json.JSONEncoder(default=_to_simpler_type, separators=(",", ":"), allow_nan=False)


def without_nan(value: Any) -> Json:
    """Return the value in plain JSON types, with null for every number that is not finite."""
    if isinstance(value, Enum):
        return value.value
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if value is None or isinstance(value, str | int):
        return value
    if isinstance(value, Mapping):
        return {str(key): without_nan(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [without_nan(entry) for entry in value]
    return without_nan(_to_simpler_type(value))


def to_json(payload: Any) -> bytes:
    """Return a dataclass or a dict as one line of JSON.

    Raises `TypeError` for values that JSON cannot represent.
    """
    return serializer_of(type(payload))(payload)


def serializer_of(payload_type: type) -> Callable[[Any], bytes]:
    """Return the function that serializes payloads of a type to JSON."""
    hashable: Any = payload_type
    return _serializer(hashable) or _encode


def _encode(payload: Any) -> bytes:
    try:
        return _ENCODER.encode(payload).encode()
    except ValueError:  # a float that is not finite: too rare to check every payload in advance
        return _ENCODER.encode(without_nan(payload)).encode()


def _with_base64(schema: Json) -> Json:
    """Return the schema with bytes described as base64, as `to_json` writes them; pydantic only says "binary"."""
    if isinstance(schema, dict):
        if schema.get("format") == "binary":
            return {"type": "string", "contentEncoding": "base64"}
        return {key: _with_base64(entry) for key, entry in schema.items()}
    if isinstance(schema, list):
        return [_with_base64(entry) for entry in schema]
    return schema


@functools.cache
def json_schema(payload_type: type) -> bytes:
    """Return the JSON Schema of a payload's type: only `object` for a dict or a type that pydantic cannot describe."""
    schema: Json = {"type": "object"}
    if is_dataclass(payload_type):
        try:
            schema = _with_base64(TypeAdapter(payload_type).json_schema(mode="serialization"))
        except PydanticUserError:
            schema = {"type": "object", "title": payload_type.__name__}
    return json.dumps(schema).encode()
