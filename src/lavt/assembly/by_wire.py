"""By-wire vehicles of configs: a kit on a bus, or a software car inside."""

from __future__ import annotations

from lavt.assembly.addresses import resolved_address
from lavt.assembly.dbw import load_profile
from lavt.assembly.software_car import build_software_car
from lavt.assembly.watchdog_proof import proof_rejection
from lavt.clock import Clock, pause
from lavt.config import ServerConfig, VehicleConfig
from lavt.config.dbw import DbwConfig
from lavt.domain import Now
from lavt.errors import UserError
from lavt.safety.limits import LIMITS
from lavt.vehicle.can_frame import BusGone, BusPort
from lavt.vehicle.dbw.adapter import ByWireAdapter
from lavt.vehicle.dbw.bus import CanPort, is_virtual
from lavt.vehicle.dbw.profile import Profile
from lavt.vehicle.dbw.vehicle import HEAR_PERIOD_NS, DbwVehicle, Truth
from lavt.vehicle.ground_truth_socket import TruthSocket
from lavt.vehicle.sim.road.road import Road
from lavt.vehicle.software_car.in_process_bus import InProcessPort
from lavt.vehicle.vehicle import Capabilities


def profile_of(config: DbwConfig) -> Profile:
    """Load the configured profile; raises `UserError`."""
    return load_profile(config.profile, config.dbc, config.steering_sign)


def inside(config: ServerConfig, road: Road, start: Now) -> DbwVehicle:
    """Make a by-wire vehicle whose kit and car are in this process; it is a simulator's in all else."""
    profile = profile_of(config.vehicle.dbw)
    car = build_software_car(config, profile, road, start.mono_ns)
    port = InProcessPort(car)
    return _vehicle(profile, port, car.simulator.capabilities, start, truth=port.truth)


def open_by_wire(config: VehicleConfig, clock: Clock) -> DbwVehicle:
    """Open the bus of the configured kit, which other processes may be on; raises `UserError`."""
    requested = config.dbw
    profile = profile_of(requested)
    truth = TruthSocket(resolved_address("vehicle.dbw.truth", requested.truth)) if requested.truth else None
    port = CanPort(requested.interface, requested.channel, requested.options, clock=clock)
    return _vehicle(
        profile,
        port,
        capabilities_of(profile, simulated=is_simulated(requested), truth=truth is not None),
        clock.now(),
        truth=None if truth is None else truth.take,
        inhibit_reason=inhibit_reason_of(requested, profile),
    )


def listen(config: VehicleConfig, clock: Clock, duration_ns: int) -> tuple[int, str]:
    """Listen to the configured bus for so long, and send nothing: how many frames came, and why nothing can be driven.

    Raises `UserError` for a profile that is none and a bus that cannot be opened.
    """
    requested = config.dbw
    profile = profile_of(requested)
    port = CanPort(requested.interface, requested.channel, requested.options, clock=clock)
    adapter = ByWireAdapter(profile, start_ns=clock.now().mono_ns, inhibit_reason=inhibit_reason_of(requested, profile))
    heard, end_ns = 0, clock.now().mono_ns + duration_ns
    try:
        while (now_ns := clock.now().mono_ns) < end_ns:
            for each in port.take(now_ns):
                adapter.receive(each.frame, now_ns)
                heard += 1
            pause(HEAR_PERIOD_NS)
    except BusGone as gone:
        return heard, str(gone)
    finally:
        port.close()
    adapter.engage(wanted=False, now_ns=end_ns)
    return heard, adapter.state().inhibit_reason


def is_simulated(config: DbwConfig) -> bool:
    """Whether the car can only be a software car: it tells the truth, and no bus leaves this machine."""
    return bool(config.truth) and is_virtual(config.interface, config.channel)


def capabilities_of(profile: Profile, *, simulated: bool, truth: bool) -> Capabilities:
    """Say what a car with this kit can do, by its profile."""
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


def inhibit_reason_of(config: DbwConfig, profile: Profile) -> str:
    """Say why a vehicle must not be armed as it is configured; empty: it may."""
    if profile.car.steering_sign is None:
        return "which sign steers left is not known: try it with the wheels up, and set vehicle.dbw.steering_sign"
    if profile.unverified and not is_virtual(config.interface, config.channel):
        return (
            f"{profile.name} has unverified signals, {profile.unverified[0]} the first of {len(profile.unverified)}: "
            "name the vendor's DBC in vehicle.dbw.dbc"
        )
    braking_mps2 = profile.car.max_braking_mps2 * profile.limits.brake
    if braking_mps2 < LIMITS.stop_deceleration_mps2:
        return (
            f"{profile.name} brakes with {braking_mps2:g} m/s2 at most, and a safe stop needs "
            f"{LIMITS.stop_deceleration_mps2:g}: raise limits.brake, if vehicle.max_braking_mps2 is right"
        )
    return proof_rejection(config.watchdog_proof, profile, config)


def _vehicle(
    profile: Profile,
    port: BusPort,
    capabilities: Capabilities,
    start: Now,
    *,
    truth: Truth | None,
    inhibit_reason: str = "",
) -> DbwVehicle:
    adapter = ByWireAdapter(profile, start_ns=start.mono_ns, inhibit_reason=inhibit_reason)
    return DbwVehicle(adapter, port, capabilities, start_ns=start.mono_ns, truth=truth)


def check_by_wire(config: VehicleConfig) -> None:
    """Raise `UserError` for what is wrong with the section `vehicle.dbw`, before any work is begun."""
    profile = profile_of(config.dbw)
    if config.dbw.is_inside and profile.car.steering_sign is None:
        raise UserError(f"{profile.name} leaves open which sign steers left: set vehicle.dbw.steering_sign=1")
