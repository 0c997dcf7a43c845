"""The errors of LAVT, one tree.

LavtError
├── UserError            what the user did wrong: one sentence that says what to do; exit code 2
├── WorkError            the work failed though the input was right: exit code 1
├── PeerError            what the peer or the network did wrong: counted and dropped, never fatal
│   ├── BadMessage       bytes that are not a message of ours, or hold a value out of range
│   └── BadPacket        a datagram that is not RTP, or whose payload cannot be H.264
└── VehicleError         what the vehicle did wrong: ends the server, as nobody can drive by it
"""

from __future__ import annotations


class LavtError(Exception):
    """Any error that LAVT raises on purpose."""


class UserError(LavtError):
    """The input was wrong; the text is one sentence that says what is wrong and what to do."""


class WorkError(LavtError):
    """The work could not be done though the input was right."""


class PeerError(LavtError):
    """Bytes from outside were not what they should be. Whoever parses counts it and goes on."""


class BadMessage(PeerError):
    """A message that cannot be one of ours."""


class BadPacket(PeerError):
    """A datagram that cannot be part of a video stream."""


class VehicleError(LavtError):
    """The vehicle or its camera does not do what it should."""


def in_words(error: Exception) -> str:
    """Say an error in one sentence: an unforeseen one with its kind, as its own text may say little."""
    return str(error) if isinstance(error, LavtError) else f"{type(error).__name__}: {error}"
