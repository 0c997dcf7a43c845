"""A drive between the two machines: routers, server and client, each where it belongs."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tests.kernel.lane.machine import Machine, MachineError, Started, wait_until

from lavt.experiment.analysis.metrics import RunMeasurement, measure
from lavt.experiment.runs.join import join_sides
from lavt.recording.record import Record, read_record

REPOSITORY = Path(__file__).resolve().parents[3]
SHORT_ROAD = REPOSITORY / "tests/kernel/roads/short.yaml"
LIGHT = ("vehicle.scenery=none",)
"""What a user-mode kernel, with its one processor and dear system calls, can draw in time."""
BY_WIRE = "configs/server-by-wire.yaml"
ROUTER_PORT = 7448
SESSION_PORT = 7447
LONGEST_S = 240


@dataclass(frozen=True)
class Loop:
    """The programs of a drive."""

    routers: tuple[Started, ...]
    server: Started
    client: Started

    def all(self) -> tuple[Started, ...]:
        """List them in the order in which they were started."""
        return *self.routers, self.server, self.client


@dataclass(frozen=True)
class Drive:
    """One drive: its run directory with both records, and what was computed from them."""

    out: Path
    server: Record
    client: Record
    measured: RunMeasurement
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
    dialled = json.dumps([f"udp/{server.address}:{ROUTER_PORT}?rel=1;mixed_rel=1"])
    routers = (
        _start(server, "router", "zenoh-configs/router-server.json5"),
        _start(client, "router", "zenoh-configs/router-client.json5", changes=[f"connect.endpoints={dialled}"]),
    )
    _wait_ready(*routers)
    changes = [f"vehicle.route={SHORT_ROAD}", *LIGHT, *server_changes]
    loop = Loop(
        routers,
        _start_server(server, "configs/server.yaml", out, changes),
        _start_client(client, server, out, client_changes),
    )
    _wait_ready(loop.server, loop.client)
    return loop


def start_by_wire(
    server: Machine,
    client: Machine,
    out: Path,
    *,
    server_changes: Sequence[str] = (),
    client_changes: Sequence[str] = (),
) -> Loop:
    """Start the programs of a drive by wire. The one router is the client's: the server's machine has more to do."""
    listened = json.dumps([f"tcp/0.0.0.0:{SESSION_PORT}"])
    router = _start(client, "router", "zenoh-configs/router-server.json5", changes=[f"listen.endpoints={listened}"])
    _wait_ready(router)
    changes = [f"zenoh.router=tcp/{client.address}:{SESSION_PORT}", *LIGHT, *server_changes]
    client_changes = [f"zenoh.router=tcp/127.0.0.1:{SESSION_PORT}", *client_changes]
    loop = Loop(
        (router,), _start_server(server, BY_WIRE, out, changes), _start_client(client, server, out, client_changes)
    )
    _wait_ready(loop.server, loop.client)
    return loop


def _start_server(machine: Machine, config: str, out: Path, changes: Sequence[str]) -> Started:
    return _start(machine, "server", config, "--once", "--out", f"{out}/server", changes=changes)


def _start_client(machine: Machine, server: Machine, out: Path, changes: Sequence[str]) -> Started:
    changes = [f"video.server={server.address}", *changes]
    return _start(machine, "client", "configs/client.yaml", "--out", f"{out}/client", changes=changes)


def _wait_ready(*programs: Started) -> None:
    for program in programs:
        program.first_line()


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
    result = join_sides(out / "server", out / "client", run)
    server_record, client_record = read_record(run / "server.mcap"), read_record(run / "client.mcap")
    return Drive(run, server_record, client_record, measure(server_record, client_record), result)


def reasons_against(driven: Drive) -> list[str]:
    """Reasons against a drive, but those of a machine too slow for it: a user-mode kernel has one processor."""
    slow = ("the physics was", "the camera missed")
    return [reason for reason in driven.result["invalid_reasons"] if not reason.startswith(slow)]


def _start(machine: Machine, command: str, *arguments: str, changes: Sequence[str] = ()) -> Started:
    sets = [part for change in changes for part in ("--set", change)]
    return machine.start(
        [machine.python, "-B", "-m", "lavt", command, *arguments, *sets, "--json"],
        environment={"OPENCV_FOR_THREADS_NUM": "1"},
    )
