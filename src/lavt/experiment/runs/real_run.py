"""One run in real time on this machine: a server, a client and a relay, each a process of its own.

Server and client contain their Zenoh routers. With netem on the loopback there is no relay.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import yaml
from pydantic import BaseModel

from lavt.assembly.links import trace_digests, trace_path
from lavt.clock import MachineClock, pause
from lavt.config import DelayConfig, ImpairmentConfig, LinkConfig, RelayConfig
from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.errors import WorkError
from lavt.experiment.analysis.invalid_reason import InvalidCode, InvalidReason, MeasuredCheck
from lavt.experiment.analysis.results import write_json
from lavt.experiment.analysis.validity import INJECTION_LIMIT_MS, injection_reasons, lateness_reasons
from lavt.experiment.runs.netem_run import NETEM, NetemRun, uses_netem
from lavt.experiment.runs.network import NetworkDelays, injected_network
from lavt.experiment.runs.plan import PlannedRun
from lavt.experiment.runs.processes import LAVT, Process, Processes
from lavt.experiment.runs.side_configs import client_config, embedded_router, server_config
from lavt.experiment.runs.virtual_run import read_costs
from lavt.transport.emulation.delay_line import DelayModel

RELAY = "relay.json"
"""The file in a run directory with the delays that the relay was asked to inject, and the delays that it measured."""
DELAYED_DIRECTIONS = {"video": "video downstream", "control": "control upstream"}
"""The delayed direction of each relayed flow, as `relay.json` names it."""
BEGIN_LIMIT_S = 40
"""The time limit for the start of the drive; the time begins when all processes have started."""
PERSON_BEGIN_LIMIT_S = 1800
"""The time limit for the start of a drive by a person, who opens the page first."""
RUN_LIMIT_S = 900
"""The time limit for the ending of the drive, except that of a person; the time begins when all processes have
started."""
UNIMPAIRED = ImpairmentConfig()
STATUS_PERIOD_NS = 200 * NS_PER_MS

Progress = Callable[[dict[str, Any], dict[str, Any]], None]
"""A callback with the status of the server and of the client, called several times a second."""


Show = Callable[[str], None]
"""A function that shows a person the page at an address."""


@dataclass(frozen=True, slots=True)
class PersonPage:
    """The page from which a person drives: its TCP port (0: any), and a function that shows it."""

    port: int
    show: Show


@dataclass(frozen=True, slots=True)
class LoopProcesses:
    """The processes of a run. With a relay, all video and control between server and client passes through it."""

    server: Process
    relay: Process | None
    client: Process
    router: str
    """The endpoint of the server's router for other programs on this machine."""
    server_ready: Mapping[str, Any]
    """The server's `ready` message, with its ports."""


def start_loop(
    processes: Processes,
    planned: PlannedRun,
    out: Path,
    work: Path,
    *,
    rearm: bool = False,
    once: bool = True,
    server_program: Sequence[str] = LAVT,
    netem: NetemRun | None = None,
    console_port: int = 0,
    is_watched: bool = False,
) -> LoopProcesses:
    """Start all processes in order; each gets the ports of the processes before it.

    The sides write their records into `out`. The configs of the processes are written into `work`. Without `once`, the
    server keeps running after the first drive. `netem` is applied before the client starts. `console_port` is the port
    of the page if a person drives, or watches the controller (`is_watched`).
    """
    run = planned.config
    server_yaml = write_config(work, "server", server_config(run, planned.seed))
    arguments = ("server", server_yaml, *(["--once"] if once else []), "--out", str(out / "server"))
    server = processes.start("server", *arguments, program=server_program)
    ready = server.wait_ready()["ready"]
    video_port, control_port = ready["video_port"], _port(ready["locators"], "udp/")
    relay = None
    if run.network.injection == "relay":
        addresses = f"127.0.0.1:{video_port}", f"127.0.0.1:{control_port}"
        relay = processes.start("relay", "relay", write_config(work, "relay", relay_config(planned, *addresses)))
        ports = relay.wait_ready()["ports"]
        video_port, control_port = ports["video"], ports["control"]
    elif netem is not None:
        netem.apply(video_port=video_port, control_port=control_port)
    dialled = f"udp/127.0.0.1:{control_port}?rel=1;mixed_rel=1"
    zenoh = embedded_router(dialled=[dialled])
    config = client_config(run, planned.seed, zenoh=zenoh, video_port=video_port, probe_port=ready["probe_port"])
    controller = config.controller.model_copy(update={"rearm": rearm})
    console = config.console.model_copy(update={"port": console_port})
    config = config.model_copy(update={"controller": controller, "console": console})
    client_arguments = (write_config(work, "client", config), "--out", str(out / "client"))
    client = processes.start("client", "client", *client_arguments, *(["--watch"] if is_watched else []))
    client.wait_ready()
    router = next(locator for locator in ready["locators"] if locator.startswith("tcp/"))
    return LoopProcesses(server, relay, client, router, ready)


def drive_real(
    planned: PlannedRun,
    out: Path,
    *,
    progress: Progress | None = None,
    page: PersonPage | None = None,
    watch: Show | None = None,
) -> None:
    """Drive once, and write the two records into `out`, with the requests and measurements of the relay or netem.

    A drive by a person needs `page`. `watch` shows a page that shows how the controller drives.

    Raises `WorkError` if a process ends early or the drive does not begin; the records up to then stay in `out`.
    """
    with TemporaryDirectory(prefix="lavt-") as work_name:
        work = Path(work_name)
        try:
            with ExitStack() as stack:
                netem = stack.enter_context(NetemRun(planned)) if uses_netem(planned) else None
                processes = stack.enter_context(Processes(work))
                port = 0 if page is None else page.port
                is_watched = watch is not None
                loop = start_loop(processes, planned, work, work, netem=netem, console_port=port, is_watched=is_watched)
                show = watch if page is None else page.show
                if show is not None:
                    show(loop.client.first["ready"]["console"])
                begin_limit_s = BEGIN_LIMIT_S if page is None else PERSON_BEGIN_LIMIT_S
                _wait_for_ending(processes, loop, progress, begin_limit_s=begin_limit_s)
                for process in reversed(processes.started):
                    process.end()
                if loop.relay is not None:
                    requested = {"requested_ms": requested_ms(planned), "traces": trace_digests(planned.requested)}
                    write_json(out / RELAY, {**requested, **loop.relay.last_line()})
                if netem is not None:
                    write_json(out / NETEM, netem.report())
        finally:
            for record in work.glob("*/*.mcap"):
                shutil.move(record, out / record.name)


def _wait_for_ending(
    processes: Processes, loop: LoopProcesses, progress: Progress | None, *, begin_limit_s: float
) -> None:
    run_limit_s = RUN_LIMIT_S + begin_limit_s - BEGIN_LIMIT_S
    clock = MachineClock()
    start_ns = clock.now().mono_ns
    while loop.server.running and loop.server.latest.get("ending") is None:
        elapsed_s = (clock.now().mono_ns - start_ns) / NS_PER_S
        status = loop.server.latest.get("status", {})
        others = (process for process in processes.started if process is not loop.server)
        ended = next((process for process in others if not process.running), None)
        if ended is not None:
            code = ended.popen.returncode  # a negative code is the number of the signal that ended the process
            raise WorkError(f"{ended.name} ended during the run with exit code {code}: {ended.last_message()}")
        not_begun = status.get("safety") in (None, "disarmed", "arming")
        if elapsed_s > run_limit_s or (elapsed_s > begin_limit_s and not_begun):
            client = loop.client.latest.get("status", {})
            raise WorkError(
                f"the drive did not begin or end within {elapsed_s:.0f} s; vehicle: {_describe(status, 'safety')}; "
                f"client: {_describe(client, 'phase')}"
            )
        if progress is not None:
            progress(status, loop.client.latest.get("status", {}))
        pause(STATUS_PERIOD_NS)
    if loop.server.popen.poll() not in (None, 0):
        raise WorkError(f"the server failed: {loop.server.last_message()}")


def _describe(status: Mapping[str, Any], state: str) -> str:
    """Return the state of a side with its reason, as far as its status has them."""
    return ", ".join(str(status[key]) for key in (state, "reason") if status.get(key)) or "no status"


def requested_ms(planned: PlannedRun) -> dict[str, float | None]:
    """Return the median delay that the relay is asked to inject into each flow, including the inherent latency.

    The value is None for a flow with an impairment other than a constant delay, because its median depends on the
    traffic.
    """
    delays = _injected_delays(planned)
    return {
        "video": delays.video.median_ms() if delays.video_injected is None else None,
        "control": delays.control.median_ms() if delays.control_injected is None else None,
    }


def relay_invalid_reasons(relay: Mapping[str, Any]) -> list[InvalidReason]:
    """Return a reason for each flow whose delay in the relay differs from the request; `relay` is from `relay.json`.

    For a flow with an impairment other than a constant delay, the send times of packets are compared with the planned
    send times.
    """
    requested_ms = relay.get("requested_ms", {"video": 0.0, "control": 0.0})
    constant_ms = {flow: delay_ms for flow, delay_ms in requested_ms.items() if delay_ms is not None}
    measured_ms, lateness_ms = relay.get("held_ms", {}), relay.get("late_ms", {})
    return [
        *injection_reasons(constant_ms, {flow: measured_ms.get(DELAYED_DIRECTIONS[flow]) for flow in constant_ms}),
        *lateness_reasons(
            {flow: lateness_ms.get(DELAYED_DIRECTIONS[flow]) for flow in requested_ms if flow not in constant_ms}
        ),
    ]


def relay_checks(relay: Mapping[str, Any]) -> list[MeasuredCheck]:
    """Return the check of `relay_invalid_reasons`: the largest difference of a flow's delay from the request."""
    differences_ms = []
    for flow, delay_ms in relay.get("requested_ms", {}).items():
        measured_ms = relay.get("late_ms" if delay_ms is None else "held_ms", {}).get(DELAYED_DIRECTIONS[flow])
        if measured_ms is not None:
            differences_ms.append(abs(measured_ms - (delay_ms or 0.0)))
    if not differences_ms:
        return []
    return [MeasuredCheck(InvalidCode.INJECTION_DIFFERS, max(differences_ms), INJECTION_LIMIT_MS)]


def _injected_delays(planned: PlannedRun) -> NetworkDelays:
    network = planned.config.network
    return injected_network(
        network.inherent, planned.requested, read_costs(), planned.seed, state_delay=network.state_delay
    )


def _port(locators: Sequence[str], protocol: str) -> int:
    """Return the port of the locator with a protocol."""
    locator = next(locator for locator in locators if locator.startswith(protocol))
    return int(locator.partition("?")[0].rpartition(":")[2])


def relay_config(planned: PlannedRun, video_server: str, control_server: str) -> RelayConfig:
    """Return the config of the relay of a run, which forwards to these addresses of the server."""
    injected, requested = _injected_delays(planned), planned.requested
    return RelayConfig(
        video_server=video_server,
        control_server=control_server,
        video=_delay_config(injected.video, requested.video_ms, requested.video),
        control=_delay_config(injected.control, requested.control_ms, requested.control),
        state=_delay_config(injected.state),
        seed=planned.seed,
    )


def _delay_config(delay: DelayModel, delay_ms: float = 0.0, impairment: ImpairmentConfig = UNIMPAIRED) -> DelayConfig:
    link = LinkConfig()
    if impairment != UNIMPAIRED:
        requested = impairment.model_dump()
        requested["trace"] = str(trace_path(impairment.trace).absolute()) if impairment.trace else ""
        link = LinkConfig(delay_ms=delay_ms, **requested)
    if delay.jitter is None:
        return DelayConfig(constant_ms=delay.constant_ms, link=link)
    return DelayConfig(
        constant_ms=delay.constant_ms,
        jitter_median_ms=delay.jitter.median_ms,
        jitter_sigma=delay.jitter.sigma,
        link=link,
    )


def write_config(work: Path, name: str, config: BaseModel) -> str:
    """Write the config of a process, and return the file's path."""
    path = work / f"{name}.yaml"
    path.write_text(yaml.safe_dump(config.model_dump(mode="json")))
    return str(path)
