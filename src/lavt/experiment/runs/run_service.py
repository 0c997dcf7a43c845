"""The server's end of remote runs: a request begins a run, and then its record can be fetched in parts.

For each run the service starts a server as a process of its own, so every run has a new vehicle. One run exists at a
time. It belongs to the client that began it, until this client ends it or sends no request for `LEASE_S`. The directory
of a run is named by its number on this server; nothing from a request is used as the name of a file.
"""

from __future__ import annotations

import hashlib
import json
import shutil
import threading
from collections import Counter, deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from lavt.assembly.vehicles import check_vehicle
from lavt.clock import Clock
from lavt.config import ExperimentConfig, ServerConfig, ZenohConfig
from lavt.config.remote_run import RemoteRunConfig
from lavt.config_file import parse_config
from lavt.domain import NS_PER_S, RunPhase, RunRefusal, RunReply, RunRequest
from lavt.errors import BadMessage, UserError
from lavt.experiment.runs.real_run import BEGIN_LIMIT_S, RUN_LIMIT_S
from lavt.transport.messages import RECORD_PART_BYTES, decode

LEASE_S = 20.0
"""A client sends two requests a second; without a request for this long, its run is ended and forgotten."""
START_LIMIT_S = 60.0
"""A process of a run that is not ready in this time is ended; on a quiet machine it takes 1 to 5 s."""
REMEMBERED_RUNS = 1000
MAX_STORED_RUNS = 10_000
"""The most directories of runs in the output directory; then no further run begins."""
RECORD = Path("server") / "server.mcap"
"""The record of a run, in the directory of the run."""
BYTES_PER_MB = 1_000_000


class RunProcess(Protocol):
    """The process of a run's server, such as `processes.Process`."""

    first: dict[str, Any]
    latest: dict[str, Any]

    @property
    def running(self) -> bool:
        """Whether the process has not ended yet."""
        ...

    @property
    def exit_code(self) -> int | None:
        """The exit code of the process, None while it runs."""
        ...

    def last_message(self) -> str:
        """Return the last line on standard error."""
        ...

    def end(self) -> None:
        """End the process, and wait for its end."""
        ...


StartProcess = Callable[[ServerConfig, Path], RunProcess]
"""Starts the server of a run; the record goes to `RECORD` in the directory."""


class Owner(NamedTuple):
    """Name and instance of the client to which a run belongs."""

    who: str
    instance: int


@dataclass
class _ActiveRun:
    """The run that exists."""

    owner: Owner
    number: int
    directory: Path
    process: RunProcess
    began_ns: int
    heard_ns: int
    phase: RunPhase = "starting"
    failure: str = ""
    ready: Mapping[str, Any] = field(default_factory=dict)
    size: int = 0
    digest: bytes = b""
    ender: threading.Thread | None = None
    """Ends the process, which takes seconds."""
    is_given_up: bool = False
    """Whether the run is forgotten as soon as its process has ended."""

    @property
    def has_process(self) -> bool:
        """Whether the end of the process has not been noted yet."""
        return self.phase in ("starting", "running", "ending")


class _Refused(Exception):
    def __init__(self, code: RunRefusal, reason: str) -> None:
        super().__init__(reason)
        self.code: RunRefusal = code


class RunService:
    """The runs of a server. One thread calls all methods."""

    def __init__(
        self, config: ServerConfig, out: Path, clock: Clock, start_process: StartProcess, zenoh: ZenohConfig
    ) -> None:
        self.counts: Counter[str] = Counter()
        """Numbers of requests by operation and refusal."""
        self._config = config
        self._out = out
        self._clock = clock
        self._start_process = start_process
        self._zenoh = zenoh
        """How the process of a run reaches the router."""
        self._run: _ActiveRun | None = None
        self._begun: deque[int] = deque(maxlen=REMEMBERED_RUNS)
        """Numbers of the runs that were begun: a late request must not begin one of them again."""
        self._is_closed = False

    def answer(self, data: bytes) -> RunReply:
        """Execute a request, and return the reply; never raise an error because of its content."""
        try:
            request = decode(RunRequest, data)
        except BadMessage as error:
            self.counts["malformed"] += 1
            return _reply(0, None, "malformed", str(error))
        try:
            run, part = self._execute(request)
        except _Refused as refusal:
            self.counts[f"{request.operation} {refusal.code}"] += 1
            return _reply(request.number, None, refusal.code, str(refusal))
        except OSError as error:  # such as a full disk
            self.counts[f"{request.operation} server_error"] += 1
            return _reply(request.number, None, "server_error", f"a file of the server failed: {error.strerror}")
        self.counts[request.operation] += 1
        return _reply(request.number, run, part=part)

    def step(self) -> None:
        """Update the phase of the run, and end it if it exceeds a time limit or its client is silent."""
        run, now_ns = self._run, self._clock.now().mono_ns
        if run is None:
            return
        if run.has_process:
            self._watch(run, now_ns)
        if now_ns - run.heard_ns > LEASE_S * NS_PER_S:
            self._end(run, f"no request of {run.owner.who} for {LEASE_S:.0f} s")
        if run.is_given_up and not run.has_process:
            self._run = None

    def close(self) -> None:
        """End the run; its process stops the vehicle first."""
        self._is_closed = True
        if self._run is not None:
            self._run.process.end()

    def describe(self) -> str:
        """Return the present run and its phase, for the log."""
        run = self._run
        if run is None:
            return "waiting for a run"
        return f"run {run.directory.name} of {run.owner.who}: {run.failure or run.phase}"

    def _execute(self, request: RunRequest) -> tuple[_ActiveRun | None, bytes]:
        run, owner = self._run, Owner(request.who, request.instance)
        is_own = run is not None and run.owner == owner
        if run is not None and is_own:
            run.heard_ns = self._clock.now().mono_ns
        if request.operation == "begin":
            return self._begin(request, owner), b""
        if run is None or not is_own or run.number != request.run:
            if request.operation == "end":
                return None, b""  # it has ended, and the reply was lost
            raise _Refused("unknown_run", "this server has no such run of this client")
        if request.operation == "end":
            self._end(run, f"{run.owner.who} ended the run")
        elif request.operation == "read":
            return run, _read_part(run, request.offset)
        return self._run, b""

    def _begin(self, request: RunRequest, owner: Owner) -> _ActiveRun:
        run = self._run
        if self._is_closed:
            raise _Refused("shutting_down", "the server is shutting down")
        if run is not None:
            if (run.owner, run.number) == (owner, request.run) and not run.is_given_up:
                return run  # the request is repeated, because its reply was lost
            if run.has_process or run.owner != owner:
                raise _Refused("busy", f"{run.owner.who} has a run on this server")
        if request.run in self._begun:
            raise _Refused("unknown_run", "this run is over")
        settings = _parse_settings(request.settings)
        config = self._run_config(settings, owner.who)
        self._out.mkdir(parents=True, exist_ok=True)  # it can have been deleted
        self._check_space()
        directory = self._new_directory()
        now_ns = self._clock.now().mono_ns
        try:
            process = self._start_process(config, directory)
        except OSError:
            shutil.rmtree(directory, ignore_errors=True)
            raise
        self._begun.append(request.run)
        self._run = _ActiveRun(owner, request.run, directory, process, now_ns, now_ns)
        return self._run

    def _check_space(self) -> None:
        if sum(1 for _ in self._out.iterdir()) >= MAX_STORED_RUNS:
            raise _Refused("storage_full", f"the server keeps the files of {MAX_STORED_RUNS} runs: delete old ones")
        limit_mb = self._config.experiment.max_stored_mb
        used = sum(path.stat().st_size for path in self._out.rglob("*") if path.is_file())
        if used >= limit_mb * BYTES_PER_MB:
            raise _Refused("storage_full", f"the records on the server exceed experiment.max_stored_mb {limit_mb}")

    def _new_directory(self) -> Path:
        number = 1 + max((int(path.name) for path in self._out.iterdir() if path.name.isdecimal()), default=0)
        directory = self._out / f"{number:04d}"
        directory.mkdir()
        return directory

    def _run_config(self, settings: RemoteRunConfig, operator: str) -> ServerConfig:
        """Return the config of the run's server: this server's, with the requested sections, for one operator."""
        own, requested = self._config.model_dump(mode="json"), settings.model_dump(mode="json")
        merged = {
            **own,
            **requested,
            "video": own["video"] | requested["video"],
            "zenoh": self._zenoh.model_dump(mode="json"),
            "experiment": ExperimentConfig(operator=operator).model_dump(mode="json"),
        }
        try:
            return parse_config(ServerConfig, merged, "the requested run, with this server's config")
        except UserError as error:
            raise _Refused("invalid", str(error)) from None

    def _watch(self, run: _ActiveRun, now_ns: int) -> None:
        run.ready = run.ready or run.process.first.get("ready", {})
        if run.phase == "starting" and run.ready:
            run.phase = "running"
        age_s = (now_ns - run.began_ns) / NS_PER_S
        if not run.process.running and (run.ender is None or not run.ender.is_alive()):
            self._finish(run)
        elif run.phase == "ending":
            pass
        elif run.phase == "starting" and age_s > START_LIMIT_S:
            self._fail(run, f"the server of the run did not get ready within {START_LIMIT_S:.0f} s")
        elif age_s > START_LIMIT_S + BEGIN_LIMIT_S and run.process.latest.get("status", {}).get("safety") in (
            None,
            "disarmed",
            "arming",
        ):
            self._fail(run, f"the drive did not begin within {age_s:.0f} s")
        elif age_s > START_LIMIT_S + RUN_LIMIT_S:
            self._fail(run, f"the drive did not end within {age_s:.0f} s")

    def _finish(self, run: _ActiveRun) -> None:
        """Note the record of a run whose process has ended, or why there is none; a failed start leaves no files."""
        record = run.directory / RECORD
        run.process.end()  # wait until its last line has been read
        if not run.failure and (run.process.exit_code != 0 or run.process.latest.get("ending") is None):
            run.failure = _failure(run.process)
        if run.failure:
            run.phase = "failed"
            if not run.ready:
                shutil.rmtree(run.directory, ignore_errors=True)
            return
        try:
            with record.open("rb") as file:
                run.digest = hashlib.file_digest(file, "sha256").digest()
            run.size = record.stat().st_size
        except OSError as error:
            run.phase, run.failure = "failed", f"the record cannot be read: {error.strerror}"
            return
        run.phase = "finished"

    def _fail(self, run: _ActiveRun, reason: str) -> None:
        run.failure = run.failure or reason
        if run.ender is None:
            run.phase = "ending"
            run.ender = threading.Thread(target=run.process.end, name="run ender")
            run.ender.start()

    def _end(self, run: _ActiveRun, reason: str) -> None:
        """End a run's process, and forget the run as soon as the process has ended; its files stay."""
        run.is_given_up = True
        if run.has_process:
            self._fail(run, reason)
        else:
            self._run = None


def _failure(process: RunProcess) -> str:
    code = process.exit_code
    if code is not None and code < 0:
        return f"the server of the run was killed by signal {-code}"
    return f"the server of the run failed with exit code {code}: {process.last_message()}"


def _parse_settings(text: str) -> RemoteRunConfig:
    try:
        data = json.loads(text)
    except (ValueError, RecursionError):
        raise _Refused("malformed", "the settings of the run are not JSON") from None
    if not isinstance(data, dict):
        raise _Refused("malformed", "the settings of the run are not an object")
    try:
        settings = parse_config(RemoteRunConfig, data, "the requested run")
        check_vehicle(settings.vehicle)
    except UserError as error:
        raise _Refused("invalid", str(error)) from None
    return settings


def _read_part(run: _ActiveRun, offset: int) -> bytes:
    if run.phase != "finished":
        raise _Refused("not_finished", f"the run is {run.phase}, so it has no record yet")
    if offset >= run.size:
        raise _Refused("invalid", f"the record has {run.size} bytes, so no part begins at {offset}")
    with (run.directory / RECORD).open("rb") as file:
        file.seek(offset)
        return file.read(min(RECORD_PART_BYTES, run.size - offset))


def _reply(
    number: int, run: _ActiveRun | None, refusal: RunRefusal = "", reason: str = "", *, part: bytes = b""
) -> RunReply:
    if run is None:
        return RunReply(number, refusal, reason, "idle", "", 0, 0, 0, b"", b"")
    return RunReply(
        number,
        refusal,
        reason or run.failure,
        run.phase,
        run.process.latest.get("ending") or "",
        run.ready.get("video_port", 0),
        run.ready.get("probe_port", 0),
        run.size,
        run.digest,
        part,
    )
