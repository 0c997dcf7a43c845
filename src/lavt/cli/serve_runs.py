"""`lavt server` with `experiment.remote_runs`: drive the runs that another machine requests, one after another."""

from __future__ import annotations

import queue
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import yaml

from lavt.assembly.security import build_authenticator, build_gateway
from lavt.assembly.zenoh import local_session, side_session
from lavt.cli import console
from lavt.cli.side import PLAIN
from lavt.clock import MachineClock
from lavt.config import ServerConfig
from lavt.domain import Now
from lavt.errors import WorkError, describe_error
from lavt.experiment.runs.processes import Process
from lavt.experiment.runs.run_service import RECORD, RunService
from lavt.node import Send
from lavt.recording.output_directory import make_directory
from lavt.runtime.thread_failures import fail_on_thread_errors
from lavt.transport.messages import encode
from lavt.transport.zenoh_link import ZenohLink
from lavt.transport.zenoh_session import quiet_logs

STEP_S = 0.05
MAX_WAITING = 64
"""The number of requests that can wait; further ones are dropped, and their clients repeat them."""


def serve_runs(settings: ServerConfig, out: Path, *, as_json: bool) -> None:
    """Answer requests for runs until Ctrl-C; the records are kept in `out`, in a directory for each run."""
    clock = MachineClock()
    authenticator = build_authenticator(settings, clock.now().wall_ns)
    requests: queue.Queue[tuple[bytes, Any]] = queue.Queue(MAX_WAITING)
    dropped = 0

    def deliver(channel: str, payload: Any, _arrived: Now, peer: Any) -> None:
        nonlocal dropped
        try:
            if channel == "run":
                requests.put_nowait((payload, peer))
        except queue.Full:
            dropped += 1

    make_directory(out)
    quiet_logs()
    link = ZenohLink(
        clock,
        side="server",
        settings=side_session(settings),
        vehicle=settings.vehicle_id,
        who="server",
        waiting=lambda reason: console.print_message(f"lavt: {reason}; waiting for one"),
    )
    failures: list[BaseException] = []
    with console.stop_on_signals() as stop, fail_on_thread_errors(failures.append), closing(link):
        locators = link.locators() if settings.zenoh.is_embedded else []
        service = RunService(settings, out, clock, start_server, local_session(settings, locators))
        gateway = build_gateway(authenticator, deliver, link.send, lambda: (0, -1))
        if not settings.security.key:
            console.print_message(PLAIN)
        with closing(service):
            link.start(gateway.receive, answers_runs_only=True)
            if as_json:
                console.print_json({"ready": {"locators": locators}})
            log = _Log(as_json=as_json)
            while not stop.is_set() and not failures:
                _answer_next(requests, service, gateway.send)
                service.step()
                log.print(service.describe())
    if dropped or service.counts:
        console.print_message(f"lavt: requests: {dict(service.counts)}, dropped: {dropped}, {dict(gateway.counts)}")
    if failures:
        raise WorkError(f"stopped because a part failed: {describe_error(failures[0])}")


def _answer_next(requests: queue.Queue[tuple[bytes, Any]], service: RunService, send: Callable[..., None]) -> None:
    try:
        payload, peer = requests.get(timeout=STEP_S)
    except queue.Empty:
        return
    send(Send("run_reply", encode(service.answer(payload)), peer))


def start_server(config: ServerConfig, directory: Path) -> Process:
    """Start the server of a run, which ends after its drive."""
    path = directory / "config.yaml"
    path.write_text(yaml.safe_dump(config.model_dump(mode="json")))
    return Process("server", ("server", str(path), "--once", "--out", str((directory / RECORD).parent)), directory)


class _Log:
    """Prints a line whenever it changes."""

    def __init__(self, *, as_json: bool) -> None:
        self._as_json = as_json
        self._last = ""

    def print(self, line: str) -> None:
        """Print the line if it differs from the last one."""
        if line != self._last:
            self._last = line
            if self._as_json:
                console.print_json({"said": [line]})
            else:
                console.print_result(line)
