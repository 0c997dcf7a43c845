"""The code shared by `lavt server` and `lavt client`: links, record, runtime and printed status."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Literal

import yaml

from lavt.assembly.actuator_process import ActuatorProcess
from lavt.assembly.clock_source import clock_source, interpreter
from lavt.assembly.rendezvous import open_flow
from lavt.assembly.security import gateway_of
from lavt.cli import console
from lavt.cli.router import find_file
from lavt.cli.session_log import SessionLog, client_end_line, server_end_line
from lavt.clock import MachineClock
from lavt.config import ClientConfig, ServerConfig
from lavt.domain import NS_PER_S, Now, State
from lavt.errors import WorkError
from lavt.node import Node
from lavt.nodes.client_session import ClientSession
from lavt.recording.live_status import LiveTap
from lavt.recording.output_directory import check_directory, prepare_directory
from lavt.recording.provenance import provenance
from lavt.recording.record import RecordWriter
from lavt.runtime.realtime import RealRuntime
from lavt.runtime.recorder import QueuedRecorder
from lavt.safety.limits import LIMITS
from lavt.safety.state_machine import ACTIVE
from lavt.transport.emulation.impairment import ExemptPort
from lavt.transport.netem.injector import Injector
from lavt.transport.netem.netem import NetemInterface
from lavt.transport.rendezvous.forwarder import FlowName
from lavt.transport.rendezvous.link import RendezvousLink
from lavt.transport.udp_link import UdpLink
from lavt.transport.zenoh_link import ZenohLink, quiet_logs

STATUS_PERIOD_S = 0.2
POLL_PERIOD_S = 0.02
RELEASE_TIMEOUT_S = 1.0
"""How long a client that ends waits for the answer to its release; any network that is good enough to drive over is
faster."""
STOP_TIMEOUT_S = 6.0
"""How long a server that ends waits for standstill: from 40 km/h with 4 m/s2 it takes 2.8 s."""


class NoRecorder:
    """A recorder that discards every entry."""

    def write(self, topic: str, payload: Any, now: Now) -> None:
        """Discard one entry."""


class Side:
    """The links and the record of one side, opened before its nodes are built and closed after its runtime."""

    def __init__(
        self,
        config: ServerConfig | ClientConfig,
        out: Path | None,
        clock: MachineClock,
    ) -> None:
        self.clock = clock
        self.runtime: RealRuntime | None = None
        self.name = config.who if isinstance(config, ClientConfig) else "server"
        """This side's name in messages: the operator's name, or "server"."""
        self._name: Literal["server", "client"] = "client" if isinstance(config, ClientConfig) else "server"
        self._config = config
        self._out = out
        self._writer: RecordWriter | None = None
        self._queue: QueuedRecorder | None = None
        self._udp: dict[str, UdpLink | RendezvousLink] = {}
        self._interpreter = interpreter(config.clock)
        if out is not None:
            check_directory(out)
        queues = _queues(config)
        quiet_logs()
        self.in_force: Callable[[], tuple[int, int]] = lambda: (0, -1)
        """The server's function that returns the epoch in force and the sequence of the last accepted command."""
        self._gateway = gateway_of(
            config, self._deliver, lambda *sends: self._zenoh.send(*sends), lambda: self.in_force()
        )
        self._zenoh = ZenohLink(
            clock,
            self._gateway.receive,
            side=self._name,
            path=find_file(Path(config.zenoh.session)),
            router=config.zenoh.router,
            vehicle=config.vehicle_id,
            who=self.name,
            waiting=lambda reason: console.print_message(f"lavt: {reason}; waiting for one"),
        )
        self._injector = Injector(clock, self._deliver, queues, _exempt_ports(config))
        self.tap = LiveTap(NoRecorder())
        self.actuator: ActuatorProcess | None = None
        """The server's actuator if it runs in a process of its own."""

    def open_video(self, channel: str, *, bind: tuple[str, int], remote: tuple[str, int] | None = None) -> int:
        """Open the video socket, deliver its datagrams on `channel`, and return its port."""
        return self._open("video", channel, bind, remote)

    def open_probe(self, channel: str, *, bind: tuple[str, int], remote: tuple[str, int] | None = None) -> int:
        """Open the socket of the clock probe, deliver its datagrams on `channel`, and return its port."""
        return self._open("probe", channel, bind, remote)

    def _open(self, name: FlowName, channel: str, bind: tuple[str, int], remote: tuple[str, int] | None) -> int:
        link = open_flow(self._config, self.clock, name, channel, self._deliver, bind=bind, remote=remote)
        self._udp[name] = link
        return link.port

    def start(self, nodes: Sequence[Node]) -> RealRuntime:
        """Open the record, start the runtime, then receive messages."""
        if self._out is not None:
            self._writer = self._open_record(self._out)
            self.tap = LiveTap(self._writer)
        self._queue = QueuedRecorder(self.tap)
        source = clock_source(self._config.clock, self.clock, self._interpreter.run)
        remote_nodes = {} if self.actuator is None else {self.actuator.name: self.actuator}
        self.runtime = RealRuntime(self.clock, nodes, self._queue, source, remote_nodes)
        self._zenoh.start()
        self.runtime.start({**self._udp, "zenoh": self._gateway, "netem": self._injector})
        if self.actuator is not None:
            self.actuator.start(self.runtime)
        for link in self._udp.values():
            link.start()
        return self.runtime

    def send(self, channel: str, payload: Any) -> None:
        """Deliver a message to a node of this side."""
        self._deliver(channel, payload, self.clock.now(), None)

    def _open_record(self, out: Path) -> RecordWriter:
        """Create the output directory and the record, after all input has been checked."""
        prepare_directory(out)
        (out / "config.yaml").write_text(yaml.safe_dump(self._config.model_dump(mode="json"), sort_keys=False))
        writer = RecordWriter(out / f"{self._name}.mcap", self._name, left_out=self._config.record.left_out)
        for name, entries in provenance().items():
            writer.annotate(name, entries)
        return writer

    def _deliver(self, channel: str, payload: Any, arrived: Now, peer: Any) -> None:
        if self.runtime is not None and not self.runtime.stopped.is_set():
            self.runtime.deliver(channel, payload, arrived, peer)

    def __enter__(self) -> Side:
        return self

    def __exit__(
        self, _kind: type[BaseException] | None, _error: BaseException | None, _trace: TracebackType | None
    ) -> None:
        if self.actuator is not None:
            self.actuator.end()
        if self.runtime is not None:
            self.runtime.stop()
        self._injector.close()
        self._interpreter.close()
        for each in self._udp.values():
            each.close()
        self._zenoh.close()
        if self._queue is not None:
            counts = {
                **{name: link.counts for name, link in self._udp.items()},
                "zenoh": {**self._zenoh.counts, **self._gateway.counts},
            }
            for name, counted in counts.items():
                self._queue.write("counts", {"link": name, **counted}, self.clock.now())
            self._queue.close(self.clock.now())
            if self._writer is not None and not self._queue.failed:
                self._writer.close()


def _queues(config: ServerConfig | ClientConfig) -> NetemInterface | None:
    """Return the queues of the configured interface, if any; raise `UserError` if netem cannot be applied to it."""
    if not config.injection.interface:
        return None
    netem = NetemInterface(config.injection.interface)
    for sentence in netem.check():
        console.print_message(sentence)
    return netem


def _exempt_ports(config: ServerConfig | ClientConfig) -> list[ExemptPort]:
    port = config.clock.probe_port
    return [ExemptPort("udp", port, "the clock probe")] if port else []


def run_side(
    side: Side,
    nodes: Sequence[Node],
    *,
    once: bool,
    as_json: bool,
    ready: Mapping[str, Any],
    session: ClientSession | None = None,
) -> None:
    """Run until Ctrl-C, until a node fails or, with `once`, until the drive has ended; print the session's log.

    Before it ends, a client releases the vehicle and a server stops it. A second Ctrl-C ends the process immediately.
    """
    log = SessionLog(side.name if session is not None else "")
    with console.stop_on_signals() as stop:
        runtime = side.start(nodes)
        if as_json:
            console.print_json({"ready": dict(ready)})
        while not stop.wait(STATUS_PERIOD_S) and not runtime.stopped.is_set():
            _print_status(side, log, session, as_json=as_json)
            if once and side.tap.ending is not None:
                break
        if not runtime.stopped.is_set():
            stop.clear()
            last_line = _stop_vehicle(side, stop) if session is None else _release(side, stop, session)
            _print_status(side, log, session, as_json=as_json, last_line=last_line)
    if runtime.failed is not None:
        raise WorkError(f"stopped because a node failed: {runtime.failed}")


def _print_status(
    side: Side, log: SessionLog, session: ClientSession | None, *, as_json: bool, last_line: str = ""
) -> None:
    """Print the new lines of the log and then `last_line`; as JSON, print the status too."""
    for heard, at in side.tap.take_updates():
        if isinstance(heard, State):
            log.add_state(heard, at.mono_ns, has_control=session is not None and session.has_control)
        else:
            log.add_rejection(heard)
    log.set_ending(side.tap.ending)
    status = side.tap.status()
    if session is not None:
        if not last_line:
            log.set_phase(session.phase, session.reason)
        status |= {"phase": session.phase, "session": session.reason}
    lines = log.take_lines(side.clock.now().mono_ns) + [last_line] * bool(last_line)
    if as_json:
        console.print_json({"status": status, "ending": side.tap.ending, "said": lines})
        return
    for line in lines:
        console.print_result(line)


def _release(side: Side, stop: console.StopEvent, session: ClientSession) -> str:
    """Release the vehicle while the link is open, so that it stops and is free; return the last log line."""
    if not session.has_control:
        return "the client ends; it had no control"
    side.send("operator", "release")
    _wait(side, stop, RELEASE_TIMEOUT_S, lambda: session.released)
    return client_end_line(released=session.released)


def _stop_vehicle(side: Side, stop: console.StopEvent) -> str:
    """Stop the vehicle, wait until it is stationary, and return the last log line."""
    side.send("server_ends", None)
    _wait(side, stop, STOP_TIMEOUT_S, lambda: _moving_speed_mps(side) is None)
    return server_end_line(_moving_speed_mps(side))


def _moving_speed_mps(side: Side) -> float | None:
    """Return the speed of the vehicle; None if it is stationary and not driven."""
    status = side.tap.status()
    speed_mps: float = status.get("speed_mps", 0.0)
    return speed_mps if status.get("safety") in ACTIVE or abs(speed_mps) >= LIMITS.standstill_mps else None


def _wait(side: Side, stop: console.StopEvent, timeout_s: float, is_done: Callable[[], bool]) -> None:
    """Wait until `is_done()`, until the timeout, or until another stop signal."""
    end_ns = side.clock.now().mono_ns + round(timeout_s * NS_PER_S)
    while not is_done() and side.clock.now().mono_ns < end_ns and not stop.wait(POLL_PERIOD_S):
        pass
