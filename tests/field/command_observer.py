"""Record every command at the vehicle's router, in a process that is independent of the server.

The observer has a session of its own with the vehicle's router, and shares only that router and the kernel's clocks
with the server. It writes one line per command, with the time of reception, the command's send time and the stamp of
its frame, among others.

    python tests/field/command_observer.py FILE
"""

from __future__ import annotations

import json
import sys
from collections import deque
from pathlib import Path
from typing import Any

import zenoh

from lavt.clock import MachineClock, pause
from lavt.config_file import shipped
from lavt.domain import NS_PER_MS, Command, Now
from lavt.errors import BadMessage
from lavt.transport.messages import decode

KEY = "lavt/vehicle-1/control"
WRITE_PERIOD_NS = 50 * NS_PER_MS


def format_line(payload: bytes, arrived: Now) -> str:
    """Return a line of JSON: fields of a command and its arrival time, or the size of an invalid message."""
    try:
        command = decode(Command, payload)
    except BadMessage:
        return json.dumps({"invalid_message_bytes": len(payload)})
    names = ("epoch", "sequence", "sent_wall_ns", "stamp_ns", "mode")
    values = {name: getattr(command, name) for name in names}
    return json.dumps({**values, "mono_ns": arrived.mono_ns, "wall_ns": arrived.wall_ns})


def main(out: Path) -> None:
    clock = MachineClock()
    received: deque[tuple[bytes, Now]] = deque()
    # The callback runs in Zenoh's receiving thread and is quick, so that no command is dropped or timestamped late.
    listener: Any = zenoh.handlers.Callback(
        lambda sample: received.append((sample.payload.to_bytes(), clock.now())), indirect=False
    )
    session = zenoh.open(zenoh.Config.from_file(str(shipped("zenoh-configs/session.json5"))))
    subscriber = session.declare_subscriber(KEY, listener)
    sys.stdout.write(json.dumps({"ready": KEY}) + "\n")
    sys.stdout.flush()
    try:
        with out.open("w") as file:
            while True:
                pause(WRITE_PERIOD_NS)
                while received:
                    file.write(format_line(*received.popleft()) + "\n")
                file.flush()
    except KeyboardInterrupt:
        pass
    finally:
        subscriber.undeclare()
        session.close()


main(Path(sys.argv[1]))
