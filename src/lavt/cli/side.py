"""What `lavt server` and `lavt client` share: links, record, runtime, and the lines they print."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Literal

import yaml

from lavt.build.clock_source import clock_source, interpreter
from lavt.cli import console
from lavt.cli.router import find
from lavt.clock import MachineClock
from lavt.config import ClientConfig, ServerConfig
from lavt.domain import Now
from lavt.errors import WorkError
from lavt.experiment.directory import check_directory, prepare_directory
from lavt.experiment.live import LiveTap
from lavt.experiment.provenance import provenance
from lavt.experiment.record import RecordWriter
from lavt.node import Node
from lavt.nodes.client_session import ClientSession
from lavt.runtime.realtime import RealRuntime
from lavt.runtime.recording import QueuedRecorder
from lavt.transport.injector import Injector
from lavt.transport.netem import Port
from lavt.transport.netem_control import Netem
from lavt.transport.udp_link import UdpLink
from lavt.transport.zenoh_link import ZenohLink, quiet_logs

STATUS_PERIOD_S = 0.2


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
        self._name: Literal["server", "client"] = "client" if isinstance(config, ClientConfig) else "server"
        self._config = config
        self._out = out
        self._writer: RecordWriter | None = None
        self._queue: QueuedRecorder | None = None
        self._udp: dict[str, UdpLink] = {}
        self._interpreter = interpreter(config.clock)
        if out is not None:
            check_directory(out)
        queues = _queues(config)
        quiet_logs()
        self._zenoh = ZenohLink(
            clock,
            self._deliver,
            side=self._name,
            path=find(Path(config.zenoh.session)),
            router=config.zenoh.router,
            vehicle=config.vehicle_id,
            who=config.who if isinstance(config, ClientConfig) else self._name,
        )
        self._injector = Injector(clock, self._deliver, queues, _never_delayed(config))
        self.tap = LiveTap(NoRecorder())

    def open_video(self, channel: str, *, bind: tuple[str, int], remote: tuple[str, int] | None = None) -> int:
        """Open the video's socket, whose datagrams come in on `channel`, and tell its port."""
        return self._open("video", channel, bind, remote)

    def open_probe(self, channel: str, *, bind: tuple[str, int], remote: tuple[str, int] | None = None) -> int:
        """Open the socket over which the clocks are compared, and tell its port."""
        return self._open("probe", channel, bind, remote)

    def _open(self, name: str, channel: str, bind: tuple[str, int], remote: tuple[str, int] | None) -> int:
        self._udp[name] = UdpLink(self.clock, channel, self._deliver, bind=bind, remote=remote, name=name)
        return self._udp[name].port

    def start(self, nodes: Sequence[Node]) -> RealRuntime:
        """Begin the record, start the runtime, then let messages in."""
        if self._out is not None:
            self._writer = self._open_record(self._out)
            self.tap = LiveTap(self._writer)
        self._queue = QueuedRecorder(self.tap)
        self.runtime = RealRuntime(
            self.clock, nodes, self._queue, clock_source(self._config.clock, self.clock, self._interpreter.run)
        )
        self._zenoh.start()
        self.runtime.start({**self._udp, "zenoh": self._zenoh, "netem": self._injector})
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
        if self.runtime is not None:
            self.runtime.stop()
        self._injector.close()
        self._interpreter.close()
        for each in self._udp.values():
            each.close()
        self._zenoh.close()
        if self._queue is not None:
            counts = {**{name: link.counts for name, link in self._udp.items()}, "zenoh": self._zenoh.counts}
            for name, counted in counts.items():
                self._queue.write("counts", {"link": name, **counted}, self.clock.now())
            self._queue.close(self.clock.now())
            if self._writer is not None and not self._queue.failed:
                self._writer.close()


def _queues(config: ServerConfig | ClientConfig) -> Netem | None:
    """Give the queues of the configured interface; raises `UserError` where nothing could be applied to it."""
    if not config.injection.interface:
        return None
    netem = Netem(config.injection.interface)
    for sentence in netem.check():
        console.say(sentence)
    return netem


def _never_delayed(config: ServerConfig | ClientConfig) -> list[Port]:
    port = config.clock.probe_port
    return [Port("udp", port, "the clock probe")] if port else []


def _in_words(status: Mapping[str, Any], ending: str | None) -> str:
    """Say how things are, for a person who reads a line whenever it changes."""
    state = f"{status.get('safety', 'waiting')}: {status.get('because', '')}"
    return state if ending is None else f"{state} ({ending})"


def run_side(
    side: Side,
    nodes: Sequence[Node],
    *,
    once: bool,
    as_json: bool,
    ready: Mapping[str, Any],
    session: ClientSession | None = None,
) -> None:
    """Run until Ctrl-C, until a node fails or, with `once`, until the drive has ended; print what happens."""
    told_state = ""
    with console.until_told() as told:
        runtime = side.start(nodes)
        if as_json:
            console.show_json({"ready": dict(ready)})
        while not told.wait(STATUS_PERIOD_S) and not runtime.stopped.is_set():
            status = side.tap.status()
            if session is not None:
                status |= {"phase": session.phase, "session": session.because}
            if as_json:
                console.show_json({"status": status, "ending": side.tap.ending})
            elif (state := _in_words(status, side.tap.ending)) != told_state:
                console.show(state)
                told_state = state
            if once and side.tap.ending is not None:
                break
    if runtime.failed is not None:
        raise WorkError(f"stopped because a part failed: {runtime.failed}")
