"""The one place where nodes are made of configs; nothing below it asks whether time is real."""

from __future__ import annotations

import math
import secrets
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from importlib.metadata import entry_points
from pathlib import Path
from typing import Protocol

import numpy as np

from lavt.config import (
    CalibrationConfig,
    CameraConfig,
    ClientCameraConfig,
    ClientConfig,
    ControllerConfig,
    RunConfig,
    SafetyConfig,
    ServerConfig,
    VehicleConfig,
    parse_config,
    read_yaml,
)
from lavt.control.drive_controller import make_controller
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
from lavt.nodes.driver import DriverNode
from lavt.nodes.receiver import ReceiverNode
from lavt.nodes.reports import Route
from lavt.perception.calibration import CalibratedCamera, calibrated
from lavt.perception.lane_detector import LaneDetector
from lavt.streams import stream, stream_key
from lavt.transport.h264 import Decoder, Encoder
from lavt.transport.reorder import ReorderBuffer
from lavt.transport.rtp import Depacketizer, Packetizer
from lavt.transport.udp_link import look_up
from lavt.transport.video_path import TOKEN_BYTES, PathServer
from lavt.vehicle.camera import Camera
from lavt.vehicle.sim.camera import SimCamera
from lavt.vehicle.sim.road import load_road
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
        math.radians(config.pitch_deg),
    )  # fmt: skip


def calibrated_camera(config: CalibrationConfig) -> CalibratedCamera:
    """Give the camera of a calibration."""
    middle_px = ((config.width_px - 1) / 2, (config.height_px - 1) / 2)
    if config.field_of_view_deg is None:
        focal_px = (config.fx_px or 0.0, config.fy_px or 0.0)
        middle_px = (config.cx_px or 0.0, config.cy_px or 0.0)
    else:
        focal_px = (config.width_px / 2 / math.tan(math.radians(config.field_of_view_deg) / 2),) * 2
    return CalibratedCamera(
        config.width_px, config.height_px, focal_px, middle_px, config.x_m, config.y_m, config.z_m,
        math.radians(config.yaw_deg), math.radians(config.pitch_deg), math.radians(config.roll_deg),
        config.distortion, config.lens == "fisheye",
    )  # fmt: skip


def camera_of_file(path: Path) -> CalibratedCamera:
    """Read a camera from a calibration, or take that of a run's or a client's config; raises `UserError`."""
    data = read_yaml(path)
    if not data.keys() & {*RunConfig.model_fields, *ClientConfig.model_fields}:
        return calibrated_camera(parse_config(CalibrationConfig, data, str(path)))
    section = data.get("camera", {})
    if not isinstance(section, dict):
        raise UserError(f"{path}: camera must hold keys and values, not {section!r}")
    return client_camera(parse_config(ClientCameraConfig, section, f"{path}: camera"))


def client_camera(config: ClientCameraConfig) -> CalibratedCamera:
    """Give the camera as the client knows it: its calibration where there is one, else what the config says."""
    if not config.calibration:
        return calibrated(camera_model(config))
    path = Path(config.calibration)
    said = config.model_fields_set - {"calibration", "rate_hz", "width_px", "height_px"}
    if said:
        raise UserError(f"camera.calibration says everything: leave out camera.{', camera.'.join(sorted(said))}")
    camera = calibrated_camera(parse_config(CalibrationConfig, read_yaml(path), str(path)))
    sizes = {"width_px": camera.width_px, "height_px": camera.height_px}
    for key in config.model_fields_set & sizes.keys():
        if getattr(config, key) != sizes[key]:
            raise UserError(
                f"camera.{key} is {getattr(config, key)}, but {path} was made for {sizes[key]}: use its size"
            )
    return camera


def build_simulator(config: ServerConfig) -> Plant:
    """Make the built-in simulator and its camera."""
    road = load_road(config.vehicle.route)
    period_ns = round(NS_PER_S / config.camera.rate_hz)
    camera = SimCamera(
        model=camera_model(config.camera),
        rate_hz=config.camera.rate_hz,
        phase_ns=int(stream(config.seed, "camera phase").integers(period_ns)),
        road=road,
        seed=config.seed,
        scenery=config.vehicle.scenery,
    )
    camera.prepare()
    stations_m = np.arange(0.0, road.length_m, ROUTE_STEP_M)
    x_m, y_m, _, _ = road.point(stations_m)
    points = tuple(zip(x_m.tolist(), y_m.tolist(), strict=True))
    return Plant(
        camera,
        lambda start: Simulator(road=road, seed=config.seed, start_mono_ns=start.mono_ns),
        Route(config.vehicle.route, road.length_m, points),
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


@lru_cache(maxsize=64)  # a sweep asks for each of its runs
def check_names(vehicle: VehicleConfig, controller: ControllerConfig) -> None:
    """Raise `UserError` for a vehicle, route, controller or preset that does not exist, before any work is begun."""
    _vehicle(vehicle.kind)
    if vehicle.kind == "simulator":
        load_road(vehicle.route)
    make_controller(controller.kind, controller.preset, controller.wheelbase_m)


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


def build_server(
    config: ServerConfig, now: Callable[[], Now], entropy: Entropy, *, host: str, video_port: int
) -> ServerNodes:
    """Make the server's nodes; their time begins when everything that is slow has been prepared."""
    plant = build_plant(config)
    video, camera = config.video, config.camera
    encoder = Encoder(
        width_px=camera.width_px,
        height_px=camera.height_px,
        rate_hz=camera.rate_hz,
        bit_rate_bps=video.bit_rate_bps,
        gop_frames=video.gop_frames,
        buffer_s=video.buffer_ms / 1000,
    )
    start = now()
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
            encoder,
            Packetizer(entropy.number(32), entropy.number(16)),
            PathServer(lambda: entropy.token(32)),
            start_ns=start.mono_ns,
            send_to=[resolved_address("video.send_to", each) for each in video.send_to],
        ),
        ActuatorNode(vehicle, gate, start_ns=start.mono_ns, route=plant.route),
        ClockSyncNode(start.mono_ns),
    )


def build_client(config: ClientConfig, now: Callable[[], Now], entropy: Entropy) -> ClientNodes:
    """Make the client's nodes."""
    controller = config.controller
    camera = client_camera(config.camera)
    detector = LaneDetector(camera)
    lane_keeper = make_controller(controller.kind, controller.preset, controller.wheelbase_m)
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
            Decoder(),
            detector,
            lane_keeper,
            session,
            CLIENT_LIMITS,
            picture_shape=(camera.height_px, camera.width_px, 3),
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
