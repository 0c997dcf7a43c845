"""The composition root, which builds a server or a client.

The steps, each of which uses the results of the steps before it:

1. Check the output directory and the network interface on which delay is injected; read the keys.
2. Open the sockets and the Zenoh session, which do not deliver messages yet.
3. Build the nodes. For a by-wire vehicle, start the actuator node in a process of its own.
4. Open the record, and build the runtime of the nodes.
5. Build the gateway between the Zenoh session and the runtime, and the injector.

`Side.start` then starts the delivery of messages.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import yaml

from lavt.assembly.actuator_process import ActuatorProcess, start_actuator
from lavt.assembly.clock_source import build_query_process, clock_source
from lavt.assembly.entropy import MachineEntropy
from lavt.assembly.nodes import AGENT_ELSEWHERE, build_client, build_server
from lavt.assembly.rendezvous import open_flow
from lavt.assembly.security import Authenticator, build_authenticator, build_gateway
from lavt.assembly.vehicles import VehicleSetup
from lavt.assembly.zenoh import check_certificates, side_session
from lavt.clock import Clock
from lavt.config import AGENT, HUMAN, ClientConfig, ServerConfig
from lavt.domain import Now
from lavt.errors import UserError
from lavt.node import Node, Peer
from lavt.nodes.client_session import ClientSession
from lavt.nodes.payloads import DelayChoice
from lavt.recording.live_status import LiveStatus
from lavt.recording.output_directory import check_directory, prepare_directory
from lavt.recording.provenance import provenance
from lavt.recording.record import RecordWriter
from lavt.runtime.realtime import MessageLink, RealRuntime
from lavt.runtime.recorder import QueuedRecorder, Recorders
from lavt.transport.clock_sync.clock_report import kernel_identity
from lavt.transport.clock_sync.persistent_process import PersistentProcess
from lavt.transport.console.console_link import ConsoleLink
from lavt.transport.datagram_filter import ProbePortFilter, VideoPortFilter, filtered
from lavt.transport.emulation.impairment import ExemptPort
from lavt.transport.netem.injector import Injector
from lavt.transport.netem.netem import NetemInterface
from lavt.transport.rendezvous.link import RendezvousLink
from lavt.transport.udp_link import UdpLink
from lavt.transport.video.path_validation import PathServer
from lavt.transport.zenoh_link import ZenohLink
from lavt.transport.zenoh_session import quiet_logs

PrintMessage = Callable[[str], None]

CONSOLE_TOKEN_BYTES = 16
"""Length of the random token in the address of the console's page."""
WATCHED_PERSON = "--watch is for a controller, but a person drives: leave it out, and open the person's page once more"


@dataclass(frozen=True)
class Prepared:
    """The parts of a side that are built before any socket is opened, to find wrong settings early."""

    authenticator: Authenticator
    queues: NetemInterface | None
    """The network queues of the interface on which delay is injected; None if the config names no interface."""
    time_source: PersistentProcess
    """The process that queries the time source of this machine's clock."""


@dataclass(frozen=True)
class Links:
    """The connections of one side, opened before its nodes are built."""

    video: UdpLink | RendezvousLink
    probe: UdpLink | RendezvousLink
    zenoh: ZenohLink
    console: ConsoleLink | None = None
    """The pages from which a person drives or watches; None: there are none."""
    relay: MessageLink | None = None
    """A relay in this process whose delays the person chooses; None: there is none."""


class Side:
    """One side with all its parts; `start` runs it, and `close` ends it and completes the record.

    `in_force` returns the epoch in force and the sequence number of its last accepted command.
    """

    def __init__(
        self,
        config: ServerConfig | ClientConfig,
        clock: Clock,
        links: Links,
        nodes: Sequence[Node],
        *,
        out: Path | None,
        prepared: Prepared,
        in_force: Callable[[], tuple[int, int]],
        actuator: ActuatorProcess | None = None,
        session: ClientSession | None = None,
        path: PathServer | None = None,
        setup: VehicleSetup | None = None,
    ) -> None:
        self.clock = clock
        self.is_plain = not config.security.key
        """Whether messages are neither encrypted nor signed."""
        self.session = session
        """The client's session; None on a server."""
        self.actuator = actuator
        """The server's actuator if it runs in a process of its own, otherwise None."""
        self._links = links
        self._setup = setup
        """The server's vehicle; None on a client."""
        self._path = path
        """The server's end of the video path, which decides whose datagrams are dropped; None on a client."""
        self._time_source = prepared.time_source
        self.live = LiveStatus()
        self._record = None if out is None else QueuedRecorder(_open_record(config, out))
        recorder = Recorders(self.live) if self._record is None else Recorders(self.live, self._record)
        self.runtime = RealRuntime(
            clock,
            nodes,
            recorder,
            clock_source(config.clock, clock, prepared.time_source.run),
            {} if actuator is None else {actuator.name: actuator},
        )
        self._gateway = build_gateway(prepared.authenticator, self._deliver, links.zenoh.send, in_force)
        self._injector = Injector(clock, self._deliver, prepared.queues, _exempt_ports(config))

    def start(self) -> None:
        """Start the runtime, then deliver received messages to it."""
        links, gateway = self._links, self._gateway
        links.zenoh.start(gateway.receive)
        carriers: dict[str, MessageLink | None] = {
            "video": links.video,
            "probe": links.probe,
            "zenoh": gateway,
            "netem": self._injector,
            "console": links.console,
            "relay": links.relay,
        }
        if self._setup is not None:
            self._setup.run(self.clock)
        self.runtime.start({carrier: link for carrier, link in carriers.items() if link is not None})
        if links.console is not None:
            links.console.start(self._deliver)
        if self.actuator is not None:
            self.actuator.start(self.runtime)
        if self._path is None:
            links.video.start(self._deliver)
            links.probe.start(self._deliver)
        else:
            links.video.start(filtered(self._deliver, VideoPortFilter(self._path), links.video.counts))
            links.probe.start(filtered(self._deliver, ProbePortFilter(self._path), links.probe.counts))

    @property
    def console_url(self) -> str | None:
        """The address of the page from which a person drives or watches; None: there is none."""
        return None if self._links.console is None else self._links.console.url

    def send(self, channel: str, payload: Any) -> None:
        """Send a message of this program to the nodes of its own side that receive `channel`."""
        self._deliver(channel, payload, self.clock.now(), None)

    def close(self) -> None:
        """Stop the runtime, close all parts, and complete the record; a part that fails does not prevent the others."""
        links = self._links
        with ExitStack() as parts:  # calls the last callback first
            parts.callback(self._close_record)
            for link in (links.zenoh, links.probe, links.video, links.console):
                if link is not None:
                    parts.callback(link.close)
            parts.callback(self._time_source.close)
            parts.callback(self._injector.close)
            if self._setup is not None:
                parts.callback(self._setup.close)
            parts.callback(self.runtime.stop)
            if self.actuator is not None:
                parts.callback(self.actuator.end)

    def _close_record(self) -> None:
        """Record the counts of the links, and complete the record."""
        for name, counts in self._link_counts().items():
            self.runtime.record("counts", {"link": name, **counts}, self.clock.now())
        if self._record is not None:
            self._record.close(self.clock.now())

    def _link_counts(self) -> dict[str, Mapping[str, int]]:
        links = self._links
        return {
            "video": links.video.counts,
            "probe": links.probe.counts,
            "zenoh": {**links.zenoh.counts, **self._gateway.counts},
            **({} if links.console is None else {"console": links.console.counts}),
        }

    def _deliver(self, channel: str, payload: Any, arrived: Now, peer: Peer) -> None:
        """Deliver a message, unless the runtime has stopped."""
        if not self.runtime.stopped.is_set():
            self.runtime.deliver(channel, payload, arrived, peer)


@contextmanager
def open_server(
    config: ServerConfig, out: Path | None, clock: Clock, print_message: PrintMessage
) -> Iterator[tuple[Side, dict[str, Any]]]:
    """Build a server, yield it with its ports, the endpoints of its embedded router and the process id of its actuator.

    The server is closed afterwards.

    Raises `UserError` for a wrong config, before the output directory is created.
    """
    with ExitStack() as opened:
        prepared = _prepare(config, out, clock, opened, print_message)
        bind = config.video.bind
        video = open_flow(config, clock, "video", "feedback", bind=(bind, config.video.port), remote=None)
        opened.callback(video.close)
        probe = open_flow(config, clock, "probe", "probe_request", bind=(bind, config.clock.probe_port), remote=None)
        opened.callback(probe.close)
        links = Links(video, probe, opened.enter_context(closing(_open_zenoh(config, clock, print_message))))
        host = kernel_identity()
        nodes = build_server(config, clock.now, MachineEntropy(), host=host, video_port=video.port)
        opened.callback(nodes.setup.close)
        ready: dict[str, Any] = {"video_port": video.port, "probe_port": probe.port}
        if config.zenoh.is_embedded:
            ready["locators"] = links.zenoh.locators()
        if nodes.actuator is not None:
            actuator, in_force = None, nodes.actuator.gate.in_force
        else:
            process = actuator = start_actuator(config, host=host, video_port=video.port)
            opened.callback(process.end)
            in_force = process.in_force
            ready["actuator_pid"] = process.pid
        side = Side(
            config,
            clock,
            links,
            nodes.all,
            out=out,
            prepared=prepared,
            in_force=in_force,
            actuator=actuator,
            path=nodes.camera.path,
            setup=nodes.setup,
        )
        opened.pop_all()  # from now on, `side.close` closes these parts
    with closing(side):
        yield side, ready


@contextmanager
def open_client(
    config: ClientConfig,
    out: Path | None,
    clock: Clock,
    print_message: PrintMessage,
    *,
    relay: MessageLink | None = None,
    delays: DelayChoice | None = None,
    is_watched: bool = False,
) -> Iterator[Side]:
    """Build a client, yield it, and close it afterwards.

    If a person drives, they can choose from `delays` for `relay`, a relay in this process. With `is_watched`, there is
    a page that shows how the controller drives.

    Raises `UserError` for a wrong config, before the output directory is created.
    """
    if config.controller.kind == AGENT:
        raise UserError(AGENT_ELSEWHERE)
    is_human = config.controller.kind == HUMAN
    if is_human and is_watched:
        raise UserError(WATCHED_PERSON)
    with ExitStack() as opened:
        prepared = _prepare(config, out, clock, opened, print_message)
        server = config.video.server
        video = open_flow(config, clock, "video", "rtp", bind=("", 0), remote=(server, config.video.port))
        opened.callback(video.close)
        probe_address = (config.clock.probe_server or server, config.clock.probe_port)
        probe = open_flow(config, clock, "probe", "probe_reply", bind=("", 0), remote=probe_address)
        opened.callback(probe.close)
        console = None
        if is_human or is_watched:
            token = MachineEntropy().token(CONSOLE_TOKEN_BYTES).hex()
            console = ConsoleLink(clock, token, config.console.port, prefix="page" if is_human else "watch")
            opened.callback(console.close)
        zenoh = opened.enter_context(closing(_open_zenoh(config, clock, print_message)))
        links = Links(video, probe, zenoh, console, relay)
        nodes = build_client(config, clock.now, MachineEntropy(), delays=delays, is_watched=is_watched)
        side = Side(
            config,
            clock,
            links,
            nodes.all,
            out=out,
            prepared=prepared,
            in_force=lambda: (0, -1),  # only a server's gateway calls it
            session=nodes.driver.session,
        )
        opened.pop_all()
    with closing(side):
        yield side


def _prepare(
    config: ServerConfig | ClientConfig,
    out: Path | None,
    clock: Clock,
    opened: ExitStack,
    print_message: PrintMessage,
) -> Prepared:
    if out is not None:
        check_directory(out)
    authenticator = build_authenticator(config, clock.now().wall_ns)
    if config.security.key:
        check_certificates(side_session(config), clock.now().wall_ns)
    queues = NetemInterface(config.injection.interface) if config.injection.interface else None
    for message in () if queues is None else queues.check():
        print_message(message)
    return Prepared(authenticator, queues, opened.enter_context(closing(build_query_process(config.clock))))


def _open_zenoh(config: ServerConfig | ClientConfig, clock: Clock, print_message: PrintMessage) -> ZenohLink:
    quiet_logs()
    return ZenohLink(
        clock,
        side="server" if isinstance(config, ServerConfig) else "client",
        settings=side_session(config),
        vehicle=config.vehicle_id,
        who="server" if isinstance(config, ServerConfig) else config.who,
        waiting=lambda reason: print_message(f"lavt: {reason}; waiting for one"),
    )


def _exempt_ports(config: ServerConfig | ClientConfig) -> list[ExemptPort]:
    port = config.clock.probe_port
    return [ExemptPort("udp", port, "the clock probe")] if port else []


def _open_record(config: ServerConfig | ClientConfig, out: Path) -> RecordWriter:
    """Create the output directory and the record."""
    name: Literal["server", "client"] = "server" if isinstance(config, ServerConfig) else "client"
    prepare_directory(out)
    (out / "config.yaml").write_text(yaml.safe_dump(config.model_dump(mode="json"), sort_keys=False))
    writer = RecordWriter(out / f"{name}.mcap", name, left_out=config.record.left_out)
    for topic, entries in provenance().items():
        writer.annotate(topic, entries)
    return writer
