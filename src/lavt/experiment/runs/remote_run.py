"""One run in real time whose server runs on another machine (`lavt sweep --server`).

The server starts the vehicle on request. The client and the relay, which injects the delay of both directions, are
processes on this machine, as in a run on one machine. The server's record is fetched at the end.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from lavt.assembly.entropy import MachineEntropy
from lavt.assembly.links import trace_digests
from lavt.assembly.zenoh import dialling, vehicle_endpoint
from lavt.clock import MachineClock, pause
from lavt.config import ClientConfig
from lavt.config.remote_run import RemoteRunConfig, remote_part
from lavt.config_file import parse_config
from lavt.domain import NS_PER_MS, NS_PER_S, RunReply, RunRequest
from lavt.errors import LavtError, UserError, WorkError
from lavt.experiment.analysis.drive_data import DriveData, extract_drive
from lavt.experiment.analysis.results import write_json
from lavt.experiment.runs.join import check_same_drive
from lavt.experiment.runs.plan import PlannedRun
from lavt.experiment.runs.processes import READY_LIMIT_S, Process, Processes
from lavt.experiment.runs.real_run import RELAY, RUN_LIMIT_S, relay_config, requested_ms, write_config
from lavt.experiment.runs.run import CONFIG, NETWORK, compute_result, config_text
from lavt.experiment.runs.run_requests import RunConnection, RunRefused, RunRequests, fetch_record
from lavt.experiment.runs.run_service import LEASE_S, START_LIMIT_S
from lavt.experiment.runs.side_configs import client_config
from lavt.recording.output_directory import prepare_directory
from lavt.recording.record import read_record
from lavt.transport.messages import TEXT_BYTES
from lavt.transport.zenoh_config import with_address
from lavt.transport.zenoh_session import RouterUnreachable

ATTEMPTS = 3
"""How often a run is driven at most, if the connection is lost or a part fails."""
POLL_NS = 500 * NS_PER_MS
READY_POLL_NS = 100 * NS_PER_MS
"""How often to look whether a process of this machine is ready; nothing is measured yet."""
RETRY_NS = 2 * NS_PER_S
BUSY_LIMIT_S = LEASE_S + 15.0
"""How long to wait for the end of another run: so long that a run whose client has died is over."""
SERVER_START_LIMIT_S = START_LIMIT_S + 30.0
DRIVE_LIMIT_S = START_LIMIT_S + RUN_LIMIT_S + 60.0
"""Time limits for the server to be ready and for the record to be finished. The server has limits of its own, which are
shorter and say more; these are for a server that does not keep them."""
OUTAGE_S = 2.0
"""If the server has not answered for this time, a safe stop counts as an effect of the lost connection."""
UDP_PROTOCOLS = ("udp/", "quic/")
FINAL_REFUSALS = ("malformed", "invalid", "storage_full")
"""Refusals that another attempt would not change."""


@dataclass(frozen=True)
class RemoteServer:
    """The server that drives the runs, as this machine's client reaches it; can be pickled."""

    client: ClientConfig
    print_message: Callable[[str], None]

    def check(self, planned: Sequence[PlannedRun]) -> None:
        """Raise `UserError` for runs that cannot be driven on another machine, before the first one begins."""
        endpoint = vehicle_endpoint(self.client)
        for run in planned:
            network = run.config.network
            if run.config.time != "real":
                raise UserError("--server drives in real time: set time: real")
            if network.injection == "netem":
                raise UserError("--server injects with the relay on this machine: choose network.injection relay")
            if network.injection == "relay" and not endpoint.startswith(UDP_PROTOCOLS):
                raise UserError(f"the relay forwards UDP only: dial an endpoint udp/ or quic/, not {endpoint}")
            part = remote_part(run.config, run.seed)
            if len(part) > TEXT_BYTES[RunRequest]["settings"]:
                raise UserError(f"{run.name}: too many values differ from the defaults to request this run")
            parse_config(RemoteRunConfig, run.config.model_dump(include=set(RemoteRunConfig.model_fields)), run.name)

    def check_connection(self) -> None:
        """Raise `ConnectionLost` if the server does not answer, and `UserError` if its router does not."""
        with RunConnection(self.client, MachineClock()) as requests, suppress(RunRefused):
            requests.request("status", 0)

    def drive(self, planned: PlannedRun, out: Path) -> DriveData:
        """Drive a run, at most `ATTEMPTS` times; write everything into `out`, and return the result with its data."""
        for attempt in range(1, ATTEMPTS + 1):
            with TemporaryDirectory(prefix="lavt-") as work:
                try:
                    _drive(self.client, planned, Path(work))
                except (WorkError, RouterUnreachable) as error:
                    if attempt == ATTEMPTS or (isinstance(error, RunRefused) and error.refusal in FINAL_REFUSALS):
                        raise WorkError(f"{error} (attempt {attempt} of {ATTEMPTS})") from error
                    self.print_message(f"{planned.name}: attempt {attempt} of {ATTEMPTS} failed: {error}")
                    pause(RETRY_NS)
                else:
                    return _evaluate(planned, Path(work), out)
        raise AssertionError


def _evaluate(planned: PlannedRun, work: Path, out: Path) -> DriveData:
    prepare_directory(out)
    (out / CONFIG).write_text(config_text(planned))
    for path in (work / "server.mcap", work / "client" / "client.mcap", work / "client.yaml", work / RELAY):
        if path.is_file():
            shutil.move(path, out / path.name)
    identity = dict(planned.identity)
    if identity["inherent"] == "loopback":
        identity["inherent"] = NETWORK
    result = compute_result(out, identity, None)
    return extract_drive(read_record(out / "server.mcap"), out, result)


def _drive(config: ClientConfig, planned: PlannedRun, work: Path) -> None:
    """Drive once, and write the files of the run into `work`."""
    run = MachineEntropy().number(63)
    with RunConnection(config, MachineClock()) as requests, Processes(work) as processes:
        _begin(requests, run, remote_part(planned.config, planned.seed))
        try:
            ready = _wait(requests, run, lambda reply: reply.phase != "starting", SERVER_START_LIMIT_S)
            if not ready.video_port or not ready.probe_port:
                raise WorkError(f"the server names no ports of the run, which is {ready.phase}")
            keep_alive = partial(_status, requests, run)
            relay, client = _start_client(processes, config, planned, work, ready, keep_alive=keep_alive)
            requests.longest_wait_s = 0.0
            finished = _wait(requests, run, lambda reply: reply.phase == "finished", DRIVE_LIMIT_S, relay, client)
            if finished.ending == "safe_stop" and requests.longest_wait_s > OUTAGE_S:
                raise WorkError(
                    f"the server did not answer for {requests.longest_wait_s:.1f} s, and the vehicle made a safe stop"
                )
            for process in reversed(processes.started):
                process.end()
            if relay is not None:
                requested = {"requested_ms": requested_ms(planned), "traces": trace_digests(planned.requested)}
                write_json(work / RELAY, {**requested, **relay.last_line()})
            fetch_record(requests, run, finished, work / "server.mcap")
        finally:
            with suppress(LavtError):
                requests.request("end", run)
    check_record(work / "server.mcap", work / "client" / "client.mcap")


def check_record(server: Path, client: Path) -> None:
    """Raise `WorkError` if the server's record is incomplete, unreadable, or of another drive than the client's."""
    try:
        is_complete = read_record(server, channels=("event",)).complete
        check_same_drive(server, client)
    except UserError as error:
        raise WorkError(
            "the server sent a damaged record, or another client has driven: see whether another program uses the name "
            "of this operator"
        ) from error
    if not is_complete:
        raise WorkError("the server could not write the whole record: free space on its disk")


def _begin(requests: RunRequests, run: int, settings: str) -> None:
    """Request the run; wait while the server has another one."""
    until_ns = requests.clock.now().mono_ns + round(BUSY_LIMIT_S * NS_PER_S)
    while True:
        try:
            requests.request("begin", run, settings=settings)
        except RunRefused as refused:
            if refused.refusal != "busy" or requests.clock.now().mono_ns > until_ns:
                raise
        else:
            return
        pause(POLL_NS)


def _status(requests: RunRequests, run: int) -> RunReply:
    reply = requests.request("status", run)
    if reply.phase == "failed":
        raise WorkError(f"the run failed on the server: {reply.reason}")
    return reply


def _wait(
    requests: RunRequests, run: int, is_reached: Callable[[RunReply], bool], limit_s: float, *processes: Process | None
) -> RunReply:
    """Wait until the server's run has reached a phase.

    Raises `WorkError` if this takes longer than `limit_s`, or if the run fails or a process ends before.
    """
    until_ns = requests.clock.now().mono_ns + round(limit_s * NS_PER_S)
    while not is_reached(reply := _status(requests, run)):
        for process in processes:
            if process is not None and not process.running:
                code = process.popen.returncode
                raise WorkError(f"{process.name} ended during the run with exit code {code}: {process.last_message()}")
        if requests.clock.now().mono_ns > until_ns:
            raise WorkError(f"the run on the server is still {reply.phase} after {limit_s:.0f} s")
        pause(POLL_NS)
    return reply


def _start_client(
    processes: Processes,
    config: ClientConfig,
    planned: PlannedRun,
    work: Path,
    ready: RunReply,
    *,
    keep_alive: Callable[[], Any],
) -> tuple[Process | None, Process]:
    """Start the relay, if the run needs one, and the client; call `keep_alive` while they start."""
    host, endpoint, video_port = config.video.server, vehicle_endpoint(config), ready.video_port
    relay = None
    if planned.config.network.injection == "relay":
        control = endpoint.partition("/")[2].partition("?")[0].partition("#")[0]
        file = write_config(work, "relay", relay_config(planned, f"{host}:{video_port}", control))
        relay = processes.start("relay", "relay", file)
        ports = _wait_ready(relay, keep_alive)["ports"]
        host, endpoint = "127.0.0.1", with_address(endpoint, f"127.0.0.1:{ports['control']}")
        video_port = ports["video"]
    local = client_config(planned.config, planned.seed, zenoh=dialling(config, endpoint), video_port=video_port)
    local = local.model_copy(
        update={
            "vehicle_id": config.vehicle_id,
            "who": config.who,
            "security": config.security,
            "video": local.video.model_copy(update={"server": host}),
            "clock": config.clock.model_copy(
                update={"probe_port": ready.probe_port, "probe_server": config.video.server}
            ),
        }
    )
    client = processes.start("client", "client", write_config(work, "client", local), "--out", str(work / "client"))
    _wait_ready(client, keep_alive)
    return relay, client


def _wait_ready(process: Process, keep_alive: Callable[[], Any]) -> dict[str, Any]:
    clock = MachineClock()
    until_ns = clock.now().mono_ns + round(READY_LIMIT_S * NS_PER_S)
    while process.running and not process.first:
        if clock.now().mono_ns > until_ns:
            raise WorkError(f"{process.name} did not get ready within {READY_LIMIT_S:.0f} s")
        keep_alive()
        pause(READY_POLL_NS)
    return process.wait_ready()
