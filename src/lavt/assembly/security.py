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
    """Return the cipher of the video, which is encrypted if the config has a key."""
    if not config.security.key:
        return plain_cipher
    check_srtp()
    end: End = "server" if isinstance(config, ServerConfig) else "client"
    return lambda token, challenge: SrtpCipher(end, token, challenge)


def build_authenticator(config: ServerConfig | ClientConfig) -> Authenticator:
    """Build a side's authenticator, None for a client without a key; raise `UserError` for an unreadable key."""
    return (
        build_vehicle_authenticator(config)
        if isinstance(config, ServerConfig)
        else build_operator_authenticator(config)
    )


def build_gateway(
    authenticator: Authenticator, deliver: Deliver, carry: Carry, in_force: Callable[[], tuple[int, int]]
) -> ServerGateway | ClientGateway | OpenClientGateway:
    """Build the gateway of a side with this authenticator; only a server's gateway calls `in_force`."""
    if authenticator is None:
        return OpenClientGateway(deliver, carry)
    if isinstance(authenticator, OperatorAuthenticator):
        return ClientGateway(deliver, carry, authenticator)
    return ServerGateway(deliver, carry, in_force, authenticator)


def build_vehicle_authenticator(config: ServerConfig) -> NullVehicleAuthenticator:
    """Build the vehicle's authenticator; raise `UserError` for an unreadable key."""
    security = config.security
    if not security.key:
        return NullVehicleAuthenticator()
    operators = {name: load_public(Path(file)) for name, file in security.operators.items()}
    return VehicleAuthenticator(config.vehicle_id, load_private(Path(security.key)), operators)


def build_operator_authenticator(config: ClientConfig) -> OperatorAuthenticator | None:
    """Build the operator's authenticator, None without a key; raise `UserError` for an unreadable key."""
    security = config.security
    if not security.key:
        return None
    key = load_private(Path(security.key))
    return OperatorAuthenticator(config.vehicle_id, config.who, key, load_public(Path(security.vehicle)))
