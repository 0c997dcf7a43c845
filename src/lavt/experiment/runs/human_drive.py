"""A drive of a person on this machine: the server in a process of its own, and a relay whose delays change live."""

from __future__ import annotations

import threading
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from queue import Empty, SimpleQueue
from tempfile import TemporaryDirectory
from typing import Any, Final

import yaml

from lavt.clock import Clock
from lavt.config import HUMAN, ClientConfig, ImpairmentConfig, NetworkConfig, RunConfig
from lavt.config_file import build_config, condition
from lavt.errors import UserError
from lavt.experiment.runs.processes import Process, Processes
from lavt.experiment.runs.side_configs import client_config, embedded_router, server_config
from lavt.node import Send
from lavt.nodes.payloads import DelayChoice, RelayDelay
from lavt.transport.console.page_messages import MAX_DELAY_MS
from lavt.transport.emulation.delay_line import DelayModel
from lavt.transport.emulation.relay import NO_DELAY, Relay, RelayedFlow, must_delay_video_datagram, video_delay_index

LOOPBACK = "127.0.0.1"
CONDITIONS = ("L0", "L1", "L2", "L3", "L4", "L5")
"""The conditions that the page offers."""
DEFAULTS: Final[Mapping[str, Any]] = {
    "time": "real",
    "controller": {"kind": HUMAN},
    "vehicle": {"after_collision": "continue"},
    "safety": {"picture_age_limit_ms": MAX_DELAY_MS},  # so that a person can feel long delays, too
}


class LiveRelay:
    """A relay between the two sides in a thread of this process; a `RelayDelay` on its carrier changes the delays."""

    def __init__(self, clock: Clock, *, video_port: int, control_port: int, initial: RelayDelay) -> None:
        self._relay = Relay(
            clock,
            [
                RelayedFlow(
                    "video",
                    (LOOPBACK, 0),
                    (LOOPBACK, video_port),
                    upstream=NO_DELAY,
                    downstream=NO_DELAY,
                    downstream_delay_filter=must_delay_video_datagram,
                    downstream_delay_index_function=video_delay_index,
                ),
                RelayedFlow("control", (LOOPBACK, 0), (LOOPBACK, control_port), upstream=NO_DELAY, downstream=NO_DELAY),
            ],
        )
        self._changes: SimpleQueue[RelayDelay] = SimpleQueue()
        self._changes.put(initial)
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._run, name="relay", daemon=True)
        self.ports = self._relay.ports()

    def start(self) -> None:
        """Start to forward; an error ends the thread, and so the process."""
        self._thread.start()

    def send(self, *sends: Send) -> None:
        """Change the delays, at the latest when the relay's present step has ended."""
        for send in sends:
            self._changes.put(send.payload)

    def close(self) -> None:
        """Stop to forward; queued datagrams are lost."""
        self._stopped.set()
        if self._thread.is_alive():
            self._thread.join()
        self._relay.close()

    def _run(self) -> None:
        while not self._stopped.is_set():
            self._change_delays()
            self._relay.step()

    def _change_delays(self) -> None:
        try:
            delay = self._changes.get_nowait()
        except Empty:
            return
        self._relay.change_delays("video", upstream=NO_DELAY, downstream=DelayModel(delay.video_ms))
        self._relay.change_delays("control", upstream=DelayModel(delay.control_ms), downstream=NO_DELAY)


@dataclass(frozen=True, slots=True)
class HumanDrive:
    """The running server and relay, and what the client of the person needs."""

    server: Process
    relay: LiveRelay
    client: ClientConfig
    delays: DelayChoice
    work: Path
    """A directory that only this user can read, for files that end with the drive."""


def drive_config(changes: Iterable[str]) -> RunConfig:
    """Return the config of a person's drive; raise `UserError` for what such a drive does not support."""
    config = build_config(RunConfig, deepcopy(dict(DEFAULTS)), changes, "lavt drive")
    if config.controller.kind != HUMAN or config.time != "real":
        raise UserError("lavt drive is for a person, in real time: leave out controller.kind and time")
    network = config.network
    if network != NetworkConfig(condition=network.condition, video=network.video, control=network.control):
        raise UserError("lavt drive injects by its own relay: of the network, set condition, video and control only")
    requested = network.requested(condition(network.condition))
    if any(flow != ImpairmentConfig() for _, flow in requested.flows.values()):
        raise UserError(f"lavt drive injects constant delays only: choose one of {', '.join(CONDITIONS)}")
    if max(requested.video_ms, requested.control_ms) > MAX_DELAY_MS:
        raise UserError(f"lavt drive injects at most {MAX_DELAY_MS:g} ms into each direction: choose shorter delays")
    return config


@contextmanager
def start_human_drive(config: RunConfig, out: Path | None, clock: Clock) -> Iterator[HumanDrive]:
    """Start the server's process and the relay, yield them, and end them; the server's record is in `out`/server."""
    requested = config.network.requested(condition(config.network.condition))
    initial = RelayDelay(requested.video_ms, requested.control_ms)
    named = [(name, condition(name)) for name in CONDITIONS]
    delays = DelayChoice(tuple((name, entry.video_ms, entry.control_ms) for name, entry in named), initial)
    with TemporaryDirectory(prefix="lavt-") as folder, Processes(Path(folder)) as processes:
        work = Path(folder)
        server_yaml = work / "server.yaml"
        server_yaml.write_text(yaml.safe_dump(server_config(config, config.seed).model_dump(mode="json")))
        record = () if out is None else ("--out", str(out / "server"))
        server = processes.start("server", "server", str(server_yaml), *record)
        ready = server.wait_ready()["ready"]
        control_port = _udp_port(ready["locators"])
        relay = LiveRelay(clock, video_port=ready["video_port"], control_port=control_port, initial=initial)
        try:
            dialled = f"udp/{LOOPBACK}:{relay.ports['control']}?rel=1;mixed_rel=1"
            client = client_config(
                config,
                config.seed,
                zenoh=embedded_router(listen=[f"tcp/{LOOPBACK}:0"], dialled=[dialled]),
                video_port=relay.ports["video"],
                probe_port=ready["probe_port"],
            )
            yield HumanDrive(server, relay, client, delays, work)
        finally:
            relay.close()


def _udp_port(locators: Iterable[str]) -> int:
    locator = next(locator for locator in locators if locator.startswith("udp/"))
    return int(locator.partition("?")[0].rpartition(":")[2])
