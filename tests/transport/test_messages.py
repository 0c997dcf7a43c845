from __future__ import annotations

import tracemalloc
from typing import Any, get_args

import msgpack
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec import UNSET
from msgspec.structs import replace

from lavt.domain import (
    PATH_POINTS,
    Command,
    NetemReply,
    NetemRequest,
    RunReply,
    RunRequest,
    SessionReply,
    SessionRequest,
    SpeedLimitReason,
    State,
    VehicleInfo,
)
from lavt.errors import BadMessage
from lavt.streams import stream
from lavt.transport.messages import (
    ELLIPSIS,
    MAX_MESSAGE_BYTES,
    REASON_BYTES,
    TEXT_BYTES,
    TYPES,
    VERSION,
    decode,
    decode_versions,
    encode,
)

AnyMessage = (
    Command | State | SessionRequest | SessionReply | NetemRequest | NetemReply | VehicleInfo | RunRequest | RunReply
)

COMMAND = Command(
    epoch=7,
    sequence=8,
    sent_wall_ns=9,
    stamp_ns=10,
    stamp_received_wall_ns=11,
    steering_rad=0.1,
    throttle=0.2,
    brake=0.0,
    path_curvature_per_m=(0.01,) * PATH_POINTS,
    mode="drive",
    emergency_stop=0,
)
STATE = State(
    sent_wall_ns=1,
    state_mono_ns=2,
    speed_mps=8.3,
    steering_rad=-0.1,
    gear="drive",
    safety="driving",
    reason="armed",
    applied_sequence=-1,
    rejected="",
)
REQUEST = SessionRequest(operation="acquire", who="operator-1", instance=2**64 - 1, number=0)
REPLY = SessionReply(granted=True, reason="", epoch=3, token=bytes(16), video_port=5600, host="a-b-c", emergency_stop=0)
NETEM = NetemRequest(
    who="operator-1",
    instance=5,
    condition="L4",
    lease_ms=5000,
    delay_ms=150.0,
    jitter_ms=1.5,
    jitter_correlation=0.25,
    jitter_distribution="normal",
    loss=0.01,
    loss_burst_packets=3.0,
    rate_bps=10**6,
    reorder=0.0,
    state_delay_ms=150.0,
)
NETEM_REPLY = NetemReply(granted=False, reason="no")
RUN = RunRequest("begin", "operator-1", instance=5, number=1, run=2**63 - 1, settings="{}", offset=0)
RUN_REPLY = RunReply(1, "", "", "finished", "completed", 5600, 5602, size=3, digest=bytes(32), data=b"abc")
INFO = VehicleInfo(
    lavt_version="0.1.0",
    safety="driving",
    reason="armed by alice",
    active_operator="alice",
    speed_mps=3.5,
    state_age_ns=2_000_000,
    instance=9,
)
MESSAGES: dict[type, AnyMessage] = {
    type(message): message for message in (COMMAND, STATE, REQUEST, REPLY, NETEM, NETEM_REPLY, INFO, RUN, RUN_REPLY)
}

U64 = st.integers(0, 2**64 - 1)
U63 = st.integers(0, 2**63 - 1)
ANGLE = st.floats(-1, 1)
PEDAL = st.floats(0, 1)


def text(max_bytes: int) -> st.SearchStrategy[str]:
    return st.text(st.characters(exclude_categories=["Cs"])).filter(lambda value: len(value.encode()) <= max_bytes)


NAMES = st.from_regex(r"[A-Za-z0-9][A-Za-z0-9_-]{0,31}", fullmatch=True)
COMMANDS = st.builds(
    Command,
    epoch=U64,
    sequence=U63,
    sent_wall_ns=U63,
    stamp_ns=U63,
    stamp_received_wall_ns=U63,
    steering_rad=ANGLE,
    throttle=PEDAL,
    brake=PEDAL,
    path_curvature_per_m=st.tuples(*[st.floats(-1, 1)] * PATH_POINTS),
    mode=st.sampled_from(["arm", "drive", "stop"]),
    emergency_stop=U63,
)
STATES = st.builds(
    State,
    sent_wall_ns=U63,
    state_mono_ns=U63,
    speed_mps=st.floats(-100, 100),
    steering_rad=ANGLE,
    gear=st.sampled_from(["park", "reverse", "neutral", "drive"]),
    safety=st.sampled_from(["disarmed", "arming", "driving", "degraded", "safe_stop", "emergency_stop"]),
    reason=text(REASON_BYTES),
    applied_sequence=st.integers(-1, 2**63 - 1),
    rejected=text(REASON_BYTES),
    limited=text(100),
    active_operator=st.one_of(st.just(""), NAMES),
    active_operator_instance=U64,
    requested_by=st.one_of(st.just(""), NAMES),
    instance=U64,
    speed_limit_mps=st.one_of(st.just(UNSET), st.floats(0, 100)),
    speed_limit_reason=st.one_of(st.just(UNSET), st.sampled_from(get_args(SpeedLimitReason))),
)
REQUESTS = st.builds(
    SessionRequest,
    operation=st.sampled_from(["acquire", "request_handover", "release", "emergency_stop", "clear_emergency_stop"]),
    who=NAMES,
    instance=U64,
    number=U63,
)
REPLIES = st.builds(
    SessionReply,
    granted=st.booleans(),
    reason=text(REASON_BYTES),
    epoch=U64,
    token=st.one_of(st.just(b""), st.binary(min_size=16, max_size=16)),
    video_port=st.integers(0, 65535),
    host=text(64),
    emergency_stop=st.integers(0, 2**62),
)


@given(st.one_of(COMMANDS, STATES, REQUESTS, REPLIES))
def test_round_trip(message: AnyMessage) -> None:
    """Decoding an encoded message whose fields are in range returns the same message."""
    kind: Any = type(message)
    assert decode(kind, encode(message)) == message


@pytest.mark.parametrize("letter", ["a", "é", "€", "🚗"])
def test_longest_texts_fit(letter: str) -> None:
    """A message with texts of the maximum length, of letters of any size in UTF-8, can be decoded."""
    longest = letter * (REASON_BYTES // len(letter.encode()))
    message = replace(
        STATE,
        reason=longest,
        rejected=longest,
        limited="x" * 100,
        active_operator="x" * 32,
        requested_by="x" * 32,
        sent_wall_ns=2**63 - 1,
        state_mono_ns=2**63 - 1,
        applied_sequence=2**63 - 1,
        active_operator_instance=2**64 - 1,
        instance=2**64 - 1,
        speed_limit_mps=100.0,
        speed_limit_reason=max(get_args(SpeedLimitReason), key=len),
    )
    assert decode(State, encode(message)) == message
    with pytest.raises(BadMessage):
        decode(State, pack_unchecked(replace(message, reason=letter * (REASON_BYTES + 1))))


ANY_TEXT = st.one_of(st.text(st.characters(categories=["L", "Cs", "So"]), max_size=2000), st.text())
TEXTS: list[tuple[type[Any], str]] = [(State, "reason"), (State, "rejected"), (State, "limited")]
TEXTS += [(SessionReply, "reason"), (SessionReply, "host"), (NetemRequest, "condition"), (NetemReply, "reason")]
TEXTS += [(RunReply, "reason"), (RunReply, "ending")]
TEXTS += [(VehicleInfo, "lavt_version"), (VehicleInfo, "reason")]


@given(st.sampled_from(TEXTS), ANY_TEXT)
def test_any_text_is_readable(field: tuple[type[Any], str], text: str) -> None:
    """A message with any text can be decoded: a text that is too long is cut between letters, and ends in an ellipsis.

    A lone surrogate, as in a file's name that is not UTF-8, becomes a question mark.
    """
    kind, name = field
    message: Any = MESSAGES[kind]
    decoded = getattr(decode(kind, encode(replace(message, **{name: text}))), name)
    complete = text.encode(errors="replace").decode()
    assert decoded == complete or complete.startswith(decoded.removesuffix(ELLIPSIS))
    assert decoded == complete or len(complete.encode()) > TEXT_BYTES[kind][name]


def test_version_comes_first() -> None:
    """A message is a msgpack array of the version and the fields, in the order of the class."""
    values = msgpack.unpackb(encode(REQUEST))
    assert values == [VERSION, *(getattr(REQUEST, name) for name in REQUEST.__struct_fields__)]


@pytest.mark.parametrize("kind", MESSAGES)
def test_random_bytes(kind: type[Any]) -> None:
    """Each of 10000 random byte strings raises BadMessage and nothing else."""
    generator = stream(1, f"random bytes {kind.__name__}")
    for _ in range(10_000):
        with pytest.raises(BadMessage):
            decode(kind, generator.bytes(int(generator.integers(0, 200))))


@pytest.mark.parametrize("kind", MESSAGES)
def test_damaged_messages(kind: type[Any]) -> None:
    """A message with a changed byte is decoded or raises BadMessage; a truncated message always raises BadMessage."""
    whole = encode(MESSAGES[kind])
    generator = stream(2, f"damaged {kind.__name__}")
    rejected = 0
    for _ in range(2_000):
        damaged = bytearray(whole)
        damaged[int(generator.integers(len(whole)))] = int(generator.integers(256))
        try:
            assert isinstance(decode(kind, bytes(damaged)), kind)
        except BadMessage:
            rejected += 1
    assert rejected > 500
    for length in range(len(whole)):
        with pytest.raises(BadMessage):
            decode(kind, whole[:length])


NAN, INF = float("nan"), float("inf")
NOT_AN_INTEGER: list[Any] = [True, False, 1.0, NAN, "1", b"1", None, [], {}, -(2**63)]
NOT_A_NUMBER: list[Any] = [NAN, INF, -INF, True, "0", b"0", None, [], {}, 2**64 - 1]
NOT_A_TEXT: list[Any] = [1, 1.0, True, None, b"drive", [], {}]
NOT_A_U63 = [*NOT_AN_INTEGER, -1, 2**63, 2**64 - 1]
NOT_A_NAME = [*NOT_A_TEXT, "", "a/b", "**", "*", "a b", "-a", "_a", "a\n", "é", "a" * 33, "$a", "a#"]
NOT_A_NAME_OR_EMPTY = [value for value in NOT_A_NAME if value != ""]
NOT_A_NUMBER_OR_NIL = [value for value in NOT_A_NUMBER if value is not None]
NOT_A_TEXT_OR_NIL = [value for value in NOT_A_TEXT if value is not None]
POINTS = [0.0] * PATH_POINTS
OUT_OF_RANGE: dict[type, dict[str, list[Any]]] = {
    Command: {
        "epoch": [*NOT_AN_INTEGER, -1],
        "sequence": NOT_A_U63,
        "sent_wall_ns": NOT_A_U63,
        "stamp_ns": NOT_A_U63,
        "stamp_received_wall_ns": NOT_A_U63,
        "emergency_stop": NOT_A_U63,
        "steering_rad": [*NOT_A_NUMBER, 1.0001, -1.0001],
        "throttle": [*NOT_A_NUMBER, 1.0001, -0.0001],
        "brake": [*NOT_A_NUMBER, 1.0001, -0.0001],
        "path_curvature_per_m": [
            None,
            0.0,
            "0000000000",
            bytes(10),
            {},
            POINTS[1:],
            [*POINTS, 0.0],
            [],
            *([*POINTS[1:], bad] for bad in (*NOT_A_NUMBER, 1.0001, -1.0001)),
        ],
        "mode": [*NOT_A_TEXT, "", "fly", "Drive", "drive "],
    },
    State: {
        "sent_wall_ns": NOT_A_U63,
        "state_mono_ns": NOT_A_U63,
        "speed_mps": [*NOT_A_NUMBER, 100.1, -100.1],
        "steering_rad": [*NOT_A_NUMBER, 1.0001, -1.0001],
        "gear": [*NOT_A_TEXT, "", "sideways"],
        "safety": [*NOT_A_TEXT, "", "safe"],
        "reason": [*NOT_A_TEXT, "x" * 301],
        "applied_sequence": [*NOT_AN_INTEGER, -2, 2**63],
        "rejected": [*NOT_A_TEXT, "x" * 301],
        "limited": [*NOT_A_TEXT, "x" * 101],
        "active_operator": NOT_A_NAME_OR_EMPTY,
        "active_operator_instance": [*NOT_AN_INTEGER, -1],
        "requested_by": NOT_A_NAME_OR_EMPTY,
        "instance": [*NOT_AN_INTEGER, -1],
        "speed_limit_mps": [*NOT_A_NUMBER_OR_NIL, 100.1, -0.1],
        "speed_limit_reason": [*NOT_A_TEXT_OR_NIL, "", "speeding"],
    },
    SessionRequest: {
        "operation": [*NOT_A_TEXT, "", "steal"],
        "who": NOT_A_NAME,
        "instance": [*NOT_AN_INTEGER, -1],
        "number": NOT_A_U63,
    },
    SessionReply: {
        "granted": [0, 1, 1.0, "true", None, []],
        "reason": [*NOT_A_TEXT, "x" * 301],
        "epoch": [*NOT_AN_INTEGER, -1],
        "token": ["", "x" * 16, None, 0, bytes(15), bytes(17), [0] * 16],
        "video_port": [*NOT_AN_INTEGER, -1, 65536],
        "host": [*NOT_A_TEXT, "x" * 65],
        "emergency_stop": NOT_A_U63,
    },
    NetemRequest: {
        "who": NOT_A_NAME,
        "instance": [*NOT_AN_INTEGER, -1],
        "condition": [*NOT_A_TEXT, "x" * 33],
        "lease_ms": [*NOT_AN_INTEGER, -1, 60_001],
        "delay_ms": [*NOT_A_NUMBER, -0.1, 10_000.1],
        "jitter_ms": [*NOT_A_NUMBER, -0.1, 10_000.1],
        "jitter_correlation": [*NOT_A_NUMBER, -0.1, 1.1],
        "jitter_distribution": [*NOT_A_TEXT, "", "gauss"],
        "loss": [*NOT_A_NUMBER, -0.1, 1.1],
        "loss_burst_packets": [*NOT_A_NUMBER, -0.1, 10_000.1],
        "rate_bps": [*NOT_AN_INTEGER, -1, 9_999, 10**11 + 1],
        "reorder": [*NOT_A_NUMBER, -0.1, 1.1],
        "state_delay_ms": [*NOT_A_NUMBER, -0.1, 10_000.1],
    },
    NetemReply: {"granted": [0, 1, 1.0, "true", None, []], "reason": [*NOT_A_TEXT, "x" * 401]},
    VehicleInfo: {
        "lavt_version": [*NOT_A_TEXT, "x" * 33],
        "safety": [*NOT_A_TEXT, "", "safe"],
        "reason": [*NOT_A_TEXT, "x" * 301],
        "active_operator": NOT_A_NAME_OR_EMPTY,
        "speed_mps": [*NOT_A_NUMBER, 100.1, -100.1],
        "state_age_ns": NOT_A_U63,
        "instance": [*NOT_AN_INTEGER, -1],
    },
    RunRequest: {
        "operation": [*NOT_A_TEXT, "", "delete"],
        "who": NOT_A_NAME,
        "instance": [*NOT_AN_INTEGER, -1],
        "number": NOT_A_U63,
        "run": NOT_A_U63,
        "settings": [*NOT_A_TEXT, "x" * 801],
        "offset": NOT_A_U63,
    },
    RunReply: {
        "number": NOT_A_U63,
        "refusal": [*NOT_A_TEXT, "no"],
        "reason": [*NOT_A_TEXT, "x" * 401],
        "phase": [*NOT_A_TEXT, "", "begun"],
        "ending": [*NOT_A_TEXT, "x" * 33],
        "video_port": [*NOT_AN_INTEGER, -1, 65536],
        "probe_port": [*NOT_AN_INTEGER, -1, 65536],
        "size": NOT_A_U63,
        "digest": ["", "x" * 32, None, 0, bytes(31), bytes(33), [0] * 32],
        "data": ["", None, 0, bytes(32_769), [0]],
    },
}


def pack_unchecked(message: AnyMessage, **changed: Any) -> bytes:
    """Pack a message with changed values, which may be invalid."""
    values = [changed.get(name, getattr(message, name)) for name in message.__struct_fields__]
    values = [None if value is UNSET else value for value in values]
    packed: bytes = msgpack.packb([VERSION, *values])
    return packed


@pytest.mark.parametrize(("kind", "name"), [(kind, name) for kind, names in TYPES.items() for name in names])
def test_every_field_is_checked(kind: type[Any], name: str) -> None:
    """A message is rejected if a field has a wrong type, is not finite or is out of range; booleans are not numbers."""
    for bad in OUT_OF_RANGE[kind][name]:
        with pytest.raises(BadMessage, match=f"{kind.__name__}.{name}"):
            decode(kind, pack_unchecked(MESSAGES[kind], **{name: bad}))


@pytest.mark.parametrize("kind", MESSAGES)
@pytest.mark.parametrize("version", [0, 4, 6, -1, True, 5.0, "5", None, [5]])
def test_other_versions(kind: type[Any], version: Any) -> None:
    """A message whose version is not exactly the expected integer is rejected."""
    _, *values = msgpack.unpackb(encode(MESSAGES[kind]))
    with pytest.raises(BadMessage, match="version"):
        decode(kind, msgpack.packb([version, *values]))


@pytest.mark.parametrize("kind", MESSAGES)
def test_other_shapes(kind: type[Any]) -> None:
    """A message is rejected if it has too many or too few fields, is of another class or is not an array."""
    values = msgpack.unpackb(encode(MESSAGES[kind]))
    shapes = [[*values, 0], values[:-1], [], {1: values}, values[0], None, "x", [values]]
    shapes += [msgpack.unpackb(encode(other)) for other_kind, other in MESSAGES.items() if other_kind is not kind]
    for shape in shapes:
        with pytest.raises(BadMessage):
            decode(kind, msgpack.packb(shape))
    with pytest.raises(BadMessage):
        decode(kind, encode(MESSAGES[kind]) * 2)


def test_too_long() -> None:
    """A message that exceeds the maximum size is rejected."""
    with pytest.raises(BadMessage, match=str(MAX_MESSAGE_BYTES + 1)):
        decode(Command, encode(COMMAND).ljust(MAX_MESSAGE_BYTES + 1, b"\0"))


BOMBS = {
    "an array of four billion": b"\xdd\xff\xff\xff\xff",
    "a map of four billion": b"\xdf\xff\xff\xff\xff",
    "a text of four gigabytes": b"\xdb\xff\xff\xff\xff",
    "bytes of four gigabytes": b"\xc6\xff\xff\xff\xff",
    "an extension of four gigabytes": b"\xc9\xff\xff\xff\xff\x01",
    "arrays in arrays": b"\x91" * MAX_MESSAGE_BYTES,
    "maps in maps": b"\x81\x01" * (MAX_MESSAGE_BYTES // 2),
    "large arrays in large arrays": b"\xdc\xff\xff" * (MAX_MESSAGE_BYTES // 3),
}


@pytest.mark.parametrize("bomb", BOMBS)
def test_bombs(bomb: str) -> None:
    """A message that claims to contain huge or deeply nested data is rejected and costs less than a megabyte."""
    data = BOMBS[bomb].ljust(MAX_MESSAGE_BYTES, b"\x90")
    tracemalloc.start()
    try:
        with pytest.raises(BadMessage):
            decode(Command, data)
        _, peak_bytes = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak_bytes < 1_000_000


def test_versions_of_information_from_another_version() -> None:
    """The versions in the information about a vehicle can be read, whatever the version of the rest."""
    assert decode_versions(encode(INFO)) == (VERSION, "0.1.0")
    assert decode_versions(msgpack.packb([9, "2.0", {"new": [1.5, None]}, b"x"])) == (9, "2.0")


@pytest.mark.parametrize(
    "data", [b"", b"\xc1", msgpack.packb(5), msgpack.packb([]), msgpack.packb([9]), msgpack.packb({9: "2.0"})]
)
def test_no_versions(data: bytes) -> None:
    """Data without versions raises BadMessage."""
    with pytest.raises(BadMessage):
        decode_versions(data)


@pytest.mark.parametrize("values", [["9", "2.0"], [-1, "2.0"], [True, "2.0"], [9, 2], [9, "x" * 33], [2**63, "2.0"]])
def test_wrong_versions(values: list[Any]) -> None:
    """Versions of a wrong type or out of range raise BadMessage."""
    with pytest.raises(BadMessage):
        decode_versions(msgpack.packb(values))


def test_versions_in_random_bytes() -> None:
    """Random bytes, a nested array and too many bytes raise BadMessage and nothing else, or contain versions."""
    generator = stream(1, "random bytes with versions")
    for data in (b"\x91" * 1000, msgpack.packb([9, "2.0", bytes(MAX_MESSAGE_BYTES)])):
        with pytest.raises(BadMessage):
            decode_versions(data)
    for _ in range(10_000):
        try:
            version, _ = decode_versions(generator.bytes(int(generator.integers(0, 200))))
        except BadMessage:
            continue
        assert version >= 0
