from __future__ import annotations

import json
import os
import re
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from tests.support.command_line import CommandResult, Run
from typer.main import get_command
from typer.testing import CliRunner

import lavt
from lavt.cli import main
from lavt.cli.main import build_app
from lavt.config_file import shipped
from lavt.experiment.analysis.results import IDENTITY_KEYS
from lavt.recording.output_directory import reserve_directory
from lavt.transport.zenoh_session import Router, quiet_logs

DEMO = str(shipped("configs/demo.yaml"))
BOUNDARY = str(shipped("configs/boundary.yaml"))
SWEEP = str(shipped("configs/sweep.yaml"))
STUDY = str(shipped("configs/study.yaml"))
SERVER = str(shipped("configs/server.yaml"))
CLIENT = str(shipped("configs/client.yaml"))
RELAY = str(shipped("configs/relay.yaml"))
RENDEZVOUS = str(shipped("configs/rendezvous.yaml"))
ROUTER = str(shipped("zenoh-configs/router-server.json5"))
EXIT_TIMEOUT_S = 60.0


def files(directory: Path) -> Mapping[str, bytes | None]:
    """Return the content of each file below a directory, by relative path; for a directory, None."""
    return {
        str(path.relative_to(directory)): path.read_bytes() if path.is_file() else None for path in directory.rglob("*")
    }


@pytest.mark.parametrize(
    "command",
    ["run demo", "sweep sweep", "boundary boundary", "study study", "server server", "client client", "doctor server"],
)
def test_a_shipped_config_is_found_from_any_directory(command: str, run: Run) -> None:
    """The shipped config that the help names is read if the present directory has no file of that name."""
    name, config = command.split()
    assert "unknown key 'sede'" in run(name, f"configs/{config}.yaml", "--set", "sede=7").rejection()


NETEM_OPTIONS = [
    part
    for change in ("time=real", "network.injection=netem", "network.inherent=loopback")
    for part in ("--set", change)
]
BAD_RUNS = {
    "unknown key": (["--set", "vehicle.rute=a_key"], "vehicle.rute"),
    "wrong type": (["--set", "seed=one"], "'seed'"),
    "out of range": (["--set", "camera.rate_hz=0"], "'camera.rate_hz'"),
    "exposure longer than a picture period": (["--set", "camera.exposure_ms=34"], "'camera.exposure_ms'"),
    "negative exposure": (["--set", "camera.exposure_ms=-1"], "'camera.exposure_ms'"),
    "too long sensor delay": (["--set", "camera.sensor_delay_ms=5000"], "'camera.sensor_delay_ms'"),
    "unknown light": (["--set", "vehicle.light=moon"], "'vehicle.light'"),
    "change without a value": (["--set", "seed"], "a.b=value"),
    "not YAML": (["--set", "seed=["], "not YAML"),
    "unknown condition": (["--set", "network.condition=L9"], "L0, L1, L2, L3, L4, L5"),
    "unknown route": (["--set", "vehicle.route=nowhere"], "a_key"),
    "unknown route in real time": (["--set", "vehicle.route=nowhere", "--set", "time=real"], "a_key"),
    "unknown preset": (["--set", "controller.preset=magic"], "designed, paper_calibrated"),
    "unknown preset in real time": (["--set", "controller.preset=magic", "--set", "time=real"], "designed"),
    "a person": (["--set", "controller.kind=human"], "`lavt drive`, `lavt client CONFIG --human` or `lavt study`"),
    "unknown controller": (["--set", "controller.kind=wizard"], "lane_keeper"),
    "a far point before the near one": (["--set", "controller.two_point.far_point_min_m=7"], "far_point_min_m must be"),
    "a negative reaction delay": (["--set", "controller.two_point.reaction_delay_s=-0.1"], "reaction_delay_s"),
    "no pictures in real time": (["--set", "fidelity=geometry", "--set", "time=real"], "fidelity geometry"),
    "unknown fidelity": (["--set", "fidelity=sketch"], "'geometry'"),
    "unknown vehicle": (["--set", "vehicle.kind=boat"], "simulator"),
    "unknown trace": (["--set", "network.video.trace=nowhere.csv"], "fading.mahimahi, handover.csv"),
    "unknown trace in real time": (["--set", "network.video.trace=nowhere", "--set", "time=real"], "'nowhere'"),
    "a trace that is a directory": (["--set", "network.video.trace=."], "trace '.'"),
    "a trace with a long name": (["--set", f"network.video.trace={'a' * 300}"], "trace 'aaa"),
    "a state delay with the trace of the video": (
        ["--set", "network.condition=handover", "--set", "network.state_delay=with_video"],
        "'handover.csv'",
    ),
    "a file that is not a trace": (["--set", f"network.video.trace={DEMO}"], "Mahimahi"),
    "a trace and a rate": (
        ["--set", "network.condition=fading", "--set", "network.video.rate_bps=1000000"],
        "rate_bps",
    ),
    "reordering without delay": (["--set", "network.video.reorder=0.1"], "reorder"),
    "a trace by netem": (
        ["--set", "network.condition=handover", *NETEM_OPTIONS],
        "'handover.csv'",
    ),
    "a short queue by netem": (
        ["--set", "network.condition=rate_short_queue", *NETEM_OPTIONS],
        "queue_packets 50",
    ),
    "netem, with a jitter larger than the delay": (
        ["--set", "network.video.jitter_ms=5", *NETEM_OPTIONS],
        "a jitter of 5 ms",
    ),
    "loss without injection": (
        ["--set", "network.video.loss=0.1", "--set", "time=real", "--set", "network.injection=none"],
        "network.injection",
    ),
    "netem, with an inherent latency": (
        ["--set", "network.injection=netem", "--set", "time=real", "--set", "network.inherent=paper_wifi5"],
        "network.injection relay",
    ),
}


@pytest.mark.parametrize("command", ["run", "sweep"])
@pytest.mark.parametrize("case", BAD_RUNS)
def test_bad_runs(command: str, case: str, run: Run, tmp_path: Path) -> None:
    """An invalid run or sweep is rejected in one sentence, and no directory is created."""
    changes, reason = BAD_RUNS[case]
    if command == "sweep":
        changes = [re.sub(r"network\.condition=(\w+)", r"conditions=[\1]", change) for change in changes]
        changes = [change.replace("vehicle.route=nowhere", "routes=[nowhere]") for change in changes]
    result = run(command, SWEEP if command == "sweep" else DEMO, *changes, "--out", "mine")
    assert reason in result.rejection()
    assert files(tmp_path) == {}


@pytest.mark.parametrize("command", [("run", DEMO), ("sweep", SWEEP), ("boundary", BOUNDARY), ("study", STUDY)])
def test_an_output_directory_with_an_impossible_name(command: Sequence[str], run: Run) -> None:
    """An output directory whose name is too long is rejected in one sentence that names it."""
    name = "a" * 300
    assert f"{name} cannot be read (File name too long)" in run(*command, "--out", name).rejection()


BAD_BOUNDARIES = {
    "a fixed value of the delay that is searched": (["network.video.delay_ms=5"], "network.video.delay_ms"),
    "unknown road": (["routes=[nowhere]"], "'nowhere'"),
    "unknown preset": (["presets=[swift]"], "'swift'"),
    "a route twice": (["routes=[a, a]"], "routes"),
    "no grid": (["grid_ms=0"], "'grid_ms'"),
    "a sweep's key": (["conditions=[L0]"], "'conditions'"),
    "real time": (["time=real"], "virtual time"),
}


@pytest.mark.parametrize("case", BAD_BOUNDARIES)
def test_bad_boundaries(case: str, run: Run, tmp_path: Path) -> None:
    """An invalid boundary search is rejected in one sentence, and no directory is created."""
    changes, reason = BAD_BOUNDARIES[case]
    options = [part for change in changes for part in ("--set", change)]
    assert reason in run("boundary", BOUNDARY, *options, "--out", "mine").rejection()
    assert files(tmp_path) == {}


BAD_STUDIES = {
    "a participant whom the study does not have": (["--participant", "13"], "from 1 to 12"),
    "participant 0": (["--participant", "0"], "from 1 to 12"),
    "one condition": (["--set", "conditions=[L0]"], "two conditions"),
    "a condition twice": (["--set", "conditions=[L0, L2, L0]"], "conditions must be a list without duplicates"),
    "no route": (["--set", "routes=[]"], "routes is empty: name at least one"),
    "unknown condition": (["--set", "conditions=[L0, L9]"], "'L9'"),
    "unknown road": (["--set", "routes=[nowhere]"], "'nowhere'"),
    "a person in virtual time": (["--set", "controller.kind=human"], "time real"),
    "a person without a number": (
        ["--set", "controller.kind=human", "--set", "time=real", "--set", "fidelity=video"],
        "--participant",
    ),
    "a person without video": (
        ["--set", "controller.kind=human", "--set", "time=real", "--participant", "1"],
        "fidelity geometry",
    ),
    "a place in the study": (["--set", "study.block=2"], "leave out the section study"),
    "a sweep's key": (["--set", "axes={seed: [1]}"], "'axes'"),
}


@pytest.mark.parametrize("case", BAD_STUDIES)
def test_bad_studies(case: str, run: Run, tmp_path: Path) -> None:
    """An invalid study is rejected in one sentence, and no directory is created."""
    options, reason = BAD_STUDIES[case]
    assert reason in run("study", STUDY, *options, "--out", "mine").rejection()
    assert files(tmp_path) == {}


def test_settings_that_the_encoder_rejects(run: Run, tmp_path: Path) -> None:
    """Settings that only the encoder can reject are rejected in one sentence, and no directory is created."""
    result = run("run", DEMO, "--set", "video.buffer_ms=0.5", "--set", "vehicle.scenery=none", "--out", "mine")
    assert (result.code, result.out) == (2, "")
    assert result.err.splitlines()[-1].startswith("lavt: ")
    assert "buffer cannot be 0.0005 s" in result.err.splitlines()[-1]
    assert files(tmp_path) == {}


LOOPBACK_SERVER = ("--interface", "lo", "--role", "server")
BAD_NETEM = {
    "unknown condition": (["apply", "L9", *LOOPBACK_SERVER], "L0, L1, L2, L3, L4, L5"),
    "the clock probe's port": (["apply", "L4", *LOOPBACK_SERVER, "--video-port", "5602"], "the clock probe (port "),
    "the clock probe on the video port": (
        ["apply", "L4", *LOOPBACK_SERVER, "--probe-port", "5600"],
        "the clock probe (port ",
    ),
    "the port of NTP": (["apply", "L4", *LOOPBACK_SERVER, "--video-port", "123"], "NTP"),
    "an invalid name of an interface": (["apply", "L4", "--role", "client", "--interface", "a/b"], "'a/b'"),
    "no such interface": (["show", "--interface", "nowhere0"], "nowhere0"),
    "nothing to verify": (["verify", "--interface", "nowhere0"], "nowhere0"),
}


@pytest.mark.parametrize("case", BAD_NETEM)
def test_bad_netem(case: str, run: Run) -> None:
    """Invalid arguments of `lavt netem` are rejected in one sentence before anything is changed."""
    arguments, reason = BAD_NETEM[case]
    rejected = run("netem", *arguments).rejection()
    assert reason in rejected or "no tc" in rejected  # on a machine without tc


def test_netem_dry_run(run: Run) -> None:
    """--dry-run needs neither root nor tc, and prints the commands, beginning with the root queue."""
    result = run("netem", "apply", "L2", *LOOPBACK_SERVER, "--dry-run")
    printed = json.loads(run("netem", "apply", "L2", *LOOPBACK_SERVER, "--dry-run", "--json").out)
    assert result.code == 0
    assert result.out.splitlines()[:2] == [
        "tc qdisc add dev lo root handle 4c56: prio bands 6",
        "tc qdisc add dev lo parent 4c56:4 handle 4c01: netem limit 10000 delay 150ms rate 10gbit",
    ]
    assert [" ".join(command) for command in printed["commands"]] == result.out.splitlines()


MISSING_FILES = {
    "run": ["run", "nothing.yaml"],
    "sweep": ["sweep", "nothing.yaml"],
    "study": ["study", "nothing.yaml"],
    "server": ["server", "nothing.yaml"],
    "client": ["client", "nothing.yaml"],
    "software-car": ["software-car", "nothing.yaml"],
    "relay": ["relay", "nothing.yaml"],
    "rendezvous": ["rendezvous", "nothing.yaml"],
    "router": ["router", "nothing.json5"],
    "report": ["report", "nothing"],
    "replay": ["replay", "nothing"],
}


@pytest.mark.parametrize("command", MISSING_FILES)
def test_missing_file(command: str, run: Run, tmp_path: Path) -> None:
    """A missing file or directory is named in one sentence, and nothing is created."""
    assert "nothing" in run(*MISSING_FILES[command]).rejection()
    assert files(tmp_path) == {}


CONFIGS_OF_OTHER_COMMANDS = {
    "run": ["run", SERVER],
    "server": ["server", DEMO],
    "client": ["client", DEMO],
    "software-car": ["software-car", DEMO],
    "relay": ["relay", DEMO],
    "rendezvous": ["rendezvous", DEMO],
    "router": ["router", DEMO],
}


@pytest.mark.parametrize("command", CONFIGS_OF_OTHER_COMMANDS)
def test_config_of_another_command(command: str, run: Run) -> None:
    """A config of another command is rejected in one sentence."""
    run(*CONFIGS_OF_OTHER_COMMANDS[command]).rejection()


COMMANDS_WITH_OUT = {
    "run": ["run", DEMO, "--out"],
    "sweep": ["sweep", SWEEP, "--out"],
    "study": ["study", STUDY, "--out"],
    "demo": ["demo", "--out"],
    "server": ["server", SERVER, "--out"],
    "client": ["client", CLIENT, "--out"],
    "drive": ["drive", "--no-browser", "--out"],
}


@pytest.mark.parametrize("occupied", ["directory", "file"])
@pytest.mark.parametrize("command", COMMANDS_WITH_OUT)
def test_nothing_is_overwritten(command: str, occupied: str, run: Run, tmp_path: Path) -> None:
    """If --out names an existing file or directory, the command is rejected and changes nothing."""
    mine = tmp_path / "mine"
    if occupied == "directory":
        (mine / "runs" / "a_key_L0_00").mkdir(parents=True)
        for name in ("server.mcap", "config.yaml", "runs/a_key_L0_00/result.json"):
            (mine / name).write_bytes(b"weeks of work")
    else:
        mine.write_bytes(b"weeks of work")
    before = files(tmp_path)
    assert "mine" in run(*COMMANDS_WITH_OUT[command], "mine").rejection()
    assert files(tmp_path) == before


def test_out_in_a_file(run: Run, tmp_path: Path) -> None:
    """An output directory that cannot be created is rejected in one sentence."""
    (tmp_path / "file").write_bytes(b"")
    for arguments in (["demo"], ["sweep", SWEEP]):
        assert "file/inside" in run(*arguments, "--out", "file/inside").rejection()


def test_a_file_that_the_system_cannot_look_up(run: Run) -> None:
    """A config or an output directory that the system refuses to look up is rejected in one sentence."""
    too_long = "a" * 300
    assert too_long in run("run", DEMO, "--out", too_long).rejection()
    assert too_long in run("run", f"{too_long}.yaml").rejection()


def test_report_of_nothing(run: Run, tmp_path: Path) -> None:
    """A report of a directory without runs is rejected, and nothing is written."""
    (tmp_path / "empty").mkdir()
    assert "empty" in run("report", "empty").rejection()
    assert "empty" in run("report", "empty", "--out", "elsewhere").rejection()
    (tmp_path / "file").write_bytes(b"x")
    assert "file" in run("report", "empty", "--out", "file").rejection()
    assert files(tmp_path) == {"empty": None, "file": b"x"}


COMPLETE_RESULT = dict.fromkeys(IDENTITY_KEYS)
INVALID_RESULTS = {
    "empty file": ("", "b/result.json"),
    "truncated file": ('{"run": "a', "b/result.json"),
    "list": ("[]", "JSON object"),
    "number": ("7", "JSON object"),
    "empty object": ("{}", "run, time"),
    "without a seed": (json.dumps({key: None for key in IDENTITY_KEYS if key != "seed"}), "seed"),
    "invalid axes": (json.dumps({**COMPLETE_RESULT, "axes": [1]}), "'axes'"),
    "invalid injection": (json.dumps({**COMPLETE_RESULT, "injected_ms": 5}), "'injected_ms'"),
}


@pytest.mark.parametrize("case", INVALID_RESULTS)
def test_report_of_an_invalid_result(case: str, run: Run, tmp_path: Path) -> None:
    """An invalid result.json ends the report with exit code 1 and one sentence, and no file of any run is changed."""
    content, reason = INVALID_RESULTS[case]
    for name, text in (("a", json.dumps(COMPLETE_RESULT)), ("b", content)):
        (tmp_path / "sweep" / "runs" / name).mkdir(parents=True)
        (tmp_path / "sweep" / "runs" / name / "result.json").write_text(text)
    before = files(tmp_path)
    result = run("report", "sweep")
    assert (result.code, result.out) == (1, "")
    assert reason in result.sentence()
    assert "b/result.json" in result.err
    assert files(tmp_path) == before


def test_report_of_a_boundary_without_a_sweep(run: Run, tmp_path: Path) -> None:
    """A directory with a boundary.json but no runs is rejected; an invalid boundary.json leads to exit code 1."""
    (tmp_path / "found").mkdir()
    (tmp_path / "found" / "boundary.json").write_text('{"runs": [{}], "groups": [{}]}')
    assert "found" in run("report", "found").rejection()
    (tmp_path / "found" / "boundary.json").write_text('{"runs": [], "groups": 3}')
    result = run("report", "found")
    assert (result.code, result.out) == (1, "")
    assert "boundary.json" in result.sentence()
    assert list(files(tmp_path / "found")) == ["boundary.json"]


@pytest.mark.parametrize("command", [("sweep", SWEEP), ("boundary", BOUNDARY)])
def test_nothing_to_resume(run: Run, tmp_path: Path, command: tuple[str, ...]) -> None:
    """A sweep or a search that was never begun in a directory cannot be resumed there."""
    (tmp_path / "photos").mkdir()
    for name in ("never", "photos", "a" * 300):
        assert f"nothing to resume in {name}" in run(*command, "--resume", "--out", name).rejection()
    assert files(tmp_path) == {"photos": None}


@pytest.mark.parametrize("command", [("sweep", SWEEP), ("boundary", BOUNDARY)])
def test_two_commands_do_not_write_into_one_directory(run: Run, tmp_path: Path, command: tuple[str, ...]) -> None:
    """While a command drives a sweep or searches boundaries, another one for the same directory is rejected."""
    with reserve_directory(tmp_path):
        assert "another command" in run(*command, "--out", str(tmp_path)).rejection()
    assert files(tmp_path) == {}


BAD_COMMANDS = {
    "vehicle with a slash": (["server", SERVER, "--set", "vehicle_id=a/b"], "the vehicle 'a/b'"),
    "vehicle with wildcards": (["client", CLIENT, "--set", "vehicle_id='**'"], "the vehicle '**'"),
    "client without a name": (["client", CLIENT, "--set", "who=''"], "the client ''"),
    "unknown key": (["server", SERVER, "--set", "vehicl_id=a"], "'vehicl_id'"),
    "missing session file": (["client", CLIENT, "--set", "zenoh={router: '', session: no.json5}"], "no.json5"),
    "TCP through the relay": (["relay", RELAY, "--set", "control_server=tcp/127.0.0.1:1"], "control_server"),
    "rendezvous for an invalid name": (
        ["rendezvous", RENDEZVOUS, "--set", "vehicle_id=a/b"],
        "the vehicle 'a/b'",
    ),
    "rendezvous without the key": (
        ["rendezvous", RENDEZVOUS, "--set", "vehicle_key=no.sign.pub"],
        "no.sign.pub",
    ),
    "replay of five runs": (["replay", *"abcde"], "at most 4"),
    "replay in an unknown format": (["replay", "a", "--out", "a.avi"], "a.avi"),
    "replay in a missing directory": (["replay", "a", "--out", "no/a.mp4"], "no is not a directory"),
    "a person's drive with a controller": (["drive", "--set", "controller.kind=lane_keeper"], "controller.kind"),
    "a person's drive in virtual time": (["drive", "--set", "time=virtual"], "in real time"),
    "a person's drive with netem": (["drive", "--set", "network.injection=netem"], "condition, video and control"),
    "a person's drive with jitter": (["drive", "--set", "network.video.jitter_ms=5"], "constant delays"),
    "a person's drive with a long delay": (["drive", "--set", "network.control.delay_ms=2001"], "at most 2000 ms"),
    "a run of a person": (["run", DEMO, "--set", "controller.kind=human"], "lavt drive"),
    "a run of an agent": (["run", DEMO, "--set", "controller.kind=agent"], "docs/gym.md"),
    "a client of an agent": (["client", CLIENT, "--set", "controller.kind=agent"], "docs/gym.md"),
    "a watched run in virtual time": (["run", DEMO, "--watch", "--set", "time=virtual"], "time=real"),
    "a watched person": (["client", CLIENT, "--human", "--watch"], "leave it out"),
    "watching without a vehicle": (["client", "--watch"], "name the vehicle's host"),
    "no address": (["relay", RELAY, "--set", "video_listen=here"], "video_listen"),
    "router's unknown key": (["router", ROUTER, "--set", "lisen.endpoints=[]"], "lisen.endpoints"),
    "router without endpoints": (["router", ROUTER, "--set", "listen.endpoints=[]"], ROUTER),
    "router's change without a value": (["router", ROUTER, "--set", "listen"], "a.b=value"),
    "router's change that is not YAML": (["router", ROUTER, "--set", "listen.endpoints=["], "not YAML"),
    "router's value that YAML reads as a date": (["router", ROUTER, "--set", "mode=2026-01-01"], "mode"),
}


@pytest.mark.parametrize("direction", ["listen", "connect"])
def test_a_router_whose_private_key_others_may_read(direction: str, run: Run, tmp_path: Path) -> None:
    """A router does not start if other users may read the private key of its certificate."""
    key = tmp_path / "vehicle-1.key"
    key.touch(0o644)
    key.chmod(0o644)
    change = f"transport.link.tls.{direction}_private_key={key}"
    assert str(key) in run("router", ROUTER, "--set", change, "--set", "listen.endpoints=[tcp/127.0.0.1:0]").rejection()


@pytest.mark.parametrize(("side", "config"), [("server", SERVER), ("client", CLIENT)])
def test_an_expired_signing_key(side: str, config: str, run: Run, tmp_path: Path) -> None:
    """A server or client with an expired signing key does not start."""
    certificates = pytest.importorskip("lavt.transport.security.certificates")
    pair = certificates.new_signing_pair(0, 1)
    private, public = tmp_path / "mine.sign.key", tmp_path / "other.sign.pub"
    private.write_bytes(pair.private)
    private.chmod(0o600)
    public.write_bytes(pair.public)
    peer_key = f"security.operators={{a: {public}}}" if side == "server" else f"security.vehicle={public}"
    sentence = run(side, config, "--set", f"security.key={private}", "--set", peer_key, "--out", "mine").rejection()
    assert str(private) in sentence or str(public) in sentence
    assert "1970-01-02" in sentence
    assert not (tmp_path / "mine").exists()


@pytest.mark.parametrize("case", BAD_COMMANDS)
def test_bad_commands(case: str, run: Run, tmp_path: Path) -> None:
    """An invalid config of a server, client, router or relay is rejected in one sentence, and nothing is created."""
    arguments, reason = BAD_COMMANDS[case]
    out = ["--out", "mine"] if arguments[0] in {"server", "client"} else []
    assert reason in run(*arguments, *out).rejection()
    assert files(tmp_path) == {}


COMMANDS = [
    "vehicles",
    "demo",
    "drive",
    "run",
    "sweep",
    "study",
    "boundary",
    "report",
    "compliance",
    "replay",
    "server",
    "client",
    "software-car",
    "sdp",
    "stop",
    "router",
    "keys",
    "relay",
    "rendezvous",
    "clock",
    "doctor",
    "join",
    "watch",
]


@pytest.mark.parametrize("command", COMMANDS)
def test_help(command: str, run: Run) -> None:
    """Each command prints a help text with an example to standard output."""
    result = run(command, "--help")
    assert result.code == 0
    assert f"Example: lavt {command}" in " ".join(result.out.split())
    assert result.err == ""


def test_list_of_commands(run: Run) -> None:
    """The help of `lavt` lists all commands by group in the order of the table, as with the modules of all commands."""
    result = run("--help")
    assert result.code == 0
    assert sorted(command.name or "" for command in build_app().registered_commands) == sorted(COMMANDS)
    assert all(command in result.out for command in COMMANDS)
    lines, complete_lines = (
        CliRunner().invoke(app, ["--help"]).output.splitlines() for app in (build_app([]), build_app())
    )
    assert sorted(lines) == sorted(complete_lines), "the complete help has groups of commands last"
    assert re.findall(r"^  ([a-z][a-z-]*)", result.out, re.MULTILINE) == list(main.COMMANDS)
    assert re.findall(r"^([A-Z].*):$", result.out, re.MULTILINE)[1:] == list(main.GROUPS)


def test_the_sentences_in_the_list_of_commands() -> None:
    """The sentence of each command in the list is the first one of its own help."""
    group: Any = get_command(build_app())
    sentences = {name: command.get_short_help_str(1000) for name, command in group.commands.items()}
    assert sentences == main.COMMANDS


@pytest.mark.parametrize("arguments", [["--version"], ["--help", "run"]])
def test_options_before_a_command(arguments: list[str], run: Run) -> None:
    """The options of `lavt` itself take precedence over a command that follows them."""
    result = run(*arguments)
    assert (result.code, result.err) == (0, "")
    assert result.out == f"lavt {lavt.__version__}\n" if "--version" in arguments else "netem" in result.out


def test_a_command_after_two_hyphens(run: Run, tmp_path: Path) -> None:
    """A command that follows `--` is executed."""
    assert "missing.yaml" in run("--", "run", "missing.yaml").rejection()
    assert list(tmp_path.iterdir()) == []


def test_join_of_nothing(run: Run, tmp_path: Path) -> None:
    """Directories without the output of a side are rejected, and no run is created."""
    rejected = run("join", "one", "two", "--out", "joined").rejection()
    assert "one" in rejected
    assert "config.yaml" in rejected
    assert not (tmp_path / "joined").exists()


@pytest.mark.parametrize("timeout", ["inf", "1e300", "nan", "0"])
@pytest.mark.parametrize("command", [("stop", CLIENT), ("vehicles",)])
def test_a_timeout_that_is_no_time(command: Sequence[str], timeout: str, run: Run) -> None:
    """A timeout that is infinite, not a number, or zero ends with exit code 2 and an error about the option."""
    result = run(*command, "--timeout", timeout)
    assert result.code == 2
    assert "Invalid value for '--timeout'" in result.err


def test_unknown_command(run: Run) -> None:
    """An unknown command or option, or a missing argument, ends with exit code 2 and an error on standard error."""
    for arguments in (["fly"], ["run", DEMO, "--fast"], ["run"]):
        result = run(*arguments)
        assert (result.code, result.out) == (2, "")
        assert "Error: " in result.err


def start_lavt(*arguments: str) -> subprocess.Popen[str]:
    """Start `lavt` in a process of its own."""
    return subprocess.Popen(
        [sys.executable, "-m", "lavt", *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "OPENCV_FOR_THREADS_NUM": "1"},
    )


@pytest.fixture(scope="module")
def router() -> Iterator[str]:
    """Run a router on this machine; return its endpoint."""
    quiet_logs()
    with closing(Router(Path(ROUTER), {"listen/endpoints": ["tcp/127.0.0.1:0"]})) as opened:
        yield opened.locators()[0]


@pytest.fixture(scope="module")
def used_port() -> Iterator[int]:
    """Return a UDP and TCP port of 127.0.0.1 that is in use."""
    with socket.socket() as tcp, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp:
        tcp.bind(("127.0.0.1", 0))
        tcp.listen()
        udp.bind(tcp.getsockname())
        yield tcp.getsockname()[1]


def test_relay_port_in_use(used_port: int, run: Run) -> None:
    """A relay's port that is in use is rejected in one sentence."""
    rejected = run("relay", RELAY, "--set", f"video_listen=127.0.0.1:{used_port}").rejection()
    assert f"127.0.0.1:{used_port}" in rejected


def test_rendezvous_port_in_use(used_port: int, run: Run) -> None:
    """A rendezvous port that is in use is rejected in one sentence."""
    changes = ("--set", "bind=127.0.0.1", "--set", "video_port=0", "--set", f"probe_port={used_port}")
    assert f"127.0.0.1:{used_port}" in run("rendezvous", RENDEZVOUS, *changes).rejection()


BAD_WATCHES = {
    "address of another machine": (["--bind", "192.0.2.7"], "192.0.2.7:5600"),
    "unknown local host": (["--bind", "a" * 64], "a" * 64),
    "unknown sender": (["--from", "a" * 64], "--from"),
}


@pytest.mark.parametrize("case", BAD_WATCHES)
def test_bad_watch(case: str, run: Run) -> None:
    """An unknown host, or an address of another machine, is rejected in one sentence."""
    arguments, reason = BAD_WATCHES[case]
    assert reason in run("watch", *arguments).rejection()


def test_watched_port_in_use(used_port: int, run: Run) -> None:
    """A watched port that is in use is rejected in one sentence."""
    rejected = run("watch", "--bind", "127.0.0.1", "--port", str(used_port)).rejection()
    assert f"127.0.0.1:{used_port}" in rejected


def test_server_with_an_unknown_route(router: str, run: Run, tmp_path: Path) -> None:
    """An unknown road is rejected in one sentence, after the server's links are open, and nothing is created."""
    changes = ("--set", "vehicle.route=nowhere", "--set", "video.port=0", "--set", f"zenoh.router={router}")
    assert "'nowhere'" in run("server", SERVER, *changes, "--out", "mine").rejection()
    assert files(tmp_path) == {}


def test_server_with_an_unknown_rendezvous(router: str, run: Run, tmp_path: Path) -> None:
    """An unknown host of the rendezvous is rejected in one sentence, and nothing is created."""
    changes = ("--set", f"rendezvous.host={'a' * 64}", "--set", f"zenoh.router={router}")
    assert "rendezvous.host" in run("server", SERVER, *changes, "--out", "mine").rejection()
    assert files(tmp_path) == {}


def test_client_with_an_unknown_server(router: str, run: Run, tmp_path: Path) -> None:
    """An unknown host of the server is rejected in one sentence, and nothing is created."""
    changes = ("--set", f"video.server={'a' * 64}", "--set", f"zenoh.router={router}")
    assert "video.server" in run("client", CLIENT, *changes, "--out", "mine").rejection()
    assert files(tmp_path) == {}


def test_server_port_in_use(router: str, used_port: int, run: Run, tmp_path: Path) -> None:
    """A server's video port that is in use is rejected in one sentence, and nothing is created."""
    changes = (f"video.port={used_port}", "video.bind=127.0.0.1", f"zenoh.router={router}")
    options = [part for change in changes for part in ("--set", change)]
    assert f"127.0.0.1:{used_port}" in run("server", SERVER, "--json", *options, "--out", "mine").rejection()
    assert files(tmp_path) == {}


def test_client_with_an_unknown_protocol(run: Run, tmp_path: Path) -> None:
    """A router endpoint with an unknown protocol is rejected in one sentence, and nothing is created."""
    rejected = run("client", CLIENT, "--json", "--set", "zenoh.router=foo/127.0.0.1:1", "--out", "mine").rejection()
    assert "zenoh.router" in rejected
    assert "'foo/127.0.0.1:1'" in rejected
    assert files(tmp_path) == {}


def test_stop_without_a_router(run: Run) -> None:
    """Without a router, `lavt stop` fails with one sentence that names the command that starts a router."""
    assert (
        "`lavt router" in run("stop", CLIENT, "--timeout", "0.1", "--set", "zenoh.router=tcp/127.0.0.1:1").rejection()
    )


def test_bad_input_of_a_process(used_port: int) -> None:
    """With invalid input, `python -m lavt` prints one sentence and no log of Zenoh, and exits with code 2."""
    process = start_lavt("router", ROUTER, "--json", "--set", f"listen.endpoints=[tcp/127.0.0.1:{used_port}]")
    out, err = process.communicate(timeout=EXIT_TIMEOUT_S)
    assert f"tcp/127.0.0.1:{used_port}" in CommandResult(process.returncode, out, err).rejection()


@pytest.mark.parametrize("command", [["client", CLIENT], ["server", SERVER, "--set", "video.port=0"]])
def test_a_side_waits_for_its_router(command: list[str]) -> None:
    """A side whose separate router is absent prints that it is plain and that it waits; Ctrl-C ends it with code 0."""
    ports = ["--set", "zenoh.router=tcp/127.0.0.1:1", "--set", f"clock.probe_port={1 if command[0] == 'client' else 0}"]
    process = start_lavt(*command, *ports, "--json", "--set", "camera.width_px=128", "--set", "camera.height_px=128")
    assert process.stdout is not None
    assert '"ready"' in process.stdout.readline()
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=EXIT_TIMEOUT_S)
    assert process.returncode == 0
    plain, waiting = err.splitlines()
    assert "plain" in plain
    assert "`lavt router" in waiting


def test_version(run: Run) -> None:
    """`lavt --version` prints the version to standard output."""
    assert run("--version") == CommandResult(0, f"lavt {lavt.__version__}\n", "")


def test_ctrl_c_ends_forwarders() -> None:
    """A router, a relay and a rendezvous print their addresses on one line, and exit with code 0 on Ctrl-C."""
    arguments = {
        "locators": ["router", ROUTER, "--json", "--set", "listen.endpoints=[tcp/127.0.0.1:0]"],
        "ready": ["rendezvous", RENDEZVOUS, "--json", "--set", "video_port=0", "--set", "probe_port=0"],
        "ports": ["relay", RELAY, "--json", "--set", "video_listen=127.0.0.1:0", "--set", "control_listen=127.0.0.1:0"],
    }
    processes = {key: start_lavt(*words) for key, words in arguments.items()}
    for key, process in processes.items():
        assert process.stdout is not None
        assert f'"{key}"' in process.stdout.readline()
        process.send_signal(signal.SIGINT)
    for process in processes.values():
        _, err = process.communicate(timeout=EXIT_TIMEOUT_S)
        assert (process.returncode, err) == (0, "")
