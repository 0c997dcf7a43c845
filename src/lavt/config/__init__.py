"""The schema of all configs: keys of quantities end with their units, and unknown keys are rejected."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field, field_validator, model_validator

from lavt.config.camera import CalibrationConfig as CalibrationConfig
from lavt.config.camera import CameraConfig as CameraConfig
from lavt.config.camera import ClientCameraConfig as ClientCameraConfig
from lavt.config.camera import ServerCameraConfig as ServerCameraConfig
from lavt.config.costs import Costs as Costs
from lavt.config.dbw import DbwConfig as DbwConfig
from lavt.config.injection import ClientInjectionConfig as ClientInjectionConfig
from lavt.config.injection import Condition as Condition
from lavt.config.injection import FlowChanges as FlowChanges
from lavt.config.injection import ImpairmentConfig as ImpairmentConfig
from lavt.config.injection import InjectionConfig as InjectionConfig
from lavt.config.injection import LinkConfig as LinkConfig
from lavt.config.injection import ServerInjectionConfig as ServerInjectionConfig
from lavt.config.rendezvous import RendezvousConfig as RendezvousConfig
from lavt.config.rendezvous import ServerRendezvousConfig as ServerRendezvousConfig
from lavt.config.section import Section as Section
from lavt.config.security import ClientSecurityConfig as ClientSecurityConfig
from lavt.config.security import ServerSecurityConfig as ServerSecurityConfig
from lavt.config.zenoh import ZenohConfig as ZenohConfig
from lavt.transport.clock_sync import probe


class VehicleConfig(Section):
    """The vehicle and its route; all keys except `kind` and `dbw` are for the built-in simulator or a software car."""

    kind: str = "simulator"
    route: str = "a_key"
    """The name of a shipped road, or the path of a road's YAML file (`docs/roads.md`)."""
    scenery: Literal["full", "light", "none"] = "full"
    light: Literal["noon", "low_sun", "overcast"] = "noon"
    """The position of the sun and the state of the sky, see `docs/camera.md`."""
    weather: Literal["clear", "wet", "rain", "fog", "night", "worn"] = "clear"
    """The weather and the state of the road, see `docs/camera.md`. It changes pictures only."""
    car: str = "lincoln_mkz"
    steering_dead_time_ms: float | None = Field(None, ge=0, le=2000)
    """The time from a command until the wheels begin to follow. Null, here and for the four keys below: the value of
    `car`."""
    steering_lag_ms: float | None = Field(None, ge=0, le=2000)
    pedal_dead_time_ms: float | None = Field(None, ge=0, le=2000)
    throttle_lag_ms: float | None = Field(None, ge=0, le=5000)
    brake_lag_ms: float | None = Field(None, ge=0, le=5000)
    after_collision: Literal["end", "continue"] = "end"
    """Whether a collision ends the drive, or the car slides along the obstacle and continues."""
    time_limit_s: float | None = Field(None, gt=0, le=86_400)
    """The maximum duration of a drive from the first movement; null: the route's time at 10 km/h plus 30 s."""
    dbw: DbwConfig = DbwConfig()
    """The by-wire kit of a vehicle of kind `dbw`. The other keys then apply to the software car, if there is one."""


ReorderHold = Literal["auto"] | Annotated[float, Field(ge=0, le=500)]
"""How many ms a packet waits for missing earlier packets; auto: 1.25 times the largest recent reordering, at least
10."""


class VideoConfig(Section):
    """The video: H.264 and RTP."""

    bit_rate_bps: int = Field(4_000_000, ge=50_000, le=50_000_000)
    """The upper limit of the H.264 stream's bit rate, as a mean over any period of `buffer_ms`. Packet headers and
    repair packets are not included."""
    gop_frames: int = Field(30, ge=1, le=600)
    """The longest distance between keyframes; after a loss, the client requests an additional keyframe."""
    buffer_ms: float = Field(100.0, gt=0, le=2000)
    """The decoder's buffer (VBV): no frame is larger than the bit rate times this duration."""
    preset: Literal["ultrafast", "superfast", "veryfast", "faster", "fast", "medium", "slow", "slower", "veryslow"] = (
        "ultrafast"
    )
    """libx264's preset: a slower one gives better pictures at the same bit rate, and takes longer."""
    encoder_threads: int = Field(1, ge=1, le=16)
    """The number of threads of the encoder; each encodes a slice of every picture."""
    repair_packets: Literal["auto", 0, 1, 2] = "auto"
    """Repair packets per frame, or per 16 packets of a larger frame; auto: the number follows the reported loss."""
    reorder_hold_ms: ReorderHold = "auto"


class NetworkConfig(Section):
    """The network of a run on one machine."""

    condition: str = "L0"
    inherent: Literal["loopback", "paper_wifi5"] = "loopback"
    injection: Literal["relay", "netem", "none"] = "relay"
    state_delay: Literal["none", "with_video"] = "none"
    video: FlowChanges = FlowChanges()
    """Values that replace those of the condition, so that a sweep can vary a single value."""
    control: FlowChanges = FlowChanges()

    def requested(self, condition: Condition) -> Condition:
        """Return `condition`, which is the condition named in this section, with the changes of this section."""
        video_ms, video = self.video.apply_to(condition.video_ms, condition.video)
        control_ms, control = self.control.apply_to(condition.control_ms, condition.control)
        return Condition(video_ms=video_ms, control_ms=control_ms, video=video, control=control)

    @property
    def changes(self) -> str | None:
        """The changes of the condition as text; None without changes."""
        flows = {"video": self.video.replacements, "control": self.control.replacements}
        changes = [f"{flow}.{name} {value}" for flow, values in flows.items() for name, value in values.items()]
        return ", ".join(changes) or None


MAX_SIMULATED_MPS = 22.3
"""The largest speed that can be configured, a little above 80 km/h."""


class SafetyConfig(Section):
    """The safety limits that a study may widen, for a simulated vehicle only."""

    lateral_acceleration_mps2: float = Field(3.0, gt=0, le=6.0)
    picture_age_limit_ms: float = Field(500.0, gt=0, le=2000)
    stopping_distance_limit_m: float = Field(20.0, gt=0, le=200)
    """The distance in which the car must be able to stop; above 20 m, the car can drive faster than it was tested."""
    speed_limit_mps: float = Field(40 / 3.6, gt=0, le=MAX_SIMULATED_MPS)
    """Above this speed the vehicle allows no throttle."""


class RecordConfig(Section):
    """The contents of the record."""

    video: bool = True
    """Whether to record the access units, as sent and as received; they are nine tenths of a record."""

    @property
    def left_out(self) -> frozenset[str]:
        """Channels that are not recorded."""
        return frozenset() if self.video else frozenset({"video"})


class ControllerConfig(Section):
    """The controller that drives."""

    kind: str = "lane_keeper"
    preset: str = "designed"
    lookahead_s: float | None = Field(None, ge=0.2, le=5)
    """How far ahead the car aims, in seconds of driving. This key and the three below replace the preset's values."""
    steering_limit_rad: float | None = Field(None, gt=0, le=0.5)
    """The limit of the angle of the road wheels."""
    lateral_limit_mps2: float | None = Field(None, gt=0, le=20)
    speed_mps: float | None = Field(None, ge=1, le=MAX_SIMULATED_MPS)
    """The target speed. The vehicle allows no throttle above `safety.speed_limit_mps`, which is at most 40 km/h for a
    vehicle that is not simulated."""
    wheelbase_m: float = Field(2.8448, gt=0.5, lt=10)
    """The wheelbase of the driven vehicle; by default the built-in car's."""
    rearm: bool = False
    """Arm automatically after a safe stop, and after a restart of the server, but not after an emergency stop
    (docs/session.md)."""
    clear_emergency_stop: bool = False
    """Clear the emergency stop that exists when the client starts, and no later one; set this only after its cause has
    been removed."""

    @property
    def changes(self) -> dict[str, Any]:
        """Settings that replace the preset's values."""
        settings = ("lookahead_s", "steering_limit_rad", "lateral_limit_mps2", "speed_mps")
        return {name: value for name in settings if (value := getattr(self, name)) is not None}

    @property
    def settings(self) -> str:
        """The preset's name and the changed settings, as results show them."""
        return ", ".join([self.preset, *(f"{name} {value:g}" for name, value in self.changes.items())])


class ClocksConfig(Section):
    """The clocks of the virtual hosts.

    The client's clock shows the true time. `offset_ms` and `drift_ppm` are those of the server's clock. `error_us` and
    `bound_us` are what the modelled chrony reports: the error of its correction, and the bound of that error.
    """

    offset_ms: float = Field(250.0, ge=-60_000, le=60_000)
    drift_ppm: float = Field(20.0, ge=-500, le=500)
    error_us: float = Field(20.0, ge=0)
    bound_us: float = Field(100.0, ge=0)

    @field_validator("bound_us")
    @classmethod
    def _check_bound(cls, bound_us: float, info: Any) -> float:
        if bound_us < info.data.get("error_us", 0.0):
            raise ValueError("must be at least error_us, because the modelled error must not exceed its bound")
        return bound_us


class StudyConfig(Section):
    """The place of a run in a study with human operators; without values if a controller drives."""

    participant: str | None = None
    block: int | None = None
    order: int | None = None


class RunConfig(Section):
    """One run on one machine."""

    vehicle: VehicleConfig = VehicleConfig()
    controller: ControllerConfig = ControllerConfig()
    camera: CameraConfig = CameraConfig()
    video: VideoConfig = VideoConfig()
    network: NetworkConfig = NetworkConfig()
    safety: SafetyConfig = SafetyConfig()
    record: RecordConfig = RecordConfig()
    clocks: ClocksConfig = ClocksConfig()
    study: StudyConfig = StudyConfig()
    time: Literal["real", "virtual"] = "virtual"
    fidelity: Literal["video", "pixels", "geometry"] = "video"
    """For virtual time. video: H.264-coded pictures. pixels: rendered pictures. geometry: no pictures, only the lane
    that they would show."""
    costs: Literal["measured", "constant"] = "measured"
    """For virtual time: the times of stages and links. measured: drawn from the distributions in `configs/costs.yaml`.
    constant: always the medians in that file."""
    seed: int = Field(1, ge=0, lt=2**63)
    repetition: int = Field(0, ge=0)
    """The number of this run among the runs with the same seed. Each repetition has its own start and noise, which are
    equal under all conditions."""

    @property
    def left_out(self) -> frozenset[str]:
        """Channels that are not recorded.

        With fidelity `pixels` or `geometry`, access units are not video and are left out. `geometry` is for sweeps of
        thousands of runs, so it also leaves out what other channels contain: commands (in `admission`), states (in
        `truth`) and packets (in `frame` and `picture`).
        """
        channels = {
            "video": self.record.left_out,
            "pixels": {"video"},
            "geometry": {"video", "control", "state", "rtp"},
        }
        return frozenset(channels[self.fidelity])


class SweepConfig(RunConfig):
    """Many runs: every route under every condition, repeated, for every combination of further axes."""

    routes: tuple[str, ...] = ("a_key",)
    conditions: tuple[str, ...] = ("L0", "L1", "L2", "L3", "L4", "L5")
    repetitions: int = Field(1, ge=1, le=10_000)
    axes: dict[str, list[Any]] = Field(default_factory=dict)
    """The values of each further axis, by config key, such as `controller.preset`."""


class BoundaryConfig(RunConfig):
    """Many searches for the maximum tolerable latency: every route with every preset, repeated with other seeds."""

    routes: tuple[str, ...] = ("a_key",)
    presets: tuple[str, ...] = ("designed", "paper_calibrated")
    repetitions: int = Field(10, ge=1, le=10_000)
    longest_delay_ms: float = Field(700.0, gt=0, le=5000)
    """The longest delay of the video that the search tries; the total delay also includes the loop's own latency."""
    grid_ms: float = Field(100.0, gt=0, le=1000)
    """The search first tries delays that are this far apart."""
    within_ms: float = Field(2.0, ge=0.1, le=100)
    """The accuracy to which the search then determines each boundary, between two neighbouring delays of the grid."""


class ClockConfig(Section):
    """The time source of this machine's clock, and the port of the clock probe."""

    source: Literal["chrony", "ptp", "external", "probe"] = "chrony"
    """probe: no time source is queried; the clock offset is known from the clock probe alone."""
    correction_ms: float | None = Field(None, ge=-86_400_000, le=86_400_000)
    """For source `external`: reference time minus this machine's wall clock."""
    bound_ms: float | None = Field(None, ge=0, le=86_400_000)
    """For source `external`: the largest error of the correction."""
    probe_port: int = Field(probe.DEFAULT_PORT, ge=0, le=65535)
    """The UDP port of the clock probe on the server. Injection must not delay the probe's packets."""

    @model_validator(mode="after")
    def _check_external(self) -> ClockConfig:
        are_set = [self.correction_ms is not None, self.bound_ms is not None]
        if self.source == "external" and not all(are_set):
            raise ValueError("source external needs correction_ms and bound_ms")
        if self.source != "external" and any(are_set):
            raise ValueError("correction_ms and bound_ms require source external: set it, or leave them out")
        return self


class ClientClockConfig(ClockConfig):
    """The clock of the client. Its probe port cannot be 0, because the client must know the server's port."""

    probe_port: int = Field(probe.DEFAULT_PORT, ge=1, le=65535)


class ServerVideoConfig(VideoConfig):
    """The video as the server sends it."""

    bind: str = "0.0.0.0"  # noqa: S104 (the video's path is validated before anything is sent)
    port: int = Field(5600, ge=0, le=65535)
    send_to: tuple[str, ...] = ()
    """Plain receivers, as host:port, to which the video is sent without path validation."""


class ServerConfig(Section):
    """The vehicle's machine."""

    vehicle_id: str = "vehicle-1"
    vehicle: VehicleConfig = VehicleConfig()
    camera: ServerCameraConfig = ServerCameraConfig()
    video: ServerVideoConfig = ServerVideoConfig()
    zenoh: ZenohConfig = ZenohConfig()
    security: ServerSecurityConfig = ServerSecurityConfig()
    rendezvous: ServerRendezvousConfig = ServerRendezvousConfig()
    injection: ServerInjectionConfig = ServerInjectionConfig()
    clock: ClockConfig = ClockConfig()
    safety: SafetyConfig = SafetyConfig()
    record: RecordConfig = RecordConfig()
    seed: int = Field(1, ge=0, lt=2**63)

    @model_validator(mode="after")
    def _check_encryption(self) -> ServerConfig:
        if self.security.key and self.video.send_to:
            raise ValueError("video.send_to sends unencrypted video: leave out video.send_to or security.key")
        return self

    @model_validator(mode="after")
    def _check_netem(self) -> ServerConfig:
        if self.rendezvous.host and self.injection.interface:
            raise ValueError(
                "netem cannot delay video to a rendezvous: leave out rendezvous.host or injection.interface"
            )
        return self


class ClientVideoConfig(Section):
    """The video as the client receives it."""

    server: str = "127.0.0.1"
    port: int = Field(0, ge=0, le=65535)
    """0: the port that the server names in the session."""
    max_bit_rate_bps: int | None = Field(None, ge=50_000, le=50_000_000)
    """The bit rate that the client requests if the server's bit rate is higher."""
    reorder_hold_ms: ReorderHold = "auto"


class ClientConfig(Section):
    """The operator's machine."""

    vehicle_id: str = "vehicle-1"
    who: str = "operator-1"
    """The operator's name."""
    take_over: bool = False
    """Whether to request a handover from the client in control, see `docs/session.md`."""
    controller: ControllerConfig = ControllerConfig()
    camera: ClientCameraConfig = ClientCameraConfig()
    video: ClientVideoConfig = ClientVideoConfig()
    zenoh: ZenohConfig = ZenohConfig()
    security: ClientSecurityConfig = ClientSecurityConfig()
    injection: ClientInjectionConfig = ClientInjectionConfig()
    clock: ClientClockConfig = ClientClockConfig()
    record: RecordConfig = RecordConfig()

    @model_validator(mode="after")
    def _check_scouting(self) -> ClientConfig:
        if self.zenoh.scouting:
            raise ValueError("zenoh.scouting is for a server, because only servers are searched: leave it out")
        return self


class DelayConfig(Section):
    """One direction of a relayed flow: a constant delay, a lognormal jitter, and the impairments of a condition."""

    constant_ms: float = Field(0.0, ge=0, le=70_000)
    """The sum of the constant delays of the inherent latency and of the condition."""
    jitter_median_ms: float = Field(0.0, ge=0, le=60_000)
    jitter_sigma: float = Field(0.0, ge=0, le=3)
    link: LinkConfig = LinkConfig()


class RelayConfig(Section):
    """The relay: its own addresses, the server's addresses, and the delays."""

    video_listen: str = "127.0.0.1:0"
    video_server: str
    control_listen: str = "127.0.0.1:0"
    control_server: str
    video: DelayConfig = DelayConfig()
    control: DelayConfig = DelayConfig()
    state: DelayConfig = DelayConfig()
    seed: int = Field(1, ge=0, lt=2**63)
