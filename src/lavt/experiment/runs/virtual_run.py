"""One run in virtual time: the nodes of both sides, connected by simulated links."""

from __future__ import annotations

import functools
import gc
import hashlib
import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, Protocol

from lavt.assembly.entropy import SeededEntropy
from lavt.assembly.fidelity import FIDELITIES
from lavt.assembly.links import trace_digests
from lavt.assembly.nodes import ClientNodes, ServerNodes, build_client, build_server
from lavt.channels import CHANNELS
from lavt.config import Condition, Costs, RunConfig
from lavt.config_file import load_config, shipped
from lavt.domain import NS_PER_S, NS_PER_US, GroundTruth, Now
from lavt.experiment.runs.network import NetworkDelays, in_ns, injected_network, virtual_delay
from lavt.experiment.runs.plan import PlannedRun
from lavt.experiment.runs.side_configs import client_config, server_config
from lavt.recording.output_directory import make_directory
from lavt.recording.provenance import provenance
from lavt.recording.record import RecordWriter
from lavt.runtime.recorder import Recorder, Recorders
from lavt.runtime.virtual import Cost, HostClock, VirtualHost, VirtualLink, VirtualRuntime, modelled_clock_source
from lavt.streams import QuantileStream
from lavt.transport.emulation.delay_line import DelayLine, DelayModel
from lavt.transport.emulation.link import EmulatedLink, LinkInjection
from lavt.transport.emulation.relay import video_delay_index

SERVER_MONO_NS = 1_000 * NS_PER_S
CLIENT_MONO_NS = 7_000 * NS_PER_S
"""The monotonic clocks at the start of every virtual run. They differ, as the monotonic clocks of two machines do."""
WALL_NS = 1_790_000_000 * NS_PER_S
"""The true wall time at the start of every virtual run, a day of 2026."""
CLIENT_ADDRESS = ("198.51.100.2", 40_000)
"""The source address of the client's datagrams, from the documentation range (RFC 5737)."""
SERVER_VIDEO_PORT = 5600
ARMING_LIMIT_NS = 30 * NS_PER_S
RUN_LIMIT_NS = 3600 * NS_PER_S
AFTER_ENDING_NS = NS_PER_S // 5
"""The recording continues for this time after the ending of the drive."""


class LoopWatcher(Recorder, Protocol):
    """A recorder of both sides, which gets at least the entries of `channels` while the loop runs."""

    @property
    def channels(self) -> frozenset[str]:
        """The channels whose entries it needs, even if nothing is recorded."""
        ...


class DriveObserver:
    """A recorder that observes the start and the ending of the drive, and keeps nothing else."""

    channels: ClassVar[frozenset[str]] = frozenset({"truth", "event"})

    def __init__(self) -> None:
        self.began = False
        self.ending: str | None = None
        self._truth: GroundTruth | None = None

    def status(self) -> dict[str, Any]:
        """Return the newest speed and cross-track error for display; empty before the first ground truth."""
        truth = self._truth
        return {} if truth is None else {"speed_mps": truth.speed_mps, "cross_track_m": truth.cross_track_m}

    def write(self, topic: str, payload: Any, now: Now) -> None:  # noqa: ARG002 (part of the protocol)
        """Observe one entry."""
        if topic == "truth":
            self._truth = payload
        elif topic == "event":
            self.began |= payload.kind == "drive_began"
            if payload.kind == "ending":
                self.ending = payload.detail


@dataclass(frozen=True, slots=True)
class VirtualLoop:
    """All parts of a virtual run that is not yet driven; tests modify them."""

    runtime: VirtualRuntime
    server: ServerNodes
    client: ClientNodes
    observer: DriveObserver
    writers: tuple[RecordWriter, ...]
    """Those of server and client; none if nothing is recorded."""
    digest: Any

    def close(self) -> None:
        """Close the vehicle's connections, and complete the records."""
        self.server.setup.close()
        for writer in self.writers:
            writer.close()


@functools.cache
def read_costs() -> Costs:
    """Return the shipped costs of the stages and links, which are read only once."""
    return load_config(Costs, shipped("configs/costs.yaml"))


def host_clocks(config: RunConfig) -> tuple[HostClock, HostClock]:
    """Return the clocks of server and client: the client's is true, the server's has an offset and a drift."""
    return (
        HostClock(SERVER_MONO_NS, WALL_NS, round(config.clocks.offset_ms * 1e6), round(config.clocks.drift_ppm * 1000)),
        HostClock(CLIENT_MONO_NS, WALL_NS),
    )


def build_loop(
    planned: PlannedRun,
    out: Path | None,
    *,
    clocks: tuple[HostClock, HostClock] | None = None,
    watcher: LoopWatcher | None = None,
) -> VirtualLoop:
    """Build both sides of a run, which record into `out`, and the links between them; create `out` if needed.

    If `out` is None, nothing is recorded. Raises `UserError` for an invalid config, before the directory is created.
    """
    config, seed = planned.config, planned.seed
    server_clock, client_clock = clocks or host_clocks(config)
    server, client = _build_nodes(config, seed, server_clock, client_clock, out)
    costs = read_costs() if config.costs == "measured" else read_costs().constant
    requested = planned.requested
    digest = hashlib.sha256()
    left_out = config.left_out
    writers: tuple[RecordWriter, ...] = ()
    if out is not None:
        writers = tuple(
            RecordWriter(out / f"{side}.mcap", side, digest, left_out=left_out) for side in ("server", "client")
        )
    for writer in writers:
        _annotate(writer, costs, requested)
    observer = DriveObserver()
    watching = () if watcher is None else (watcher,)
    if out is None:
        left_out = frozenset(CHANNELS).difference(observer.channels, *(each.channels for each in watching))
    client_recorders: tuple[Recorder, ...] = (*watching, *writers[1:])
    costs_ns = stage_costs_ns(costs, seed)
    error_s, bound_s = config.clocks.error_us / 1e6, config.clocks.bound_us / 1e6
    hosts = [
        VirtualHost(
            "server",
            server_clock,
            server.all,
            Recorders(observer, *watching, *writers[:1]),
            costs_ns,
            modelled_clock_source(server_clock, "virtual-server", error_s, bound_s),
            left_out=left_out,
        ),
        VirtualHost(
            "client",
            client_clock,
            client.all,
            client_recorders[0] if len(client_recorders) == 1 else Recorders(*client_recorders),
            costs_ns,
            modelled_clock_source(client_clock, "virtual-client", -error_s, bound_s),
            CLIENT_ADDRESS,
            left_out=left_out,
        ),
    ]
    network = config.network
    injected = injected_network(network.inherent, requested, costs, seed, state_delay=network.state_delay)
    runtime = VirtualRuntime(hosts, virtual_links(injected, costs, seed))
    return VirtualLoop(runtime, server, client, observer, writers, digest)


def _build_nodes(
    config: RunConfig, seed: int, server_clock: HostClock, client_clock: HostClock, out: Path | None
) -> tuple[ServerNodes, ClientNodes]:
    """Build the nodes of both sides, and create `out`, if any; after an error, close the vehicle's connections."""
    fidelity = FIDELITIES[config.fidelity]()
    server = build_server(
        server_config(config, seed),
        lambda: server_clock.now_at(0),
        SeededEntropy(seed, "server"),
        host="virtual-server",
        video_port=SERVER_VIDEO_PORT,
        fidelity=fidelity,
        lazy_physics=True,
    )
    try:
        client = build_client(
            client_config(config, seed),
            lambda: client_clock.now_at(0),
            SeededEntropy(seed, "client"),
            fidelity=fidelity,
        )
        if out is not None:
            make_directory(out)
    except BaseException:
        server.setup.close()
        raise
    return server, client


def _annotate(writer: RecordWriter, costs: Costs, requested: Condition) -> None:
    """Store in a record what its values were computed from."""
    for name, entries in provenance().items():
        writer.annotate(name, entries)
    writer.annotate(
        "model",
        {
            "costs": costs.model_dump_json(),
            "condition": requested.model_dump_json(),
            "traces": json.dumps(trace_digests(requested)),
        },
    )


def stage_costs_ns(costs: Costs, seed: int) -> dict[tuple[str, str], Cost]:
    """Return the time of each stage in ns, by node and stage; it is drawn if the costs have quantiles of the stage."""
    costs_ns: dict[tuple[str, str], Cost] = {
        (node, stage): round(cost_us * NS_PER_US)
        for node, stages in costs.stages_us.items()
        for stage, cost_us in stages.items()
    }
    for node, stages_us in costs.stage_quantiles_us.items():
        for stage, quantiles_us in stages_us.items():
            name = f"cost of stage {node} {stage}"
            costs_ns[node, stage] = QuantileStream(seed, name, costs.levels, in_ns(quantiles_us))
    return costs_ns


def virtual_links(network: NetworkDelays, costs: Costs, seed: int) -> dict[str, VirtualLink]:
    """Return the links of all channels that cross the network.

    In reality, commands and session requests share a network path. Here each of the two channels has a delay line and
    random-number streams of its own, so that they do not affect each other. The random delay of a packet depends on the
    packet's number or, for video, on its frame.
    """

    def packet_number(_payload: bytes, number: int) -> int:
        return number

    def video_frame(payload: bytes, _number: int) -> int:
        return video_delay_index(payload)

    session = None if network.control_injected is None else replace(network.control_injected, name="session")
    links: dict[str, tuple[DelayModel, str, LinkInjection | None]] = {
        "rtp": (network.video, "video", network.video_injected),
        "control": (network.control, "control", network.control_injected),
        "state": (network.state, "state", None),
        "feedback": (network.without_injection, "state", None),
        "session": (network.control, "control", session),
        "session_reply": (network.state, "state", None),
        "probe_request": (network.without_injection, "state", None),
        "probe_reply": (network.without_injection, "state", None),
    }
    """By channel: the requested delay, the key of the link's own latency in the costs, and what else is injected."""
    return {
        channel: VirtualLink(
            DelayLine(
                virtual_delay(requested, costs, cost_key, seed, channel),
                None if injected is None else EmulatedLink(injected),
            ),
            video_frame if channel == "rtp" else packet_number,
        )
        for channel, (requested, cost_key, injected) in links.items()
    }


def drive(loop: VirtualLoop, *, limit_ns: int = RUN_LIMIT_NS, progress: Callable[[int], None] | None = None) -> None:
    """Run until shortly after the ending of the drive, until the limit for arming, or until `limit_ns`.

    `progress` is called with the virtual time in ns, once per second of virtual time.
    """
    runtime, observer = loop.runtime, loop.observer
    if progress is not None:
        _report_every_second(runtime, progress)
    # Exclude the existing objects from garbage collection: they exist until the end, and visiting them took over 3 % of
    # the time.
    gc.freeze()
    try:
        has_begun = runtime.run(min(ARMING_LIMIT_NS, limit_ns), lambda: observer.began)
        if has_begun and runtime.run(limit_ns, lambda: observer.ending is not None):
            runtime.run(runtime.true_ns + AFTER_ENDING_NS, lambda: False)
        runtime.close()
    finally:
        gc.unfreeze()
        loop.close()


def free_finished_loops(config: RunConfig) -> None:
    """Free the loops of finished runs, each of which has up to 250 MB of painted ground.

    The nodes of a loop refer to each other, and Python would find them much later. `config` is that of the last run:
    without pictures a loop is so small that the search, which takes 50 ms, is omitted.
    """
    if config.fidelity != "geometry":
        gc.collect()


def _report_every_second(runtime: VirtualRuntime, progress: Callable[[int], None]) -> None:
    def report() -> None:
        progress(runtime.true_ns)
        runtime.call_at(runtime.true_ns + NS_PER_S, report)

    runtime.call_at(NS_PER_S, report)
