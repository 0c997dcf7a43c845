"""The table of all channels: the sender and the receivers of each, its carrier, and how its messages wait."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Carrier = Literal["local", "video", "zenoh", "probe", "clock", "netem", "console", "relay", "record"]
"""local: between nodes of one side. video: the UDP flow of the video. zenoh: a Zenoh key or query. probe: the UDP flow
of the clock probes. clock: the host's time source. netem: the host's network queues. console: the web pages from which
a person drives or watches. relay: a relay in the client's process. record: the record only, no receiver."""

Waiting = Literal["queue", "newest"]
"""queue: messages are received in order; a full queue drops its oldest message. newest: a new message replaces the
waiting one."""

QUEUE_LENGTH = 4096
"""More than a second of packets."""
COMMAND_QUEUE_LENGTH = 64
"""More than the commands of a second; older commands would be rejected anyway."""
PAGE_QUEUE_LENGTH = 4096
"""More than the messages of all pages in a second: the link closes a page that sends more, so that none is dropped."""
PROBE_QUEUE_LENGTH = 64
"""A probe that waits behind many other probes measures mainly its wait in this queue."""

WATCHED = ("page_watch",)
"""The observer of what the pages show that watch a client."""


@dataclass(frozen=True, slots=True)
class Channel:
    """One row of the table."""

    carrier: Carrier
    sender: str
    receivers: tuple[str, ...] = ()
    waiting: Waiting = "queue"
    length: int = QUEUE_LENGTH
    """Capacity of the queue."""
    inline: bool = False
    """Whether the thread that delivers a message in real time also runs the receiver's pipeline; for pipelines that are
    short and run often."""
    observers: tuple[str, ...] = ()
    """Nodes of the side that sends or receives the messages. If it has them, they get each message, too, in real
    time."""


CHANNELS: dict[str, Channel] = {
    # server, between its nodes
    "pose": Channel("local", "actuator", ("camera",), "newest", inline=True),
    "frame": Channel("local", "camera", ("actuator",), inline=True),
    "video_token": Channel("local", "actuator", ("camera",)),
    # Whether the vehicle is stationary, and who has control. These messages wait in a queue, because an inbox serves
    # its queues first: a flood of requests would delay messages that wait as "newest".
    "rest": Channel("local", "actuator", ("injection",)),
    "server_ends": Channel("local", "operator", ("actuator",)),  # stops the vehicle before a server shutdown
    # client, between its nodes
    "access_unit": Channel("local", "receiver", ("driver",), observers=WATCHED),
    "view": Channel("local", "driver", ("driver",), "newest"),
    "picture_lost": Channel("local", "driver", ("receiver",)),
    "operator": Channel("local", "operator", ("driver",)),  # a person requests a stop or a release
    "path_token": Channel("local", "driver", ("receiver",)),
    "agent_action": Channel("local", "agent", ("driver",)),  # what an agent chose in a Gymnasium environment
    "condition_in_force": Channel("local", "injection", ("driver",), "newest"),
    # client, if a person drives: between the driver node and the pages, and to a relay of its own
    "unit_to_decode": Channel("local", "driver", ("driver",)),
    "video_reception": Channel("local", "receiver", ("driver",), "newest"),
    "page_opened": Channel("local", "console", ("driver",)),
    "page_closed": Channel("local", "console", ("driver",)),
    "page_message": Channel("local", "console", ("driver",), length=PAGE_QUEUE_LENGTH),
    "page_unit": Channel("console", "driver"),
    "page_status": Channel("console", "driver"),
    "relay_delay": Channel("relay", "driver"),
    # client, if pages only watch: between them and the node that serves them, which sends to no other node
    "watch_opened": Channel("local", "console", ("page_watch",)),
    "watch_closed": Channel("local", "console", ("page_watch",)),
    "watch_message": Channel("local", "console", ("page_watch",), length=PAGE_QUEUE_LENGTH),
    "watch_unit": Channel("console", "page_watch"),
    "watch_status": Channel("console", "page_watch"),
    # across the network
    # server to client: RTP, sender reports, and challenges, to which the client must answer to prove its address
    "rtp": Channel("video", "camera", ("receiver",), inline=True),
    "feedback": Channel("video", "receiver", ("camera",)),  # client to server: RTCP, hellos, answers to challenges
    "control": Channel("zenoh", "driver", ("actuator",), length=COMMAND_QUEUE_LENGTH, observers=WATCHED),
    "state": Channel("zenoh", "actuator", ("driver",), "newest", observers=WATCHED),
    "session": Channel("zenoh", "driver", ("actuator",), length=COMMAND_QUEUE_LENGTH),
    "session_reply": Channel("zenoh", "actuator", ("driver",)),
    "netem": Channel("zenoh", "injection", ("injection",), length=COMMAND_QUEUE_LENGTH),
    "netem_reply": Channel("zenoh", "injection", ("injection",), length=COMMAND_QUEUE_LENGTH),
    # clocks: the time source of each host, and the probes between client and server
    "probe_request": Channel("probe", "clock_sync", ("clock_sync",), length=PROBE_QUEUE_LENGTH),
    "probe_reply": Channel("probe", "clock_sync", ("clock_sync",), length=PROBE_QUEUE_LENGTH),
    "clock_query": Channel("clock", "clock_sync"),
    "clock_report": Channel("local", "clock_source", ("clock_sync",)),
    # the network queues of each host
    "inject": Channel("netem", "injection"),
    "injected": Channel("local", "injector", ("injection",)),
    # recorded only
    "video": Channel("record", "camera"),
    "admission": Channel("record", "actuator"),
    "wheel": Channel("record", "actuator"),
    "speed_limit": Channel("record", "actuator"),
    "truth": Channel("record", "actuator"),
    "route": Channel("record", "actuator"),
    "event": Channel("record", "actuator"),
    "reception": Channel("record", "receiver", observers=WATCHED),
    "picture": Channel("record", "driver", observers=WATCHED),
    "lane": Channel("record", "driver", observers=WATCHED),
    "human_input": Channel("record", "driver"),
    "page_picture": Channel("record", "driver"),
    "clock": Channel("record", "clock_sync"),
    "injection": Channel("record", "injection"),
    "clock_probe": Channel("record", "clock_sync"),
    "counts": Channel("record", "runtime"),
    "timeline": Channel("record", "runtime"),
}
