"""A drive with the two machines: start server and client on their machines, and collect the result."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
from tests.kernel.lane.machine import Machine, MachineError, StartedProgram, wait_until

from lavt.experiment.analysis.invalid_reason import InvalidCode, InvalidReason
from lavt.experiment.analysis.metrics import RunMeasurement, measure
from lavt.experiment.runs.join import join_sides
from lavt.recording.record import Record, read_record

REPOSITORY = Path(__file__).resolve().parents[3]
SHORT_ROAD = REPOSITORY / "tests/kernel/roads/short.yaml"
NO_SCENERY = ("vehicle.scenery=none",)
"""Without scenery, a user-mode kernel with one processor and slow system calls can render in time."""
BY_WIRE = "configs/server-by-wire.yaml"
PROGRAM_TO_ROUTER_PORT = 7447
DRIVE_TIMEOUT_S = 240


@dataclass(frozen=True)
class LoopPrograms:
    """The programs of a control loop, which make a drive."""

    routers: tuple[StartedProgram, ...]
    """Separate routers; none if server and client contain their routers."""
    server: StartedProgram
    client: StartedProgram

    def all(self) -> tuple[StartedProgram, ...]:
        """Return all programs in the order of their start."""
        return *self.routers, self.server, self.client


@dataclass(frozen=True)
class DriveResult:
    """A finished drive: its run directory with both records, and the results."""

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
) -> LoopPrograms:
    """Start server and client, which contain their routers; `out` is a new directory on both machines."""
    changes = [f"vehicle.route={SHORT_ROAD}", *NO_SCENERY, *server_changes]
    loop = LoopPrograms(
        (),
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
) -> LoopPrograms:
    """Start a by-wire drive. It has one separate router, on the client's machine, to relieve the server's machine."""
    endpoints = json.dumps([f"tcp/0.0.0.0:{PROGRAM_TO_ROUTER_PORT}"])
    router = _start(client, "router", "zenoh-configs/router-server.json5", changes=[f"listen.endpoints={endpoints}"])
    _wait_ready(router)
    changes = [f"zenoh.router=tcp/{client.address}:{PROGRAM_TO_ROUTER_PORT}", *NO_SCENERY, *server_changes]
    client_changes = [f"zenoh.router=tcp/127.0.0.1:{PROGRAM_TO_ROUTER_PORT}", *client_changes]
    loop = LoopPrograms(
        (router,), _start_server(server, BY_WIRE, out, changes), _start_client(client, server, out, client_changes)
    )
    _wait_ready(loop.server, loop.client)
    return loop


def _start_server(machine: Machine, config: str, out: Path, changes: Sequence[str]) -> StartedProgram:
    return _start(machine, "server", config, "--once", "--out", f"{out}/server", changes=changes)


def _start_client(machine: Machine, server: Machine, out: Path, changes: Sequence[str]) -> StartedProgram:
    changes = [f"video.server={server.address}", *changes]
    return _start(machine, "client", "configs/client.yaml", "--out", f"{out}/client", changes=changes)


def _wait_ready(*programs: StartedProgram) -> None:
    for program in programs:
        program.first_line()


def wait_for_end(loop: LoopPrograms, meanwhile: Callable[[LoopPrograms], None]) -> None:
    """Wait until the server has ended the drive. Raise `MachineError` if another program ends first.

    `meanwhile` is called twice a second.
    """

    def has_ended() -> bool:
        meanwhile(loop)
        if not loop.server.running:
            return True
        for program in loop.all():
            if not program.running and program is not loop.server:
                raise MachineError(f"{' '.join(program.command)} ended during the drive: {program.errors}")
        return False

    wait_until(f"the drive has ended: {loop.server.command}", has_ended, DRIVE_TIMEOUT_S, every_ns=500_000_000)


def collect(loop: LoopPrograms, client: Machine, out: Path) -> DriveResult:
    """Stop the programs in order, join the records, and compute the result."""
    for program in reversed(loop.all()):
        program.stop()
    (out / "client").mkdir()
    for name in ("client.mcap", "config.yaml"):
        (out / "client" / name).write_bytes(client.read(out / "client" / name))
    run = out / "run"
    result = join_sides(out / "server", out / "client", run)
    server_record, client_record = read_record(run / "server.mcap"), read_record(run / "client.mcap")
    return DriveResult(run, server_record, client_record, measure(server_record, client_record), result)


SLOW_MACHINE_CODES = (InvalidCode.PHYSICS_LATE, InvalidCode.FRAMES_MISSED, InvalidCode.LOOP_JITTER)


def invalid_reasons(finished_drive: DriveResult) -> list[InvalidReason]:
    """Return why a drive is invalid, except for reasons that are normal on a slow machine with one processor."""
    reasons = msgspec.convert(finished_drive.result["invalid_reasons"], list[InvalidReason])
    return [reason for reason in reasons if reason.code not in SLOW_MACHINE_CODES]


def _start(machine: Machine, command: str, *arguments: str, changes: Sequence[str] = ()) -> StartedProgram:
    set_options = [part for change in changes for part in ("--set", change)]
    return machine.start(
        [machine.python, "-B", "-m", "lavt", command, *arguments, *set_options, "--json"],
        environment={"OPENCV_FOR_THREADS_NUM": "1"},
    )
