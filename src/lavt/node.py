"""What a node is: tables of hops, and no input, output or clock of its own.

A runtime gives a node a message with the time it arrived, calls hop after hop with each hop's own `now`, sends what
comes out at the end, and wakes the node when it asked. The same node objects run in real and in virtual time.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol

from lavt.domain import Now
from lavt.value import value

Peer = Any
"""Opaque: whoever sent a message and may be answered (an address, a query). Only links look inside."""

WAKE = "wake"
"""The channel on which a node is woken; its payload is None."""


@value
class Message:
    """What a node gets: a payload on a channel, when it arrived on this host, and from whom."""

    channel: str
    payload: Any
    arrived: Now
    peer: Peer = None


@value
class Send:
    """What a node wants sent: a payload on a channel, to the channel's receivers or to one peer.

    On a channel that crosses the network the payload is bytes, elsewhere an object that nobody changes.
    """

    channel: str
    payload: Any
    peer: Peer = None


Hop = tuple[str, Callable[[Any, Now], Any]]
"""A name and a function of (what the hop before returned, now).

The first hop of a chain gets the `Message`. A hop that returns None ends the chain; the last one returns the list of
`Send`s. Where a value on the way has an attribute `stamp_ns`, the chain's timeline is filed under it.
"""


class Node(Protocol):
    """A part of the loop, driven by a runtime."""

    @property
    def name(self) -> str:
        """The node's name in records and timelines."""
        ...

    @property
    def counts(self) -> Mapping[str, int]:
        """What the node has counted; written into the record at the end."""
        ...

    @property
    def chains(self) -> Mapping[str, Sequence[Hop]]:
        """For each channel the node listens to, its hops in order."""
        ...

    def next_wake_ns(self) -> int | None:
        """When the node wants its `WAKE` chain called, on its host's monotonic clock; None: not at all."""
        ...
