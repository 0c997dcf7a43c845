"""The schema of all configs: keys of quantities end with their units, and unknown keys are rejected."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field, field_validator, model_validator

from lavt.config.camera import CalibrationConfig as CalibrationConfig
from lavt.config.camera import CameraConfig as CameraConfig
from lavt.config.camera import ClientCameraConfig as ClientCameraConfig
from lavt.config.camera import ServerCameraConfig as ServerCameraConfig
from lavt.config.carla import CarlaConfig as CarlaConfig
from lavt.config.controller import AGENT as AGENT
from lavt.config.controller import HUMAN as HUMAN
from lavt.config.controller import CompensationConfig as CompensationConfig
from lavt.config.controller import ControllerConfig as ControllerConfig
from lavt.config.controller import PredictionConfig as PredictionConfig
from lavt.config.controller import TwoPointConfig as TwoPointConfig
from lavt.config.costs import Costs as Costs
from lavt.config.dbw import DbwConfig as DbwConfig
from lavt.config.experiment import ExperimentConfig as ExperimentConfig
from lavt.config.governor import GovernorConfig as GovernorConfig
from lavt.config.injection import ClientInjectionConfig as ClientInjectionConfig
from lavt.config.injection import Condition as Condition
from lavt.config.injection import FlowChanges as FlowChanges
from lavt.config.injection import ImpairmentConfig as ImpairmentConfig
from lavt.config.injection import InjectionConfig as InjectionConfig
from lavt.config.injection import LinkConfig as LinkConfig
from lavt.config.injection import ServerInjectionConfig as ServerInjectionConfig
from lavt.config.perception import PerceptionConfig as PerceptionConfig
from lavt.config.relay import DelayConfig as DelayConfig
from lavt.config.relay import RelayConfig as RelayConfig
from lavt.config.rendezvous import RendezvousConfig as RendezvousConfig
from lavt.config.rendezvous import ServerRendezvousConfig as ServerRendezvousConfig
from lavt.config.section import Section as Section
from lavt.config.security import ClientSecurityConfig as ClientSecurityConfig
from lavt.config.security import ServerSecurityConfig as ServerSecurityConfig
from lavt.config.vehicle import MAX_SIMULATED_MPS as MAX_SIMULATED_MPS
from lavt.config.vehicle import SafetyConfig as SafetyConfig
from lavt.config.vehicle import VehicleConfig as VehicleConfig
from lavt.config.zenoh import ZenohConfig as ZenohConfig
from lavt.transport.clock_sync import probe

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
    """How long a packet waits for missing earlier ones; auto: 1.25 times the largest recent reordering, at least 10."""


class NetworkConfig(Section):
    """The network of a run on one machine."""

    condition: str = "L0"
    """The name of a network condition (`netem/conditions.yaml`)."""
    inherent: Literal["loopback", "paper_wifi5"] = "loopback"
    """The latency that the network has without injection: that of one machine, or a model of the paper's WiFi."""
    injection: Literal["relay", "netem", "none"] = "relay"
    """In real time, what injects the delay: the relay, the kernel (`docs/netem.md`), or nothing."""
    state_delay: Literal["none", "with_video"] = "none"
    """with_video: the vehicle's state is delayed by the video's constant delay, too."""
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


class RecordConfig(Section):
    """The contents of the record."""

    video: bool = True
    """Whether to record the access units, as sent and as received; they are nine tenths of a record."""

    @property
    def left_out(self) -> frozenset[str]:
        """Channels that are not recorded."""
        return frozenset() if self.video else frozenset({"video"})


class ClocksConfig(Section):
    """The clocks of the virtual hosts.

    The client's clock shows the true time. `offset_ms` and `drift_ppm` are those of the server's clock. `error_us` and
    `bound_us` are what the modelled chrony reports: the error of its correction, and the bound of that error.
    """

    offset_ms: float = Field(250.0, ge=-60_000, le=60_000)
    """The server's clock minus the true time, at the beginning."""
    drift_ppm: float = Field(20.0, ge=-500, le=500)
    """How fast this offset grows."""
    error_us: float = Field(20.0, ge=0)
    """The error of the correction that the modelled chrony reports."""
    bound_us: float = Field(100.0, ge=0)
    """The bound of that error, which the modelled chrony reports."""

    @field_validator("bound_us")
    @classmethod
    def _check_bound(cls, bound_us: float, info: Any) -> float:
        if bound_us < info.data.get("error_us", 0.0):
            raise ValueError("must be at least error_us, because the modelled error must not exceed its bound")
        return bound_us


class StudyPlaceConfig(Section):
    """The place of a run in a study; `lavt study` sets it, and other runs have no values."""

    participant: str | None = None
    """The participant of the study."""
    block: int | None = None
    """The number of the block to which this run belongs, counted from 1; a block has one condition."""
    order: int | None = None
    """The position of this run in the order in which the participant drove, counted from 1."""


class RunConfig(Section):
    """One run on one machine."""

    vehicle: VehicleConfig = VehicleConfig()
    controller: ControllerConfig = ControllerConfig()
    perception: PerceptionConfig = PerceptionConfig()
    camera: CameraConfig = CameraConfig()
    video: VideoConfig = VideoConfig()
    network: NetworkConfig = NetworkConfig()
    safety: SafetyConfig = SafetyConfig()
    record: RecordConfig = RecordConfig()
    clocks: ClocksConfig = ClocksConfig()
    study: StudyPlaceConfig = StudyPlaceConfig()
    time: Literal["real", "virtual"] = "virtual"
    """virtual: computed, waiting is skipped; real: with processes, sockets and the machine's clocks."""
    fidelity: Literal["video", "pixels", "geometry"] = "video"
    """For virtual time. video: H.264-coded pictures. pixels: rendered pictures. geometry: no pictures, only the lane
    that they would show."""
    costs: Literal["measured", "constant"] = "measured"
    """For virtual time: the times of stages and links. measured: drawn from the distributions in `configs/costs.yaml`.
    constant: always the medians in that file."""
    seed: int = Field(1, ge=0, lt=2**63)
    """The seed of everything random."""
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
    """The routes that are driven; they replace `vehicle.route`. Paths of road files, such as imported ones
    (`docs/opendrive.md`), may stand beside names."""
    conditions: tuple[str, ...] = ("L0", "L1", "L2", "L3", "L4", "L5")
    """The network conditions that are driven."""
    repetitions: int = Field(1, ge=1, le=10_000)
    """How often each combination is driven, each time with another seed."""
    axes: dict[str, list[Any]] = Field(default_factory=dict)
    """The values of each further axis, by config key, such as `controller.preset`."""


class BoundaryConfig(RunConfig):
    """Many searches for the maximum tolerable latency: every route with every preset, repeated with other seeds."""

    routes: tuple[str, ...] = ("a_key",)
    """The routes that are driven; they replace `vehicle.route`."""
    presets: tuple[str, ...] = ("designed", "paper_calibrated")
    """The presets of the controller that are searched."""
    repetitions: int = Field(10, ge=1, le=10_000)
    """How many seeds each combination has."""
    longest_delay_ms: float = Field(700.0, gt=0, le=5000)
    """The longest delay of the video that the search tries; the total delay also includes the loop's own latency."""
    grid_ms: float = Field(100.0, gt=0, le=1000)
    """The search first tries delays that are this far apart."""
    within_ms: float = Field(2.0, ge=0.1, le=100)
    """The accuracy to which the search then determines each boundary, between two neighbouring delays of the grid."""


class StudyConfig(RunConfig):
    """A study: every participant drives all routes under all conditions, a block for each condition."""

    participants: int = Field(12, ge=1, le=999)
    """The planned number of participants. Their numbers begin with 1."""
    conditions: tuple[str, ...] = ("L0", "L2", "L3", "L5")
    """The network conditions; each participant drives them in an order that is balanced over the participants."""
    routes: tuple[str, ...] = ("a_key",)
    """The routes that are driven in each block, in this order; they replace `vehicle.route`."""
    repetitions: int = Field(1, ge=1, le=100)
    """How often the routes are driven in each block, each time with another start and noise."""
    instructions: str = ""
    """The text that a person reads in the terminal before each block."""

    @model_validator(mode="after")
    def _check_study(self) -> StudyConfig:
        for name in ("conditions", "routes"):
            values = getattr(self, name)
            if not values:
                raise ValueError(f"{name} is empty: name at least one entry")
            if len(set(values)) < len(values):
                raise ValueError(f"{name} must be a list without duplicates: name each entry once")
        if len(self.conditions) < 2:
            raise ValueError("conditions needs at least two conditions, because a study compares them: add one")
        if self.study != StudyPlaceConfig():
            raise ValueError("study.* is set for each run by the study itself: leave out the section study")
        if self.controller.kind == HUMAN and self.time != "real":
            raise ValueError("controller.kind human needs time real, because a person drives in real time: set it")
        return self


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
    probe_server: str = ""
    """The server's address for the clock probe; empty: `video.server`. It differs if a relay forwards the video."""


class ServerVideoConfig(VideoConfig):
    """The video as the server sends it."""

    bind: str = "0.0.0.0"  # noqa: S104 (the video's path is validated before anything is sent)
    """The local address from which video is sent."""
    port: int = Field(5600, ge=0, le=65535)
    """The UDP port for video; 0: any free port, which the server names in the session."""
    send_to: tuple[str, ...] = ()
    """Plain receivers, as host:port, to which the video is sent without path validation."""


class ServerConfig(Section):
    """The vehicle's machine."""

    vehicle_id: str = "vehicle-1"
    """The vehicle's name, which is part of every Zenoh key; equal on server and client."""
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
    experiment: ExperimentConfig = ExperimentConfig()
    seed: int = Field(1, ge=0, lt=2**63)
    """The seed of everything random."""

    @model_validator(mode="after")
    def _check_remote_runs(self) -> ServerConfig:
        if self.experiment.remote_runs and (self.vehicle.kind, self.camera.source) != ("simulator", "simulated"):
            raise ValueError("experiment.remote_runs is for the simulator and its camera only: leave it out")
        return self

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
    """The address or name of the vehicle's machine."""
    port: int = Field(0, ge=0, le=65535)
    """0: the port that the server names in the session."""
    max_bit_rate_bps: int | None = Field(None, ge=50_000, le=50_000_000)
    """The bit rate that the client requests if the server's bit rate is higher."""
    reorder_hold_ms: ReorderHold = "auto"
    """How long a packet waits for missing earlier ones; auto: 1.25 times the largest recent reordering, at least 10."""


class ConsoleConfig(Section):
    """The web page from which a person drives, if `controller.kind` is human."""

    port: int = Field(0, ge=0, le=65535)
    """The TCP port of the page on this machine's loopback addresses; 0: any free port."""
    shows_latency: bool = True
    """Whether the page shows the measured latencies and lost packets; `lavt study` hides them from a participant."""


class ClientConfig(Section):
    """The operator's machine."""

    vehicle_id: str = "vehicle-1"
    """The vehicle's name, which is part of every Zenoh key; equal on server and client."""
    who: str = "operator-1"
    """The operator's name."""
    take_over: bool = False
    """Whether to request a handover from the client in control, see `docs/session.md`."""
    controller: ControllerConfig = ControllerConfig()
    perception: PerceptionConfig = PerceptionConfig()
    console: ConsoleConfig = ConsoleConfig()
    camera: ClientCameraConfig = ClientCameraConfig()
    video: ClientVideoConfig = ClientVideoConfig()
    zenoh: ZenohConfig = ZenohConfig()
    security: ClientSecurityConfig = ClientSecurityConfig()
    injection: ClientInjectionConfig = ClientInjectionConfig()
    clock: ClientClockConfig = ClientClockConfig()
    record: RecordConfig = RecordConfig()
    seed: int = Field(1, ge=0, lt=2**63)
    """The seed of the noise of `controller.kind` two_point."""

    @model_validator(mode="after")
    def _check_scouting(self) -> ClientConfig:
        if self.zenoh.scouting:
            raise ValueError("zenoh.scouting is for a server, because only servers are searched: leave it out")
        return self
