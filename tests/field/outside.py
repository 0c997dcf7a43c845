"""A process outside the loop that counts: it hears every command as the vehicle does, and writes down what it heard.

It has a session of its own with the vehicle's router, and shares nothing with the server but that router and the clocks
of the kernel. A line for each command: when it arrived here, when it was sent, as it says, and its picture's stamp.

    python tests/field/outside.py FILE
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


def line_of(payload: bytes, arrived: Now) -> str:
    try:
        command = decode(Command, payload)
    except BadMessage:
        return json.dumps({"unreadable": len(payload)})
    names = ("epoch", "sequence", "sent_wall_ns", "stamp_ns", "mode")
    heard = {name: getattr(command, name) for name in names}
    return json.dumps({**heard, "mono_ns": arrived.mono_ns, "wall_ns": arrived.wall_ns})


def main(out: Path) -> None:
    clock = MachineClock()
    heard: deque[tuple[bytes, Now]] = deque()
    # Called where Zenoh receives, and quick: nothing is dropped, and nothing waits before it has its time.
    listener: Any = zenoh.handlers.Callback(
        lambda sample: heard.append((sample.payload.to_bytes(), clock.now())), indirect=False
    )
    session = zenoh.open(zenoh.Config.from_file(str(shipped("zenoh-configs/session.json5"))))
    subscriber = session.declare_subscriber(KEY, listener)
    sys.stdout.write(json.dumps({"ready": KEY}) + "\n")
    sys.stdout.flush()
    try:
        with out.open("w") as file:
            while True:
                pause(WRITE_PERIOD_NS)
                while heard:
                    file.write(line_of(*heard.popleft()) + "\n")
                file.flush()
    except KeyboardInterrupt:
        pass
    finally:
        subscriber.undeclare()
        session.close()


main(Path(sys.argv[1]))
