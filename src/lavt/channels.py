"""One table of all channels: who sends, who listens, what carries it, and what happens to what has to wait."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Carrier = Literal["local", "video", "zenoh", "probe", "clock", "netem", "record"]
"""local: between nodes of one side. video: the UDP flow of the video. zenoh: a key or a query. probe: the UDP flow that
compares the clocks. clock: the host's source of clock reports. netem: the host's own queues. record: nobody listens,
it is written down."""

Waiting = Literal["queue", "newest"]
"""queue: kept in order, the oldest dropped when full. newest: a new one replaces the one that waits."""

QUEUE_LENGTH = 4096
"""More than a second of packets."""
COMMANDS = 64
"""A second of commands: older ones would be refused anyway."""
PROBES = 64
"""One that has to wait for more than a few others tells little."""


@dataclass(frozen=True, slots=True)
class Channel:
    """One row of the table."""

    carrier: Carrier
    sender: str
    receivers: tuple[str, ...] = ()
    waiting: Waiting = "queue"
    length: int = QUEUE_LENGTH
    """How many may wait in the queue."""
    at_once: bool = False
    """In real time the thread that brings it walks it through its receiver: for short chains that come often."""


CHANNELS: dict[str, Channel] = {
    # server, between its nodes
    "pose": Channel("local", "actuator", ("camera",), "newest", at_once=True),
    "frame": Channel("local", "camera", ("actuator",), at_once=True),
    "video_token": Channel("local", "actuator", ("camera",)),
    "rest": Channel("local", "actuator", ("injection",)),  # in order with requests: a flood of these must not hide it
    "server_ends": Channel("local", "operator", ("actuator",)),  # the vehicle is stopped before the server ends
    # client, between its nodes
    "access_unit": Channel("local", "receiver", ("driver",)),
    "view": Channel("local", "driver", ("driver",), "newest"),
    "picture_lost": Channel("local", "driver", ("receiver",)),
    "operator": Channel("local", "operator", ("driver",)),  # a person stops or releases the vehicle
    "path_token": Channel("local", "driver", ("receiver",)),
    "condition_in_force": Channel("local", "injection", ("driver",), "newest"),
    # across the network
    "rtp": Channel("video", "camera", ("receiver",), at_once=True),  # RTP, sender reports, challenges: server to client
    "feedback": Channel("video", "receiver", ("camera",)),  # RTCP, hellos: client to server
    "control": Channel("zenoh", "driver", ("actuator",), length=COMMANDS),
    "state": Channel("zenoh", "actuator", ("driver",), "newest"),
    "session": Channel("zenoh", "driver", ("actuator",), length=COMMANDS),
    "session_reply": Channel("zenoh", "actuator", ("driver",)),
    "netem": Channel("zenoh", "injection", ("injection",), length=COMMANDS),
    "netem_reply": Channel("zenoh", "injection", ("injection",), length=COMMANDS),
    # the clocks: each host's own, and the client's against the server's
    "probe_request": Channel("probe", "clock_sync", ("clock_sync",), length=PROBES),
    "probe_reply": Channel("probe", "clock_sync", ("clock_sync",), length=PROBES),
    "clock_query": Channel("clock", "clock_sync"),
    "clock_report": Channel("local", "clock_source", ("clock_sync",)),
    # each host and its own queues
    "inject": Channel("netem", "injection"),
    "injected": Channel("local", "injector", ("injection",)),
    # written down only
    "video": Channel("record", "camera"),
    "admission": Channel("record", "actuator"),
    "wheel": Channel("record", "actuator"),
    "truth": Channel("record", "actuator"),
    "route": Channel("record", "actuator"),
    "event": Channel("record", "actuator"),
    "reception": Channel("record", "receiver"),
    "picture": Channel("record", "driver"),
    "lane": Channel("record", "driver"),
    "clock": Channel("record", "clock_sync"),
    "injection": Channel("record", "injection"),
    "clock_probe": Channel("record", "clock_sync"),
    "counts": Channel("record", "runtime"),
    "timeline": Channel("record", "runtime"),
}
