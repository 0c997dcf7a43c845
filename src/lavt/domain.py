"""The data types of the domain, with units and signs.

Times are integer nanoseconds. x points forward, y left, z up; a left turn is positive. The vehicle's frame has its
origin on the ground under the middle of the rear axle. `mono_ns` is a host's monotonic clock, `wall_ns` its wall clock.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal, Protocol

from msgspec import UNSET, Struct, UnsetType

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    Picture = NDArray[np.uint8]
    """An image: (height, width, 3), blue green red, 0 to 255."""

    FloatArray = NDArray[np.float64]
else:  # commands without pictures need no numpy, which is large
    Picture = FloatArray = Any

FramePayload = Any
"""The content of a frame on its way from camera to detector: a `Picture` or, if nothing is rendered, a `SeenLane`. Only
camera, frame codec and detector use this content."""

NS_PER_S = 1_000_000_000
NS_PER_MS = 1_000_000
NS_PER_US = 1_000

MAX_REPORTED_MPS = 100.0
MAX_ROAD_WHEEL_RAD = 1.0
"""No vehicle is as fast, or turns its wheels as far. A vehicle that reports more has a fault."""

PATH_STEP_M = 2.0
PATH_POINTS = 10
"""A command contains the curvature of its planned path at 2, 4, ..., 20 m ahead of the rear axle."""


class Now(Struct, frozen=True):
    """A reading of a host's two clocks."""

    mono_ns: int
    wall_ns: int

    def later(self, duration_ns: int) -> Now:
        """Return the reading at `duration_ns` after this one, if the wall clock is not stepped in between."""
        return Now(self.mono_ns + duration_ns, self.wall_ns + duration_ns)


class Pose(Struct, frozen=True):
    """The pose of the vehicle's rear axle in the world frame, at a time of the server's monotonic clock."""

    mono_ns: int
    x_m: float
    y_m: float
    heading_rad: float


class Actuation(Struct, frozen=True):
    """An actuation of the vehicle: road wheel angle, and pedals in [0, 1]."""

    steering_rad: float
    throttle: float
    brake: float


class VehicleState(Struct, frozen=True):
    """The state that a vehicle reported for the time `mono_ns` of the server's monotonic clock."""

    mono_ns: int
    speed_mps: float
    steering_rad: float
    gear: Literal["park", "reverse", "neutral", "drive"]
    inhibit_reason: str = ""
    """Why the vehicle does not accept commands; empty: it accepts them."""
    is_engaged: bool = True
    """Whether the vehicle executes commands; engaging may take time after `Vehicle.engage`."""
    is_overridden: bool = False
    """Whether the driver in the car has taken over, so that no command reaches the wheels."""
    is_speed_plausible: bool = True
    """False is a vehicle fault: `speed_mps` can be wrong, so the car can be moving even if `speed_mps` is 0."""


class GroundTruth(Struct, frozen=True):
    """The true state of a simulated vehicle; it is recorded on the server and never published."""

    mono_ns: int
    x_m: float
    y_m: float
    heading_rad: float
    speed_mps: float
    steering_rad: float
    cross_track_m: float
    """Distance of the rear axle from the lane's centre, left positive."""
    heading_error_rad: float
    """Heading of the body minus that of the lane's centre."""
    progress_m: float
    """Distance along the lane's centre since the start of the route."""


EventKind = Literal["lane_invasion", "collision", "off_road", "completed", "timeout", "fault", "late"]

Ending = Literal["completed", "collision", "off_road", "timeout", "safe_stop"]


class VehicleEvent(Struct, frozen=True):
    """An event of a vehicle."""

    mono_ns: int
    kind: EventKind
    detail: str


class CameraModel(Struct, frozen=True):
    """A pinhole camera on a vehicle: no distortion, principal point in the middle of the image.

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
        """Return the focal length in pixels."""
        import numpy as np  # noqa: PLC0415 (large, and only cameras need it)

        return self.width_px / 2 / float(np.tan(self.field_of_view_rad / 2))


class ReceivedPicture(Protocol):
    """A picture decoded from an access unit."""

    @property
    def picture(self) -> FramePayload:
        """The picture for a detector, or the lane that replaces it. Reading this property can convert the picture."""
        ...

    @property
    def corrupt(self) -> bool:
        """True if the decoder had to conceal parts of the picture."""
        ...


class Lane(Struct, frozen=True):
    """The lane detected in one picture, in the vehicle's frame.

    The centre line is y = c0 + c1 x + c2 x^2 for x between `near_m` and `far_m` ahead of the rear axle; `centre` is
    (c0, c1, c2).
    """

    centre: tuple[float, float, float]
    width_m: float
    near_m: float
    far_m: float
    confidence: float
    """0 (no lane in the picture) to 1 (both lines detected over the whole length)."""


class SeenLane(Struct, frozen=True):
    """The lane that would be visible in a picture; it replaces the picture if nothing is rendered."""

    stamp_ns: int
    """0 until the frame is stamped."""
    at_ns: int
    """Capture time (server's monotonic clock)."""
    lane: Lane


class Decision(Struct, frozen=True):
    """The output of a controller: road wheel angle, pedals and planned path.

    `path_curvature_per_m` has `PATH_POINTS` values, `PATH_STEP_M` apart, left positive.
    """

    steering_rad: float
    throttle: float
    brake: float
    path_curvature_per_m: tuple[float, ...]


Mode = Literal["arm", "drive", "stop"]
Operation = Literal["acquire", "request_handover", "release", "emergency_stop", "clear_emergency_stop"]
"""acquire, release: control of the vehicle. request_handover: ask the active operator to release control."""
SafetyState = Literal["disarmed", "arming", "driving", "degraded", "safe_stop", "emergency_stop"]
SpeedLimitReason = Literal["speed", "stopping distance", "sight", "latency", "delay margin", "no picture", "recovery"]
"""Why the vehicle limits its speed; `SPEED_LIMIT_REASONS` (`safety/speed_limit.py`) has the meanings."""


class Command(Struct, frozen=True):
    """A command of the client to the vehicle, at least 50 times a second."""

    epoch: int
    sequence: int
    sent_wall_ns: int
    """Send time on the client's wall clock, for latency measurement only."""
    stamp_ns: int
    """Stamp of the newest picture from which this command was made; 0: none."""
    stamp_received_wall_ns: int
    """When the client read that stamp, on its wall clock."""
    steering_rad: float
    throttle: float
    brake: float
    path_curvature_per_m: tuple[float, ...]
    mode: Mode
    emergency_stop: int
    """0: no emergency stop. Otherwise its number; another emergency stop has another one."""


class State(Struct, frozen=True):
    """The state that the server publishes 50 times a second."""

    sent_wall_ns: int
    state_mono_ns: int
    """Time of the vehicle's state on the server's monotonic clock."""
    speed_mps: float
    steering_rad: float
    gear: str
    safety: SafetyState
    reason: str
    """The reason for the safety state, as a message."""
    applied_sequence: int
    """Sequence number of the last accepted command; -1: none in this epoch."""
    rejected: str
    """Reason for the last rejection of a command, for 1 s after the rejection; then empty."""
    limited: str = ""
    """Names of the limits that changed the last accepted command; empty: no limit changed it."""
    active_operator: str = ""
    """Name of the client that has control; empty: no client has control."""
    active_operator_instance: int = 0
    """`SessionRequest.instance` of that client, which distinguishes clients of the same name."""
    requested_by: str = ""
    """Name of the client that requests a handover; empty: no client requests one."""
    instance: int = 0
    """Random number of the server process."""
    speed_limit_mps: float | UnsetType = UNSET
    """The speed above which the vehicle brakes; unset: it has no speed governor, or is not driven."""
    speed_limit_reason: SpeedLimitReason | UnsetType = UNSET


class SessionRequest(Struct, frozen=True):
    """A client's session request to the server."""

    operation: Operation
    who: str
    instance: int
    """Random number of the client process, which distinguishes it from another client of the same name."""
    number: int
    """Number of the emergency stop that is raised or cleared; 0 for other operations."""


class NetemRequest(Struct, frozen=True):
    """A client's request to the server: how to impair the packets of the vehicle's machine, and for how long."""

    who: str
    instance: int
    """As in a `SessionRequest`."""
    condition: str
    """Name of the condition, for the records."""
    lease_ms: int
    """Without a further request, all impairments are removed after this time."""
    delay_ms: float
    jitter_ms: float
    jitter_correlation: float
    jitter_distribution: str
    loss: float
    loss_burst_packets: float
    rate_bps: int
    reorder: float
    state_delay_ms: float
    """Delay of states and replies; the impairments in the fields above apply to the video."""


class NetemReply(Struct, frozen=True):
    """The server's answer to a `NetemRequest`: whether the condition is in force."""

    granted: bool
    reason: str


class VehicleInfo(Struct, frozen=True):
    """The server's answer to a query of anybody who may receive the state: the vehicle for a list of vehicles."""

    lavt_version: str
    safety: SafetyState
    reason: str
    """The reason for the safety state, as a message."""
    active_operator: str
    """Name of the client that has control; empty: no client has control."""
    speed_mps: float
    state_age_ns: int
    """Age of the vehicle's state when the query arrived."""
    instance: int
    """Random number of the server process."""


RunOperation = Literal["begin", "status", "read", "end"]
RunPhase = Literal["idle", "starting", "running", "ending", "finished", "failed"]
RunRefusal = Literal[
    "", "malformed", "invalid", "busy", "storage_full", "unknown_run", "not_finished", "shutting_down", "server_error"
]
"""Why the server does not do what a `RunRequest` asks for; empty: it does."""


class RunRequest(Struct, frozen=True):
    """A sweeping machine's request to the server about one run of an experiment."""

    operation: RunOperation
    """begin: drive this run. status: report its phase. read: send a part of its record. end: end it, and forget it."""
    who: str
    instance: int
    """As in a `SessionRequest`."""
    number: int
    """Repeated in the reply."""
    run: int
    """Random number of the run."""
    settings: str
    """For `begin`: the server's part of the run's config, in JSON. Empty for other operations."""
    offset: int
    """For `read`: where in the record the part begins, in bytes."""


class RunReply(Struct, frozen=True):
    """The server's answer to a `RunRequest`."""

    number: int
    refusal: RunRefusal
    reason: str
    """Why the request was refused, or why the run failed."""
    phase: RunPhase
    """The phase of the sender's run; idle if the sender has no run."""
    ending: str
    """How the drive ended; empty before its end."""
    video_port: int
    probe_port: int
    size: int
    """Size of the record of a finished run, in bytes."""
    digest: bytes
    """SHA-256 of that record; empty before the run is finished."""
    data: bytes
    """The part of the record that was asked for."""


class SessionReply(Struct, frozen=True):
    """The server's answer to a `SessionRequest`."""

    granted: bool
    reason: str
    epoch: int
    token: bytes
    """Validates the video path (16 bytes); empty for a client without control."""
    video_port: int
    host: str
    """Identity of the server's kernel: processes on the same kernel share its clocks."""
    emergency_stop: int
    """Number of the last emergency stop; 0: none. In the reply to an emergency stop: the number in the request."""
