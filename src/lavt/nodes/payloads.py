"""What nodes tell each other on one side, and what they write down."""

from __future__ import annotations

from lavt.domain import Lane
from lavt.transport.video.frame_codec import ReceivedPicture
from lavt.value import value


@value
class FrameWritten:
    """A frame was stamped and encoded on the server."""

    number: int
    stamp_ns: int
    stamped_mono_ns: int
    capture_ns: int | None
    pixel_crc: int
    """Tells the picture, without its stamp, from the one before."""
    size_bytes: int


@value
class VideoUnit:
    """One H.264 access unit as it was sent or received."""

    stamp_ns: int
    data: bytes


@value
class ReceivedUnit:
    """An access unit out of the network; the times are the client's monotonic clock."""

    data: bytes
    rtp_timestamp: int
    complete: bool
    keyframe: bool
    packet_mono_ns: int
    """Arrival of its last packet."""


@value
class DecodedFrame:
    """A decoded picture with a stamp that could be read."""

    stamp_ns: int
    read_wall_ns: int
    received: ReceivedPicture


@value
class PictureRead:
    """What became of a received access unit."""

    stamp_ns: int | None
    """None where it could not be read."""
    readable: bool
    reason: str
    in_doubt: bool
    """Something of it, or of a picture it refers to, was lost since the last clean keyframe."""
    decoded: bool
    """The decoder gave a picture for it."""
    rtp_timestamp: int
    packet_mono_ns: int
    decoded_mono_ns: int
    read_mono_ns: int
    read_wall_ns: int


@value
class LaneSeen:
    """What perception made of a picture."""

    stamp_ns: int
    lane: Lane


@value
class Admission:
    """What became of a command on the server."""

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
    """Names of the limits that changed it, with commas."""
    mode: str
    steering_rad: float
    throttle: float
    brake: float


@value
class AtWheel:
    """A command was seen to have reached the wheels; the times are the server's monotonic clock."""

    sequence: int
    stamp_ns: int
    applied_mono_ns: int
    """As in its `Admission`."""
    wheel_mono_ns: int
    """When the vehicle's own report came, that it steers by it."""


@value
class Event:
    """Something worth a line in the record of the server."""

    mono_ns: int
    kind: str
    detail: str


@value
class Route:
    """The road that is driven: the middle of its lane, once at the start of a record."""

    name: str
    length_m: float
    points: tuple[tuple[float, float], ...]


@value
class PathToken:
    """The client may open the path of the video with this."""

    token: bytes
    port: int


@value
class StationaryStatus:
    """Whether the vehicle stands and nobody drives it, and who holds it."""

    at_rest: bool
    active_operator: tuple[str, int] | None


@value
class InjectionSample:
    """What this machine does to a flow that it sends, as asked and as measured; written at each change, and again."""

    mono_ns: int
    condition: str
    """Empty: none is in force any more."""
    flow: str
    requested_ms: float
    measured_ms: float | None
    reason: str
    """Why it is not in force, or what was measured to be otherwise than asked; empty: all is well."""
