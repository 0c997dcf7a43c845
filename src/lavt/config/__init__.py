"""What a user can configure: one schema, units in its names; unknown keys are refused with the nearest known one."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field, field_validator, model_validator

from lavt.config.calibration import CalibrationConfig as CalibrationConfig
from lavt.config.camera import CameraConfig as CameraConfig
from lavt.config.camera import ClientCameraConfig as ClientCameraConfig
from lavt.config.camera import ServerCameraConfig as ServerCameraConfig
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
from lavt.transport.clock_sync import probe


class VehicleConfig(Section):
    """Which vehicle, and what it drives; all but `kind` and `dbw` is the built-in simulator's."""

    kind: str = "simulator"
    route: str = "a_key"
    """A road that comes with LAVT, or the path of a road's YAML file (`docs/roads.md`)."""
    scenery: Literal["full", "light", "none"] = "full"
    light: Literal["noon", "low_sun", "overcast"] = "noon"
    """The simulator's: where the sun stands and what the sky does, see `docs/camera.md`."""
    car: str = "lincoln_mkz"
    steering_dead_time_ms: float | None = Field(None, ge=0, le=2000)
    """From a command until the wheels begin to follow; like all lags here, the car's own where nothing is given."""
    steering_lag_ms: float | None = Field(None, ge=0, le=2000)
    pedal_dead_time_ms: float | None = Field(None, ge=0, le=2000)
    throttle_lag_ms: float | None = Field(None, ge=0, le=5000)
    brake_lag_ms: float | None = Field(None, ge=0, le=5000)
    after_collision: Literal["end", "continue"] = "end"
    """Whether a collision ends the drive, or the car slides along what it has hit and goes on."""
    time_limit_s: float | None = Field(None, gt=0, le=86_400)
    """Of a drive, from the first movement; where nothing is given, the route's time at 10 km/h and 30 s more."""
    dbw: DbwConfig = DbwConfig()
    """Of kind `dbw`: a by-wire kit. The rest is its software car's then, where there is one."""


ReorderHold = Literal["auto"] | Annotated[float, Field(ge=0, le=500)]
"""So many ms a packet waits for those before it; auto: 10, or a quarter more than any was overtaken by lately."""


class VideoConfig(Section):
    """H.264 and RTP."""

    bit_rate_bps: int = Field(4_000_000, ge=50_000, le=50_000_000)
    """Of the H.264, kept to over any `buffer_ms`; headers and repair packets come on top."""
    gop_frames: int = Field(30, ge=1, le=600)
    """A keyframe at least so often; after a loss it comes on request."""
    buffer_ms: float = Field(100.0, gt=0, le=2000)
    """The decoder's buffer (VBV): no frame is larger than what the bit rate carries in this time."""
    preset: Literal["ultrafast", "superfast", "veryfast", "faster", "fast", "medium", "slow", "slower", "veryslow"] = (
        "ultrafast"
    )
    """libx264's: a slower one makes better pictures of the same bits, and takes longer."""
    encoder_threads: int = Field(1, ge=1, le=16)
    """Each encodes a slice of every picture."""
    repair_packets: Literal["auto", 0, 1, 2] = "auto"
    """For each frame (for each 16 packets of a large one); auto: as many as the reported loss asks for."""
    reorder_hold_ms: ReorderHold = "auto"


class NetworkConfig(Section):
    """What the network does to a run on one machine."""

    condition: str = "L0"
    inherent: Literal["loopback", "paper_wifi5"] = "loopback"
    injection: Literal["relay", "netem", "none"] = "relay"
    state_delay: Literal["none", "with_video"] = "none"
    video: FlowChanges = FlowChanges()
    """Instead of the condition's, value by value, so that a sweep can vary them one by one."""
    control: FlowChanges = FlowChanges()

    def requested(self, condition: Condition) -> Condition:
        """Give what is asked of the network: `condition`, the one named here, with the changes."""
        video_ms, video = self.video.of(condition.video_ms, condition.video)
        control_ms, control = self.control.of(condition.control_ms, condition.control)
        return Condition(video_ms=video_ms, control_ms=control_ms, video=video, control=control)

    @property
    def changes(self) -> str | None:
        """What is asked for instead of what the condition says, in words; None where nothing is."""
        flows = {"video": self.video.given, "control": self.control.given}
        words = [f"{flow}.{name} {value}" for flow, given in flows.items() for name, value in given.items()]
        return ", ".join(words) or None


class SafetyConfig(Section):
    """The limits that a study may widen, for a simulated vehicle only."""

    lateral_acceleration_mps2: float = Field(3.0, gt=0, le=6.0)
    picture_age_limit_ms: float = Field(500.0, gt=0, le=2000)
    stopping_distance_limit_m: float = Field(20.0, gt=0, le=200)
    """On so much of its path the car must be able to stop; beyond 20 m it goes faster than was shown to it."""


class RecordConfig(Section):
    """What is written down."""

    video: bool = True
    """The access units as sent and as received: nine tenths of a record."""

    @property
    def left_out(self) -> frozenset[str]:
        """Channels that stay out of the record."""
        return frozenset() if self.video else frozenset({"video"})


class ControllerConfig(Section):
    """Who drives."""

    kind: str = "lane_keeper"
    preset: str = "designed"
    lookahead_s: float | None = Field(None, ge=0.2, le=5)
    """Instead of the preset's, like the three below: how far ahead the car aims, in seconds of driving."""
    steering_limit_rad: float | None = Field(None, gt=0, le=0.5)
    """Of the road wheels."""
    lateral_limit_mps2: float | None = Field(None, gt=0, le=20)
    speed_mps: float | None = Field(None, ge=1, le=11)
    """The vehicle gives no throttle above 40 km/h, whatever is asked."""
    wheelbase_m: float = Field(2.8448, gt=0.5, lt=10)
    """Of the vehicle that is driven; the built-in car's."""
    rearm: bool = False
    """Arm again by itself after a safe stop, and when the server was started again (docs/session.md)."""
    clear_emergency_stop: bool = False
    """Clear an emergency stop that is found, as whoever set this has seen to what caused it."""

    @property
    def changes(self) -> dict[str, Any]:
        """Settings that are not the preset's own."""
        settings = ("lookahead_s", "steering_limit_rad", "lateral_limit_mps2", "speed_mps")
        return {name: value for name in settings if (value := getattr(self, name)) is not None}

    @property
    def settings(self) -> str:
        """The preset's name, and what differs from it: results call it so."""
        return ", ".join([self.preset, *(f"{name} {value:g}" for name, value in self.changes.items())])


class ClocksConfig(Section):
    """The virtual hosts' clocks: the server's against the true time (the client's is true), and chrony's model."""

    offset_ms: float = Field(250.0, ge=-60_000, le=60_000)
    drift_ppm: float = Field(20.0, ge=-500, le=500)
    error_us: float = Field(20.0, ge=0)
    bound_us: float = Field(100.0, ge=0)

    @field_validator("bound_us")
    @classmethod
    def _holds(cls, bound_us: float, info: Any) -> float:
        if bound_us < info.data.get("error_us", 0.0):
            raise ValueError("must be at least error_us: the modelled error lies inside its bound")
        return bound_us


class StudyConfig(Section):
    """Where a run belongs in a study with people; empty for a controller."""

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
    """In virtual time: pictures through H.264; pictures as rendered; or no pictures, but the lane they would show."""
    seed: int = Field(1, ge=0, lt=2**63)
    repetition: int = Field(0, ge=0)
    """Which of several runs with one seed: each has its own start and noise, the same under every condition."""

    @property
    def left_out(self) -> frozenset[str]:
        """Channels that stay out of the record.

        What stands for H.264 at another fidelity is no video. Geometry is for sweeps of thousands of runs: there what
        other channels say as well is left out, commands (`admission`), states (`truth`) and packets (`frame`,
        `picture`).
        """
        further = {"video": self.record.left_out, "pixels": {"video"}, "geometry": {"video", "control", "state", "rtp"}}
        return frozenset(further[self.fidelity])


class SweepConfig(RunConfig):
    """Many runs: every route under every condition, repeated, over every combination of further axes."""

    routes: tuple[str, ...] = ("a_key",)
    conditions: tuple[str, ...] = ("L0", "L1", "L2", "L3", "L4", "L5")
    repetitions: int = Field(1, ge=1, le=10_000)
    axes: dict[str, list[Any]] = Field(default_factory=dict)


class BoundaryConfig(RunConfig):
    """Many searches for the delay that a loop bears: every route with every preset, repeated with other seeds."""

    routes: tuple[str, ...] = ("a_key",)
    presets: tuple[str, ...] = ("designed", "paper_calibrated")
    repetitions: int = Field(10, ge=1, le=10_000)
    longest_delay_ms: float = Field(700.0, gt=0, le=5000)
    """Of the video, on top of what is there anyway: searched from 0 to here."""
    grid_ms: float = Field(100.0, gt=0, le=1000)
    """So far apart are the delays that are tried first."""
    within_ms: float = Field(2.0, ge=0.1, le=100)
    """So exactly each boundary is found between two of them."""


class ZenohConfig(Section):
    """The session to the router on this machine."""

    session: str = "zenoh-configs/session.json5"
    """A JSON5 file: a path, or one of those that come with LAVT."""
    router: str = ""
    """Endpoint of the router; empty: the one the file names."""


class ClockConfig(Section):
    """Who says how far this machine's clock is off, and where the clocks of both machines are compared."""

    source: Literal["chrony", "ptp", "external", "probe"] = "chrony"
    """probe: nobody says it, the offset is the probe's alone."""
    correction_ms: float | None = Field(None, ge=-86_400_000, le=86_400_000)
    """With `external`: reference time less this machine's wall clock."""
    bound_ms: float | None = Field(None, ge=0, le=86_400_000)
    """With `external`: how far the correction can be from the truth."""
    probe_port: int = Field(probe.DEFAULT_PORT, ge=0, le=65535)
    """The server's UDP port for the probe; nothing may delay it."""

    @model_validator(mode="after")
    def _external(self) -> ClockConfig:
        given = [self.correction_ms is not None, self.bound_ms is not None]
        if self.source == "external" and not all(given):
            raise ValueError("source external needs correction_ms and bound_ms")
        if self.source != "external" and any(given):
            raise ValueError("correction_ms and bound_ms belong to source external: set it, or leave them out")
        return self


class ClientClockConfig(ClockConfig):
    """The same on the client, which must know the server's port."""

    probe_port: int = Field(probe.DEFAULT_PORT, ge=1, le=65535)


class ServerVideoConfig(VideoConfig):
    """The video as the server sends it."""

    bind: str = "0.0.0.0"  # noqa: S104 (the video's path must be proven before anything is sent)
    port: int = Field(5600, ge=0, le=65535)
    send_to: tuple[str, ...] = ()
    """Plain receivers, as host:port, that get the video without proving anything."""


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
    def _encrypted(self) -> ServerConfig:
        if self.security.key and self.video.send_to:
            raise ValueError("video.send_to gets the video unencrypted: leave it out, or security.key")
        return self

    @model_validator(mode="after")
    def _plain_for_netem(self) -> ServerConfig:
        if self.rendezvous.host and self.injection.interface:
            raise ValueError("netem finds no video that is wrapped: leave out rendezvous.host or injection.interface")
        return self


class ClientVideoConfig(Section):
    """The video as the client receives it."""

    server: str = "127.0.0.1"
    port: int = Field(0, ge=0, le=65535)
    """0: the port that the server names in the session."""
    max_bit_rate_bps: int | None = Field(None, ge=50_000, le=50_000_000)
    """What the server is asked to keep to, where that is less than its own bit rate."""
    reorder_hold_ms: ReorderHold = "auto"


class ClientConfig(Section):
    """The remote machine."""

    vehicle_id: str = "vehicle-1"
    who: str = "operator-1"
    take_over: bool = False
    """Ask whoever holds the vehicle to hand it over, see `docs/session.md`."""
    controller: ControllerConfig = ControllerConfig()
    camera: ClientCameraConfig = ClientCameraConfig()
    video: ClientVideoConfig = ClientVideoConfig()
    zenoh: ZenohConfig = ZenohConfig()
    security: ClientSecurityConfig = ClientSecurityConfig()
    injection: ClientInjectionConfig = ClientInjectionConfig()
    clock: ClientClockConfig = ClientClockConfig()
    record: RecordConfig = RecordConfig()


class DelayConfig(Section):
    """One direction of a relayed flow: a constant delay, a lognormal one on top, and what a condition does."""

    constant_ms: float = Field(0.0, ge=0, le=70_000)
    """An inherent profile's and a condition's."""
    jitter_median_ms: float = Field(0.0, ge=0, le=60_000)
    jitter_sigma: float = Field(0.0, ge=0, le=3)
    link: LinkConfig = LinkConfig()


class RelayConfig(Section):
    """The relay: where it listens, where the server is, and what it holds back."""

    video_listen: str = "127.0.0.1:0"
    video_server: str
    control_listen: str = "127.0.0.1:0"
    control_server: str
    video: DelayConfig = DelayConfig()
    control: DelayConfig = DelayConfig()
    state: DelayConfig = DelayConfig()
    seed: int = Field(1, ge=0, lt=2**63)


class Costs(Section):
    """What the loop costs where the virtual runtime does not wait for it: see `configs/costs.yaml`."""

    measured_on: str
    stages_us: dict[str, dict[str, float]]
    links_us: dict[str, float]
