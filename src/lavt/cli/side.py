"""What `lavt server` and `lavt client` share: links, record, runtime, and the lines they print."""

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
from lavt.cli.router import find
from lavt.cli.session_log import SessionLog, end_words, release_words
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
from lavt.safety.gate import ACTIVE
from lavt.safety.limits import LIMITS
from lavt.transport.emulation.impairment import ExemptPort
from lavt.transport.netem.injector import Injector
from lavt.transport.netem.netem import NetemInterface
from lavt.transport.rendezvous.forwarder import FlowName
from lavt.transport.rendezvous.link import RendezvousLink
from lavt.transport.udp_link import UdpLink
from lavt.transport.zenoh_link import ZenohLink, quiet_logs

STATUS_PERIOD_S = 0.2
LOOK_S = 0.02
RELEASE_S = 1.0
"""So long a client that ends waits for the answer to its release; over any network that one can drive by it comes."""
STOP_S = 6.0
"""So long a server that ends waits for standstill: from 40 km/h with 4 m/s2 it takes 2.8 s."""


class NoRecorder:
    """Keeps nothing."""

    def write(self, topic: str, payload: Any, now: Now) -> None:
        """Forget one entry."""


class Side:
    """One side's links and record, opened before its nodes are built and closed after its runtime has ended."""

    def __init__(
        self,
        config: ServerConfig | ClientConfig,
        out: Path | None,
        clock: MachineClock,
    ) -> None:
        self.clock = clock
        self.runtime: RealRuntime | None = None
        self.name = config.who if isinstance(config, ClientConfig) else "server"
        """What the other side knows this one by."""
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
        """The server's: epoch in force, and sequence of the command last obeyed."""
        self._gateway = gateway_of(
            config, self._deliver, lambda *sends: self._zenoh.send(*sends), lambda: self.in_force()
        )
        self._zenoh = ZenohLink(
            clock,
            self._gateway.receive,
            side=self._name,
            path=find(Path(config.zenoh.session)),
            router=config.zenoh.router,
            vehicle=config.vehicle_id,
            who=self.name,
            waiting=lambda reason: console.say(f"lavt: {reason}; waiting until one does"),
        )
        self._injector = Injector(clock, self._deliver, queues, _never_delayed(config))
        self.tap = LiveTap(NoRecorder())
        self.elsewhere: ActuatorProcess | None = None
        """The server's actuator, where it is in a process of its own."""

    def open_video(self, channel: str, *, bind: tuple[str, int], remote: tuple[str, int] | None = None) -> int:
        """Open the video's socket, whose datagrams come in on `channel`, and tell its port."""
        return self._open("video", channel, bind, remote)

    def open_probe(self, channel: str, *, bind: tuple[str, int], remote: tuple[str, int] | None = None) -> int:
        """Open the socket over which the clocks are compared, and tell its port."""
        return self._open("probe", channel, bind, remote)

    def _open(self, name: FlowName, channel: str, bind: tuple[str, int], remote: tuple[str, int] | None) -> int:
        link = open_flow(self._config, self.clock, name, channel, self._deliver, bind=bind, remote=remote)
        self._udp[name] = link
        return link.port

    def start(self, nodes: Sequence[Node]) -> RealRuntime:
        """Begin the record, start the runtime, then let messages in."""
        if self._out is not None:
            self._writer = self._open_record(self._out)
            self.tap = LiveTap(self._writer)
        self._queue = QueuedRecorder(self.tap)
        source = clock_source(self._config.clock, self.clock, self._interpreter.run)
        away = {} if self.elsewhere is None else {self.elsewhere.name: self.elsewhere}
        self.runtime = RealRuntime(self.clock, nodes, self._queue, source, away)
        self._zenoh.start()
        self.runtime.start({**self._udp, "zenoh": self._gateway, "netem": self._injector})
        if self.elsewhere is not None:
            self.elsewhere.start(self.runtime)
        for link in self._udp.values():
            link.start()
        return self.runtime

    def tell(self, channel: str, payload: Any) -> None:
        """Hand a message to a node of this side."""
        self._deliver(channel, payload, self.clock.now(), None)

    def _open_record(self, out: Path) -> RecordWriter:
        """Begin the record only now that nothing can be wrong with the input any more."""
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
        if self.elsewhere is not None:
            self.elsewhere.end()
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
    """Give the queues of the configured interface; raises `UserError` where nothing could be applied to it."""
    if not config.injection.interface:
        return None
    netem = NetemInterface(config.injection.interface)
    for sentence in netem.check():
        console.say(sentence)
    return netem


def _never_delayed(config: ServerConfig | ClientConfig) -> list[ExemptPort]:
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
    """Run until Ctrl-C, until a node fails or, with `once`, until the drive has ended; print what happens.

    Before it ends a client releases the vehicle, and a server stops it; a second Ctrl-C does not wait for that.
    """
    narrator = SessionLog(side.name if session is not None else "")
    with console.until_told() as told:
        runtime = side.start(nodes)
        if as_json:
            console.show_json({"ready": dict(ready)})
        while not told.wait(STATUS_PERIOD_S) and not runtime.stopped.is_set():
            _tell(side, narrator, session, as_json=as_json)
            if once and side.tap.ending is not None:
                break
        if not runtime.stopped.is_set():
            told.clear()
            last = _stop_vehicle(side, told) if session is None else _release(side, told, session)
            _tell(side, narrator, session, as_json=as_json, last=last)
    if runtime.failed is not None:
        raise WorkError(f"stopped because a part failed: {runtime.failed}")


def _tell(side: Side, narrator: SessionLog, session: ClientSession | None, *, as_json: bool, last: str = "") -> None:
    """Print what is new, and `last` at the very end; as JSON also how everything is."""
    for heard, at in side.tap.take_updates():
        if isinstance(heard, State):
            narrator.state(heard, at.mono_ns, holds=session is not None and session.holds)
        else:
            narrator.rejection(heard)
    narrator.ending(side.tap.ending)
    status = side.tap.status()
    if session is not None:
        if not last:
            narrator.phase(session.phase, session.reason)
        status |= {"phase": session.phase, "session": session.reason}
    lines = narrator.take(side.clock.now().mono_ns) + [last] * bool(last)
    if as_json:
        console.show_json({"status": status, "ending": side.tap.ending, "said": lines})
        return
    for line in lines:
        console.show(line)


def _release(side: Side, told: console.StopEvent, session: ClientSession) -> str:
    """Release the vehicle while the link is open: it stops at once, and somebody else may have it."""
    if not session.holds:
        return "the client ends; it held no vehicle"
    side.tell("operator", "release")
    _wait(side, told, RELEASE_S, lambda: session.released)
    return release_words(released=session.released)


def _stop_vehicle(side: Side, told: console.StopEvent) -> str:
    """Stop the vehicle, and wait until it stands."""
    side.tell("server_ends", None)
    _wait(side, told, STOP_S, lambda: _moves_mps(side) is None)
    return end_words(_moves_mps(side))


def _moves_mps(side: Side) -> float | None:
    """Speed of a vehicle that is not at rest."""
    status = side.tap.status()
    speed_mps: float = status.get("speed_mps", 0.0)
    return speed_mps if status.get("safety") in ACTIVE or abs(speed_mps) >= LIMITS.standstill_mps else None


def _wait(side: Side, told: console.StopEvent, limit_s: float, done: Callable[[], bool]) -> None:
    """Wait until it is done, but not for long, and not for whom is told once more to end."""
    end_ns = side.clock.now().mono_ns + round(limit_s * NS_PER_S)
    while not done() and side.clock.now().mono_ns < end_ns and not told.wait(LOOK_S):
        pass
