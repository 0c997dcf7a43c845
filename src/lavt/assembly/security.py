"""The construction of gateways, authenticators and ciphers from the keys in configs."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from lavt.config import ClientConfig, ServerConfig
from lavt.transport.rtp.srtp import check_srtp
from lavt.transport.security.envelope import NullVehicleAuthenticator, OperatorAuthenticator, VehicleAuthenticator
from lavt.transport.security.gateway import Carry, ClientGateway, Deliver, OpenClientGateway, ServerGateway
from lavt.transport.security.keys import load_private, load_public
from lavt.transport.video.cipher import End, NewCipher, SrtpCipher, plain_cipher

Authenticator = NullVehicleAuthenticator | OperatorAuthenticator | None


def build_cipher(config: ServerConfig | ClientConfig) -> NewCipher:
    """Return the function that makes the video's cipher: SRTP if the config has a key, otherwise no encryption."""
    if not config.security.key:
        return plain_cipher
    check_srtp()
    end: End = "server" if isinstance(config, ServerConfig) else "client"
    return lambda token, challenge: SrtpCipher(end, token, challenge)


def build_authenticator(config: ServerConfig | ClientConfig, now_wall_ns: int | None = None) -> Authenticator:
    """Build a side's authenticator; the result is None for a client without a key.

    Raise `UserError` for a key that is unreadable or has expired by `now_wall_ns`. Without a time, expiry is not
    checked.
    """
    if isinstance(config, ServerConfig):
        return build_vehicle_authenticator(config, now_wall_ns)
    return build_operator_authenticator(config, now_wall_ns)


def build_gateway(
    authenticator: Authenticator, deliver: Deliver, carry: Carry, in_force: Callable[[], tuple[int, int]]
) -> ServerGateway | ClientGateway | OpenClientGateway:
    """Build the gateway of a side with this authenticator; only a server's gateway calls `in_force`."""
    if authenticator is None:
        return OpenClientGateway(deliver, carry)
    if isinstance(authenticator, OperatorAuthenticator):
        return ClientGateway(deliver, carry, authenticator)
    return ServerGateway(deliver, carry, in_force, authenticator)


def build_vehicle_authenticator(config: ServerConfig, now_wall_ns: int | None = None) -> NullVehicleAuthenticator:
    """Build the vehicle's authenticator; raise `UserError` for a key that is unreadable or has expired."""
    security = config.security
    if not security.key:
        return NullVehicleAuthenticator()
    operators = {name: load_public(Path(file), now_wall_ns) for name, file in security.operators.items()}
    return VehicleAuthenticator(config.vehicle_id, load_private(Path(security.key), now_wall_ns), operators)


def build_operator_authenticator(config: ClientConfig, now_wall_ns: int | None = None) -> OperatorAuthenticator | None:
    """Build the operator's authenticator (None without a key); raise `UserError` for an unreadable or expired key."""
    security = config.security
    if not security.key:
        return None
    key, vehicle = load_private(Path(security.key), now_wall_ns), load_public(Path(security.vehicle), now_wall_ns)
    return OperatorAuthenticator(config.vehicle_id, config.who, key, vehicle)
