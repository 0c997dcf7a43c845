from __future__ import annotations

import json
import socket
import stat
import threading
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgpack
import msgspec
import pytest
from pydantic import Field
from tests.field import by_wire
from tests.support.command_line import Run
from tests.support.ports import free_port
from tests.vehicle.moving_video import write_video

from lavt.assembly.by_wire import listen
from lavt.cli import doctor
from lavt.clock import MachineClock
from lavt.config import Section, ServerConfig
from lavt.config_file import load_config, parse_config, shipped
from lavt.doctor import checks, key_checks, measurements
from lavt.doctor.checks import CameraSample, Check, CodecTimes, StateSample, Verdict
from lavt.doctor.clock_checks import ClockComparison, ClockEstimate
from lavt.domain import NS_PER_MS, NS_PER_S, Now, State
from lavt.node import Message, Send
from lavt.nodes.clock_sync import ClockSyncNode
from lavt.transport.clock_sync import chrony
from lavt.transport.clock_sync.clock_report import ClockReport, unknown_clock
from lavt.transport.messages import encode
from lavt.transport.router_check import Routers
from lavt.transport.udp_link import RECEIVE_BUFFER_BYTES, UdpLink
from lavt.transport.zenoh_config import SessionSettings
from lavt.transport.zenoh_link import Deliver, ZenohLink
from lavt.transport.zenoh_session import Router, quiet_logs

STATE = State(
    1, 1, 0.0, 0.0, "park", "disarmed", "nobody has armed the vehicle yet", -1, "", active_operator="operator-1"
)
STATE_WITHOUT_OPERATOR = msgspec.structs.replace(STATE, active_operator="")
NOW = Now(1, 1)
REQUIREMENTS = ["av>=14", "numpy>=1.26", "cryptography>=42; extra == 'secure'"]
INSTALLED = {"lavt": "0.1.0", "av": "14.0.1", "numpy": "2.0", "cryptography": None}


def codec_times(encode_ms: float, decode_ms: float = 1.0) -> CodecTimes:
    return CodecTimes([round(encode_ms * NS_PER_MS)] * 20, [round(decode_ms * NS_PER_MS)] * 20)


def check_codec(times: CodecTimes, side: str = "", cores: int = 2) -> Check:
    return checks.check_codec(times, size="640x480", rate_hz=50.0, side=side, cores=cores)


def clock_report(bound_s: float) -> ClockReport:
    return ClockReport(1, 1, "here", "chrony", 0.001, bound_s, follows="192.0.2.1")


def check_port(rejection: str, is_served: bool) -> Check:
    return checks.check_port("video port", "video.port", "0.0.0.0", 5600, rejection=rejection, is_served=is_served)


def check_key_file(rejection: str = "", mode: int = 0o600, is_private: bool = True) -> Check:
    return key_checks.check_key_file(
        "security.key", Path("a.key"), rejection=rejection, mode=mode, is_private=is_private
    )


def check_camera(sample: CameraSample | str) -> Check:
    return checks.check_camera(sample, name="/dev/video0", size="640x480", rate_hz=30.0)


def camera_sample(rate_hz: float, pictures_with_capture_time: int = 0) -> CameraSample:
    return CameraSample([round(number * 1e9 / rate_hz) for number in range(61)], pictures_with_capture_time)


COMPARISON = ClockComparison(True, ("this clock", "both agree"), None, ClockEstimate(1.0, 0.5), 1.0)

VERDICTS: list[tuple[Callable[[], Check], str, str]] = [
    (lambda: checks.check_versions("3.11", INSTALLED, REQUIREMENTS), "ok", "Python 3.11, lavt 0.1.0, av 14.0.1"),
    (lambda: checks.check_versions("3.11", INSTALLED | {"av": "9.2"}, REQUIREMENTS), "problem", "at least 14 is req"),
    (lambda: checks.check_versions("3.11", INSTALLED | {"numpy": None}, REQUIREMENTS), "problem", "numpy is missing"),
    (
        lambda: checks.check_versions("3.11", INSTALLED | {"cryptography": "41"}, REQUIREMENTS),
        "problem",
        "at least 42",
    ),
    (lambda: checks.check_versions("3.11", INSTALLED, []), "ok", "Python 3.11"),
    (lambda: check_codec(codec_times(2.0)), "ok", "10% of the picture period"),
    (lambda: check_codec(codec_times(11.0)), "warning", "55% of the picture period"),
    (lambda: check_codec(codec_times(21.0)), "problem", "105% of the picture period"),
    (lambda: check_codec(codec_times(21.0), "client"), "ok", "2 cores"),
    (lambda: check_codec(codec_times(1.0, 21.0), "server"), "ok", "2 cores"),
    (lambda: check_codec(codec_times(1.0, 21.0), "client"), "problem", "to decode takes 21.0 ms"),
    (lambda: check_codec(codec_times(2.0), cores=1), "warning", "1 core"),
    (lambda: check_camera(camera_sample(30.0)), "ok", "no capture time"),
    (lambda: check_camera(camera_sample(29.0, 61)), "ok", "a capture time"),
    (lambda: check_camera(camera_sample(15.0)), "warning", " 15.0 pictures"),
    (lambda: check_camera(CameraSample([], 0)), "warning", " 0.0 pictures"),
    (lambda: check_camera(CameraSample([5], 0)), "warning", " 0.0 pictures"),
    (lambda: check_camera("/dev/video0 cannot be opened"), "problem", "/dev/video0"),
    (lambda: checks.check_by_wire(300, "", name="socketcan can0"), "ok", "300 frames"),
    (lambda: checks.check_memory_lock(""), "ok", "RAM"),
    (lambda: checks.check_memory_lock("this user may lock only 64 KiB"), "warning", "wait for the disk"),
    (
        lambda: checks.check_by_wire(0, "no BrakeReport for 200 ms", name="can0"),
        "problem",
        "no BrakeReport for 200 ms",
    ),
    (lambda: checks.check_buffer(RECEIVE_BUFFER_BYTES), "ok", "requests 4194304"),
    (lambda: checks.check_buffer(212_992), "warning", " 212992 bytes"),
    (lambda: checks.check_arrival(True), "ok", "records"),
    (lambda: checks.check_arrival(False), "warning", "does not record"),
    (lambda: checks.check_timer(400, [NS_PER_MS // 10] * 20), "ok", "0.10 ms late (p95 0.10 ms)"),
    (lambda: checks.check_timer(400, [0] * 18 + [5 * NS_PER_MS] * 2), "warning", "p95 5.00 ms"),
    (lambda: checks.check_timer(400, [21 * NS_PER_MS] * 20), "problem", "21.00 ms late"),
    (lambda: checks.check_process_priority(-10, -10), "ok", "nice -10"),
    (lambda: checks.check_process_priority(-10, None), "ok", "nice -10"),
    (lambda: checks.check_process_priority(-10, 0), "warning", "session only"),
    (lambda: checks.check_process_priority(0, 0), "warning", "ordinary priority"),
    (lambda: checks.check_governor(["performance"] * 2), "ok", "performance"),
    (lambda: checks.check_governor(["performance", "powersave"]), "warning", "performance, powersave"),
    (lambda: checks.check_governor([]), "not checked", "does not report"),
    (lambda: checks.check_clock(clock_report(0.0001)), "ok", "follows 192.0.2.1"),
    (lambda: checks.check_clock(clock_report(0.01)), "warning", "too wide"),
    (lambda: checks.check_clock(unknown_clock(NOW, "here", "chrony", chrony.ABSENT)), "warning", chrony.ABSENT),
    (lambda: checks.check_clock(unknown_clock(NOW, "here", "probe", "left to the probe")), "ok", "left to the probe"),
    (lambda: checks.check_clock(None), "warning", "timed out"),
    (lambda: checks.check_netem("", "eth0"), "ok", "can delay packets"),
    (lambda: checks.check_netem("no netem", ""), "ok", "needed only"),
    (lambda: checks.check_netem("no netem", "eth0"), "problem", "no netem"),
    (lambda: check_port("", False), "ok", "UDP 0.0.0.0:5600 is free"),
    (lambda: check_port("Address already in use", True), "ok", "`lavt server`"),
    (lambda: check_port("Address already in use", False), "problem", "Address already in use"),
    (lambda: checks.check_router("tcp/127.0.0.1:7447", ""), "ok", "tcp/127.0.0.1:7447"),
    (lambda: checks.check_router("tcp/127.0.0.1:7447", "no router answers"), "problem", "no router answers"),
    (lambda: checks.check_embedded_router(["tcp/127.0.0.1:7447"], ""), "ok", "can listen at tcp/127.0.0.1:7447"),
    (lambda: checks.check_embedded_router([], "in use"), "problem", "in use"),
    (lambda: checks.check_link(Routers(1, ("v1", "v1")), has_vehicle=False), "ok", "1 other router"),
    (lambda: checks.check_link(Routers(0, ("v1",)), has_vehicle=True), "ok", "linked to 0 other routers"),
    (lambda: checks.check_link(Routers(0, ("v1",)), has_vehicle=False), "warning", "no link to another one"),
    (lambda: checks.check_link(Routers(1, ("v1", "v2")), has_vehicle=True), "warning", "Zenoh v1, v2"),
    (lambda: checks.check_link(None, has_vehicle=True), "not checked", "does not report"),
    (
        lambda: checks.check_vehicle(StateSample([STATE] * 50), "v-1", "1"),
        "ok",
        "operator-1 has control",
    ),
    (
        lambda: checks.check_vehicle(StateSample([STATE_WITHOUT_OPERATOR] * 50), "v-1", "1"),
        "ok",
        "no operator has control",
    ),
    (lambda: checks.check_vehicle(StateSample([STATE] * 20), "v-1", "1"), "warning", "20 times a second"),
    (lambda: checks.check_vehicle(StateSample(), "v-1", "1"), "problem", "no state of v-1"),
    (
        lambda: checks.check_vehicle(StateSample([], {"of another version": 50}), "v-1", "1"),
        "problem",
        "another version (50)",
    ),
    (lambda: checks.check_probe(COMPARISON, "car", 5602), "ok", "both agree"),
    (lambda: checks.check_probe(replace(COMPARISON, good=False), "car", 5602), "warning", "both agree"),
    (lambda: checks.check_probe(None, "car", 5602), "problem", "UDP car:5602"),
    (lambda: checks.check_video("car", 0), "not checked", "video.port (5600 by default)"),
    (lambda: checks.check_video("car", 5601), "not checked", "UDP car:5601"),
    (lambda: key_checks.check_keys_configured(True), "ok", "messages are signed"),
    (lambda: key_checks.check_keys_configured(False), "warning", "router"),
    (lambda: check_key_file(), "ok", "a.key is readable"),
    (lambda: check_key_file(mode=0o640), "problem", "mode 640"),
    (lambda: check_key_file(mode=0o644, is_private=False), "ok", "a.key is readable"),
    (lambda: check_key_file("No such file or directory"), "problem", "cannot be read: No such file"),
    (lambda: key_checks.check_certificate(Path("a.pem"), 100.0), "ok", "valid for 100 days"),
    (lambda: key_checks.check_certificate(Path("a.pem"), 13.0), "warning", "valid for 13 days"),
    (lambda: key_checks.check_certificate(Path("a.pem"), -1.0), "problem", "expired 1 days ago"),
    (lambda: key_checks.check_signing_key(Path("a.sign.key"), 100.0), "ok", "valid for 100 days"),
    (lambda: key_checks.check_signing_key(Path("a.sign.key"), 13.0), "warning", "valid for 13 days"),
    (lambda: key_checks.check_signing_key(Path("a.sign.key"), -1.0), "problem", "expired 1 days ago"),
    (lambda: key_checks.check_signing_key(Path("a.sign.key"), None), "warning", "never expires"),
]
"""A check, its verdict, and a part of its text."""


@pytest.mark.parametrize(("check", "verdict", "part"), VERDICTS)
def test_verdicts(check: Callable[[], Check], verdict: str, part: str) -> None:
    """Every check returns its verdict and what it found, and suggests a fix with every warning and problem."""
    result = check()
    assert (result.verdict, part in result.found) == (verdict, True), result
    assert bool(result.do) == (verdict in {"warning", "problem"} or result.name == "video")


def test_every_check_has_verdicts() -> None:
    """Every check is in `VERDICTS` with two verdicts or more, except that of the video, which is never checked."""
    verdicts: dict[str, set[str]] = {}
    for check, verdict, _ in VERDICTS:
        for name in check.__code__.co_names:
            verdicts.setdefault(name, set()).add(verdict)
    check_names = {name for name in vars(checks) if name.startswith("check_")} - {"check_host", "check_video"}
    assert {name for name in check_names if len(verdicts[name]) < 2} == set()


MACHINE_CHECKS = [
    "versions",
    "processor",
    "receive buffer",
    "arrival times",
    "timer",
    "process priority",
    "frequency",
    "clock",
    "netem",
]


def test_this_machine(run: Run) -> None:
    """Without a config this machine is checked; the exit code is 1 if and only if a check finds a problem."""
    code, out, _ = run("doctor", "--json")
    result = json.loads(out)
    assert [check["name"] for check in result["checks"]] == MACHINE_CHECKS
    problems = [check for check in result["checks"] if check["verdict"] == "problem"]
    assert (code, result["good"]) == ((1, False) if problems else (0, True))
    processor = result["checks"][1]["measured"]
    assert 0 < processor["encode_ms"] <= processor["encode_p95_ms"]
    assert 0 < processor["decode_ms"] <= processor["decode_p95_ms"]


@pytest.mark.parametrize("verdict", ["ok", "warning", "problem", "not checked"])
def test_output_as_text(run: Run, monkeypatch: pytest.MonkeyPatch, verdict: Verdict) -> None:
    """Without --json each check is a line that begins with its verdict; the suggested fix follows after an arrow."""
    checks = [Check("receive buffer", "ok", "found this", ""), Check("netem", verdict, "found that", "do this")]
    monkeypatch.setattr(doctor, "_checks", lambda *_: iter(checks))
    code, out, err = run("doctor")
    assert (code, err) == (1 if verdict == "problem" else 0, "")
    first, second, fix = out.splitlines()
    assert (first[:12].strip(), first[12:30].strip(), first[30:]) == ("ok", "receive buffer", "found this")
    assert (second[:12].strip(), second[12:30].strip(), second[30:]) == (verdict, "netem", "found that")
    assert fix == " " * 30 + "-> do this"


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (("nothing.yaml",), "nothing.yaml"),
        (("--set", "seed=1"), "--set"),
        ((str(shipped("configs/client.yaml")), "--set", "whom=me"), "'whom'"),
        ((str(shipped("configs/server.yaml")), "--set", "nothing"), "a.b=value"),
        ((str(shipped("configs/demo.yaml")),), "keys of a config for `lavt run`"),
    ],
)
def test_bad_input(run: Run, arguments: tuple[str, ...], reason: str) -> None:
    """An invalid config is rejected in one sentence, with exit code 2, before any check."""
    assert reason in run("doctor", *arguments).rejection()


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Skip the checks of the machine itself, and wait for a peer for one second only."""
    monkeypatch.setattr(doctor, "_machine_checks", lambda *_: iter(()))
    monkeypatch.setattr(doctor, "PROBE_DURATION_NS", 100 * NS_PER_MS)
    monkeypatch.setattr(measurements, "FIRST_STATE_TIMEOUT_NS", 1000 * NS_PER_MS)


def check_config(path: Path, *changes: str) -> dict[str, Check]:
    """Run the checks for a config; return them by name."""
    settings = doctor._load(path, list(changes))
    return {check.name: check for check in doctor._checks(settings, MachineClock())}


@pytest.mark.usefixtures("quick")
@pytest.mark.parametrize(
    ("rate_hz", "size", "verdicts", "part"),
    [
        (30.0, (320, 240), {"ok", "warning"}, "of 320x240 "),  # a busy machine reads a file too slowly
        (30.0, (640, 480), {"problem"}, "640x480 at 30 Hz"),
        (25.0, (320, 240), {"problem"}, "320x240 at 25 Hz"),
    ],
)
def test_camera_device(tmp_path: Path, rate_hz: float, size: tuple[int, int], verdicts: set[str], part: str) -> None:
    """The camera of a server's config is opened and its picture rate is measured; another size or rate is a problem."""
    video = write_video(tmp_path / "video.avi", rate_hz=30.0)
    camera = ["source=device", f"device={video}", f"rate_hz={rate_hz}", f"width_px={size[0]}", f"height_px={size[1]}"]
    changes = [f"camera.{setting}" for setting in camera]
    results = check_config(shipped("configs/server.yaml"), *changes, "zenoh.router=tcp/127.0.0.1:1")
    assert results["camera"].verdict in verdicts
    assert part in results["camera"].found


@pytest.mark.usefixtures("quick")
def test_a_server_with_a_used_port_and_no_router() -> None:
    """For a server, a port that is in use and a router that does not answer are problems."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as occupant:
        occupant.bind(("127.0.0.1", 0))
        changes = ["video.bind=127.0.0.1", f"video.port={occupant.getsockname()[1]}", "clock.probe_port=0"]
        results = check_config(shipped("configs/server.yaml"), *changes, "zenoh.router=tcp/127.0.0.1:1")
    assert [(name, check.verdict) for name, check in results.items()][2:] == [
        ("security", "warning"),
        ("video port", "problem"),
        ("probe port", "ok"),
        ("router", "problem"),
    ]
    assert "Address already in use" in results["video port"].found
    assert "'tcp/127.0.0.1:1'" in results["router"].found


@pytest.fixture(scope="module")
def router() -> Iterator[str]:
    """Run a router for both sides; return its endpoint."""
    quiet_logs()
    opened = Router(shipped("zenoh-configs/router-server.json5"), {"listen/endpoints": ["tcp/127.0.0.1:0"]})
    with closing(opened):
        yield opened.locators()[0]


@pytest.fixture
def probe_port() -> Iterator[int]:
    """Run a server that answers probes; return its port."""
    clock, node = MachineClock(), ClockSyncNode(0)
    ((_, answer_request),) = node.pipelines["probe_request"]

    def answer(_channel: str, payload: Any, arrived: Now, peer: Any) -> None:
        for send in answer_request(Message("probe_request", payload, arrived, peer), clock.now()):
            link.send(send)

    link = UdpLink(clock, "probe_request", bind=("127.0.0.1", 0), name="probe")
    with closing(link):
        link.start(answer)
        yield link.port


@contextmanager
def sending(server: ZenohLink, send: Callable[[], None], deliver: Deliver = lambda *_: None) -> Iterator[None]:
    """Start a server's link and call `send` 50 times a second."""
    is_over = threading.Event()

    def send_periodically() -> None:
        while not is_over.wait(0.02):
            send()

    sender = threading.Thread(target=send_periodically)
    with closing(server):
        server.start(deliver)
        sender.start()
        try:
            yield
        finally:
            is_over.set()
            sender.join()


def check_client(run: Run, router: str, probe_port: int, vehicle: str, payload: bytes) -> dict[str, Any]:
    """Run the doctor with a client's config while a server sends `payload` as its state; return the checks by name."""
    server = ZenohLink(
        MachineClock(),
        side="server",
        settings=SessionSettings(shipped("zenoh-configs/session.json5"), {"connect/endpoints": [router]}),
        vehicle=vehicle,
        who="server",
    )
    changes = [f"vehicle_id={vehicle}", f"zenoh.router={router}", f"clock.probe_port={probe_port}"]
    set_options = [part for change in changes for part in ("--set", change)]
    with sending(server, lambda: server.send(Send("state", payload))):
        code, out, _ = run("doctor", str(shipped("configs/client.yaml")), "--json", *set_options)
    result = json.loads(out)
    assert code == (0 if result["good"] else 1)
    return {check["name"]: check for check in result["checks"]}


@pytest.mark.usefixtures("quick")
def test_a_pair(run: Run, router: str, probe_port: int) -> None:
    """For a client, router, vehicle state, link of the routers and clocks are checked, but not the video."""
    results = check_client(run, router, probe_port, "vehicle-1", encode(STATE))
    expected = ["security", "router", "vehicle", "link of routers", "clock probe", "video"]
    assert [name for name in results if name not in MACHINE_CHECKS] == expected
    assert "operator-1" in results["vehicle"]["found"]
    assert results["vehicle"]["measured"]["states"] > 0
    assert results["link of routers"]["verdict"] == "ok"
    assert abs(results["clock probe"]["measured"]["offset_ms"]) <= results["clock probe"]["measured"]["bound_ms"]
    assert results["video"]["verdict"] == "not checked"


@pytest.fixture(scope="module")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Create signing keys of a vehicle and two operators; return their directory."""
    certificates = pytest.importorskip("lavt.transport.security.certificates")
    folder = tmp_path_factory.mktemp("keys")
    for name in ("vehicle-3", "operator-1", "operator-2"):
        pair = certificates.new_signing_pair(MachineClock().now().wall_ns, 10)
        (folder / f"{name}.key").write_bytes(pair.private)
        (folder / f"{name}.key").chmod(0o600)
        (folder / f"{name}.pub").write_bytes(pair.public)
    return folder


@pytest.mark.parametrize(
    ("operator", "vehicle", "expected"),
    [
        ("operator-1", "vehicle-3", ("ok", "operator-1")),
        ("operator-2", "vehicle-3", ("problem", "operator's key")),
        ("operator-1", "operator-2", ("problem", "security.vehicle")),
    ],
)
@pytest.mark.usefixtures("quick")
def test_a_pair_with_keys(router: str, keys: Path, operator: str, vehicle: str, expected: tuple[str, str]) -> None:
    """Signed states are verified with the configured keys, without a session; keys that do not match are a problem."""
    from lavt.assembly.security import build_vehicle_authenticator
    from lavt.transport.security.gateway import ServerGateway

    security = {"key": str(keys / "vehicle-3.key"), "operators": {"operator-1": str(keys / "operator-1.pub")}}
    authenticator = build_vehicle_authenticator(
        parse_config(ServerConfig, {"vehicle_id": "vehicle-3", "security": security}, "test")
    )
    server = ZenohLink(
        MachineClock(),
        side="server",
        settings=SessionSettings(shipped("zenoh-configs/session.json5"), {"connect/endpoints": [router]}),
        vehicle="vehicle-3",
        who="server",
    )
    gateway = ServerGateway(lambda *_: None, server.send, lambda: (0, -1), authenticator)
    changes = [f"security.key={keys / operator}.key", f"security.vehicle={keys / vehicle}.pub"]
    network = [f"zenoh.router={router}", "vehicle_id=vehicle-3", "clock.probe_port=1"]
    with sending(server, lambda: gateway.send(Send("state", encode(STATE))), gateway.receive):
        results = check_config(shipped("configs/client.yaml"), *changes, *network)
    verdict, part = expected
    verdicts = {verdict, "warning"} if verdict == "ok" else {verdict}  # on a busy machine, states come too rarely
    assert results["vehicle"].verdict in verdicts, results["vehicle"]
    assert part in results["vehicle"].found
    assert {results[name].verdict for name in ("security", "security.key", "security.vehicle")} == {"ok"}


@pytest.mark.parametrize("content", ["", "no key"])
@pytest.mark.usefixtures("quick")
def test_invalid_keys(content: str, tmp_path: Path) -> None:
    """A file without a key is a problem; it is not said to never expire, and the router is not checked with it."""
    pytest.importorskip("lavt.transport.security.certificates")
    for name in ("key", "pub"):
        (tmp_path / name).write_text(content)
        (tmp_path / name).chmod(0o600)
    changes = [f"security.key={tmp_path}/key", f"security.vehicle={tmp_path}/pub", "clock.probe_port=1"]
    results = check_config(shipped("configs/client.yaml"), *changes)
    assert (results["keys"].verdict, results["router"].verdict) == ("problem", "not checked")
    assert str(tmp_path) in results["keys"].found
    assert not {"key", "pub"} & results.keys()


@pytest.mark.usefixtures("quick")
def test_a_peer_of_another_version(run: Run, router: str, probe_port: int) -> None:
    """States of another message version are a problem whose text names the version and the fix."""
    fields = msgpack.unpackb(encode(STATE))
    results = check_client(run, router, probe_port, "vehicle-2", msgpack.packb([99, *fields[1:]]))
    assert results["vehicle"]["verdict"] == "problem"
    assert "another version" in results["vehicle"]["found"]
    assert "version" in results["vehicle"]["do"]


@pytest.mark.usefixtures("quick")
def test_a_client_without_a_vehicle(router: str) -> None:
    """Missing states and unanswered probes are problems, and a missing link of the routers is a warning."""
    changes = ["vehicle_id=away", f"zenoh.router={router}", "clock.probe_port=1"]
    results = check_config(shipped("configs/client.yaml"), *changes)
    assert {name: results[name].verdict for name in ("vehicle", "link of routers", "clock probe")} == {
        "vehicle": "problem",
        "link of routers": "warning",
        "clock probe": "problem",
    }


def embedded(key: str, endpoint: str) -> str:
    """Return the change of a config for an embedded router that listens at or dials an endpoint."""
    return f"zenoh={{router: embedded, router_settings: {{{key}: {{endpoints: ['{endpoint}']}}}}}}"


@pytest.mark.usefixtures("quick")
def test_embedded_routers() -> None:
    """A server's router is checked before it runs and while it runs; a client's reaches it at its address."""
    endpoint = f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"
    changes = ["video.bind=127.0.0.1", "video.port=0", "clock.probe_port=0", embedded("listen", endpoint)]
    before = check_config(shipped("configs/server.yaml"), *changes)["router"]
    assert (before.verdict, before.measured) == ("ok", {"locators": [endpoint]})
    settings = SessionSettings(
        shipped("zenoh-configs/router-server.json5"), {"listen/endpoints": [endpoint]}, is_router=True
    )
    server = ZenohLink(MachineClock(), side="server", settings=settings, vehicle="vehicle-1", who="server")
    with sending(server, lambda: server.send(Send("state", encode(STATE)))):
        running = check_config(shipped("configs/server.yaml"), *changes)["router"]
        client = check_config(shipped("configs/client.yaml"), embedded("connect", endpoint), "clock.probe_port=1")
    assert (running.verdict, running.measured) == ("ok", {"endpoint": endpoint})
    assert (client["router"].verdict, client["router"].measured) == ("ok", {"endpoint": endpoint})
    assert client["vehicle"].verdict in {"ok", "warning"}  # on a busy machine, states come too rarely


@pytest.mark.usefixtures("quick")
def test_embedded_routers_that_cannot_work() -> None:
    """An occupied port of a server's router, and no server at the address of a client, are problems with advice."""
    with socket.socket() as occupant:
        occupant.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{occupant.getsockname()[1]}"
        server = check_config(shipped("configs/server.yaml"), embedded("listen", endpoint))["router"]
        client = check_config(shipped("configs/client.yaml"), embedded("connect", endpoint), "clock.probe_port=1")
    for check, advice in ((server, "zenoh.router_settings"), (client["router"], "`lavt server`")):
        assert check.verdict == "problem"
        assert endpoint in check.found
        assert advice in check.do


@pytest.mark.usefixtures("quick")
def test_an_unknown_host(router: str) -> None:
    """An unknown host in video.server is reported as a problem by the check of the clock probe."""
    results = check_config(shipped("configs/client.yaml"), f"zenoh.router={router}", f"video.server={'a' * 64}")
    assert results["clock probe"].verdict == "problem"
    assert "a" * 64 in results["clock probe"].found


def test_side_of_a_config(tmp_path: Path) -> None:
    """A config, with its --set changes, is a client's if it has a key that only a client has, otherwise a server's."""
    neither = tmp_path / "neither.yaml"
    neither.write_text("{}")
    assert isinstance(doctor._load(neither, []), ServerConfig)
    assert not isinstance(doctor._load(neither, ["video.server=192.0.2.7"]), ServerConfig)
    assert not isinstance(doctor._load(neither, ["who=operator-2"]), ServerConfig)


class Security(Section):
    """A security section with the keys of both sides."""

    key: str = ""
    operators: dict[str, str] = Field(default_factory=dict)


def test_key_files(tmp_path: Path) -> None:
    """Every file of `security` is listed, and its permissions or its error are read."""
    private, public = tmp_path / "vehicle-1.sign.key", tmp_path / "operator-1.sign.pub"
    private.write_text("key")
    private.chmod(0o644)
    section = Security(key=str(private), operators={"operator-1": str(public)})
    files = measurements.key_files(section)
    assert files == [("security.key", private, True), ("security.operators.operator-1", public, False)]
    assert measurements.file_state(private) == ("", 0o644)
    assert measurements.file_state(public) == ("No such file or directory", 0)
    assert stat.S_IMODE(private.stat().st_mode) == 0o644
    assert measurements.key_files(Security()) == []


def test_certificates(tmp_path: Path) -> None:
    """The remaining days of the certificates in a directory are read; other files are ignored."""
    x509 = pytest.importorskip("cryptography.x509")
    from datetime import UTC, datetime, timedelta  # noqa: TID251 (no clock is read)

    from cryptography.hazmat.primitives import hashes
    from cryptography.hazmat.primitives.asymmetric import ec
    from cryptography.hazmat.primitives.serialization import Encoding

    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, "vehicle-1")])
    valid_from = datetime(2026, 1, 1, tzinfo=UTC)
    certificate = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(key.public_key())
        .serial_number(1)
        .not_valid_before(valid_from)
        .not_valid_after(valid_from + timedelta(days=30))
        .sign(key, hashes.SHA256())
    )
    (tmp_path / "vehicle-1.pem").write_bytes(certificate.public_bytes(Encoding.PEM))
    (tmp_path / "other.pem").write_text("no certificate")
    now_ns = round(valid_from.timestamp()) * 10**9
    assert measurements.certificates(tmp_path, now_ns) == [(tmp_path / "vehicle-1.pem", 30.0)]
    assert measurements.certificates(tmp_path, now_ns + 31 * 86_400 * 10**9) == [(tmp_path / "vehicle-1.pem", -1.0)]


@pytest.mark.realtime
@pytest.mark.judges_times
def test_a_kit_on_its_bus(tmp_path: Path) -> None:
    """The doctor listens to a by-wire kit's bus, sends nothing, and reports what inhibits driving."""
    pytest.importorskip("can")
    run = by_wire.run_config("dataspeed_gen2", tmp_path / "none.json")
    path, clock = by_wire.write_config(run, tmp_path / "server.yaml"), MachineClock()
    config = load_config(ServerConfig, path)
    frames, reason = listen(config, clock, NS_PER_S)
    assert frames == 0
    assert "SteerReport1" in reason
    with by_wire.software_car(path) as car:
        frames, reason = listen(config, clock, 2 * NS_PER_S)
        assert frames > 100
        assert "none.json" in reason
        assert "SteerReport1" not in reason
    assert [event for event in car.events if event["kind"] == "enabled"] == []


@pytest.mark.usefixtures("quick")
def test_an_unknown_bus() -> None:
    """A bus that cannot be opened is a problem, and the other checks are still made."""
    pytest.importorskip("can")
    changes = ("vehicle.kind=dbw", "vehicle.dbw.interface=socketcan", "vehicle.dbw.channel=nothere")
    results = check_config(shipped("configs/server.yaml"), *changes, "zenoh.router=tcp/127.0.0.1:1")
    assert (results["by wire"].verdict, "nothere" in results["by wire"].found) == ("problem", True)
    assert "video port" in results
