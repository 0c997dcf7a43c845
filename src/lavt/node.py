"""The interface of a node: pipelines of stages, which do no I/O and read no clock.

A runtime passes a message with its arrival time through the stages of a pipeline, and sends the result of the last
stage. Each stage gets its start time as `now`. The runtime also wakes a node at the times that the node requests. The
same nodes run in real and in virtual time.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol

from msgspec import Struct

from lavt.domain import Now

Peer = Any
"""The sender of a message, to which a reply can be sent: an address or a Zenoh query. Nodes only pass it on."""

WAKE = "wake"
"""The channel on which a runtime wakes a node; the payload is None."""


class Message(Struct, frozen=True):
    """A message to a node: channel, payload, arrival time on this host, and sender."""

    channel: str
    payload: Any
    arrived: Now
    peer: Peer = None


class Send(Struct, frozen=True):
    """A message from a node: a payload on a channel, to the channel's receivers or to one peer.

    On a channel that crosses the network the payload is bytes, elsewhere an object that is never modified.
    """

    channel: str
    payload: Any
    peer: Peer = None


Stage = tuple[str, Callable[[Any, Now], Any]]
"""A name and a function of (result of the previous stage, now).

The first stage of a pipeline gets the `Message`. A stage that returns None ends the pipeline; the last stage returns
the list of `Send`s. If a result has an attribute `stamp_ns`, the end times of the stages are recorded with that stamp.
"""


class Node(Protocol):
    """A part of the server or the client, run by a runtime."""

    @property
    def name(self) -> str:
        """Return the node's name in records and timelines."""
        ...

    @property
    def counts(self) -> Mapping[str, int]:
        """Return the node's counters by name, which are recorded at the end of the run."""
        ...

    @property
    def pipelines(self) -> Mapping[str, Sequence[Stage]]:
        """Return the pipeline of each channel that the node receives."""
        ...

    def next_wake_ns(self) -> int | None:
        """Return when the `WAKE` pipeline is due, on the host's monotonic clock; None: never."""
        ...
