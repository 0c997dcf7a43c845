"""Encode and decode the messages between the two sides: msgpack arrays that begin with a version.

A message on the wire is `[version, field, field, ..]`, the fields in the order of the class. `decode` raises
`BadMessage` for data that is too long, not msgpack, of another version or shape, not finite, or out of range. `encode`
cuts texts that are too long, such as a list of faults, because a state must be readable whatever its reason.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass, fields
from functools import lru_cache
from operator import attrgetter
from typing import Any, TypeVar

import msgpack

from lavt.domain import PATH_POINTS, Command, NetemReply, NetemRequest, SessionReply, SessionRequest, State
from lavt.errors import BadMessage

VERSION = 4
MAX_MESSAGE_BYTES = 1024
NAME = re.compile(r"^[A-Za-z0-9][A-Za-z0-9_-]{0,31}\Z")
"""A valid name of a vehicle or client: it contains nothing that has a meaning in a Zenoh key."""
REASON_BYTES = 300
"""Limits a reason; a message with its longest texts is within `MAX_MESSAGE_BYTES`."""
ELLIPSIS = "\N{HORIZONTAL ELLIPSIS}"
MAX_DELAY_MS = 10_000.0
"""Limits what a client can request of a server, which needs as long to clear the delay."""

Check = Callable[[Any], bool]
_NUMBERS = frozenset((int, float))


def _integer(low: int, high: int) -> Check:
    return lambda value: type(value) is int and low <= value <= high


def _number(low: float, high: float) -> Check:
    return lambda value: type(value) in _NUMBERS and low <= value <= high  # false for NaN


@dataclass(frozen=True, slots=True)
class _Text:
    """A check of a text's length in bytes, so that texts of any letters fit into a message."""

    max_bytes: int

    def __call__(self, value: Any) -> bool:
        return type(value) is str and len(value.encode()) <= self.max_bytes

    def cut(self, text: str) -> str:
        """Return the text without lone surrogates (of a file's name), cut to the limit and then with an ellipsis."""
        data = text.encode(errors="replace")
        if len(data) <= self.max_bytes:
            return data.decode()
        return data[: self.max_bytes - len(ELLIPSIS.encode())].decode(errors="ignore") + ELLIPSIS


def _one_of(*choices: str) -> Check:
    return lambda value: type(value) is str and value in choices


def _name(value: object) -> bool:
    return type(value) is str and NAME.match(value) is not None


def _name_or_empty(value: object) -> bool:
    return value == "" or _name(value)


def _bytes(*lengths: int) -> Check:
    return lambda value: type(value) is bytes and len(value) in lengths


def _curvatures(value: object) -> bool:
    """Return whether the value is a tuple of curvatures; the sum is not finite if one of them is NaN or infinite."""
    return (
        type(value) is tuple
        and len(value) == PATH_POINTS
        and _NUMBERS.issuperset(map(type, value))
        and min(value) >= -1.0
        and max(value) <= 1.0
        and math.isfinite(sum(value))
    )


U64 = _integer(0, 2**64 - 1)
TIME = _integer(0, 2**63 - 1)
LAST_STOP = _integer(0, 2**62)
"""The highest number of an emergency stop in a reply: the operator's next number must still be a `TIME`."""
ROAD_WHEEL = _number(-1.0, 1.0)
UNIT = _number(0.0, 1.0)
RATE = _integer(10_000, 10**11)

CHECKS: dict[type, dict[str, Check]] = {
    Command: {
        "epoch": U64,
        "sequence": TIME,
        "sent_wall_ns": TIME,
        "stamp_ns": TIME,
        "stamp_received_wall_ns": TIME,
        "steering_rad": ROAD_WHEEL,
        "throttle": UNIT,
        "brake": UNIT,
        "path_curvature_per_m": _curvatures,
        "mode": _one_of("arm", "drive", "stop"),
        "emergency_stop": TIME,
    },
    State: {
        "sent_wall_ns": TIME,
        "state_mono_ns": TIME,
        "speed_mps": _number(-100.0, 100.0),
        "steering_rad": ROAD_WHEEL,
        "gear": _one_of("park", "reverse", "neutral", "drive"),
        "safety": _one_of("disarmed", "arming", "driving", "degraded", "safe_stop", "emergency_stop"),
        "reason": _Text(REASON_BYTES),
        "applied_sequence": _integer(-1, 2**63 - 1),
        "rejected": _Text(REASON_BYTES),
        "limited": _Text(100),
        "active_operator": _name_or_empty,
        "active_operator_instance": U64,
        "requested_by": _name_or_empty,
        "instance": U64,
    },
    SessionRequest: {
        "operation": _one_of("acquire", "request_handover", "release", "emergency_stop", "clear_emergency_stop"),
        "who": _name,
        "instance": U64,
        "number": TIME,
    },
    SessionReply: {
        "granted": lambda value: type(value) is bool,
        "reason": _Text(REASON_BYTES),
        "epoch": U64,
        "token": _bytes(0, 16),
        "video_port": _integer(0, 65535),
        "host": _Text(64),
        "emergency_stop": LAST_STOP,
    },
    NetemRequest: {
        "who": _name,
        "instance": U64,
        "condition": _Text(32),
        "lease_ms": _integer(0, 60_000),
        "delay_ms": _number(0.0, MAX_DELAY_MS),
        "jitter_ms": _number(0.0, MAX_DELAY_MS),
        "jitter_correlation": UNIT,
        "jitter_distribution": _one_of("uniform", "normal", "pareto", "paretonormal"),
        "loss": UNIT,
        "loss_burst_packets": _number(0.0, 10_000.0),
        "rate_bps": lambda value: type(value) is int and (value == 0 or RATE(value)),
        "reorder": UNIT,
        "state_delay_ms": _number(0.0, MAX_DELAY_MS),
    },
    NetemReply: {"granted": lambda value: type(value) is bool, "reason": _Text(400)},
}

_FIELD_NAMES: dict[type, tuple[str, ...]] = {kind: tuple(checks) for kind, checks in CHECKS.items()}
_FIELD_CHECKS: dict[type, tuple[Check, ...]] = {kind: tuple(checks.values()) for kind, checks in CHECKS.items()}
_TEXTS: dict[type, list[tuple[int, _Text]]] = {
    kind: [(position, check) for position, check in enumerate(checks.values(), 1) if isinstance(check, _Text)]
    for kind, checks in CHECKS.items()
}
"""The texts of a message, with their positions after the version."""
_FIELD_VALUES: dict[type, Callable[[Any], tuple[Any, ...]]] = {
    kind: attrgetter(*(field.name for field in fields(kind))) for kind in CHECKS
}

Kind = TypeVar("Kind", Command, State, SessionRequest, SessionReply, NetemRequest, NetemReply)


def encode(message: Command | State | SessionRequest | SessionReply | NetemRequest | NetemReply) -> bytes:
    """Return the bytes of `message` on the wire, with texts cut to their limits."""
    values = [VERSION, *_FIELD_VALUES[type(message)](message)]
    for position, text in _TEXTS[type(message)]:
        values[position] = text.cut(values[position])
    packed: bytes = msgpack.packb(values)
    return packed


def decode(kind: type[Kind], data: bytes) -> Kind:
    """Return the message of class `kind` in `data`; raise `BadMessage` for invalid data, and nothing else."""
    untyped: Any = kind
    message: Kind = _decode(untyped, bytes(data))
    return message


@lru_cache(maxsize=512)  # in virtual time both records and the receiver decode the same bytes
def _decode(kind: type[Any], data: bytes) -> Any:
    if len(data) > MAX_MESSAGE_BYTES:
        raise BadMessage(f"{len(data)} bytes exceed the maximum of a message ({MAX_MESSAGE_BYTES})")
    try:
        values = msgpack.unpackb(data, use_list=False, raw=False, strict_map_key=True)
    except Exception as error:  # the parser has half a dozen kinds of error, and bytes from outside may cause any
        raise BadMessage("not msgpack") from error
    checks = _FIELD_CHECKS[kind]
    if type(values) is not tuple or len(values) != 1 + len(checks):
        raise BadMessage(f"not an array of the fields of a {kind.__name__}")
    version, *field_values = values
    if type(version) is not int or version != VERSION:
        raise BadMessage("a message of another version")
    for index, check in enumerate(checks):
        if not check(field_values[index]):
            raise BadMessage(f"{kind.__name__}.{_FIELD_NAMES[kind][index]} is out of range")
    return kind(*field_values)
