"""The connection to a CARLA server, and its world: the version, the town, the settings, and a killed run's actors.

A server of another version aborts the client's process, so the version is asked for before anything else.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any, Final, NamedTuple

from lavt.errors import UserError, VehicleError
from lavt.vehicle.carla.frames import CarlaPose
from lavt.vehicle.carla.library import SUPPORTED
from lavt.vehicle.carla.probe import NoServerError, ask_version
from lavt.vehicle.carla.settings import CarlaSettings

SUBSTEP_S: Final = 0.01
"""The longest step of CARLA's physics."""
MIN_SUBSTEPS, MAX_SUBSTEPS = 10, 16
OTHER_CLIENT_WAIT_S: Final = 1.0
"""A synchronous world that does not tick for this long is ticked by nobody."""
ADDRESS_KEYS: Final = "vehicle.carla.host and vehicle.carla.port"
MAX_VERSION_LENGTH: Final = 30
"""A server's version is shown up to this length."""


_all_clients: list[Any] = []
"""All clients of this process, which are never freed: if a thread of the package `carla` happens to free the client,
the process is aborted."""
_usable_clients: dict[tuple[str, int], Any] = {}
"""The newest client of each address, which the sessions of a sweep share."""


class OpenedWorld(NamedTuple):
    """A world that this client ticks, with what it restores in the end."""

    world: Any
    settings: Any
    weather: Any
    is_asynchronous: bool = False

    def restore(self, *, has_own_weather: bool) -> None:
        """Restore the settings and the weather; the world then runs as it did before.

        If another client has made an asynchronous world synchronous, it stays so: its car could drive on.
        """
        if has_own_weather:
            self.world.set_weather(self.weather)
        if self.world.get_settings().synchronous_mode != self.is_asynchronous:
            self.world.apply_settings(self.settings)


@contextmanager
def sentences(settings: CarlaSettings, work: str) -> Iterator[None]:
    """Turn an error of the wheel into a `VehicleError` that says that the server did not do some `work`."""
    try:
        yield
    except RuntimeError as error:
        forget_client(settings)
        reason = " ".join(str(error).split())
        raise VehicleError(
            f"the CARLA server at {settings.address} did not {work} ({reason}): check that it runs, or restart it"
        ) from None


def check_server(settings: CarlaSettings) -> None:
    """Raise `UserError` if no server answers, or one of another version; the package `carla` is not used."""
    try:
        _check_version(ask_version(settings.host, settings.port, settings.timeout_s), settings)
    except NoServerError as error:
        raise _no_server(settings, str(error)) from None


def connect(carla: Any, settings: CarlaSettings) -> Any:
    """Return a client; raise `UserError` if no server answers, or one of another version."""
    check_server(settings)
    client = _find_client(carla, settings)
    try:
        _check_version(client.get_server_version(), settings)
    except RuntimeError:
        raise _no_server(settings, f"no answer came within {settings.timeout_s:g} s") from None
    return client


def _check_version(found: str | None, settings: CarlaSettings) -> None:
    """Raise `UserError` for another version than the supported one; None is a version that is not known yet."""
    if found is None or found == SUPPORTED:
        return
    shown = repr(found if len(found) <= MAX_VERSION_LENGTH else f"{found[:MAX_VERSION_LENGTH]}...")
    raise UserError(
        f"the CARLA server at {settings.address} has version {shown}, but LAVT supports {SUPPORTED} only: start "
        f"CARLA {SUPPORTED}, or set {ADDRESS_KEYS}"
    )


def _no_server(settings: CarlaSettings, reason: str) -> UserError:
    forget_client(settings)
    return UserError(
        f"no CARLA server answers at {settings.address}, because {reason}: start CARLA {SUPPORTED} there, or give "
        "another host or port (vehicle.carla.host, vehicle.carla.port)"
    )


def forget_client(settings: CarlaSettings) -> None:
    """Make the next session connect anew, because the server failed."""
    _usable_clients.pop((settings.host, settings.port), None)


def _find_client(carla: Any, settings: CarlaSettings) -> Any:
    """Return the client of an address, with the timeout of these settings."""
    address = (settings.host, settings.port)
    if address not in _usable_clients:
        _usable_clients[address] = carla.Client(*address)
        _all_clients.append(_usable_clients[address])
    _usable_clients[address].set_timeout(settings.timeout_s)
    return _usable_clients[address]


def open_world(carla: Any, client: Any, settings: CarlaSettings) -> OpenedWorld:
    """Load the town, take over the ticks, and remove what a killed run left.

    Raises `UserError` if another client ticks the world, or if there is no such town or weather.
    """
    weather = _find_weather(carla, settings.weather) if settings.weather else None
    with sentences(settings, "open its world"):
        world = client.get_world()
        if world.get_settings().synchronous_mode:
            _check_nobody_ticks(world, settings)
        world = _load_town(client, world, settings)
        before = world.get_settings()
        opened = OpenedWorld(world, _settings_to_restore(carla, before), world.get_weather())
        may_run = not before.synchronous_mode
        try:
            world.apply_settings(_own_settings(carla, before, settings))
            world.tick(settings.timeout_s)  # without a tick, a frozen world shows no actors
            _remove_leftovers(carla, world, settings)
            may_run = True
            if weather is not None:
                world.set_weather(weather)
            if settings.is_asynchronous:  # only now, because a killed run's car could drive on
                world.apply_settings(_asynchronous(carla, world.get_settings()))
                opened = opened._replace(is_asynchronous=True)
        except BaseException:
            if may_run:  # a world that was found frozen may hold the car of a killed run, which would drive on
                with suppress(RuntimeError):
                    opened.restore(has_own_weather=False)
            raise
    return opened


def to_transform(carla: Any, pose: CarlaPose) -> Any:
    """Return a pose as the package's transform."""
    return carla.Transform(
        carla.Location(pose.x_m, pose.y_m, pose.z_m), carla.Rotation(pose.pitch_deg, pose.yaw_deg, pose.roll_deg)
    )


def to_pose(transform: Any) -> CarlaPose:
    """Return the package's transform as a pose."""
    location, rotation = transform.location, transform.rotation
    return CarlaPose(location.x, location.y, location.z, rotation.pitch, rotation.yaw, rotation.roll)


def town_of(world: Any) -> str:
    """Return the name of a world's town."""
    return str(world.get_map().name).rpartition("/")[2]


def _check_nobody_ticks(world: Any, settings: CarlaSettings) -> None:
    try:
        world.wait_for_tick(OTHER_CLIENT_WAIT_S)
    except RuntimeError:  # no tick came
        return
    raise UserError(
        f"another client ticks the CARLA server at {settings.address}: end it, because only one client can, or set "
        f"{ADDRESS_KEYS}"
    )


def _load_town(client: Any, world: Any, settings: CarlaSettings) -> Any:
    town = settings.town
    if not town or town_of(world) == town:
        return world
    known = sorted(path.rpartition("/")[2] for path in client.get_available_maps())
    if town not in known:
        raise UserError(
            f"the CARLA server at {settings.address} has no town {town!r}: set vehicle.carla.town to one of "
            f"{', '.join(known)}"
        )
    client.set_timeout(settings.load_timeout_s)
    world = client.load_world(town)
    client.set_timeout(settings.timeout_s)
    if town_of(world) != town:
        raise VehicleError(f"the CARLA server loaded the town {town_of(world)!r} instead of {town!r}: restart it")
    return world


def _own_settings(carla: Any, before: Any, settings: CarlaSettings) -> Any:
    own = _copied(carla, before)
    own.synchronous_mode = True
    own.fixed_delta_seconds = settings.tick_s
    own.substepping = True
    own.max_substep_delta_time = SUBSTEP_S
    own.max_substeps = min(MAX_SUBSTEPS, max(MIN_SUBSTEPS, math.ceil(settings.tick_s / SUBSTEP_S)))
    own.no_rendering_mode = False
    return own


def _asynchronous(carla: Any, own: Any) -> Any:
    """Return settings with which the world runs by itself, in the time of its machine."""
    running = _copied(carla, own)
    running.synchronous_mode = False
    running.fixed_delta_seconds = None
    running.max_substeps = MAX_SUBSTEPS
    return running


def _settings_to_restore(carla: Any, found: Any) -> Any:
    """Return the settings that were found; but a world that a killed client left frozen shall run again.

    Nobody ticked the world when it was found, so a synchronous world was frozen.
    """
    restored = _copied(carla, found)
    if found.synchronous_mode:
        restored.synchronous_mode = False
        restored.fixed_delta_seconds = None
    return restored


def _copied(carla: Any, found: Any) -> Any:
    copy = carla.WorldSettings()
    for name in dir(found):
        if not name.startswith("_"):
            setattr(copy, name, getattr(found, name))
    return copy


def _find_weather(carla: Any, name: str) -> Any:
    weather = getattr(carla.WeatherParameters, name, None)
    if not isinstance(weather, carla.WeatherParameters):
        raise UserError(f"CARLA has no weather {name!r}: set vehicle.carla.weather to one such as ClearNoon")
    return weather


def _remove_leftovers(carla: Any, world: Any, settings: CarlaSettings) -> None:
    """Destroy the actors of a killed run: those with our role name, the newest first; brake a car that stays.

    The car is braked first: a control is not answered, and is lost if the process ends before another request is.
    """
    ours = [actor for actor in world.get_actors() if actor.attributes.get("role_name") == settings.role_name]
    for actor in sorted(ours, key=lambda actor: actor.id, reverse=True):
        if actor.type_id.startswith("vehicle."):
            actor.apply_control(carla.VehicleControl(brake=1.0, hand_brake=True))
        if not actor.destroy():
            raise VehicleError(
                f"the CARLA server at {settings.address} did not remove {actor.type_id}, which a killed run left: "
                "restart it"
            )
