"""Datagrams of python-can's interface `udp_multicast`: each is a CAN message as a msgpack map.

Anyone who can reach the multicast group can send a datagram, and python-can unpacks all of them. If `data` is a number,
python-can allocates this number of bytes. So the port checks each waiting datagram before python-can reads it.
"""

from __future__ import annotations

import os
import socket
from typing import Annotated, Final

from msgspec import DecodeError, Meta, Struct
from msgspec.msgpack import Decoder

MAX_DATAGRAM_BYTES: Final = 512
"""A message with 64 data bytes takes about 250 bytes."""


class MulticastMessage(Struct, forbid_unknown_fields=True):
    """The map of a datagram, with all the keys that python-can writes."""

    timestamp: float
    arbitration_id: Annotated[int, Meta(ge=0, lt=1 << 29)]
    is_extended_id: bool
    is_remote_frame: bool
    is_error_frame: bool
    channel: str | int | None
    dlc: Annotated[int, Meta(ge=0, le=64)]
    data: Annotated[bytes, Meta(max_length=64)]
    is_fd: bool
    bitrate_switch: bool
    error_state_indicator: bool


_DECODER: Final = Decoder(MulticastMessage)


def is_well_formed(datagram: bytes) -> bool:
    """Return whether a datagram is short enough, and a map with the keys and types of a CAN message."""
    if len(datagram) > MAX_DATAGRAM_BYTES:
        return False
    try:
        _DECODER.decode(datagram)
    except (DecodeError, RecursionError, UnicodeError):
        return False
    return True


class DatagramCheck:
    """A check of the datagrams that wait at a bus's socket. It uses a descriptor of its own for this socket."""

    def __init__(self, descriptor: int) -> None:
        self._socket = socket.socket(fileno=os.dup(descriptor))

    def drop_malformed(self) -> bool:
        """Drop the first waiting datagram if it is malformed; return whether it was dropped.

        Raises `BlockingIOError` if no datagram waits.
        """
        datagram = self._socket.recv(MAX_DATAGRAM_BYTES + 1, socket.MSG_PEEK | socket.MSG_DONTWAIT)
        if is_well_formed(datagram):
            return False
        self._socket.recv(1, socket.MSG_DONTWAIT)
        return True

    def close(self) -> None:
        """Close the descriptor."""
        self._socket.close()
