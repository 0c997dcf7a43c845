"""The actors of a session in a CARLA server, and their blueprints. A Ctrl-C at any moment leaves no unknown actor."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from itertools import starmap
from typing import Any

from lavt.domain import CameraModel
from lavt.errors import UserError


class SpawnedActors:
    """The car, and then its sensors, in the order in which they were spawned."""

    def __init__(self) -> None:
        self._actors: list[Any] = []
        self.are_new = False
        """Whether one was spawned after the newest state of the world, so that the library does not know if it is
        alive, and may refuse to destroy it."""

    def __iter__(self) -> Iterator[Any]:
        return (actor for actor in self._actors if actor is not None)

    def add(self, spawn: Callable[..., Any], *arguments: Any) -> Any:
        """Call `spawn`, and return the new actor, or None if the server did not spawn it.

        A Ctrl-C during the request is handled only after `extend`, so that the actor is never lost.
        """
        self.are_new = True
        self._actors.extend(starmap(spawn, [arguments]))
        return self._actors[-1]

    def destroy(self, world: Any, braked: Any) -> bool:
        """Brake the car by the control `braked`, and destroy all actors; return False if the server keeps the car.

        They should not be new. After a Ctrl-C in this method, another call destroys the rest. Raises `RuntimeError` if
        the server does not answer.
        """
        alive = [actor for actor in self if actor.is_alive]
        cars = [actor for actor in alive if not actor.type_id.startswith("sensor.")]
        for car in cars:  # before anything else, because a car in an asynchronous world drives on
            car.apply_control(braked)
        for sensor in reversed([actor for actor in alive if actor not in cars]):
            if sensor.is_listening():
                sensor.stop()
            sensor.destroy()  # whether it succeeds: another client may have destroyed it
        return all(car.destroy() or all(other.id != car.id for other in world.get_actors()) for car in cars)


def find_blueprint(world: Any, name: str, role_name: str) -> Any:
    """Return the blueprint of this name, with the role name of the session; raise `UserError` without one."""
    try:
        blueprint = world.get_blueprint_library().find(name)
    except IndexError:
        raise UserError(f"the CARLA server has no {name!r}: set vehicle.carla.blueprint to another car") from None
    if blueprint.has_attribute("role_name"):
        blueprint.set_attribute("role_name", role_name)
    return blueprint


def set_camera(blueprint: Any, model: CameraModel) -> None:
    """Set the attributes of a camera's blueprint."""
    attributes = {
        "image_size_x": model.width_px,
        "image_size_y": model.height_px,
        "fov": math.degrees(model.field_of_view_rad),
        "sensor_tick": 0.0,  # a picture in each tick; other values do not divide exactly
        "motion_blur_intensity": 0.0,
    }
    for name, value in attributes.items():
        if blueprint.has_attribute(name):
            blueprint.set_attribute(name, str(value))
