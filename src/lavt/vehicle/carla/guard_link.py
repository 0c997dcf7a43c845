"""The guard's own connection to the CARLA server, which is made anew if the server does not answer.

A network failure can cut the connections of LAVT's process and of its guard at the same time. The server then keeps the
last control of the car, so the guard must reach it again.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, Final

from lavt.errors import UserError, VehicleError
from lavt.vehicle.carla.connection import connect, forget_client
from lavt.vehicle.carla.probe import NoServerError, ask_episode
from lavt.vehicle.carla.settings import CarlaSettings

CALL_TIMEOUT_S: Final = 1.0


class GuardLink:
    """A connection: `connect_client` returns a client, and raises `UserError` if no server answers.

    Raises `UserError` if no server answers at the start. `reach` raises `VehicleError` if `connect_client` does: the
    car is gone.
    """

    def __init__(self, connect_client: Callable[[], Any]) -> None:
        self._connect_client = connect_client
        self._first: Any = connect_client()
        self._client: Any = self._first

    def reach(self, send: Callable[[Any], object]) -> bool:
        """Call `send` with the client, and return whether the server answered a request afterwards.

        A control is not answered itself, and one that is sent over a lost connection is lost without an error. After a
        failure, the next call connects anew.
        """
        try:
            if self._client is None:
                self._client = self._connect_client()
            send(self._client)
            self._client.get_server_version()
        except (RuntimeError, UserError):
            self._client = None
            return False
        return True

    def ask(self) -> None:
        """Raise `RuntimeError` if the server does not answer over the first connection.

        If that one is lost, so may be the connection of LAVT's process, whose run must end.
        """
        self._first.get_server_version()


def connector(carla: Any, settings: CarlaSettings) -> Callable[[], Any]:
    """Return a function that connects; it raises `VehicleError` if the server's world has been replaced since.

    In another world the car is gone, and its number may be that of another client's car.
    """
    episodes: list[int | None] = []

    def connect_client() -> Any:
        forget_client(settings)
        timeout_s = CALL_TIMEOUT_S if episodes else settings.timeout_s
        client = connect(carla, replace(settings, timeout_s=timeout_s))
        client.set_timeout(CALL_TIMEOUT_S)
        try:
            episodes.append(ask_episode(settings.host, settings.port, timeout_s))
        except NoServerError as error:
            raise UserError(str(error)) from None
        if episodes[-1] != episodes[0]:
            raise VehicleError("the car is gone, because the CARLA server has begun another world")
        return client

    return connect_client
