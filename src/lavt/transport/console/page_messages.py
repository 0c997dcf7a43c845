"""The messages between the client and the page of the console.

The page sends JSON texts, each with a `type`. The client sends statuses, lanes and predictions (JSON texts) and access
units (binary).
"""

from __future__ import annotations

import struct
from typing import Annotated, Any, Final, Literal

import msgspec
from msgspec import Meta, Struct

from lavt.errors import BadMessage

PAGE_VERSION: Final = 2
"""The version of these messages. A page of another version is told to reload."""
MAX_PAGE_MESSAGE_BYTES: Final = 1024
MAX_DELAY_MS: Final = 2000.0
"""The longest delay that the page can request for one direction."""

_Count = Annotated[int, Meta(ge=0, le=2**53 - 1)]
_ZeroToOne = Annotated[float, Meta(ge=0.0, le=1.0)]
_Delay = Annotated[float, Meta(ge=0.0, le=MAX_DELAY_MS)]


class PageHello(Struct, frozen=True, tag="hello", forbid_unknown_fields=True):
    """The first message of a page, with the token from its address."""

    version: int
    token: str


class PageInput(Struct, frozen=True, tag="input", forbid_unknown_fields=True):
    """The person's input, every 20 ms."""

    seen_us: _Count
    """`sent_us` of the newest message that the page has seen."""
    held: bool
    """The hand holds the dead-man control."""
    live: bool
    """The page is visible and has the focus."""
    steering: Annotated[float, Meta(ge=-1.0, le=1.0)]
    """Left positive."""
    throttle: _ZeroToOne
    brake: _ZeroToOne


class PageAck(Struct, frozen=True, tag="ack", forbid_unknown_fields=True):
    """The page has shown an access unit."""

    unit: Annotated[int, Meta(ge=0, le=2**32 - 1)]
    """Its RTP timestamp."""


class PageShown(Struct, frozen=True, tag="shown", forbid_unknown_fields=True):
    """The times at which the page had a picture, on the page's clock, and the clock offset that the page knows."""

    unit: Annotated[int, Meta(ge=0, le=2**32 - 1)]
    """RTP timestamp of its access unit."""
    stamp: Annotated[str, Meta(pattern=r"^[0-9]{1,19}\Z")]
    """The stamp in ns that the page has read from the picture; as text, because JavaScript's numbers have 53 bits."""
    arrived_us: _Count
    decoded_us: _Count
    drawn_us: _Count
    shown_us: _Count
    """When the browser began to make the next picture of the screen (`requestAnimationFrame`)."""
    offset_us: Annotated[float, Meta(ge=-(2.0**53), le=2.0**53)]
    """The client's wall clock minus the page's clock."""
    bound_us: Annotated[float, Meta(ge=0.0, le=1e9)]
    """The largest error of this offset: half of the round trip of the probe."""


class PageProbe(Struct, frozen=True, tag="probe", forbid_unknown_fields=True):
    """A probe of the clock offset, as in NTP."""

    sent_us: _Count
    """Send time on the page's clock, which the answer returns."""


class PageLost(Struct, frozen=True, tag="lost", forbid_unknown_fields=True):
    """The page cannot decode until the next keyframe."""


class PageStop(Struct, frozen=True, tag="stop", forbid_unknown_fields=True):
    """The person makes an emergency stop."""


class PageDrive(Struct, frozen=True, tag="drive", forbid_unknown_fields=True):
    """The person wants to drive from this page, which only watches so far."""


class PageRelease(Struct, frozen=True, tag="release", forbid_unknown_fields=True):
    """The person hands the vehicle over to the client that requests it, or only releases it."""


class PageDelay(Struct, frozen=True, tag="delay", forbid_unknown_fields=True):
    """The person chooses the injected delay of each direction."""

    video_ms: _Delay
    control_ms: _Delay


PageMessage = PageInput | PageAck | PageShown | PageProbe | PageLost | PageStop | PageDrive | PageRelease | PageDelay

_messages = msgspec.json.Decoder(PageMessage)
_hellos = msgspec.json.Decoder(PageHello)


def parse_page_message(data: str | bytes) -> PageMessage:
    """Parse a message of a page that has sent a valid hello; raise `BadMessage` for anything else."""
    parsed: PageMessage = _parse(_messages, data)
    return parsed


def is_stop(data: str | bytes) -> bool:
    """Return whether a message of a page is an emergency stop."""
    try:
        return isinstance(parse_page_message(data), PageStop)
    except BadMessage:
        return False


def parse_hello(data: str | bytes) -> PageHello:
    """Parse the first message of a page; raise `BadMessage` for anything else."""
    parsed: PageHello = _parse(_hellos, data)
    return parsed


def _parse(decoder: msgspec.json.Decoder[Any], data: str | bytes) -> Any:
    if len(data) > MAX_PAGE_MESSAGE_BYTES:
        raise BadMessage("a message of the page is too long")
    try:
        return decoder.decode(data)
    except (msgspec.MsgspecError, UnicodeError, RecursionError) as error:
        raise BadMessage(f"not a message of the page: {error}") from error


_UNIT_HEAD: Final = struct.Struct(">BBHIQ")
"""Kind (1), flags (1: keyframe), zero, RTP timestamp, `sent_us`."""


def pack_unit(data: bytes, rtp_timestamp: int, *, is_keyframe: bool, sent_us: int) -> bytes:
    """Return the binary message with an access unit."""
    return _UNIT_HEAD.pack(1, is_keyframe, 0, rtp_timestamp, sent_us) + data


class PageStatus(Struct, frozen=True, kw_only=True):
    """What the page shows besides the picture. Texts are for people; codes are for programs."""

    type: Literal["status"] = "status"
    version: int = PAGE_VERSION
    sent_us: int
    """Send time on the client's monotonic clock."""
    role: Literal["drives", "watches"]
    can_drive: bool
    """No page drives, so this one can."""
    hand: str
    """`HandState`."""
    phase: str
    """Phase of the client's session."""
    session_reason: str
    has_control: bool
    safety: str
    """Safety state of the vehicle; empty: no state yet."""
    reason: str
    active_operator: str
    requested_by: str
    rejected: str
    limited: str
    speed_mps: float | None
    target_mps: float
    """The speed above which the client gives no throttle."""
    steering_rad: float | None
    state_age_ms: float | None
    emergency_stop: Literal["none", "sent", "confirmed"]
    command: tuple[float, float, float] | None
    """Steering (rad), throttle and brake of the last command; None: no command is sent."""
    shows_latency: bool = True
    """Whether the page shows latencies and lost packets, which would tell the condition."""
    video_ms: float | None
    """From the stamp until the client had decoded the frame, by the wall clocks of both machines, not corrected for
    their offset."""
    round_trip_ms: float | None
    """From a command to the first state in which the vehicle reports it as applied."""
    bit_rate_bps: int
    """Bit rate of the access units that arrived in the last second."""
    lost_share: float | None
    """Share of the video's packets that were lost after repair in the last second; None: unknown, or none was due."""
    delay: tuple[float, float] | None
    """The injected delays of video and control in ms; None: this client cannot inject any."""
    conditions: tuple[tuple[str, float, float], ...] = ()
    """Name and delays of the conditions to choose from."""
    speed_limit_mps: float | None = None
    """The speed above which the vehicle brakes; None: it has no speed governor, or is not driven."""
    speed_limit_reason: str = ""
    """`SpeedLimitReason`; empty: none, or the page shows no latency."""
    controller: str = ""
    """The controller that drives; then the pages can command nothing. Empty: a person drives."""


class PageLane(Struct, frozen=True, kw_only=True):
    """The lane that a controller has detected in a picture; points are (column, row) in pixels, the nearest first."""

    type: Literal["lane"] = "lane"
    unit: int
    """RTP timestamp of the picture's access unit."""
    stamp: str
    """The picture's stamp in ns; as text, because JavaScript's numbers have 53 bits."""
    confidence: float
    """0 to 1."""
    left: tuple[tuple[float, float], ...]
    right: tuple[tuple[float, float], ...]


class PagePrediction(Struct, frozen=True, kw_only=True):
    """Where the car of a picture is predicted to be; points are (column, row) in pixels of this picture.

    It is sent before the picture's access unit.
    """

    type: Literal["prediction"] = "prediction"
    unit: int
    """RTP timestamp of the picture's access unit."""
    stamp: str
    """The picture's stamp in ns, computed from the RTP timestamp, so at most 12 us too early; as text, because
    JavaScript's numbers have 53 bits."""
    left: tuple[tuple[float, float], ...]
    right: tuple[tuple[float, float], ...]
    """The paths of the car's front corners since the picture, the oldest point first."""
    ghost: tuple[tuple[float, float], ...]
    """The outline of the car where a command that is sent now takes effect, without the parts that the camera cannot
    see."""
    stop: tuple[tuple[float, float], ...]
    """The stopping line: where the car's front is at standstill, if this command brakes."""


class ProbeAnswer(Struct, frozen=True):
    """The answer to a `PageProbe`; times are on the client's wall clock."""

    sent_us: int
    received_us: int
    answered_us: int
    type: Literal["probe"] = "probe"


_encoder = msgspec.json.Encoder()


def pack_text(message: PageStatus | PageLane | PagePrediction | ProbeAnswer) -> bytes:
    """Return the JSON of a message to the page."""
    return _encoder.encode(message)
