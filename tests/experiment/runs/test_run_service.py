"""Requests for runs, as the server's end answers them; the servers of the runs are stand-ins."""

from __future__ import annotations

import hashlib
import json
import shutil
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace
from tests.support.clocks import ManualClock

from lavt.config import RunConfig, ServerConfig, ZenohConfig
from lavt.config.remote_run import remote_part
from lavt.config_file import parse_config
from lavt.domain import RunReply, RunRequest
from lavt.errors import UserError
from lavt.experiment.runs import run_service
from lavt.experiment.runs.run_service import RECORD, RunService
from lavt.transport.messages import VERSION, decode, encode

# The expected values of the code's limits. They are not imported, so that a changed limit makes a test fail.
LEASE_MS = 20_000
PART_BYTES = 32_768
BEGIN = RunRequest("begin", "operator-1", instance=5, number=1, run=7, settings='{"seed":9}', offset=0)
STATUS, READ, END = (replace(BEGIN, operation=operation, settings="") for operation in ("status", "read", "end"))


@dataclass
class RunProcessStandIn:
    """The process of a run's server, which the test lets become ready, drive and end."""

    config: ServerConfig
    directory: Path
    first: dict[str, Any] = field(default_factory=dict)
    latest: dict[str, Any] = field(default_factory=dict)
    running: bool = True
    exit_code: int | None = None

    def drive(self) -> None:
        """Become ready and begin to drive."""
        self.first = {"ready": {"video_port": 5600, "probe_port": 5602}}
        self.latest = {"status": {"safety": "driving"}, "ending": None}

    def complete(self, record: bytes) -> None:
        """End the drive and the process, with a record."""
        self.latest = {"ending": "completed"}
        (self.directory / RECORD).parent.mkdir()
        (self.directory / RECORD).write_bytes(record)
        self.running, self.exit_code = False, 0

    def last_message(self) -> str:
        """Return a message."""
        return "the last message"

    def end(self) -> None:
        """End the process."""
        self.running = False


class Rig:
    """A service and the processes that it has started."""

    def __init__(self, out: Path, changes: dict[str, Any] | None = None) -> None:
        self.out = out
        self.clock = ManualClock()
        self.processes: list[RunProcessStandIn] = []
        data = {"experiment": {"remote_runs": True}, "video": {"port": 7777}, **(changes or {})}
        self.service = RunService(
            parse_config(ServerConfig, data, "the test"), out, self.clock, self.start, ZenohConfig(router="tcp/[::1]:1")
        )

    def start(self, config: ServerConfig, directory: Path) -> RunProcessStandIn:
        """Start a stand-in."""
        self.processes.append(RunProcessStandIn(config, directory))
        return self.processes[-1]

    def ask(self, request: RunRequest) -> RunReply:
        """Return the reply to a request."""
        return self.service.answer(encode(request))

    def settle(self) -> None:
        """Wait until the process of the run has been ended, and let the service note it."""
        self.service.step()
        run = self.service._run
        if run is not None and run.ender is not None:
            run.ender.join()
        self.service.step()

    def finish(self, record: bytes) -> None:
        """Drive the run to its end."""
        self.processes[-1].drive()
        self.service.step()
        self.processes[-1].complete(record)
        self.service.step()


@pytest.fixture
def rig(tmp_path: Path) -> Rig:
    return Rig(tmp_path)


def test_a_run_begins_runs_and_finishes(rig: Rig) -> None:
    """The phases follow the process of the run, and a repeated request begins no second run."""
    assert rig.ask(BEGIN).phase == "starting"
    assert rig.ask(BEGIN).phase == "starting"
    [process] = rig.processes
    process.drive()
    rig.service.step()
    running = rig.ask(STATUS)
    assert (running.phase, running.video_port, running.probe_port) == ("running", 5600, 5602)
    process.complete(b"record")
    rig.service.step()
    finished = rig.ask(STATUS)
    assert (finished.phase, finished.ending, finished.size) == ("finished", "completed", 6)
    assert finished.digest == hashlib.sha256(b"record").digest()
    assert rig.ask(END).phase == "idle"
    assert rig.ask(END).phase == "idle", "a repeated end is no error"


def test_a_run_uses_the_servers_own_ports_and_the_requested_sections(rig: Rig) -> None:
    """The requested sections replace those of the server; its ports, keys and network settings stay."""
    run = RunConfig.model_validate({"vehicle": {"route": "straight"}, "video": {"bit_rate_bps": 100_000}})
    rig.ask(replace(BEGIN, settings=remote_part(run, 3)))
    config = rig.processes[0].config
    assert (config.vehicle.route, config.video.bit_rate_bps, config.seed) == ("straight", 100_000, 3)
    assert (config.video.port, config.zenoh.router) == (7777, "tcp/[::1]:1")
    assert not config.experiment.remote_runs
    assert config.experiment.operator == "operator-1"


def test_a_record_is_read_in_parts(rig: Rig) -> None:
    """The parts of a record together are the record, whatever their order."""
    record = bytes(range(256)) * 300
    rig.ask(BEGIN)
    rig.finish(record)
    offsets = [65_536, 0, PART_BYTES]
    parts = {offset: rig.ask(replace(READ, offset=offset)).data for offset in offsets}
    assert b"".join(parts[offset] for offset in sorted(offsets)) == record
    assert rig.ask(replace(READ, offset=len(record))).refusal == "invalid"
    assert rig.ask(replace(READ, offset=2**63 - 1)).refusal == "invalid"


@pytest.mark.parametrize(
    ("settings", "refusal"),
    [
        ("", "malformed"),
        ("{", "malformed"),
        ("[" * 800, "malformed"),
        ("[1]", "malformed"),
        ('"text"', "malformed"),
        ('{"unknown":1}', "invalid"),
        ('{"seed":NaN}', "invalid"),
        ('{"vehicle":{"time_limit_s":Infinity}}', "invalid"),
        ('{"vehicle":{"time_limit_s":1e9}}', "invalid"),
        ('{"camera":{"rate_hz":NaN}}', "invalid"),
        ('{"video":{"reorder_hold_ms":-Infinity}}', "invalid"),
        (f'{{"seed":{"9" * 700}}}', "invalid"),
        ('{"\\ud800":1}', "invalid"),
        ('{"vehicle":{"route":"\\ud800"}}', "invalid"),
        ('{"vehicle":{"car":"\\ud800"}}', "invalid"),
        ('{"vehicle":{"scenery":"\\ud800"}}', "invalid"),
        ('{"experiment":{"operator":"operator-2"}}', "invalid"),
        ('{"seed":-1}', "invalid"),
        ('{"camera":{"width_px":100000}}', "invalid"),
        ('{"camera":{"source":"device","device":"/etc/passwd"}}', "invalid"),
        ('{"video":{"send_to":["192.0.2.1:5600"]}}', "invalid"),
        ('{"vehicle":{"kind":"dbw"}}', "invalid"),
        ('{"vehicle":{"dbw":{"channel":"can7"}}}', "invalid"),
        ('{"vehicle":{"route":"no_such_road"}}', "invalid"),
        ('{"vehicle":{"route":"../secret.yaml"}}', "invalid"),
        ('{"vehicle":{"route":"/etc/passwd"}}', "invalid"),
        ('{"vehicle":{"route":"road.yaml"}}', "invalid"),
        ('{"vehicle":{"route":""}}', "invalid"),
        ('{"vehicle":{"car":"../x"}}', "invalid"),
        ('{"vehicle":null}', "invalid"),
    ],
)
def test_invalid_settings_are_refused(rig: Rig, settings: str, refusal: str) -> None:
    """Settings that are not JSON, or that a file could not have either, start nothing; nor do paths of files."""
    reply = decode(RunReply, encode(rig.ask(replace(BEGIN, settings=settings))))
    assert (reply.refusal, reply.number) == (refusal, BEGIN.number)
    assert reply.reason
    assert not rig.processes
    assert not list(rig.out.iterdir())
    assert rig.ask(BEGIN).refusal == ""


OTHER_VERSION = encode(BEGIN).replace(bytes([VERSION]), bytes([VERSION + 1]), 1)
HUGE = encode(replace(BEGIN, settings="x" * 800)) + bytes(10_000_000)
NAMES = ("../operator", "a/b", "n" * 10_000, "", "operator\n")


@pytest.mark.parametrize(
    "data",
    [
        *(b"", b"\xff", bytes(1025), encode(BEGIN)[:-1], encode(BEGIN) + b"\0", HUGE, OTHER_VERSION),
        *(encode(replace(BEGIN, who=name)) for name in NAMES),
        *(encode(replace(BEGIN, run=run)) for run in (-1, 2**63)),
        encode(BEGIN).replace(b"seed", b"\xed\xa0\x80x"),
    ],
)
def test_unreadable_requests_are_refused(rig: Rig, data: bytes) -> None:
    """A request that cannot be decoded, or is longer than a message may be, is counted and starts nothing."""
    assert decode(RunReply, encode(rig.service.answer(data))).refusal == "malformed"
    assert not rig.processes
    assert rig.service.counts == {"malformed": 1}


@pytest.mark.parametrize("other", [{"who": "operator-2"}, {"instance": 6}])
def test_a_run_belongs_to_its_client(rig: Rig, other: dict[str, Any]) -> None:
    """Another client, also one of the same name, cannot begin, see, read or end anything until the run is over."""
    rig.ask(BEGIN)
    rig.finish(b"record")
    for request in (BEGIN, replace(BEGIN, run=8)):
        assert rig.ask(replace(request, **other)).refusal == "busy"
    for request in (STATUS, READ):
        reply = rig.ask(replace(request, **other))
        assert (reply.refusal, reply.size, reply.data) == ("unknown_run", 0, b"")
    rig.ask(replace(END, **other))
    assert rig.ask(STATUS).phase == "finished"
    rig.ask(END)
    assert rig.ask(replace(BEGIN, run=8, **other)).refusal == ""


def test_a_client_has_one_run_at_a_time(rig: Rig) -> None:
    """The client of a run cannot begin another one before the end of this one."""
    rig.ask(BEGIN)
    assert rig.ask(replace(BEGIN, run=8)).refusal == "busy"
    assert rig.ask(replace(STATUS, run=8)).refusal == "unknown_run"
    rig.finish(b"record")
    assert rig.ask(replace(BEGIN, run=8)).phase == "starting"


def test_a_run_that_is_over_does_not_begin_again(rig: Rig) -> None:
    """A late copy of the request that began a run starts nothing when the run is over."""
    rig.ask(BEGIN)
    rig.finish(b"record")
    rig.ask(END)
    assert rig.ask(BEGIN).refusal == "unknown_run"
    assert len(rig.processes) == 1


def test_a_run_that_is_not_finished_has_no_record(rig: Rig) -> None:
    """A part of the record can be read only after the end of the run."""
    rig.ask(BEGIN)
    assert rig.ask(READ).refusal == "not_finished"


def test_a_silent_client_loses_its_run(rig: Rig) -> None:
    """If the client sends no request for the time of the lease, the process is ended and another run can begin."""
    rig.ask(BEGIN)
    rig.processes[0].drive()
    for _ in range(3):
        rig.clock.advance(LEASE_MS - 1)
        rig.settle()
        assert rig.ask(STATUS).phase == "running"
    rig.ask(replace(STATUS, who="operator-2"))
    rig.clock.advance(LEASE_MS + 1)
    rig.settle()
    assert not rig.processes[0].running
    assert rig.ask(replace(BEGIN, who="operator-2", run=8)).phase == "starting"


def test_a_finished_run_is_forgotten_after_the_lease(rig: Rig) -> None:
    """A finished run whose record nobody reads does not block the server."""
    rig.ask(BEGIN)
    rig.finish(b"record")
    rig.clock.advance(LEASE_MS + 1)
    rig.service.step()
    assert rig.ask(STATUS).refusal == "unknown_run"
    assert rig.ask(replace(BEGIN, who="operator-2", run=8)).refusal == ""


def test_a_run_that_is_ended_early_is_forgotten(rig: Rig) -> None:
    """`end` ends the process; the next run can begin when the process has ended."""
    rig.ask(BEGIN)
    rig.processes[0].drive()
    rig.ask(END)
    assert rig.ask(replace(BEGIN, run=8)).refusal == "busy"
    rig.settle()
    assert not rig.processes[0].running
    assert rig.ask(replace(BEGIN, run=8)).phase == "starting"


@pytest.mark.parametrize(
    ("latest", "after_ms"),
    [({}, 61_000), ({"status": {"safety": "arming"}}, 101_000), ({"status": {"safety": "driving"}}, 961_000)],
)
def test_a_run_has_time_limits(rig: Rig, latest: dict[str, Any], after_ms: int) -> None:
    """A process that does not get ready, begin or end its drive in time is ended, and the run has failed."""
    rig.ask(BEGIN)
    if latest:
        rig.processes[0].drive()
        rig.processes[0].latest = latest
    for _ in range(after_ms // 1000):
        rig.clock.advance(1000)
        rig.service.step()
        assert rig.ask(STATUS).phase in ("starting", "running", "ending", "failed")
    rig.settle()
    failed = rig.ask(STATUS)
    assert failed.phase == "failed"
    assert failed.reason
    assert not rig.processes[0].running


@pytest.mark.parametrize(("ending", "exit_code"), [(None, 0), (None, 2), ("completed", 1)])
def test_a_failed_process_fails_the_run(rig: Rig, ending: str | None, exit_code: int) -> None:
    """If the process ends before its drive or with an error, the run has failed, and the reply has its last message."""
    rig.ask(BEGIN)
    rig.processes[0].complete(b"record")
    rig.processes[0].latest, rig.processes[0].exit_code = {"ending": ending}, exit_code
    rig.service.step()
    failed = rig.ask(STATUS)
    assert (failed.phase, failed.size) == ("failed", 0)
    assert "the last message" in failed.reason


def test_the_reason_of_a_killed_process_is_the_signal(rig: Rig) -> None:
    """If the process is killed, which it could not report, the reply names the signal."""
    rig.ask(BEGIN)
    rig.processes[0].complete(b"record")
    rig.processes[0].exit_code = -9
    rig.service.step()
    failed = rig.ask(STATUS)
    assert failed.phase == "failed"
    assert "signal 9" in failed.reason
    assert "the last message" not in failed.reason


def test_a_deleted_output_directory_is_made_again(rig: Rig) -> None:
    """A run begins even if somebody has deleted the directory of all runs."""
    shutil.rmtree(rig.out)
    assert rig.ask(BEGIN).phase == "starting"
    assert [path.name for path in rig.out.iterdir()] == ["0001"]


def test_directories_are_numbered_by_the_server(tmp_path: Path) -> None:
    """The directory of a run has the next free number, also after a restart of the server; nothing is overwritten."""
    for _ in range(2):
        rig = Rig(tmp_path)
        rig.ask(BEGIN)
        rig.finish(b"record")
        rig.ask(replace(BEGIN, run=8))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["0001", "0002", "0003", "0004"]


def test_a_full_store_begins_no_run(tmp_path: Path) -> None:
    """No run begins when the records occupy the configured space."""
    (tmp_path / "0001").mkdir()
    (tmp_path / "0001" / "server.mcap").write_bytes(bytes(1_000_000))
    rig = Rig(tmp_path, {"experiment": {"remote_runs": True, "max_stored_mb": 1}})
    assert rig.ask(BEGIN).refusal == "storage_full"


def test_errors_of_the_servers_files_are_refusals(tmp_path: Path) -> None:
    """If a directory or record cannot be used, the request is refused, and the server continues."""
    (tmp_path / "file").touch()
    rig = Rig(tmp_path / "file")
    assert rig.ask(BEGIN).refusal == "server_error"
    rig = Rig(tmp_path / "runs")
    rig.ask(BEGIN)
    rig.finish(b"record")
    (tmp_path / "runs" / "0001" / RECORD).unlink()
    assert rig.ask(READ).refusal == "server_error"


def test_a_run_whose_directory_is_deleted_fails(rig: Rig) -> None:
    """If the files of a run vanish during the drive, the run has failed, and the server continues."""
    rig.ask(BEGIN)
    rig.processes[0].drive()
    rig.service.step()
    rig.processes[0].complete(b"record")
    shutil.rmtree(rig.processes[0].directory)
    rig.service.step()
    assert rig.ask(STATUS).phase == "failed"
    assert rig.ask(replace(BEGIN, run=8)).phase == "starting"


def test_a_failed_start_leaves_no_files(tmp_path: Path) -> None:
    """Neither a process that cannot be started nor one that ends before it is ready leaves a directory."""

    def fail(_config: ServerConfig, _directory: Path) -> RunProcessStandIn:
        raise OSError(28, "No space left on device")

    rig = Rig(tmp_path)
    rig.service._start_process = fail
    assert rig.ask(BEGIN).refusal == "server_error"
    assert not list(tmp_path.iterdir())
    rig.service._start_process = rig.start
    assert rig.ask(BEGIN).phase == "starting"
    rig.processes[0].running = False
    rig.service.step()
    failed = rig.ask(STATUS)
    assert (failed.phase, "the last message" in failed.reason) == ("failed", True)
    assert not list(tmp_path.iterdir())


def test_the_number_of_stored_runs_is_limited(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    """Runs that are begun and ended again and again do not fill the output directory with directories."""
    monkeypatch.setattr(run_service, "MAX_STORED_RUNS", 2)
    for run in range(3):
        reply = rig.ask(replace(BEGIN, run=run))
        if not reply.refusal:
            rig.finish(b"record")
    assert (reply.refusal, len(rig.processes)) == ("storage_full", 2)


def test_a_closed_service_begins_no_run(rig: Rig) -> None:
    """At the end of the server its run is ended, and no other one begins."""
    rig.ask(BEGIN)
    rig.service.close()
    assert not rig.processes[0].running
    assert rig.ask(replace(BEGIN, who="operator-2")).refusal == "shutting_down"


def test_remote_runs_are_for_the_simulator_only() -> None:
    """A server of another vehicle, or with another camera, rejects `experiment.remote_runs`; it is off by default."""
    assert not ServerConfig().experiment.remote_runs
    for other in ({"vehicle": {"kind": "dbw"}}, {"vehicle": {"kind": "mine"}}, {"camera": {"source": "device"}}):
        with pytest.raises(UserError):
            parse_config(ServerConfig, {"experiment": {"remote_runs": True}, **other}, "the test")


def test_the_requested_part_has_what_differs_from_the_defaults() -> None:
    """The part of a config that is sent is short: it leaves out default values and the client's sections."""
    run = RunConfig.model_validate({"vehicle": {"route": "b_key"}, "network": {"condition": "L3"}})
    assert json.loads(remote_part(run, 12)) == {"vehicle": {"route": "b_key"}, "seed": 12}
