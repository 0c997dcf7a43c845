"""The words of the design as data: what travels between the parts, with units and signs.

Times are integer nanoseconds. x points forward, y left, z up; a left turn is positive. The vehicle's frame has its
origin on the ground under the middle of the rear axle. `mono_ns` is a host's monotonic clock, `wall_ns` its wall clock.
"""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from lavt.value import value

Picture = NDArray[np.uint8]
"""A picture: (height, width, 3), blue green red, 0 to 255."""

Sight = Any
"""Opaque: what a camera gives and a detector looks at; a `Picture` or, where nothing is rendered, a `SeenLane`. Only
these two and what carries it look inside."""

FloatArray = NDArray[np.float64]

NS_PER_S = 1_000_000_000
NS_PER_MS = 1_000_000
NS_PER_US = 1_000

PATH_STEP_M = 2.0
"""A command carries the curvature of the path it means to follow at 2, 4, .. 20 m ahead of the rear axle."""
PATH_POINTS = 10


@value
class Now:
    """One reading of a host's two clocks."""

    mono_ns: int
    wall_ns: int

    def later(self, duration_ns: int) -> Now:
        """Both clocks after `duration_ns` without a step."""
        return Now(self.mono_ns + duration_ns, self.wall_ns + duration_ns)


@value
class Pose:
    """Where the vehicle is: its rear axle in the world's frame, at a time of the server's monotonic clock."""

    mono_ns: int
    x_m: float
    y_m: float
    heading_rad: float


@value
class Actuation:
    """What a vehicle is asked to do: road wheel angle, and pedals in [0, 1]."""

    steering_rad: float
    throttle: float
    brake: float


@value
class VehicleState:
    """What a vehicle reports of itself, at its own time `mono_ns` on the server's monotonic clock."""

    mono_ns: int
    speed_mps: float
    steering_rad: float
    gear: Literal["park", "reverse", "neutral", "drive"]
    inhibit_reason: str = ""
    """Why the vehicle cannot be driven by command, in words; empty: it can."""
    is_engaged: bool = True
    """It obeys commands now; where that takes time, after `Vehicle.engage`."""
    is_overridden: bool = False
    """A driver in the car has taken over: nothing commanded reaches the wheels."""


@value
class GroundTruth:
    """What only a simulator knows; it is recorded on the server and never published."""

    mono_ns: int
    x_m: float
    y_m: float
    heading_rad: float
    speed_mps: float
    steering_rad: float
    cross_track_m: float
    """Distance of the rear axle from the lane's centre, left positive."""
    heading_error_rad: float
    """Heading of the body less that of the lane's centre."""
    progress_m: float
    """Distance along the lane's centre since the start of the route."""


EventKind = Literal["lane_invasion", "collision", "off_road", "completed", "timeout", "fault", "late"]

Ending = Literal["completed", "collision", "off_road", "timeout", "safe_stop"]


@value
class VehicleEvent:
    """Something that happened to a vehicle."""

    mono_ns: int
    kind: EventKind
    detail: str


@value
class CameraModel:
    """A pinhole camera on a vehicle: no distortion, principal point in the middle of the picture.

    The pose is in the vehicle's frame, turned first by `yaw_rad` (positive to the left), then by `pitch_rad` (positive
    downwards), then by `roll_rad` (positive leaning to the right: the horizon turns anticlockwise in the picture). The
    field of view is horizontal.
    """

    width_px: int = 640
    height_px: int = 480
    field_of_view_rad: float = 1.5707963267948966
    x_m: float = 1.6
    z_m: float = 1.4
    pitch_rad: float = 0.0
    y_m: float = 0.0
    yaw_rad: float = 0.0
    roll_rad: float = 0.0

    @property
    def focal_px(self) -> float:
        """Focal length in pixels."""
        return self.width_px / 2 / float(np.tan(self.field_of_view_rad / 2))


@value
class Lane:
    """The lane as seen in one picture, in the vehicle's frame.

    The centre line is y = c0 + c1 x + c2 x^2, x metres ahead of the rear axle, valid from `near_m` to `far_m`.
    """

    centre: tuple[float, float, float]
    width_m: float
    near_m: float
    far_m: float
    confidence: float
    """0 (nothing of a lane in the picture) to 1 (both lines seen over the whole length)."""


@value
class SeenLane:
    """What takes the place of a picture where nothing is rendered: the lane that would be seen in it."""

    stamp_ns: int
    """0 until it is stamped."""
    at_ns: int
    """When it was taken (server's monotonic clock)."""
    lane: Lane


@value
class Decision:
    """What a controller wants: pedals, road wheel angle, and the path it means to follow.

    `path_curvature_per_m` has `PATH_POINTS` values, `PATH_STEP_M` apart, left positive.
    """

    steering_rad: float
    throttle: float
    brake: float
    path_curvature_per_m: tuple[float, ...]


Mode = Literal["arm", "drive", "stop"]
Operation = Literal["hold", "ask", "release", "emergency_stop", "clear_emergency_stop"]
"""ask: the holder is asked to release the vehicle to who asks."""
SafetyState = Literal["disarmed", "arming", "driving", "degraded", "safe_stop", "emergency_stop"]


@value
class Command:
    """What the client wants the vehicle to do, at least 50 times a second."""

    epoch: int
    sequence: int
    sent_wall_ns: int
    """Send time on the client's wall clock; it serves the measurement of latency only."""
    stamp_ns: int
    """Stamp of the newest picture this command was made from; 0: none."""
    stamp_received_wall_ns: int
    """When the client had read that stamp, on its wall clock."""
    steering_rad: float
    throttle: float
    brake: float
    path_curvature_per_m: tuple[float, ...]
    mode: Mode
    emergency_stop: int
    """0, or the number of an emergency stop; the numbers only grow."""


@value
class State:
    """What the vehicle tells, 50 times a second."""

    sent_wall_ns: int
    state_mono_ns: int
    """The state's own time, on the server's monotonic clock."""
    speed_mps: float
    steering_rad: float
    gear: str
    safety: SafetyState
    reason: str
    """Why the safety state is what it is, in words."""
    applied_sequence: int
    """Sequence of the command last obeyed; -1: none in this epoch."""
    rejected: str
    """Why a command was refused, of those in the last second the last; empty: none was."""
    limited: str = ""
    """Which limits changed the command last obeyed; empty: none did."""
    active_operator: str = ""
    """Who holds the vehicle; empty: nobody."""
    active_operator_instance: int = 0
    """As in that one's `SessionRequest`s: two clients of one name are told apart."""
    requested_by: str = ""
    """Who asks the holder for the vehicle; empty: nobody."""
    instance: int = 0
    """Random number of the server's process."""


@value
class SessionRequest:
    """A client's query to the server."""

    operation: Operation
    who: str
    instance: int
    """Random number of the client's process: the same client asking again is told from a new one of the same name."""
    number: int
    """Number of an emergency stop, else 0."""


@value
class NetemRequest:
    """A client's query to the server: what shall happen to what the vehicle's machine sends, and for how long."""

    who: str
    instance: int
    """As in a `SessionRequest`."""
    condition: str
    """Its name, for the records."""
    lease_ms: int
    """Without another request everything is put back after so long."""
    delay_ms: float
    jitter_ms: float
    jitter_correlation: float
    jitter_distribution: str
    loss: float
    loss_burst_packets: float
    rate_bps: int
    reorder: float
    state_delay_ms: float
    """Of the state and the replies; all before it is the video's."""


@value
class NetemReply:
    """The server's answer to a `NetemRequest`: whether the condition is in force."""

    granted: bool
    reason: str


@value
class SessionReply:
    """The server's answer to a `SessionRequest`."""

    granted: bool
    reason: str
    epoch: int
    token: bytes
    """Opens the path of the video (16 bytes); empty when refused."""
    video_port: int
    host: str
    """Identity of the server's kernel: hosts that share one share a clock."""
    emergency_stop: int
    """Highest number of an emergency stop that the server has seen."""
