from __future__ import annotations

import json
import os
import re
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator, Mapping
from contextlib import closing
from pathlib import Path

import pytest
from tests.support.command_line import CommandResult, Run

import lavt
from lavt.cli.main import app
from lavt.config_file import shipped
from lavt.experiment.analysis.results import IDENTITY
from lavt.transport.zenoh_link import Router, quiet_logs

DEMO = str(shipped("configs/demo.yaml"))
BOUNDARY = str(shipped("configs/boundary.yaml"))
SWEEP = str(shipped("configs/sweep.yaml"))
SERVER = str(shipped("configs/server.yaml"))
CLIENT = str(shipped("configs/client.yaml"))
RELAY = str(shipped("configs/relay.yaml"))
RENDEZVOUS = str(shipped("configs/rendezvous.yaml"))
ROUTER = str(shipped("zenoh-configs/router-server.json5"))
ENDS_S = 60.0


def files(directory: Path) -> Mapping[str, bytes | None]:
    """Give everything in a directory: path to content, None for directories."""
    return {
        str(path.relative_to(directory)): path.read_bytes() if path.is_file() else None for path in directory.rglob("*")
    }


BY_NETEM = [
    part
    for change in ("time=real", "network.injection=netem", "network.inherent=loopback")
    for part in ("--set", change)
]
BAD_RUNS = {
    "unknown key": (["--set", "vehicle.rute=a_key"], "vehicle.rute"),
    "wrong type": (["--set", "seed=one"], "'seed'"),
    "out of range": (["--set", "camera.rate_hz=0"], "'camera.rate_hz'"),
    "exposure longer than a frame": (["--set", "camera.exposure_ms=34"], "'camera.exposure_ms'"),
    "exposure of less than nothing": (["--set", "camera.exposure_ms=-1"], "'camera.exposure_ms'"),
    "endless sensor delay": (["--set", "camera.sensor_delay_ms=5000"], "'camera.sensor_delay_ms'"),
    "no such light": (["--set", "vehicle.light=moon"], "'vehicle.light'"),
    "not a change": (["--set", "seed"], "a.b=value"),
    "not YAML": (["--set", "seed=["], "not YAML"),
    "unknown condition": (["--set", "network.condition=L9"], "L0, L1, L2, L3, L4, L5"),
    "unknown route": (["--set", "vehicle.route=nowhere"], "a_key"),
    "unknown route in real time": (["--set", "vehicle.route=nowhere", "--set", "time=real"], "a_key"),
    "unknown preset": (["--set", "controller.preset=magic"], "designed, paper_calibrated"),
    "unknown preset in real time": (["--set", "controller.preset=magic", "--set", "time=real"], "designed"),
    "unknown controller": (["--set", "controller.kind=wizard"], "lane_keeper"),
    "no pixels in real time": (["--set", "fidelity=geometry", "--set", "time=real"], "fidelity geometry"),
    "unknown fidelity": (["--set", "fidelity=sketch"], "'geometry'"),
    "unknown vehicle": (["--set", "vehicle.kind=boat"], "simulator"),
    "no such trace": (["--set", "network.video.trace=nowhere.csv"], "fading.mahimahi, handover.csv"),
    "no such trace in real time": (["--set", "network.video.trace=nowhere", "--set", "time=real"], "'nowhere'"),
    "a trace that is a directory": (["--set", "network.video.trace=."], "trace '.'"),
    "a trace of a long name": (["--set", f"network.video.trace={'a' * 300}"], "trace 'aaa"),
    "a trace that the state is to follow": (
        ["--set", "network.condition=handover", "--set", "network.state_delay=with_video"],
        "'handover.csv'",
    ),
    "a trace that is none": (["--set", f"network.video.trace={DEMO}"], "Mahimahi"),
    "a trace and a rate": (
        ["--set", "network.condition=fading", "--set", "network.video.rate_bps=1000000"],
        "rate_bps",
    ),
    "overtaking nothing": (["--set", "network.video.reorder=0.1"], "reorder"),
    "a trace by netem": (
        ["--set", "network.condition=handover", *BY_NETEM],
        "'handover.csv'",
    ),
    "a short queue by netem": (
        ["--set", "network.condition=rate_short_queue", *BY_NETEM],
        "queue_packets 50",
    ),
    "jitter beyond the delay by netem": (
        ["--set", "network.video.jitter_ms=5", *BY_NETEM],
        "a jitter of 5 ms",
    ),
    "loss that nobody injects": (
        ["--set", "network.video.loss=0.1", "--set", "time=real", "--set", "network.injection=none"],
        "network.injection",
    ),
    "a profile that netem cannot do": (
        ["--set", "network.injection=netem", "--set", "time=real", "--set", "network.inherent=paper_wifi5"],
        "network.injection relay",
    ),
}


@pytest.mark.parametrize("command", ["run", "sweep"])
@pytest.mark.parametrize("case", BAD_RUNS)
def test_bad_runs(command: str, case: str, run: Run, tmp_path: Path) -> None:
    """A run or sweep that cannot be driven is refused in one sentence, and no directory is made for it."""
    changes, said = BAD_RUNS[case]
    if command == "sweep":
        changes = [re.sub(r"network\.condition=(\w+)", r"conditions=[\1]", each) for each in changes]
        changes = [each.replace("vehicle.route=nowhere", "routes=[nowhere]") for each in changes]
    ended = run(command, SWEEP if command == "sweep" else DEMO, *changes, "--out", "mine")
    assert said in ended.rejected()
    assert files(tmp_path) == {}


BAD_BOUNDARIES = {
    "the delay that is searched": (["network.video.delay_ms=5"], "network.video.delay_ms"),
    "unknown road": (["routes=[nowhere]"], "'nowhere'"),
    "unknown preset": (["presets=[swift]"], "'swift'"),
    "a route twice": (["routes=[a, a]"], "routes"),
    "no grid": (["grid_ms=0"], "'grid_ms'"),
    "a sweep's key": (["conditions=[L0]"], "'conditions'"),
    "real time": (["time=real"], "virtual time"),
}


@pytest.mark.parametrize("case", BAD_BOUNDARIES)
def test_bad_boundaries(case: str, run: Run, tmp_path: Path) -> None:
    """A boundary that cannot be searched is refused in one sentence, and no directory is made for it."""
    changes, said = BAD_BOUNDARIES[case]
    options = [part for change in changes for part in ("--set", change)]
    assert said in run("boundary", BOUNDARY, *options, "--out", "mine").rejected()
    assert files(tmp_path) == {}


def test_codec_that_cannot_be(run: Run, tmp_path: Path) -> None:
    """A run that only the encoder can refuse, when the car is built already, leaves no directory behind either."""
    ended = run("run", DEMO, "--set", "video.buffer_ms=0.5", "--set", "vehicle.scenery=none", "--out", "mine")
    assert (ended.code, ended.out) == (2, "")
    assert ended.err.splitlines()[-1].startswith("lavt: ")
    assert "buffer of 0.0005 s" in ended.err.splitlines()[-1]
    assert files(tmp_path) == {}


ON_LO = ("--interface", "lo", "--role", "server")
BAD_NETEM = {
    "unknown condition": (["apply", "L9", *ON_LO], "L0, L1, L2, L3, L4, L5"),
    "the clock probe's port": (["apply", "L4", *ON_LO, "--video-port", "5602"], "the clock probe (port "),
    "the probe moved onto the video": (["apply", "L4", *ON_LO, "--probe-port", "5600"], "the clock probe (port "),
    "the port of NTP": (["apply", "L4", *ON_LO, "--video-port", "123"], "NTP"),
    "no interface's name": (["apply", "L4", "--role", "client", "--interface", "a/b"], "'a/b'"),
    "no such interface": (["show", "--interface", "nowhere0"], "nowhere0"),
    "nothing to verify": (["verify", "--interface", "nowhere0"], "nowhere0"),
}


@pytest.mark.parametrize("case", BAD_NETEM)
def test_bad_netem(case: str, run: Run) -> None:
    """What netem must not or cannot do is refused in one sentence before anything is changed."""
    arguments, said = BAD_NETEM[case]
    rejected = run("netem", *arguments).rejected()
    assert said in rejected or "there is no tc" in rejected


def test_netem_tells_what_it_would_do(run: Run) -> None:
    """--dry-run needs no root and no tc, and prints the commands, the root's first."""
    ended = run("netem", "apply", "L2", *ON_LO, "--dry-run")
    told = json.loads(run("netem", "apply", "L2", *ON_LO, "--dry-run", "--json").out)
    assert ended.code == 0
    assert ended.out.splitlines()[:2] == [
        "tc qdisc add dev lo root handle 4c56: prio bands 6",
        "tc qdisc add dev lo parent 4c56:4 handle 4c01: netem limit 10000 delay 150ms rate 10gbit",
    ]
    assert [" ".join(command) for command in told["commands"]] == ended.out.splitlines()


MISSING = {
    "run": ["run", "nothing.yaml"],
    "sweep": ["sweep", "nothing.yaml"],
    "server": ["server", "nothing.yaml"],
    "client": ["client", "nothing.yaml"],
    "software-car": ["software-car", "nothing.yaml"],
    "relay": ["relay", "nothing.yaml"],
    "rendezvous": ["rendezvous", "nothing.yaml"],
    "router": ["router", "nothing.json5"],
    "report": ["report", "nothing"],
}


@pytest.mark.parametrize("command", MISSING)
def test_missing_file(command: str, run: Run, tmp_path: Path) -> None:
    """A file or directory that is not there is named in one sentence, and nothing is made."""
    assert "nothing" in run(*MISSING[command]).rejected()
    assert files(tmp_path) == {}


WRONG_CONFIG = {
    "run": ["run", SERVER],
    "server": ["server", DEMO],
    "client": ["client", DEMO],
    "software-car": ["software-car", DEMO],
    "relay": ["relay", DEMO],
    "rendezvous": ["rendezvous", DEMO],
    "router": ["router", DEMO],
}


@pytest.mark.parametrize("command", WRONG_CONFIG)
def test_config_of_another_command(command: str, run: Run) -> None:
    """A config that is another command's is refused in one sentence."""
    run(*WRONG_CONFIG[command]).rejected()


OUT = {
    "run": ["run", DEMO, "--out"],
    "sweep": ["sweep", SWEEP, "--out"],
    "demo": ["demo", "--out"],
    "server": ["server", SERVER, "--out"],
    "client": ["client", CLIENT, "--out"],
}


@pytest.mark.parametrize("occupied", ["directory", "file"])
@pytest.mark.parametrize("command", OUT)
def test_nothing_is_overwritten(command: str, occupied: str, run: Run, tmp_path: Path) -> None:
    """What lies where --out points is never touched: the command refuses, and every byte is as it was."""
    mine = tmp_path / "mine"
    if occupied == "directory":
        (mine / "runs" / "a_key_L0_00").mkdir(parents=True)
        for name in ("server.mcap", "config.yaml", "runs/a_key_L0_00/result.json"):
            (mine / name).write_bytes(b"weeks of work")
    else:
        mine.write_bytes(b"weeks of work")
    before = files(tmp_path)
    assert "mine" in run(*OUT[command], "mine").rejected()
    assert files(tmp_path) == before


def test_out_that_cannot_be_made(run: Run, tmp_path: Path) -> None:
    """A directory that cannot be made is refused in one sentence."""
    (tmp_path / "file").write_bytes(b"")
    for arguments in (["demo"], ["sweep", SWEEP]):
        assert "file/inside" in run(*arguments, "--out", "file/inside").rejected()


def test_report_of_nothing(run: Run, tmp_path: Path) -> None:
    """A report of a directory without runs is refused, and nothing is written into it."""
    (tmp_path / "empty").mkdir()
    assert "empty" in run("report", "empty").rejected()
    assert "empty" in run("report", "empty", "--out", "elsewhere").rejected()
    (tmp_path / "file").write_bytes(b"x")
    assert "file" in run("report", "empty", "--out", "file").rejected()
    assert files(tmp_path) == {"empty": None, "file": b"x"}


WHOLE = dict.fromkeys(IDENTITY)
NO_RESULTS = {
    "nothing": ("", "cannot read"),
    "half a file": ('{"run": "a', "cannot read"),
    "list": ("[]", "JSON object"),
    "number": ("7", "JSON object"),
    "empty object": ("{}", "run, time"),
    "without a seed": (json.dumps({key: None for key in IDENTITY if key != "seed"}), "seed"),
    "axes that are none": (json.dumps({**WHOLE, "axes": [1]}), "'axes'"),
    "injection that is none": (json.dumps({**WHOLE, "injected_ms": 5}), "'injected_ms'"),
}


@pytest.mark.parametrize("case", NO_RESULTS)
def test_report_of_what_is_no_result(case: str, run: Run, tmp_path: Path) -> None:
    """A result.json that is none ends the report with 1 and one sentence, and nothing is written, in no run."""
    content, said = NO_RESULTS[case]
    for name, text in (("a", json.dumps(WHOLE)), ("b", content)):
        (tmp_path / "sweep" / "runs" / name).mkdir(parents=True)
        (tmp_path / "sweep" / "runs" / name / "result.json").write_text(text)
    before = files(tmp_path)
    ended = run("report", "sweep")
    assert (ended.code, ended.out) == (1, "")
    assert said in ended.sentence()
    assert "b/result.json" in ended.err
    assert files(tmp_path) == before


def test_report_of_a_boundary_without_runs(run: Run, tmp_path: Path) -> None:
    """A boundary alone is refused, and a boundary.json that is none ends the report with 1 and one sentence."""
    (tmp_path / "found").mkdir()
    (tmp_path / "found" / "boundary.json").write_text('{"runs": [{}], "groups": [{}]}')
    assert "found" in run("report", "found").rejected()
    (tmp_path / "found" / "boundary.json").write_text('{"runs": [], "groups": 3}')
    ended = run("report", "found")
    assert (ended.code, ended.out) == (1, "")
    assert "boundary.json" in ended.sentence()
    assert list(files(tmp_path / "found")) == ["boundary.json"]


def test_nothing_to_resume(run: Run, tmp_path: Path) -> None:
    """A sweep that was never begun cannot be resumed."""
    assert "never" in run("sweep", SWEEP, "--resume", "--out", "never").rejected()
    assert files(tmp_path) == {}


SIDES = {
    "vehicle with a slash": (["server", SERVER, "--set", "vehicle_id=a/b"], "the vehicle 'a/b'"),
    "vehicle of stars": (["client", CLIENT, "--set", "vehicle_id='**'"], "the vehicle '**'"),
    "client without a name": (["client", CLIENT, "--set", "who=''"], "the client ''"),
    "unknown key": (["server", SERVER, "--set", "vehicl_id=a"], "'vehicl_id'"),
    "missing session file": (["client", CLIENT, "--set", "zenoh.session=no.json5"], "no.json5"),
    "TCP through the relay": (["relay", RELAY, "--set", "control_server=tcp/127.0.0.1:1"], "control_server"),
    "rendezvous of a bad name": (
        ["rendezvous", RENDEZVOUS, "--set", "vehicle_id=a/b"],
        "the vehicle 'a/b'",
    ),
    "rendezvous without the key": (
        ["rendezvous", RENDEZVOUS, "--set", "vehicle_key=no.sign.pub"],
        "no.sign.pub",
    ),
    "no address": (["relay", RELAY, "--set", "video_listen=here"], "video_listen"),
    "router's unknown key": (["router", ROUTER, "--set", "lisen.endpoints=[]"], "lisen.endpoints"),
    "router without endpoints": (["router", ROUTER, "--set", "listen.endpoints=[]"], ROUTER),
    "router's change without a value": (["router", ROUTER, "--set", "listen"], "a.b=value"),
    "router's change that is not YAML": (["router", ROUTER, "--set", "listen.endpoints=["], "not YAML"),
    "router's change that is a date": (["router", ROUTER, "--set", "mode=2026-01-01"], "mode"),
}


@pytest.mark.parametrize("case", SIDES)
def test_bad_sides(case: str, run: Run, tmp_path: Path) -> None:
    """A server, client, router or relay whose config cannot work is refused in one sentence, and nothing is made."""
    arguments, said = SIDES[case]
    out = ["--out", "mine"] if arguments[0] in {"server", "client"} else []
    assert said in run(*arguments, *out).rejected()
    assert files(tmp_path) == {}


COMMANDS = [
    "demo",
    "run",
    "sweep",
    "boundary",
    "report",
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
    """The help of every command goes to standard output and has an example."""
    ended = run(command, "--help")
    assert ended.code == 0
    assert f"Example: lavt {command}" in " ".join(ended.out.split())
    assert ended.err == ""


def test_list_of_commands(run: Run) -> None:
    """The help of lavt names every command, and this test knows them all."""
    ended = run("--help")
    assert ended.code == 0
    assert sorted(each.name or "" for each in app.registered_commands) == sorted(COMMANDS)
    assert all(command in ended.out for command in COMMANDS)


def test_join_of_nothing(run: Run, tmp_path: Path) -> None:
    """Directories that no side wrote are refused with what to name instead, and no run is made."""
    said = run("join", "one", "two", "--out", "joined").rejected()
    assert "one" in said
    assert "config.yaml" in said
    assert not (tmp_path / "joined").exists()


def test_unknown_command(run: Run) -> None:
    """A command or option that does not exist ends with 2 and is named on standard error."""
    for arguments in (["fly"], ["run", DEMO, "--fast"], ["run"]):
        ended = run(*arguments)
        assert (ended.code, ended.out) == (2, "")
        assert "Error: " in ended.err


def lavt_process(*arguments: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "lavt", *arguments], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        env={**os.environ, "OPENCV_FOR_THREADS_NUM": "1"},
    )  # fmt: skip


@pytest.fixture(scope="module")
def router() -> Iterator[str]:
    """A router on this machine; gives its endpoint."""
    quiet_logs()
    with closing(Router(Path(ROUTER), {"listen/endpoints": ["tcp/127.0.0.1:0"]})) as opened:
        yield opened.locators()[0]


@pytest.fixture(scope="module")
def taken() -> Iterator[int]:
    """A port of 127.0.0.1, of UDP and of TCP, that somebody else has."""
    with socket.socket() as tcp, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp:
        tcp.bind(("127.0.0.1", 0))
        tcp.listen()
        udp.bind(tcp.getsockname())
        yield tcp.getsockname()[1]


def test_relay_port_in_use(taken: int, run: Run) -> None:
    """A relay whose port somebody else has is refused in one sentence."""
    said = run("relay", RELAY, "--set", f"video_listen=127.0.0.1:{taken}").rejected()
    assert f"127.0.0.1:{taken}" in said


def test_port_of_the_rendezvous_in_use(taken: int, run: Run) -> None:
    """A rendezvous of whose ports somebody else has one is refused in one sentence, and gives the other one back."""
    changes = ("--set", "bind=127.0.0.1", "--set", "video_port=0", "--set", f"probe_port={taken}")
    assert f"127.0.0.1:{taken}" in run("rendezvous", RENDEZVOUS, *changes).rejected()


WATCHES = {
    "no such address": (["--bind", "192.0.2.7"], "192.0.2.7:5600"),
    "no host to listen at": (["--bind", "a" * 64], "a" * 64),
    "no host to hear": (["--from", "a" * 64], "--from"),
}


@pytest.mark.parametrize("case", WATCHES)
def test_bad_watch(case: str, run: Run) -> None:
    """A host that nobody knows, and an address that is not this machine's, are refused in one sentence."""
    arguments, said = WATCHES[case]
    assert said in run("watch", *arguments).rejected()


def test_watched_port_in_use(taken: int, run: Run) -> None:
    """A port that somebody else has is refused in one sentence."""
    said = run("watch", "--bind", "127.0.0.1", "--port", str(taken)).rejected()
    assert f"127.0.0.1:{taken}" in said


def test_server_of_an_unknown_route(router: str, run: Run, tmp_path: Path) -> None:
    """A server whose road does not exist is refused in one sentence though its links are open, and nothing is made."""
    changes = ("--set", "vehicle.route=nowhere", "--set", "video.port=0", "--set", f"zenoh.router={router}")
    assert "'nowhere'" in run("server", SERVER, *changes, "--out", "mine").rejected()
    assert files(tmp_path) == {}


def test_server_of_an_unknown_rendezvous(router: str, run: Run, tmp_path: Path) -> None:
    """A server whose rendezvous no one can look up is refused in one sentence, and nothing is made."""
    changes = ("--set", f"rendezvous.host={'a' * 64}", "--set", f"zenoh.router={router}")
    assert "rendezvous.host" in run("server", SERVER, *changes, "--out", "mine").rejected()
    assert files(tmp_path) == {}


def test_client_of_an_unknown_server(router: str, run: Run, tmp_path: Path) -> None:
    """A client whose server no one can look up is refused in one sentence, and nothing is made."""
    changes = ("--set", f"video.server={'a' * 64}", "--set", f"zenoh.router={router}")
    assert "video.server" in run("client", CLIENT, *changes, "--out", "mine").rejected()
    assert files(tmp_path) == {}


def test_server_port_in_use(router: str, taken: int, run: Run, tmp_path: Path) -> None:
    """A server whose video port another program uses is refused in one sentence, and nothing is made."""
    changes = (f"video.port={taken}", "video.bind=127.0.0.1", f"zenoh.router={router}")
    sets = [part for change in changes for part in ("--set", change)]
    assert f"127.0.0.1:{taken}" in run("server", SERVER, "--json", *sets, "--out", "mine").rejected()
    assert files(tmp_path) == {}


def test_client_of_an_unknown_protocol(run: Run, tmp_path: Path) -> None:
    """A client whose router has an endpoint of an unknown protocol is refused in one sentence, and nothing is made."""
    said = run("client", CLIENT, "--json", "--set", "zenoh.router=foo/127.0.0.1:1", "--out", "mine").rejected()
    assert "zenoh.router" in said
    assert "'foo/127.0.0.1:1'" in said
    assert files(tmp_path) == {}


def test_stop_without_a_router(run: Run) -> None:
    """A stop that reaches no router is refused in one sentence, which names the command that starts one."""
    assert "`lavt router" in run("stop", CLIENT, "--set", "zenoh.router=tcp/127.0.0.1:1").rejected()


def test_a_process_whose_input_is_bad(taken: int) -> None:
    """`python -m lavt` ends by itself with 2 and one sentence; nothing is on its standard output, of Zenoh neither."""
    process = lavt_process("router", ROUTER, "--json", "--set", f"listen.endpoints=[tcp/127.0.0.1:{taken}]")
    out, err = process.communicate(timeout=ENDS_S)
    assert f"tcp/127.0.0.1:{taken}" in CommandResult(process.returncode, out, err).rejected()


@pytest.mark.parametrize("command", [["client", CLIENT], ["server", SERVER, "--set", "video.port=0"]])
def test_a_side_waits_for_its_router(command: list[str]) -> None:
    """A server or client that no router answers says so once and waits, and ends with 0 on Ctrl-C."""
    ports = ["--set", "zenoh.router=tcp/127.0.0.1:1", "--set", f"clock.probe_port={1 if command[0] == 'client' else 0}"]
    process = lavt_process(*command, *ports, "--json", "--set", "camera.width_px=128", "--set", "camera.height_px=128")
    assert process.stdout is not None
    assert '"ready"' in process.stdout.readline()
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=ENDS_S)
    assert process.returncode == 0
    assert err.count("\n") == 1
    assert "`lavt router" in err


def test_version(run: Run) -> None:
    """The version goes to standard output."""
    assert run("--version") == CommandResult(0, f"lavt {lavt.__version__}\n", "")


def test_end_by_ctrl_c() -> None:
    """A router, a relay and a rendezvous say on one line where they are, and end with 0 on Ctrl-C."""
    arguments = {
        "locators": ["router", ROUTER, "--json", "--set", "listen.endpoints=[tcp/127.0.0.1:0]"],
        "ready": ["rendezvous", RENDEZVOUS, "--json", "--set", "video_port=0", "--set", "probe_port=0"],
        "ports": ["relay", RELAY, "--json", "--set", "video_listen=127.0.0.1:0", "--set", "control_listen=127.0.0.1:0"],
    }
    started = {said: lavt_process(*each) for said, each in arguments.items()}
    for said, process in started.items():
        assert process.stdout is not None
        assert f'"{said}"' in process.stdout.readline()
        process.send_signal(signal.SIGINT)
    for process in started.values():
        _, err = process.communicate(timeout=ENDS_S)
        assert (process.returncode, err) == (0, "")
