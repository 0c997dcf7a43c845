"""The payloads of messages between the nodes of one side, and of entries in records."""

from __future__ import annotations

from msgspec import Struct

from lavt.domain import Lane, ReceivedPicture


class FrameWritten(Struct, frozen=True):
    """A frame was stamped and encoded on the server."""

    number: int
    stamp_ns: int
    stamped_mono_ns: int
    capture_ns: int | None
    pixel_crc: int
    """Checksum of the picture without its stamp, by which a frozen camera is detected."""
    size_bytes: int


class VideoUnit(Struct, frozen=True):
    """One H.264 access unit, sent or received."""

    stamp_ns: int
    data: bytes


class ReceivedUnit(Struct, frozen=True):
    """A received access unit; times are on the client's monotonic clock."""

    data: bytes
    rtp_timestamp: int
    complete: bool
    keyframe: bool
    packet_mono_ns: int
    """Arrival of the message that released its last packet from the jitter buffer."""


class DecodedFrame(Struct, frozen=True):
    """A decoded picture with a valid stamp."""

    stamp_ns: int
    read_wall_ns: int
    received: ReceivedPicture


class FrameStamp(Struct, frozen=True):
    """A decoded frame's stamp and when it was read, without the picture."""

    stamp_ns: int
    read_wall_ns: int


class PictureRead(Struct, frozen=True):
    """The outcome of decoding an access unit and reading its stamp."""

    stamp_ns: int | None
    """None: the stamp could not be read."""
    readable: bool
    reason: str
    in_doubt: bool
    """Since the last intact keyframe, parts of this picture or of an earlier one were lost."""
    decoded: bool
    """The decoder returned a picture."""
    rtp_timestamp: int
    packet_mono_ns: int
    decoded_mono_ns: int
    read_mono_ns: int
    read_wall_ns: int


class LaneSeen(Struct, frozen=True):
    """The lane detected in a picture."""

    stamp_ns: int
    lane: Lane


class Admission(Struct, frozen=True):
    """The server's verdict on a command, with the command's times."""

    epoch: int
    sequence: int
    stamp_ns: int
    sent_wall_ns: int
    stamp_received_wall_ns: int
    received_mono_ns: int
    received_wall_ns: int
    applied_mono_ns: int | None
    verdict: str
    reason: str
    limited: str
    """Names of the limits that changed the command, separated by commas."""
    mode: str
    steering_rad: float
    throttle: float
    brake: float


class SpeedLimitSample(Struct, frozen=True):
    """The limit of the speed while the vehicle has a speed governor and is driven."""

    mono_ns: int
    limit_mps: float
    reason: str
    """`SpeedLimitReason`."""
    age_ms: float | None
    """The picture age that the speed governor's limit is for; None: unknown."""


class AtWheel(Struct, frozen=True):
    """A command that reached the wheels; times are on the server's monotonic clock."""

    sequence: int
    stamp_ns: int
    applied_mono_ns: int
    """As in the command's `Admission`."""
    wheel_mono_ns: int
    """Arrival of the vehicle's report that it steers by this command."""


class Event(Struct, frozen=True):
    """An event in the server's record."""

    mono_ns: int
    kind: str
    detail: str


class Route(Struct, frozen=True):
    """The centre line of the driven lane, once at the start of a record."""

    name: str
    length_m: float
    points: tuple[tuple[float, float], ...]
    """(x, y) in metres."""


class PathToken(Struct, frozen=True):
    """The token with which the client validates its video path."""

    token: bytes
    port: int


class StationaryStatus(Struct, frozen=True):
    """Whether the vehicle is at rest, and who has control."""

    at_rest: bool
    """The vehicle is stationary, is not driven and is not about to be driven."""
    active_operator: tuple[str, int] | None
    """Name and instance."""


class InjectionSample(Struct, frozen=True):
    """The requested and the measured delay of a flow that this machine sends, at each change and periodically."""

    mono_ns: int
    condition: str
    """Empty: no condition is in force any more."""
    flow: str
    requested_ms: float
    measured_ms: float | None
    reason: str
    """Why the condition is not in force, or which measurement deviates from the request; empty: neither."""


class AgentAction(Struct, frozen=True):
    """The action that an agent has chosen from its observation of a picture."""

    stamp_ns: int
    """Stamp of the picture."""
    steering_rad: float
    """Wanted angle of the road wheels."""
    speed_mps: float
    """Wanted speed."""


class HumanSample(Struct, frozen=True):
    """An input of the person who drives, or a change of the state of the hand without an input."""

    mono_ns: int
    hand: str
    """The state of the hand after this input (`control/human_controls.py`)."""
    steering: float
    """-1 to 1, left positive."""
    throttle: float
    brake: float


class PagePicture(Struct, frozen=True):
    """The times at which the page had a picture, on the client's wall clock, from the page's clock and its offset."""

    stamp_ns: int
    arrived_wall_ns: int
    """The page's script got the access unit."""
    decoded_wall_ns: int
    drawn_wall_ns: int
    shown_wall_ns: int
    """The browser began to make the next picture of the screen, which shows the frame."""
    bound_ns: int
    """The largest error of these times: half of the round trip of the probe between page and client."""


class RelayDelay(Struct, frozen=True):
    """The delays that the person has chosen for a relay in the client's process."""

    video_ms: float
    control_ms: float


class DelayChoice(Struct, frozen=True):
    """The delays that a person can choose: named conditions, or any others; and those at the start."""

    conditions: tuple[tuple[str, float, float], ...]
    """Name, delay of the video and delay of the control, in ms."""
    initial: RelayDelay
