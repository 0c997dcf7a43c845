"""The actors of a session in a CARLA server: a Ctrl-C at any moment leaves none of them that is not known here."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import starmap
from typing import Any


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

        They must not be new. After a Ctrl-C in this method, another call destroys the rest. Raises `RuntimeError` if
        the server does not answer.
        """
        alive = [actor for actor in self if actor.is_alive]
        for car in alive[:1]:  # before anything else, because a car in an asynchronous world drives on
            car.apply_control(braked)
        for actor in reversed(alive):
            if not actor.type_id.startswith("sensor."):
                return actor.destroy() or all(other.id != actor.id for other in world.get_actors())
            if actor.is_listening():
                actor.stop()
            actor.destroy()  # whether it succeeds: another client may have destroyed it
        return True
