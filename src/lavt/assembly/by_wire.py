"""The construction of by-wire vehicles: a kit on a bus, or a software car in this process."""

from __future__ import annotations

from lavt.assembly.addresses import resolved_address
from lavt.assembly.dbw import load_profile
from lavt.assembly.simulators import build_software_car
from lavt.assembly.watchdog_proof import proof_rejection
from lavt.clock import Clock, pause
from lavt.config import ServerConfig, VehicleConfig
from lavt.config.dbw import DbwConfig
from lavt.domain import Now
from lavt.errors import UserError
from lavt.safety.limits import LIMITS
from lavt.vehicle.can_frame import BusGone, BusPort
from lavt.vehicle.dbw.adapter import ByWireAdapter
from lavt.vehicle.dbw.bus import CanPort
from lavt.vehicle.dbw.profile import Profile
from lavt.vehicle.dbw.vehicle import POLL_PERIOD_NS, DbwVehicle, TruthSource
from lavt.vehicle.dbw.virtual_bus import is_virtual
from lavt.vehicle.ground_truth_socket import TruthSocket
from lavt.vehicle.sim.road.road import Road
from lavt.vehicle.software_car.in_process_bus import InProcessPort
from lavt.vehicle.vehicle import Capabilities


def profile_of(config: DbwConfig) -> Profile:
    """Load the configured profile; raise `UserError` if it is invalid."""
    return load_profile(config.profile, config.dbc, config.steering_sign)


def build_inside(config: ServerConfig, road: Road, start: Now) -> DbwVehicle:
    """Build a by-wire vehicle whose kit and simulated car are in this process."""
    profile = profile_of(config.vehicle.dbw)
    car = build_software_car(config, profile, road, start.mono_ns)
    port = InProcessPort(car)
    return _build_vehicle(profile, port, car.simulator.capabilities, start, truth=port.truth)


def open_by_wire(config: ServerConfig, clock: Clock) -> DbwVehicle:
    """Open the bus of the configured kit and build its vehicle; raise `UserError` on failure."""
    dbw = config.vehicle.dbw
    profile = profile_of(dbw)
    truth = TruthSocket(resolved_address("vehicle.dbw.truth", dbw.truth)) if dbw.truth else None
    port = CanPort(dbw.interface, dbw.channel, dbw.options, clock=clock)
    return _build_vehicle(
        profile,
        port,
        capabilities_of(profile, simulated=is_simulated(dbw), truth=truth is not None),
        clock.now(),
        truth=None if truth is None else truth.take,
        inhibit_reason=inhibit_reason_of(config, profile, clock.now().wall_ns),
    )


def listen(config: ServerConfig, clock: Clock, duration_ns: int) -> tuple[int, str]:
    """Listen to the configured bus without sending; return the number of frames, and the inhibit reason.

    Raises `UserError` for an invalid profile and for a bus that cannot be opened.
    """
    dbw = config.vehicle.dbw
    profile = profile_of(dbw)
    port = CanPort(dbw.interface, dbw.channel, dbw.options, clock=clock)
    now = clock.now()
    reason = inhibit_reason_of(config, profile, now.wall_ns)
    adapter = ByWireAdapter(profile, start_ns=now.mono_ns, inhibit_reason=reason)
    frame_count, end_ns = 0, now.mono_ns + duration_ns
    try:
        while (now_ns := clock.now().mono_ns) < end_ns:
            for received in port.take(now_ns):
                adapter.receive(received.frame, now_ns)
                frame_count += 1
            pause(POLL_PERIOD_NS)
    except BusGone as error:
        return frame_count, str(error)
    finally:
        port.close()
    adapter.frames_due(end_ns)  # called to check the ages of the reports again; no frame is due
    return frame_count, adapter.state().inhibit_reason


def is_simulated(config: DbwConfig) -> bool:
    """Return whether the car is a software car: the address of its ground truth is known, and its bus is virtual."""
    return bool(config.truth) and is_virtual(config.interface, config.channel, config.options)


def capabilities_of(profile: Profile, *, simulated: bool, truth: bool) -> Capabilities:
    """Return the capabilities of a car with a kit, from the kit's profile."""
    car, limits = profile.car, profile.limits
    return Capabilities(
        simulated=simulated,
        virtual_time=False,
        ground_truth=truth,
        reset=False,
        wheelbase_m=car.wheelbase_m,
        max_steering_rad=abs(profile.road_rad(limits.steering_wheel_deg)),
        max_steering_rate_radps=abs(profile.road_rad(limits.steering_wheel_rate_degps)),
        max_acceleration_mps2=car.max_acceleration_mps2 * limits.throttle,
        max_braking_mps2=car.max_braking_mps2 * limits.brake,
    )


def inhibit_reason_of(server: ServerConfig, profile: Profile, wall_ns: int) -> str:
    """Return why the vehicle must not be armed with this config at `wall_ns`; empty: arming is allowed."""
    config = server.vehicle.dbw
    is_real = not is_virtual(config.interface, config.channel, config.options)
    if is_real and not server.security.key:
        return (
            f"{config.interface} {config.channel} may have a real car, which anyone who reaches the router could drive"
            ": make keys with `lavt keys` and set security.key and security.operators"
        )
    if is_real and not config.car:
        return "it is not known which car this is: set vehicle.dbw.car to its serial number or VIN"
    if is_real and profile.unverified:
        return (
            f"{profile.name} has {len(profile.unverified)} unverified signals, such as {profile.unverified[0]}: "
            "name the vendor's DBC in vehicle.dbw.dbc"
        )
    braking_mps2 = profile.car.max_braking_mps2 * profile.limits.brake
    if braking_mps2 < LIMITS.stop_deceleration_mps2:
        return (
            f"{profile.name} brakes with at most {braking_mps2:g} m/s2, but a safe stop needs "
            f"{LIMITS.stop_deceleration_mps2:g}: raise limits.brake if vehicle.max_braking_mps2 is correct"
        )
    return proof_rejection(config.watchdog_proof, profile, config, wall_ns)


def _build_vehicle(
    profile: Profile,
    port: BusPort,
    capabilities: Capabilities,
    start: Now,
    *,
    truth: TruthSource | None,
    inhibit_reason: str = "",
) -> DbwVehicle:
    adapter = ByWireAdapter(profile, start_ns=start.mono_ns, inhibit_reason=inhibit_reason)
    return DbwVehicle(adapter, port, capabilities, start_ns=start.mono_ns, truth=truth)


def check_by_wire(config: VehicleConfig) -> None:
    """Raise `UserError` for an invalid section `vehicle.dbw`, before any work starts."""
    profile = profile_of(config.dbw)
    if config.dbw.is_inside and profile.car.steering_sign is None:
        raise UserError(f"{profile.name} has no sign of steering to the left: set vehicle.dbw.steering_sign=1")
