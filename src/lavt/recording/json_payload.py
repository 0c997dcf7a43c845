"""Conversion of a record's payloads to JSON, and the JSON Schema of their types.

Bytes become base64 text. None and NaN become null. Times remain integers, and floats keep every digit.
"""

from __future__ import annotations

import functools
from typing import Any

import msgspec
import numpy as np


def _to_builtin(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"a record cannot contain a {type(value).__name__}")


to_json = msgspec.json.Encoder(enc_hook=_to_builtin).encode
"""Return a payload as one line of JSON; raise `TypeError` for values that JSON cannot represent."""


@functools.cache
def json_schema(payload_type: type) -> bytes:
    """Return the JSON Schema of a payload's type; for a dict, or for a type with NumPy arrays, it allows any object."""
    if payload_type is dict:
        return b'{"type": "object"}'
    name = payload_type.__name__
    try:
        _, components = msgspec.json.schema_components((payload_type,))
    except TypeError:
        components = {name: {"type": "object", "title": name}}
    own = components.pop(name)
    return msgspec.json.encode({**own, "$defs": components} if components else own)
