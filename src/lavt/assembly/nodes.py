"""The construction of all nodes from configs; the nodes do not know whether time is real or virtual."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

from lavt.assembly.addresses import resolved_address
from lavt.assembly.cameras import client_camera
from lavt.assembly.entropy import Entropy
from lavt.assembly.fidelity import VIDEO, FidelityModel
from lavt.assembly.injection import injection_client, injection_node
from lavt.assembly.security import build_cipher
from lavt.assembly.vehicles import VehicleSetup, check_vehicle, physics_sample_times
from lavt.config import AGENT, HUMAN, ClientConfig, ControllerConfig, SafetyConfig, ServerConfig, VehicleConfig
from lavt.control.agent import AgentController
from lavt.control.client_limits import CLIENT_LIMITS
from lavt.control.compensation import VARIANTS, CompensatingController
from lavt.control.drive_controller import DriveController, make_controller
from lavt.control.human_controls import HUMAN_LIMITS, HumanControls
from lavt.control.prediction import CarModel
from lavt.control.two_point import TWO_POINT, TwoPointDriver, TwoPointSettings
from lavt.domain import NS_PER_MS, NS_PER_S, Now
from lavt.errors import UserError
from lavt.node import Node
from lavt.nodes.actuator import ActuatorNode
from lavt.nodes.agent_driver import AgentDriverNode
from lavt.nodes.camera import CameraNode
from lavt.nodes.client_session import ClientSession
from lavt.nodes.clock_sync import ClockSyncNode, ProbingClockSyncNode
from lavt.nodes.driver import DriverNode
from lavt.nodes.human_driver import HumanDriverNode
from lavt.nodes.injection import InjectionClient, InjectionNode
from lavt.nodes.page_prediction import Outline, PagePredictor
from lavt.nodes.page_watch import PageWatchNode
from lavt.nodes.payloads import DelayChoice, Route
from lavt.nodes.picture_reader import PictureReader
from lavt.nodes.receiver import ReceiverNode
from lavt.safety.gate import SafetyGate
from lavt.safety.governor import Governor, GovernorSettings
from lavt.safety.limiter import Limiter
from lavt.safety.limits import LIMITS, Limits
from lavt.transport.rtp.fec import RepairSender
from lavt.transport.rtp.jitter_buffer import JitterBuffer
from lavt.transport.rtp.rtp import Depacketizer, Packetizer
from lavt.transport.video.path_validation import TOKEN_BYTES, PathServer
from lavt.transport.video.stream_sender import StreamSender
from lavt.vehicle.camera import FrameTimes
from lavt.vehicle.vehicle import Vehicle

AGENT_ELSEWHERE = "an agent drives in a Gymnasium environment only (docs/gym.md): name another controller"


@dataclass(frozen=True, slots=True)
class ServerNodes:
    """The server's nodes; the actuator is None if it runs in a process of its own."""

    camera: CameraNode
    actuator: ActuatorNode | None
    clock_sync: ClockSyncNode
    injection: InjectionNode
    setup: VehicleSetup
    """The vehicle and its camera."""

    @property
    def all(self) -> Sequence[Node]:
        """All nodes, for a runtime."""
        actuator = () if self.actuator is None else (self.actuator,)
        return (self.camera, *actuator, self.clock_sync, self.injection)


@dataclass(frozen=True, slots=True)
class ClientNodes:
    """The client's nodes."""

    receiver: ReceiverNode
    driver: DriverNode | HumanDriverNode
    clock_sync: ClockSyncNode
    injection: InjectionClient
    page_watch: PageWatchNode | None = None
    """None: no page watches."""

    @property
    def all(self) -> Sequence[Node]:
        """All nodes, for a runtime."""
        watch = () if self.page_watch is None else (self.page_watch,)
        return (self.receiver, self.driver, self.clock_sync, self.injection, *watch)


@lru_cache(maxsize=64)  # a sweep checks each of its runs
def check_names(vehicle: VehicleConfig, controller: ControllerConfig) -> None:
    """Raise `UserError` for an unknown vehicle, route, controller or preset, before any work starts."""
    check_vehicle(vehicle)
    if controller.kind == HUMAN:
        build_controls(controller)
    elif controller.kind == AGENT:
        build_agent_controller(controller)
    else:
        build_controller(controller)


def build_controller(config: ControllerConfig, seed: int = 1, *, rate_hz: float = 30.0) -> DriveController:
    """Build the configured controller, for pictures at `rate_hz`; the noise of the human model depends on `seed`.

    Raises `UserError` with the known names for an unknown controller or preset.
    """
    if config.kind == HUMAN:
        raise UserError("a person drives by `lavt drive` or `lavt client CONFIG --human` only: name another controller")
    if config.kind == AGENT:
        raise UserError(AGENT_ELSEWHERE)
    if config.kind == TWO_POINT:
        model = TwoPointSettings(**config.two_point.model_dump())
        return TwoPointDriver(config.effective_preset(), wheelbase_m=config.wheelbase_m, settings=model, seed=seed)
    if config.kind in VARIANTS:
        variant, preset = VARIANTS[config.kind], config.effective_preset()
        if config.lookahead_s is None:
            preset = replace(preset, lookahead_s=variant.lookahead_s)
        known = config.compensation.settings_at(rate_hz)
        return CompensatingController(variant, preset, wheelbase_m=config.wheelbase_m, settings=known)
    return make_controller(config.kind, config.effective_preset(), config.wheelbase_m)


def build_agent_controller(config: ControllerConfig) -> AgentController:
    """Build the controller in an agent's place; of the preset, it uses the limits, the speed and the lookahead."""
    return AgentController(config.effective_preset(), wheelbase_m=config.wheelbase_m)


def build_controls(config: ControllerConfig) -> HumanControls:
    """Build the controls of a person; of the preset, they use the limits and the speed."""
    settings = config.effective_preset()
    limits = replace(
        HUMAN_LIMITS,
        steering_limit_rad=min(settings.steering_limit_rad, HUMAN_LIMITS.steering_limit_rad),
        lateral_limit_mps2=settings.lateral_limit_mps2,
        speed_mps=settings.speed_mps,
    )
    return HumanControls(limits, wheelbase_m=config.wheelbase_m)


def limits_of(config: SafetyConfig, *, simulated: bool) -> Limits:
    """Return the configured limits; raise `UserError` if a vehicle that is not simulated exceeds the defaults."""
    limits = replace(
        LIMITS,
        lateral_acceleration_mps2=config.lateral_acceleration_mps2,
        picture_age_limit_ns=round(config.picture_age_limit_ms * NS_PER_MS),
        stopping_distance_limit_m=config.stopping_distance_limit_m,
        speed_limit_mps=config.speed_limit_mps,
    )
    exceeds_defaults = (
        limits.lateral_acceleration_mps2 > LIMITS.lateral_acceleration_mps2
        or limits.picture_age_limit_ns > LIMITS.picture_age_limit_ns
        or limits.stopping_distance_limit_m > LIMITS.stopping_distance_limit_m
        or limits.speed_limit_mps > LIMITS.speed_limit_mps
    )
    if exceeds_defaults and not simulated:
        raise UserError(
            f"only a simulated vehicle can have safety limits beyond {LIMITS.lateral_acceleration_mps2} m/s2, "
            f"{LIMITS.picture_age_limit_ns // NS_PER_MS} ms, {LIMITS.stopping_distance_limit_m:.0f} m and "
            f"{LIMITS.speed_limit_mps * 3.6:.0f} km/h: lower safety.lateral_acceleration_mps2, "
            "safety.picture_age_limit_ms, safety.stopping_distance_limit_m and safety.speed_limit_mps"
        )
    return limits


def build_governor(config: SafetyConfig) -> Governor | None:
    """Build the speed governor; None: the config does not enable it."""
    settings = config.governor
    if not settings.enabled:
        return None
    governed = GovernorSettings(
        nominal_mps=config.speed_limit_mps if settings.nominal_mps is None else settings.nominal_mps,
        latency_limit_ns=round(settings.latency_limit_ms * NS_PER_MS),
        sight_m=settings.sight_m,
        braking_mps2=settings.braking_mps2,
        brake_delay_ns=round(settings.brake_delay_ms * NS_PER_MS),
        reaction_ns=round(settings.reaction_ms * NS_PER_MS),
        delay_margin=tuple((mps, round(delay_ms * NS_PER_MS)) for mps, delay_ms in settings.delay_margin),
        window_ns=round(settings.window_s * NS_PER_S),
        tail=settings.tail,
        rise_mps2=settings.rise_mps2,
        hysteresis_mps=settings.hysteresis_mps,
    )
    return Governor(governed, config.speed_limit_mps)


def build_server(
    config: ServerConfig,
    now: Callable[[], Now],
    entropy: Entropy,
    *,
    host: str,
    video_port: int,
    fidelity: FidelityModel = VIDEO,
    lazy_physics: bool = False,
) -> ServerNodes:
    """Build the server's nodes; the slow preparations come first, then the start time is read.

    With `lazy_physics`, a vehicle whose setup `catches_up` advances only when its state is read. Lazy physics requires
    that every wake is on time, so it is for virtual time only.
    """
    setup = fidelity.vehicle_setup(config)
    picture_sender = fidelity.sender(config)
    start = now()
    sample_times = physics_sample_times(setup.camera, start.mono_ns) if lazy_physics and setup.catches_up else ()
    actuator = None
    if setup.start is not None:
        actuator = build_actuator(
            config,
            setup.start(start),
            entropy,
            start,
            host=host,
            video_port=video_port,
            route=setup.route,
            sample_times=sample_times,
        )
    return ServerNodes(
        CameraNode(
            setup.camera,
            picture_sender,
            StreamSender(
                Packetizer(ssrc=entropy.number(32), first_sequence=entropy.number(16)),
                RepairSender(ssrc=entropy.number(32), first_sequence=entropy.number(16)),
                None if config.video.repair_packets == "auto" else config.video.repair_packets,
            ),
            PathServer(new_secret=lambda: entropy.token(32), new_cipher=build_cipher(config)),
            start_ns=start.mono_ns,
            send_to=[resolved_address("video.send_to", address) for address in config.video.send_to],
        ),
        actuator,
        ClockSyncNode(start.mono_ns),
        injection_node(config.injection, simulated=setup.simulated, video_port=video_port),
        setup,
    )


def build_actuator(
    config: ServerConfig,
    vehicle: Vehicle,
    entropy: Entropy,
    start: Now,
    *,
    host: str,
    video_port: int,
    route: Route | None,
    sample_times: Sequence[FrameTimes] = (),
) -> ActuatorNode:
    """Build the actuator of a vehicle. Physics advances at `sample_times` only or, if they are empty, at every step."""
    capabilities = vehicle.capabilities
    limits = limits_of(config.safety, simulated=capabilities.simulated)
    limiter = Limiter(
        limits,
        wheelbase_m=capabilities.wheelbase_m,
        max_steering_rad=capabilities.max_steering_rad,
        max_acceleration_mps2=capabilities.max_acceleration_mps2,
        max_braking_mps2=capabilities.max_braking_mps2,
    )
    gate = SafetyGate(
        limits,
        limiter,
        new_epoch=lambda: entropy.number(64),
        new_token=lambda: entropy.token(TOKEN_BYTES),
        host=host,
        video_port=video_port,
        instance=entropy.number(64),
        only_operator=config.experiment.operator,
        governor=build_governor(config.safety),
    )
    return ActuatorNode(
        vehicle,
        gate,
        start_ns=start.mono_ns,
        route=route,
        sample_times=sample_times,
        after_collision=config.vehicle.after_collision,
    )


def build_client(
    config: ClientConfig,
    now: Callable[[], Now],
    entropy: Entropy,
    *,
    fidelity: FidelityModel = VIDEO,
    delays: DelayChoice | None = None,
    is_watched: bool = False,
) -> ClientNodes:
    """Build the client's nodes, with `is_watched` also that of pages that watch the controller.

    `delays` are those that a person who drives can choose, if any.
    """
    controller = config.controller
    if controller.kind == HUMAN:
        build_driver: Callable[[ClientSession], DriverNode | HumanDriverNode] = _human_driver(config, fidelity, delays)
    else:
        build_driver = _agent_driver(config, fidelity) if controller.kind == AGENT else _driver(config, fidelity)
    hold_ms = config.video.reorder_hold_ms
    start = now()
    instance = entropy.number(64)
    session = ClientSession(
        config.who,
        instance,
        rearm=controller.rearm or controller.kind == HUMAN,  # a person decides by a fresh press to arm again
        start_ns=start.mono_ns,
        clear_stop=controller.clear_emergency_stop,
        waits_for_condition=config.injection.condition != "",
        take_over=config.take_over,
    )
    return ClientNodes(
        ReceiverNode(
            JitterBuffer(None if hold_ms == "auto" else round(hold_ms * NS_PER_MS)),
            Depacketizer(),
            config.video.max_bit_rate_bps,
            build_cipher(config),
            informs_driver=controller.kind == HUMAN,
        ),
        build_driver(session),
        ProbingClockSyncNode(start.mono_ns),
        injection_client(config.injection, config.who, instance, start.mono_ns),
        _page_watch(config, instance) if is_watched else None,
    )


def _page_watch(config: ClientConfig, instance: int) -> PageWatchNode:
    controller, camera = config.controller, client_camera(config.camera)
    return PageWatchNode(controller.kind, controller.effective_preset().speed_mps, camera, (config.who, instance))


def _driver(config: ClientConfig, fidelity: FidelityModel) -> Callable[[ClientSession], DriverNode]:
    """Prepare a driver node with the configured controller; return a function that builds it for a session."""
    reader, detector = PictureReader(fidelity.receiver(config)), fidelity.detector(config)
    controller = build_controller(config.controller, config.seed, rate_hz=config.camera.rate_hz)
    lane_confidence = config.controller.effective_preset().lane_confidence
    return lambda session: DriverNode(
        reader, detector, controller, session, CLIENT_LIMITS, lane_confidence=lane_confidence
    )


def _agent_driver(config: ClientConfig, fidelity: FidelityModel) -> Callable[[ClientSession], AgentDriverNode]:
    """Prepare the driver node of an agent; return a function that builds it for a session."""
    reader, detector = PictureReader(fidelity.receiver(config)), fidelity.detector(config)
    controller = build_agent_controller(config.controller)
    lane_confidence = config.controller.effective_preset().lane_confidence
    return lambda session: AgentDriverNode(
        reader, detector, controller, session, CLIENT_LIMITS, lane_confidence=lane_confidence
    )


def _human_driver(
    config: ClientConfig, fidelity: FidelityModel, delays: DelayChoice | None
) -> Callable[[ClientSession], HumanDriverNode]:
    """Prepare the driver node of a person; return a function that builds it for a session."""
    reader, controls = PictureReader(fidelity.receiver(config)), build_controls(config.controller)
    shows_latency, predictor = config.console.shows_latency, build_predictor(config)
    return lambda session: HumanDriverNode(
        reader, controls, session, CLIENT_LIMITS, delays, shows_latency=shows_latency, predictor=predictor
    )


def build_predictor(config: ClientConfig) -> PagePredictor | None:
    """Build the predictive display of a person's page; None: the config does not show it."""
    settings = config.controller.prediction
    if not settings.shown:
        return None
    model = CarModel(
        wheelbase_m=config.controller.wheelbase_m,
        steering_rate_radps=LIMITS.steering_rate_radps,
        steering_lag_s=settings.steering_lag_s,
        stop_deceleration_mps2=LIMITS.stop_deceleration_mps2,
    )
    outline = Outline(settings.front_m, settings.rear_m, settings.width_m)
    return PagePredictor(model, outline, client_camera(config.camera))
