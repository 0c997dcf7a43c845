"""The exceptions of LAVT.

LavtError
├── UserError            wrong input: a sentence with the error and its remedy; exit code 2
├── WorkError            the work failed with valid input; exit code 1
├── PeerError            invalid bytes from the network: counted and dropped, never fatal
│   ├── BadMessage       bytes that are not a LAVT message, or a value out of range
│   └── BadPacket        a datagram that is not RTP, or whose payload cannot be H.264
└── VehicleError         a failure of the vehicle or its camera; ends the server
"""

from __future__ import annotations


class LavtError(Exception):
    """The base class of all exceptions that LAVT raises."""


class UserError(LavtError):
    """The input is wrong; the message is one sentence with the error and its remedy."""


class WorkError(LavtError):
    """The work failed with valid input."""


class PeerError(LavtError):
    """Bytes from the network are invalid; the caller counts this error, drops the bytes and continues."""


class BadMessage(PeerError):
    """Bytes that are not a valid LAVT message."""


class BadPacket(PeerError):
    """A datagram that is not a valid part of a video stream."""


class VehicleError(LavtError):
    """The vehicle or its camera failed."""


def describe_error(error: BaseException) -> str:
    """Return an error as one sentence; an unexpected error is preceded by its type."""
    return str(error) if isinstance(error, LavtError) else f"{type(error).__name__}: {error}"
