"""A drive between the two machines: routers, server and client, each where it belongs."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tests.kernel.lane.machine import Machine, MachineError, Started, wait_until

from lavt.experiment.join import join
from lavt.experiment.metrics import Measured, measure
from lavt.experiment.record import Record, read_record

REPOSITORY = Path(__file__).resolve().parents[3]
SHORT_ROAD = REPOSITORY / "tests/kernel/roads/short.yaml"
LIGHT = ("vehicle.scenery=none",)
"""What a user-mode kernel, with its one processor and dear system calls, can draw in time."""
ROUTER_PORT = 7448
LONGEST_S = 240


@dataclass(frozen=True)
class Loop:
    """The four programs of a drive."""

    server_router: Started
    server: Started
    client_router: Started
    client: Started

    def all(self) -> tuple[Started, ...]:
        """List them in the order in which they were started."""
        return self.server_router, self.server, self.client_router, self.client


@dataclass(frozen=True)
class Drive:
    """One drive: its run directory with both records, and what was computed from them."""

    out: Path
    server: Record
    client: Record
    measured: Measured
    result: dict[str, Any]


def start_loop(
    server: Machine,
    client: Machine,
    out: Path,
    *,
    server_changes: Sequence[str] = (),
    client_changes: Sequence[str] = (),
) -> Loop:
    """Start the four programs; `out` is a new directory's name on both machines."""
    server_router = _start(server, "router", "zenoh-configs/router-server.json5")
    dialled = json.dumps([f"udp/{server.address}:{ROUTER_PORT}?rel=1;mixed_rel=1"])
    client_router = _start(
        client, "router", "zenoh-configs/router-client.json5", changes=[f"connect.endpoints={dialled}"]
    )
    for router in (server_router, client_router):
        router.first_line()
    changes = [f"vehicle.route={SHORT_ROAD}", *LIGHT, *server_changes]
    server_program = _start(
        server, "server", "configs/server.yaml", "--once", "--out", f"{out}/server", changes=changes
    )
    changes = [f"video.server={server.address}", *client_changes]
    client_program = _start(client, "client", "configs/client.yaml", "--out", f"{out}/client", changes=changes)
    for program in (server_program, client_program):
        program.first_line()
    return Loop(server_router, server_program, client_router, client_program)


def wait_for_the_end(loop: Loop, meanwhile: Callable[[Loop], None]) -> None:
    """Wait until the server has seen the drive's end; raises `MachineError` where one of the others ends before.

    `meanwhile` is called twice a second.
    """

    def ended() -> bool:
        meanwhile(loop)
        if not loop.server.running:
            return True
        for each in loop.all():
            if not each.running and each is not loop.server:
                raise MachineError(f"{' '.join(each.command)} ended in the middle of the drive: {each.errors}")
        return False

    wait_until(f"the drive has ended: {loop.server.command}", ended, LONGEST_S, every_ns=500_000_000)


def collect(loop: Loop, client: Machine, out: Path) -> Drive:
    """End the programs in order, bring the records together, and compute the result."""
    for each in reversed(loop.all()):
        each.stop()
    (out / "client").mkdir()
    for name in ("client.mcap", "config.yaml"):
        (out / "client" / name).write_bytes(client.read(out / "client" / name))
    run = out / "run"
    result = join(out / "server", out / "client", run)
    server_record, client_record = read_record(run / "server.mcap"), read_record(run / "client.mcap")
    return Drive(run, server_record, client_record, measure(server_record, client_record), result)


def reasons_against(driven: Drive) -> list[str]:
    """Reasons against a drive, but those of a machine too slow for it: a user-mode kernel has one processor."""
    slow = ("the physics was", "the camera missed")
    return [reason for reason in driven.result["invalid_because"] if not reason.startswith(slow)]


def _start(machine: Machine, command: str, *arguments: str, changes: Sequence[str] = ()) -> Started:
    sets = [part for change in changes for part in ("--set", change)]
    return machine.start(
        [machine.python, "-B", "-m", "lavt", command, *arguments, *sets, "--json"],
        environment={"OPENCV_FOR_THREADS_NUM": "1"},
    )
