"""The one place where nodes are made of configs; nothing below it asks whether time is real."""

from __future__ import annotations

import math
import secrets
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from importlib.metadata import entry_points
from typing import Protocol

import numpy as np

from lavt.config import CameraConfig, ClientConfig, ControllerConfig, SafetyConfig, ServerConfig, VehicleConfig
from lavt.control.drive_controller import DriveController, find_preset, make_controller
from lavt.control.limiter import Limiter
from lavt.control.limits import CLIENT_LIMITS, LIMITS, Limits
from lavt.control.safety import SafetyGate
from lavt.domain import NS_PER_MS, NS_PER_S, CameraModel, Now
from lavt.errors import UserError
from lavt.node import Node
from lavt.nodes.actuator import ActuatorNode
from lavt.nodes.camera import CameraNode
from lavt.nodes.client_session import ClientSession
from lavt.nodes.clock_sync import ClockSyncNode
from lavt.nodes.driver import Detector, DriverNode
from lavt.nodes.receiver import ReceiverNode
from lavt.nodes.reports import Route
from lavt.perception.lane_detector import GRID, LaneDetector
from lavt.perception.lane_given import GivenLane
from lavt.streams import stream, stream_key
from lavt.transport.h264 import Decoder, Encoder
from lavt.transport.pictures import (
    HandedOver,
    LaneReceiver,
    LaneSender,
    PictureReceiver,
    PictureSender,
    VideoReceiver,
    VideoSender,
)
from lavt.transport.reorder import ReorderBuffer
from lavt.transport.rtp import Depacketizer, Packetizer
from lavt.transport.udp_link import look_up
from lavt.transport.video_path import TOKEN_BYTES, PathServer
from lavt.vehicle.camera import Camera, FrameTimes, TimedCamera
from lavt.vehicle.sim.camera import SimCamera
from lavt.vehicle.sim.cars import named_car
from lavt.vehicle.sim.dynamics import CarParameters
from lavt.vehicle.sim.lane_camera import LaneCamera
from lavt.vehicle.sim.road import Road, load_road
from lavt.vehicle.sim.simulator import Simulator
from lavt.vehicle.vehicle import Vehicle

CUSTOM_VEHICLES = "lavt.vehicles"
"""Entry points of this group are functions like `build_simulator`: a user adds a vehicle without touching LAVT."""

ROUTE_STEP_M = 1.0


class Entropy(Protocol):
    """Where epochs, tokens and stream identifiers come from."""

    def number(self, bits: int) -> int:
        """Give a number of so many random bits."""
        ...

    def token(self, length: int) -> bytes:
        """Give so many random bytes."""
        ...


class MachineEntropy:
    """The operating system's randomness."""

    def number(self, bits: int) -> int:
        """Give a number of so many random bits."""
        return secrets.randbits(bits)

    def token(self, length: int) -> bytes:
        """Give so many random bytes."""
        return secrets.token_bytes(length)


class SeededEntropy:
    """Numbers that repeat with the seed: for virtual time, where nobody is kept out."""

    def __init__(self, seed: int, name: str) -> None:
        self._generator = stream(seed, f"{name} entropy")

    def number(self, bits: int) -> int:
        """Give a number of so many random bits."""
        return int.from_bytes(self.token(bits // 8), "little")

    def token(self, length: int) -> bytes:
        """Give so many random bytes."""
        return self._generator.bytes(length)


@dataclass(frozen=True, slots=True)
class Plant:
    """A vehicle with its camera, and the road it drives where one is known.

    `start` begins its time: building takes seconds, and a vehicle's time must not run before the loop does.
    """

    camera: Camera
    start: Callable[[Now], Vehicle]
    route: Route | None
    catches_up: bool = False
    """The vehicle loses nothing when `advance` is called later than it asked for."""


@dataclass(frozen=True, slots=True)
class ServerNodes:
    """The server's nodes."""

    camera: CameraNode
    actuator: ActuatorNode
    clock_sync: ClockSyncNode

    @property
    def all(self) -> Sequence[Node]:
        """All nodes, for a runtime."""
        return (self.camera, self.actuator, self.clock_sync)


@dataclass(frozen=True, slots=True)
class ClientNodes:
    """The client's nodes."""

    receiver: ReceiverNode
    driver: DriverNode
    clock_sync: ClockSyncNode

    @property
    def all(self) -> Sequence[Node]:
        """All nodes, for a runtime."""
        return (self.receiver, self.driver, self.clock_sync)


def camera_model(config: CameraConfig) -> CameraModel:
    """Geometry of the configured camera."""
    return CameraModel(
        config.width_px, config.height_px, math.radians(config.field_of_view_deg), config.x_m, config.z_m,
        math.radians(config.pitch_deg), config.y_m, math.radians(config.yaw_deg), math.radians(config.roll_deg),
    )  # fmt: skip


def car_of(config: VehicleConfig) -> CarParameters:
    """Take the configured car with the configured lags; raises `UserError` naming the known cars."""
    given = {
        "steering_dead_time_s": config.steering_dead_time_ms,
        "steering_lag_s": config.steering_lag_ms,
        "pedal_dead_time_s": config.pedal_dead_time_ms,
        "throttle_lag_s": config.throttle_lag_ms,
        "brake_lag_s": config.brake_lag_ms,
    }
    return replace(named_car(config.car), **{name: each / 1000 for name, each in given.items() if each is not None})


def build_simulator(config: ServerConfig) -> Plant:
    """Make the built-in simulator and its camera."""
    road = load_road(config.vehicle.route)
    camera = SimCamera(
        model=camera_model(config.camera),
        rate_hz=config.camera.rate_hz,
        phase_ns=camera_phase_ns(config),
        road=road,
        seed=config.seed,
        scenery=config.vehicle.scenery,
        light=config.vehicle.light,
        exposure_ns=round(config.camera.exposure_ms * NS_PER_MS),
        sensor_delay_ns=round(config.camera.sensor_delay_ms * NS_PER_MS),
    )
    camera.prepare()
    return _simulated(config, road, camera)


def build_unpictured(config: ServerConfig) -> Plant:
    """Make the built-in simulator with a camera that gives the lane itself; other vehicles' roads are not known."""
    if config.vehicle.kind != "simulator":
        raise UserError(
            f"fidelity geometry needs the road, which only the built-in simulator tells: choose vehicle.kind simulator "
            f"instead of {config.vehicle.kind!r}, or another fidelity"
        )
    road = load_road(config.vehicle.route)
    camera = LaneCamera(
        model=camera_model(config.camera),
        rate_hz=config.camera.rate_hz,
        phase_ns=camera_phase_ns(config),
        road=road,
        near_m=GRID.near_m,
        far_m=GRID.far_m,
        half_width_m=GRID.half_width_m,
        exposure_ns=round(config.camera.exposure_ms * NS_PER_MS),
        sensor_delay_ns=round(config.camera.sensor_delay_ms * NS_PER_MS),
    )
    return _simulated(config, road, camera)


def camera_phase_ns(config: ServerConfig) -> int:
    """Draw when the camera's first frame is taken after the start: anywhere within its period."""
    return int(stream(config.seed, "camera phase").integers(round(NS_PER_S / config.camera.rate_hz)))


def _simulated(config: ServerConfig, road: Road, camera: Camera) -> Plant:
    stations_m = np.arange(0.0, road.length_m, ROUTE_STEP_M)
    x_m, y_m, _, _ = road.point(stations_m)
    points = tuple(zip(x_m.tolist(), y_m.tolist(), strict=True))
    return Plant(
        camera,
        lambda start: Simulator(
            road=road,
            seed=config.seed,
            start_mono_ns=start.mono_ns,
            parameters=car_of(config.vehicle),
            goes_on=config.vehicle.after_collision == "continue",
            limit_s=config.vehicle.time_limit_s,
        ),
        Route(config.vehicle.route, road.length_m, points),
        catches_up=True,
    )


VEHICLES: dict[str, Callable[[ServerConfig], Plant]] = {"simulator": build_simulator}


def build_plant(config: ServerConfig) -> Plant:
    """Make the configured vehicle with its camera; raises `UserError` naming the known kinds."""
    return _vehicle(config.vehicle.kind)(config)


def _vehicle(kind: str) -> Callable[[ServerConfig], Plant]:
    if kind in VEHICLES:
        return VEHICLES[kind]
    custom = {entry.name: entry for entry in entry_points(group=CUSTOM_VEHICLES)}
    if kind not in custom:
        raise UserError(f"there is no vehicle {kind!r}: the known kinds are {', '.join([*VEHICLES, *custom])}")
    build: Callable[[ServerConfig], Plant] = custom[kind].load()
    return build


@dataclass(frozen=True, slots=True)
class Fidelity:
    """How the pictures of a run come about and cross the network: what is made for it on both sides."""

    plant: Callable[[ServerConfig], Plant]
    sender: Callable[[ServerConfig], PictureSender]
    receiver: Callable[[ClientConfig], PictureReceiver]
    detector: Callable[[ClientConfig], Detector]


def _video_sender(config: ServerConfig) -> VideoSender:
    video, camera = config.video, config.camera
    return VideoSender(
        Encoder(
            width_px=camera.width_px,
            height_px=camera.height_px,
            rate_hz=camera.rate_hz,
            bit_rate_bps=video.bit_rate_bps,
            gop_frames=video.gop_frames,
            buffer_s=video.buffer_ms / 1000,
        )
    )


def _video_receiver(config: ClientConfig) -> VideoReceiver:
    return VideoReceiver(Decoder(), (config.camera.height_px, config.camera.width_px, 3))


def _lane_detector(config: ClientConfig) -> LaneDetector:
    return LaneDetector(camera_model(config.camera))


VIDEO = Fidelity(build_plant, _video_sender, _video_receiver, _lane_detector)


def _pixels() -> Fidelity:
    between = HandedOver()
    return Fidelity(build_plant, lambda _: between, lambda _: between, _lane_detector)


def _geometry() -> Fidelity:
    return Fidelity(build_unpictured, lambda _: LaneSender(), lambda _: LaneReceiver(), lambda _: GivenLane())


FIDELITIES: dict[str, Callable[[], Fidelity]] = {
    "video": lambda: VIDEO,
    "pixels": _pixels,
    "geometry": _geometry,
}
"""By the config's `fidelity`: what to make for one run, whose two sides may share something."""


@lru_cache(maxsize=64)  # a sweep asks for each of its runs
def check_names(vehicle: VehicleConfig, controller: ControllerConfig) -> None:
    """Raise `UserError` for a vehicle, route, controller or preset that does not exist, before any work is begun."""
    _vehicle(vehicle.kind)
    if vehicle.kind == "simulator":
        load_road(vehicle.route)
        car_of(vehicle)
    build_controller(controller)


def build_controller(config: ControllerConfig) -> DriveController:
    """Make the configured controller; raises `UserError` naming the known ones and the known presets."""
    return make_controller(config.kind, replace(find_preset(config.preset), **config.changes), config.wheelbase_m)


def limits_of(config: SafetyConfig, *, simulated: bool) -> Limits:
    """Take the configured limits; only a simulated vehicle may have wider ones than the default."""
    limits = replace(
        LIMITS,
        lateral_acceleration_mps2=config.lateral_acceleration_mps2,
        picture_age_limit_ns=round(config.picture_age_limit_ms * NS_PER_MS),
    )
    wider = (
        limits.lateral_acceleration_mps2 > LIMITS.lateral_acceleration_mps2
        or limits.picture_age_limit_ns > LIMITS.picture_age_limit_ns
    )
    if wider and not simulated:
        raise UserError(
            f"only a simulated vehicle may have safety limits beyond {LIMITS.lateral_acceleration_mps2} m/s2 and "
            f"{LIMITS.picture_age_limit_ns // NS_PER_MS} ms: lower safety.lateral_acceleration_mps2 and "
            "safety.picture_age_limit_ms"
        )
    return limits


def looks_of(camera: Camera, start_ns: int) -> list[FrameTimes]:
    """Tell when the vehicle's pose is needed: when the shutter opens and, where the camera has an exposure, closes."""
    opens = FrameTimes(start_ns + camera.phase_ns, camera.rate_hz)
    exposure_ns = camera.exposure_ns if isinstance(camera, TimedCamera) else 0
    return [opens, replace(opens, first_ns=opens.first_ns + exposure_ns)] if exposure_ns else [opens]


def build_server(
    config: ServerConfig,
    now: Callable[[], Now],
    entropy: Entropy,
    *,
    host: str,
    video_port: int,
    fidelity: Fidelity = VIDEO,
    lives_on_demand: bool = False,
) -> ServerNodes:
    """Make the server's nodes; their time begins when everything that is slow has been prepared.

    With `lives_on_demand` a vehicle that catches up lives on only when somebody looks: where no wake is ever late, in
    virtual time.
    """
    plant = fidelity.plant(config)
    pictures = fidelity.sender(config)
    start = now()
    looks = looks_of(plant.camera, start.mono_ns) if lives_on_demand and plant.catches_up else ()
    vehicle = plant.start(start)
    able = vehicle.capabilities
    limits = limits_of(config.safety, simulated=able.simulated)
    limiter = Limiter(
        limits,
        wheelbase_m=able.wheelbase_m,
        max_steering_rad=able.max_steering_rad,
        max_braking_mps2=able.max_braking_mps2,
    )
    gate = SafetyGate(
        limits,
        limiter,
        new_epoch=lambda: entropy.number(64),
        new_token=lambda: entropy.token(TOKEN_BYTES),
        host=host,
        video_port=video_port,
    )
    return ServerNodes(
        CameraNode(
            plant.camera,
            pictures,
            Packetizer(entropy.number(32), entropy.number(16)),
            PathServer(lambda: entropy.token(32)),
            start_ns=start.mono_ns,
            send_to=[resolved_address("video.send_to", each) for each in config.video.send_to],
        ),
        ActuatorNode(
            vehicle,
            gate,
            start_ns=start.mono_ns,
            route=plant.route,
            looks=looks,
            after_collision=config.vehicle.after_collision,
        ),
        ClockSyncNode(start.mono_ns),
    )


def build_client(
    config: ClientConfig, now: Callable[[], Now], entropy: Entropy, *, fidelity: Fidelity = VIDEO
) -> ClientNodes:
    """Make the client's nodes."""
    controller = config.controller
    pictures, detector = fidelity.receiver(config), fidelity.detector(config)
    drive_controller = build_controller(controller)
    start = now()
    session = ClientSession(
        config.who,
        entropy.number(64),
        rearm=controller.rearm,
        start_ns=start.mono_ns,
        clear_stop=controller.clear_emergency_stop,
    )
    return ClientNodes(
        ReceiverNode(ReorderBuffer(round(config.video.reorder_hold_ms * NS_PER_MS)), Depacketizer()),
        DriverNode(
            pictures,
            detector,
            drive_controller,
            session,
            CLIENT_LIMITS,
        ),
        ClockSyncNode(start.mono_ns),
    )


def parse_address(key: str, text: str) -> tuple[str, int]:
    """Read `host:port`; raises `UserError` naming `key`."""
    host, colon, port = text.rpartition(":")
    if not colon or not host or not (port.isascii() and port.isdigit()) or len(port) > 5 or int(port) > 65535:
        raise UserError(f"{key}: {text!r} is not an address: write it as host:port")
    return host, int(port)


def resolved_address(key: str, text: str) -> tuple[str, int]:
    """Read `host:port` and look the host up; raises `UserError` naming `key`."""
    host, port = parse_address(key, text)
    return look_up(key, host), port


def run_seed(seed: int, route: str, repetition: int) -> int:
    """Seed of one repetition on a route: the same under every condition, so that conditions are paired.

    53 bits, because that is as far as JSON's readers agree on numbers.
    """
    return stream_key(seed, f"run {route} {repetition}") & (2**53 - 1)
