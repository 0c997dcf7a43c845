"""Encode and decode the messages between the two sides: msgpack arrays that begin with a version.

A message on the wire is `[version, field, field, ..]`, the fields in the order of the class. `decode` raises
`BadMessage` for data that is too long, not msgpack, of another version or shape, not finite, or out of range. `encode`
shortens long texts, such as a list of faults, because the receiver must be able to decode every state.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from functools import lru_cache
from operator import attrgetter
from types import GenericAlias
from typing import Annotated, Any, Literal, TypeVar

import msgspec
from msgspec import UNSET, Meta

from lavt.domain import (
    MAX_REPORTED_MPS,
    MAX_ROAD_WHEEL_RAD,
    PATH_POINTS,
    Command,
    Mode,
    NetemReply,
    NetemRequest,
    Operation,
    RunOperation,
    RunPhase,
    RunRefusal,
    RunReply,
    RunRequest,
    SafetyState,
    SessionReply,
    SessionRequest,
    SpeedLimitReason,
    State,
    VehicleInfo,
)
from lavt.errors import BadMessage

VERSION = 5
MAX_MESSAGE_BYTES = 1024
RECORD_PART_BYTES = 32_768
"""The longest part of a record in a `RunReply`."""
DIGEST_BYTES = 32
"""The length of the SHA-256 of a record."""
MAX_RUN_REPLY_BYTES = RECORD_PART_BYTES + MAX_MESSAGE_BYTES
NAME = re.compile(r"^[A-Za-z0-9][A-Za-z0-9_-]{0,31}\Z")
"""A valid name of a vehicle or client: it contains nothing that has a meaning in a Zenoh key."""
ELLIPSIS = "\N{HORIZONTAL ELLIPSIS}"
MAX_DELAY_MS = 10_000.0
"""The longest delay that a client can request of a server. Clearing a delay takes as long, because the delayed packets
leave first."""
CURVATURE_BOUND_PER_M = 1.0

Version = Annotated[int, Meta(ge=VERSION, le=VERSION)]
U64 = Annotated[int, Meta(ge=0)]
"""An epoch, or the instance of a process. The type has no upper bound, because msgpack has no larger integers."""
U63 = Annotated[int, Meta(ge=0, le=2**63 - 1)]
"""Times, and numbers that grow, such as that of an emergency stop: the non-negative signed 64-bit integers."""
SpeedLimit = Annotated[float, Meta(ge=0.0, le=MAX_REPORTED_MPS)]
Speed = Annotated[float, Meta(ge=-MAX_REPORTED_MPS, le=MAX_REPORTED_MPS)]
RoadWheel = Annotated[float, Meta(ge=-MAX_ROAD_WHEEL_RAD, le=MAX_ROAD_WHEEL_RAD)]
Curvature = Annotated[float, Meta(ge=-CURVATURE_BOUND_PER_M, le=CURVATURE_BOUND_PER_M)]
ZeroToOne = Annotated[float, Meta(ge=0.0, le=1.0)]
Delay = Annotated[float, Meta(ge=0.0, le=MAX_DELAY_MS)]
Port = Annotated[int, Meta(ge=0, le=65535)]
Name = Annotated[str, Meta(pattern=NAME.pattern)]
NameOrEmpty = Annotated[str, Meta(pattern=rf"^\Z|{NAME.pattern}")]

REASON_BYTES = 300
"""The longest reason. A message with the longest texts still fits into `MAX_MESSAGE_BYTES`."""
TEXT_BYTES: dict[type, dict[str, int]] = {
    Command: {},
    State: {"reason": REASON_BYTES, "rejected": REASON_BYTES, "limited": 100},
    SessionRequest: {},
    SessionReply: {"reason": REASON_BYTES, "host": 64},
    NetemRequest: {"condition": 32},
    NetemReply: {"reason": 400},
    VehicleInfo: {"lavt_version": 32, "reason": REASON_BYTES},
    RunRequest: {"settings": 800},
    RunReply: {"reason": 400, "ending": 32},
}
"""The maximum length of each text: in bytes for the sender, in characters for the receiver."""


def _text(kind: type, field: str) -> Any:
    return Annotated[str, Meta(max_length=TEXT_BYTES[kind][field])]


BOUNDS: dict[type, dict[str, float]] = {State: {"speed_mps": MAX_REPORTED_MPS, "steering_rad": MAX_ROAD_WHEEL_RAD}}
"""The largest magnitudes of numbers that a vehicle reports. The bound is sent instead of a larger number or NaN."""

TYPES: dict[type, dict[str, Any]] = {
    Command: {
        "epoch": U64,
        "sequence": U63,
        "sent_wall_ns": U63,
        "stamp_ns": U63,
        "stamp_received_wall_ns": U63,
        "steering_rad": RoadWheel,
        "throttle": ZeroToOne,
        "brake": ZeroToOne,
        "path_curvature_per_m": Annotated[tuple[Curvature, ...], Meta(min_length=PATH_POINTS, max_length=PATH_POINTS)],
        "mode": Mode,
        "emergency_stop": U63,
    },
    State: {
        "sent_wall_ns": U63,
        "state_mono_ns": U63,
        "speed_mps": Speed,
        "steering_rad": RoadWheel,
        "gear": Literal["park", "reverse", "neutral", "drive"],
        "safety": SafetyState,
        "reason": _text(State, "reason"),
        "applied_sequence": Annotated[int, Meta(ge=-1, le=2**63 - 1)],
        "rejected": _text(State, "rejected"),
        "limited": _text(State, "limited"),
        "active_operator": NameOrEmpty,
        "active_operator_instance": U64,
        "requested_by": NameOrEmpty,
        "instance": U64,
        "speed_limit_mps": SpeedLimit | None,
        "speed_limit_reason": SpeedLimitReason | None,
    },
    SessionRequest: {"operation": Operation, "who": Name, "instance": U64, "number": U63},
    SessionReply: {
        "granted": bool,
        "reason": _text(SessionReply, "reason"),
        "epoch": U64,
        "token": bytes,
        "video_port": Port,
        "host": _text(SessionReply, "host"),
        "emergency_stop": U63,
    },
    NetemRequest: {
        "who": Name,
        "instance": U64,
        "condition": _text(NetemRequest, "condition"),
        "lease_ms": Annotated[int, Meta(ge=0, le=60_000)],
        "delay_ms": Delay,
        "jitter_ms": Delay,
        "jitter_correlation": ZeroToOne,
        "jitter_distribution": Literal["uniform", "normal", "pareto", "paretonormal"],
        "loss": ZeroToOne,
        "loss_burst_packets": Annotated[float, Meta(ge=0.0, le=10_000.0)],
        "rate_bps": Annotated[int, Meta(ge=0, le=10**11)],
        "reorder": ZeroToOne,
        "state_delay_ms": Delay,
    },
    NetemReply: {"granted": bool, "reason": _text(NetemReply, "reason")},
    VehicleInfo: {
        "lavt_version": _text(VehicleInfo, "lavt_version"),
        "safety": SafetyState,
        "reason": _text(VehicleInfo, "reason"),
        "active_operator": NameOrEmpty,
        "speed_mps": Speed,
        "state_age_ns": U63,
        "instance": U64,
    },
    RunRequest: {
        "operation": RunOperation,
        "who": Name,
        "instance": U64,
        "number": U63,
        "run": U63,
        "settings": _text(RunRequest, "settings"),
        "offset": U63,
    },
    RunReply: {
        "number": U63,
        "refusal": RunRefusal,
        "reason": _text(RunReply, "reason"),
        "phase": RunPhase,
        "ending": _text(RunReply, "ending"),
        "video_port": Port,
        "probe_port": Port,
        "size": U63,
        "digest": Annotated[bytes, Meta(max_length=DIGEST_BYTES)],
        "data": Annotated[bytes, Meta(max_length=RECORD_PART_BYTES)],
    },
}
"""The fields of each message in the order on the wire, with types and ranges. NaN is in no range.

`None` (nil on the wire) stands for a field that is unset.
"""

CHECKS: dict[type, dict[str, Callable[[Any], bool]]] = {
    SessionReply: {"token": lambda token: len(token) in {0, 16}},
    RunReply: {"digest": lambda digest: len(digest) in {0, DIGEST_BYTES}},
    NetemRequest: {"rate_bps": lambda rate_bps: rate_bps == 0 or rate_bps >= 10_000},
}
"""Checks of fields that a range cannot express."""

_ENCODER = msgspec.msgpack.Encoder()
_VERSIONS = GenericAlias(tuple, (U63, TYPES[VehicleInfo]["lavt_version"]))
_ANY_DECODER = msgspec.msgpack.Decoder(list[Any])
_DECODERS: dict[type, msgspec.msgpack.Decoder[tuple[Any, ...]]] = {
    kind: msgspec.msgpack.Decoder(GenericAlias(tuple, (Version, *fields.values()))) for kind, fields in TYPES.items()
}
_FIELD_VALUES: dict[type, Callable[[Any], tuple[Any, ...]]] = {
    kind: attrgetter(*fields) for kind, fields in TYPES.items()
}

Message = (
    Command | State | SessionRequest | SessionReply | NetemRequest | NetemReply | VehicleInfo | RunRequest | RunReply
)
Kind = TypeVar(
    "Kind",
    Command,
    State,
    SessionRequest,
    SessionReply,
    NetemRequest,
    NetemReply,
    VehicleInfo,
    RunRequest,
    RunReply,
)


def encode(message: Message) -> bytes:
    """Return the bytes of `message` on the wire, with texts and reported numbers within their limits."""
    kind = type(message)
    limited: dict[str, str | float] = {
        name: _cut(getattr(message, name), max_bytes) for name, max_bytes in TEXT_BYTES[kind].items()
    }
    limited |= {name: _bounded(getattr(message, name), bound) for name, bound in BOUNDS.get(kind, {}).items()}
    if limited:
        message = msgspec.structs.replace(message, **limited)
    values = _FIELD_VALUES[kind](message)
    return _ENCODER.encode((VERSION, *(None if value is UNSET else value for value in values)))


def _cut(text: str, max_bytes: int) -> str:
    """Return the text without lone surrogates (as in a file's name); if it is too long, cut it and add an ellipsis."""
    data = text.encode(errors="replace")
    if len(data) <= max_bytes:
        return data.decode()
    return data[: max_bytes - len(ELLIPSIS.encode())].decode(errors="ignore") + ELLIPSIS


def _bounded(number: float, bound: float) -> float:
    """Return the number within -bound and bound; NaN becomes `bound`, so that it is never taken for standstill."""
    return bound if math.isnan(number) else min(max(number, -bound), bound)


def decode(kind: type[Kind], data: bytes) -> Kind:
    """Return the message of class `kind` in `data`; raise `BadMessage` for invalid data, and nothing else."""
    untyped: Any = kind
    if kind is RunReply:  # too large for the cache
        message: Kind = _decode.__wrapped__(untyped, bytes(data))
    else:
        message = _decode(untyped, bytes(data))
    return message


def decode_versions(data: bytes) -> tuple[int, str]:
    """Return the version of the messages and that of LAVT in a `VehicleInfo` of any version; raise `BadMessage`."""
    if len(data) > MAX_MESSAGE_BYTES:
        raise BadMessage(f"{len(data)} bytes exceed the maximum of a message ({MAX_MESSAGE_BYTES})")
    try:
        version, lavt_version, *_ = _ANY_DECODER.decode(data)
        versions: tuple[int, str] = msgspec.convert((version, lavt_version), _VERSIONS)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError, ValueError) as error:
        raise BadMessage(f"VehicleInfo: {error}") from error
    return versions


@lru_cache(maxsize=512)  # in virtual time both records and the receiver decode the same bytes
def _decode(kind: type[Any], data: bytes) -> Any:
    longest = MAX_RUN_REPLY_BYTES if kind is RunReply else MAX_MESSAGE_BYTES
    if len(data) > longest:
        raise BadMessage(f"{len(data)} bytes exceed the maximum of a message ({longest})")
    try:
        _, *values = _DECODERS[kind].decode(data)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise BadMessage(_describe(kind, str(error))) from error
    message = kind(*(UNSET if value is None else value for value in values))
    for name, is_valid in CHECKS.get(kind, {}).items():
        if not is_valid(getattr(message, name)):
            raise BadMessage(f"{kind.__name__}.{name} is out of range")
    return message


def _describe(kind: type[Any], error: str) -> str:
    """Return an error of the decoder, preceded by the name of the field that is invalid."""
    position = re.search(r"`\$\[(\d+)\]", error)
    if position is None:
        return f"{kind.__name__}: {error}"
    index = int(position[1])  # 0 is the version
    return f"{kind.__name__}.{list(TYPES[kind])[index - 1]}: {error}" if index else "a message of another version"
