"""Faults of a CARLA server: each gives a sentence, and no car drives on."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from importlib.metadata import PackageNotFoundError
from pathlib import Path
from typing import Any

import pytest
from tests.carla.contract_vehicle import blind_settings, server_config
from tests.carla.stand_in import REPOSITORY, StandIn, need_carla, stand_in
from tests.support.ports import free_port_pair

from lavt.assembly.vehicles import VehicleSetup, build_carla, carla_settings
from lavt.config import ServerCameraConfig, ServerConfig
from lavt.domain import NS_PER_S, Actuation, Now
from lavt.errors import UserError, VehicleError
from lavt.vehicle.carla import connection, library, session
from lavt.vehicle.carla.actors import SpawnedActors
from lavt.vehicle.carla.session import BRAKED, CarlaSession
from lavt.vehicle.sim.road.road import load_road
from lavt.vehicle.vehicle import Vehicle

pytestmark = pytest.mark.full

FULL_THROTTLE = Actuation(0.0, 1.0, 0.0)
CAR = "vehicle.lincoln.mkz_2020"
CAR_AND_SENSORS = f"{CAR} sensor.other.collision sensor.other.lane_invasion"
TIMEOUT_S = 1.0
HOPELESS_S = 0.2
"""The time-out for closing a session with a server that cannot answer."""
PICTURE = ("320", "240")
DESTROY = SpawnedActors.destroy
KILLED_CLIENT = """
import os, sys
from tests.carla.contract_vehicle import blind_settings
from lavt.domain import Actuation
from lavt.vehicle.carla.session import CarlaSession
session = CarlaSession(blind_settings(int(sys.argv[1]))[0])
for _ in range(30):
    session.tick(Actuation(0.0, 1.0, 0.0))
os.kill(os.getpid(), 9)
"""


@pytest.fixture(scope="module")
def server() -> Iterator[StandIn]:
    """Start a stand-in server that the faults of clients share."""
    with stand_in() as started:
        yield started


@contextmanager
def driving(port: int, **changes: object) -> Iterator[CarlaSession]:
    """Open a session, and drive for a second; on a busy machine a tick can take a while."""
    with closing(CarlaSession(blind_settings(port, tick_timeout_s=20.0, timeout_s=20.0, **changes)[0])) as opened:
        for _ in range(30):
            opened.tick(FULL_THROTTLE)
        yield opened


def expect_no_answer(opened: CarlaSession, monkeypatch: pytest.MonkeyPatch) -> None:
    """Shorten the time-outs of a session whose server cannot answer."""
    opened.settings = replace(opened.settings, tick_timeout_s=TIMEOUT_S)
    opened._client.set_timeout(TIMEOUT_S)
    monkeypatch.setattr(session, "CLOSE_TIMEOUT_S", HOPELESS_S)


def run_lavt(port: int, tmp_path: Path, *changes: str) -> tuple[int, str]:
    """Run a drive in a process of its own, and return its exit code and its messages."""
    settings = ["vehicle.kind=carla", f"vehicle.carla.port={port}", f"vehicle.carla.timeout_s={TIMEOUT_S}", *changes]
    command = [sys.executable, "-m", "lavt", "run", str(REPOSITORY / "configs" / "demo.yaml"), "--out", "out"]
    done = subprocess.run(
        [*command, *(word for setting in settings for word in ("--set", setting))],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "PYTHONPATH": str(REPOSITORY / "src")},
    )
    return done.returncode, done.stderr


def test_without_the_wheel_one_sentence_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without the wheel, or with another version of it, the vehicle is refused before anything is imported."""

    def no_version(name: str) -> str:
        raise PackageNotFoundError(name)

    monkeypatch.setattr(library, "version", no_version)
    with pytest.raises(UserError, match=r"pip install -e '\.\[carla\]'"):
        library.load_library()
    monkeypatch.setattr(library, "version", lambda _: "0.9.15")
    with pytest.raises(UserError, match=r"is 0\.9\.15"):
        library.load_library()


def test_a_server_of_another_version_is_refused(tmp_path: Path) -> None:
    """A server of another version, which would abort the process, ends it with exit code 2 and one sentence."""
    with stand_in("--version", "0.9.15") as other:
        code, message = run_lavt(other.port, tmp_path, f"vehicle.carla.timeout_s={20 * TIMEOUT_S}")
    assert code == 2, message
    sentence = message.splitlines()[-1]
    assert sentence.startswith(f"lavt: the CARLA server at 127.0.0.1:{other.port} ")
    assert "Traceback" not in message
    assert "has version '0.9.15', but LAVT supports 0.9.16 only" in message


def test_an_absent_server_is_named() -> None:
    """Without a server, a sentence names the address, without waiting for the time-out."""
    need_carla()
    port = free_port_pair(socket.SOCK_STREAM)
    with pytest.raises(UserError, match=rf"answers at 127\.0\.0\.1:{port}, because no program listens there: start"):
        CarlaSession(blind_settings(port, timeout_s=600.0)[0])


def test_a_camera_of_another_source_is_refused() -> None:
    """A car in CARLA has CARLA's camera only."""
    config = server_config(2000).model_copy(update={"camera": ServerCameraConfig()})
    with pytest.raises(UserError, match=r"set camera\.source carla"):
        build_carla(config)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"town": "Town99"}, "has no town 'Town99'"),
        ({"weather": "Hail"}, "CARLA has no weather 'Hail'"),
        ({"blueprint": "vehicle.flying.saucer"}, "has no 'vehicle.flying.saucer'"),
        ({"start": (1e5, 0.0, 0.0)}, "is on no lane of StandIn"),
    ],
)
def test_wrong_settings_are_named(changes: dict[str, object], reason: str, server: StandIn) -> None:
    """An unknown town, weather or car, or a start beside the road, is refused, and the server is left as it was."""
    settings, _ = blind_settings(server.port, **changes)
    with pytest.raises(UserError, match=reason):
        CarlaSession(settings)
    assert server.ask("actors") == ""
    assert server.ask("settings") == "False [False]"


def test_an_occupied_start_is_named() -> None:
    """A car that is parked at the start is not removed; the run is refused and leaves the server as it was."""
    with stand_in() as server:
        settings, _ = blind_settings(server.port)
        assert settings.start is not None
        assert server.ask("park", settings.start.x_m, settings.start.y_m) == "parked"
        with pytest.raises(UserError, match="the start is occupied"):
            CarlaSession(settings)
        assert server.ask("actors") == "vehicle.lincoln.mkz_2020"
        assert server.ask("settings") == "False [False]"


def interrupt(*_: object) -> None:
    raise KeyboardInterrupt


def test_the_leftovers_of_a_killed_run_are_removed(server: StandIn) -> None:
    """A killed run leaves a frozen world; the next run removes its actors, and only then can the world run again."""
    killed = subprocess.run(
        [sys.executable, "-c", KILLED_CLIENT, str(server.port)],
        cwd=REPOSITORY,
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(REPOSITORY / "src"), str(REPOSITORY)])},
        check=False,
        stdout=subprocess.DEVNULL,
    )
    assert killed.returncode == -9
    assert server.ask("actors") == CAR_AND_SENSORS
    assert server.ask("settings").startswith("True")
    with pytest.MonkeyPatch.context() as patch:  # a start that ends before the actors are removed
        patch.setattr(connection, "_remove_leftovers", interrupt)
        with pytest.raises(KeyboardInterrupt):
            CarlaSession(blind_settings(server.port)[0])
    assert server.ask("actors") == CAR_AND_SENSORS
    assert server.ask("settings").startswith("True"), "the car of the killed run could drive on"
    frame = server.ask("frame")
    with closing(CarlaSession(blind_settings(server.port)[0])) as opened:
        assert int(frame) < opened.snapshot.frame
        assert server.ask("actors") == CAR_AND_SENSORS
        assert server.ask("speed").split()[0] == "0.000"
    assert server.ask("actors") == ""
    assert server.ask("settings") == "False [False]"


def drive_a_tick(server: StandIn, *, interrupted_start: str = "none", interrupted_drive: str = "none") -> None:
    """Open a session, make a tick and close the session, with SIGINT during a request of these methods."""
    server.ask("fault", "interrupted_process", os.getpid())
    server.ask("fault", "interrupted_method", interrupted_start)
    session = CarlaSession(blind_settings(server.port)[0])
    server.ask("fault", "interrupted_method", interrupted_drive)
    try:
        session.tick(FULL_THROTTLE)
        session.close()
    finally:
        session.close()  # as at the end of the process


def destroy_known(actors: SpawnedActors, *arguments: Any) -> bool:
    """Destroy actors as the class does, if a state contains them: of others, the library may refuse it by chance."""
    assert not actors.are_new
    return DESTROY(actors, *arguments)


@pytest.mark.parametrize(
    "moment",
    [
        {"interrupted_start": "set_episode_settings"},
        {"interrupted_start": "spawn_actor"},
        {"interrupted_start": "spawn_actor_with_parent"},
        {"interrupted_drive": "tick_cue"},
        {"interrupted_drive": "destroy_actor"},
    ],
    ids=lambda moment: "".join(moment.values()),
)
def test_ctrl_c_in_any_request_leaves_nothing_in_the_world(
    server: StandIn, moment: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A Ctrl-C during a request of the start, of a tick or of the end leaves no actor and no frozen world."""
    monkeypatch.setattr(SpawnedActors, "destroy", destroy_known)
    with pytest.raises(KeyboardInterrupt):
        drive_a_tick(server, **moment)
    assert server.ask("actors") == ""
    assert server.ask("settings") == "False [False]"


def test_sigterm_during_the_start_of_a_server_leaves_nothing_in_the_world() -> None:
    """If a service manager ends `lavt server` while it spawns the car, no actor and no frozen world remains."""
    with stand_in() as server:
        changes = ["vehicle.kind=carla", "camera.source=carla", f"vehicle.carla.port={server.port}"]
        ports = ["video.port=0", "clock.probe_port=0", "zenoh.router_settings={listen: {endpoints: [tcp/127.0.0.1:0]}}"]
        process = subprocess.Popen(
            [sys.executable, "-m", "lavt", "server", *(word for key in [*changes, *ports] for word in ("--set", key))],
            env={**os.environ, "PYTHONPATH": str(REPOSITORY / "src")},
            stderr=subprocess.DEVNULL,
        )
        server.ask("fault", "interrupted_process", process.pid)
        server.ask("fault", "interrupting_signal", int(signal.SIGTERM))
        server.ask("fault", "interrupted_method", "spawn_actor")
        assert process.wait(60) == 130
        assert server.ask("actors") == ""
        assert server.ask("settings") == "False [False]"


def test_a_leftover_that_the_server_keeps_is_named_and_stands_still() -> None:
    """A killed run's car that the server does not remove is braked first; it ends the next run, in a frozen world."""
    with stand_in() as server:
        killed = subprocess.run(
            [sys.executable, "-c", KILLED_CLIENT, str(server.port)],
            cwd=REPOSITORY,
            env={**os.environ, "PYTHONPATH": os.pathsep.join([str(REPOSITORY / "src"), str(REPOSITORY)])},
            check=False,
            stdout=subprocess.DEVNULL,
        )
        assert killed.returncode == -9
        assert server.ask("fault", "kept_kind", CAR) == "set"
        with pytest.raises(VehicleError, match=f"did not remove {CAR}, which a killed run left: restart it"):
            CarlaSession(blind_settings(server.port, timeout_s=20.0)[0])
        assert server.ask("actors") == CAR
        assert server.ask("settings").startswith("True")
        assert server.ask("kept_control") == server.ask("control", CAR) == "0.0 1.0 True"


def test_a_car_that_the_server_keeps_is_left_braked_in_a_frozen_world() -> None:
    """If the server does not remove the car at the end, the world stays frozen and the car is braked."""
    with stand_in() as server:
        with driving(server.port):
            assert server.ask("fault", "kept_kind", CAR) == "set"
        assert server.ask("actors") == CAR
        assert server.ask("settings").startswith("True")
        assert server.ask("control", CAR) == "0.0 1.0 True"


def test_a_sensor_that_another_client_destroyed_does_not_hinder_the_end(server: StandIn) -> None:
    """Without its collision sensor the car drives on, and at the end everything else is removed and restored."""
    with driving(server.port) as opened:
        assert server.ask("destroy", "sensor.other.collision") == "True"
        opened.tick(FULL_THROTTLE)
    assert server.ask("actors") == ""
    assert server.ask("settings") == "False [False]"


def test_a_car_that_another_client_destroyed_leaves_no_sensors(server: StandIn) -> None:
    """If another client destroys the car alone, the session removes the sensors and restores the world."""
    with driving(server.port) as opened:
        assert server.ask("destroy", CAR) == "True"
        with pytest.raises(VehicleError):
            opened.tick(FULL_THROTTLE)
    assert server.ask("actors") == ""
    assert server.ask("settings") == "False [False]"


def pictured_config(port: int, tick_timeout_s: float = 20.0) -> ServerConfig:
    """Return a config with a camera of the size for which the stand-in server is prepared."""
    width_px, height_px = map(int, PICTURE)
    camera = ServerCameraConfig(source="carla", width_px=width_px, height_px=height_px)
    return server_config(port, tick_timeout_s=tick_timeout_s, timeout_s=20.0).model_copy(update={"camera": camera})


@pytest.fixture(scope="module")
def camera_server() -> Iterator[StandIn]:
    """Start a stand-in server that the faults of cameras share."""
    with stand_in("--scenery", "none", "--camera", *PICTURE) as started:
        yield started


@contextmanager
def first_picture(port: int) -> Iterator[tuple[VehicleSetup, Vehicle]]:
    """Open a car with a camera, and take its first picture; close the car at the end."""
    setup = build_carla(pictured_config(port))
    assert setup.start is not None
    with contextlib.ExitStack() as opened:
        opened.callback(setup.close)
        vehicle = setup.start(Now(0, 0))
        vehicle.advance(NS_PER_S)
        assert setup.camera.capture(1, NS_PER_S, None) is not None
        yield setup, vehicle


def expect_no_picture(setup: VehicleSetup) -> None:
    """Shorten the time-out of a camera that cannot send a picture."""
    opened = setup.camera._session  # type: ignore[attr-defined]
    opened.settings = replace(opened.settings, tick_timeout_s=TIMEOUT_S)


def test_a_camera_that_another_client_destroyed_ends_the_run(camera_server: StandIn) -> None:
    """Without its camera the car cannot be driven: the next picture fails with a sentence, not with a wait forever."""
    with first_picture(camera_server.port) as (setup, vehicle):
        assert camera_server.ask("destroy", "sensor.camera.rgb") == "True"
        vehicle.advance(2 * NS_PER_S)
        expect_no_picture(setup)
        with pytest.raises(VehicleError, match="the camera is gone"):
            setup.camera.capture(2, 2 * NS_PER_S, None)
    assert camera_server.ask("actors") == ""


def test_a_car_that_another_client_destroyed_ends_the_run(server: StandIn) -> None:
    """Without the car, the next tick fails with a sentence, and at the end the server is left as it was."""
    with driving(server.port) as opened:
        assert server.ask("destroy", CAR) == "True"
        with pytest.raises(VehicleError, match="the car is gone"):
            opened.tick(FULL_THROTTLE)
    assert server.ask("settings") == "False [False]"


def test_a_tick_of_another_length_ends_the_run(server: StandIn) -> None:
    """A server that advances its world by another time than it was told is named, and no result is made from it."""
    with driving(server.port) as opened:
        opened.settings = replace(opened.settings, tick_s=0.9 * opened.settings.tick_s)
        with pytest.raises(VehicleError, match=r"advances its world by 0\.\d+ s in a tick instead of"):
            opened.tick(FULL_THROTTLE)


def test_a_session_leaves_a_world_that_another_client_ticks_frozen() -> None:
    """A session that ends while another client ticks does not let the world run: that client's car would drive on."""
    with stand_in() as server:
        with driving(server.port) as opened:
            opened._world.tick(20.0)  # as another client would
        assert server.ask("actors") == ""
        assert server.ask("settings").startswith("True")


def test_an_unknown_host_is_named() -> None:
    """A host whose name cannot be resolved gives the sentence of an absent server."""
    need_carla()
    settings = replace(blind_settings(2000)[0], host="nowhere.invalid")
    with pytest.raises(UserError, match=r"no CARLA server answers at nowhere\.invalid"):
        CarlaSession(settings)


def test_a_second_ticking_client_is_refused(server: StandIn) -> None:
    """While one run ticks the world, another one is refused, and the first one goes on."""
    with driving(server.port) as first:
        ended = threading.Event()

        def tick() -> None:
            while not ended.wait(0.02):
                first.tick(BRAKED)

        ticking = threading.Thread(target=tick)
        ticking.start()
        try:
            with pytest.raises(UserError, match="another client ticks"):
                CarlaSession(blind_settings(server.port)[0])
        finally:
            ended.set()
            ticking.join()
        assert server.ask("actors") == CAR_AND_SENSORS


def test_a_frozen_server_ends_the_run_and_its_car_stands_still(monkeypatch: pytest.MonkeyPatch) -> None:
    """A frozen server gives a sentence after the tick's time-out; when it goes on, its world moves by one tick only."""
    with stand_in() as server, driving(server.port) as opened:
        frame = int(server.ask("frame"))
        server.freeze()
        expect_no_answer(opened, monkeypatch)
        with pytest.raises(VehicleError, match="did not complete a tick"):
            opened.tick(FULL_THROTTLE)
        opened.close()
        monkeypatch.undo()
        server.resume()
        assert int(server.ask("frame")) <= frame + 1
        assert server.ask("settings").startswith("True")
        with closing(CarlaSession(blind_settings(server.port)[0])):
            assert server.ask("actors") == CAR_AND_SENSORS


def test_a_killed_server_ends_the_run(monkeypatch: pytest.MonkeyPatch) -> None:
    """A killed server gives a sentence, closing the session does not wait for it, and it is absent for the next run."""
    with stand_in() as server, driving(server.port) as opened:
        server.kill()
        expect_no_answer(opened, monkeypatch)
        with pytest.raises(VehicleError, match="did not complete a tick"):
            opened.tick(FULL_THROTTLE)
        opened.close()
        with pytest.raises(UserError, match="no CARLA server answers"):
            CarlaSession(blind_settings(server.port)[0])


def test_a_late_first_picture_is_awaited(camera_server: StandIn, monkeypatch: pytest.MonkeyPatch) -> None:
    """A camera whose first pictures fail is ticked until one comes; without any, a sentence says what to check."""
    monkeypatch.setattr(session, "MAX_TICKS_TO_PICTURE", 6)
    settings = carla_settings(pictured_config(camera_server.port, TIMEOUT_S), load_road("a_key"))
    try:
        assert camera_server.ask("fault", "late_pictures", 3) == "set"
        with closing(CarlaSession(settings)) as opened:
            assert opened.pictures.counts["pictures_read"] >= 1
        assert camera_server.ask("fault", "late_pictures", 100) == "set"
        with pytest.raises(VehicleError, match="sent no picture in 6 ticks"):
            CarlaSession(settings)
        assert camera_server.ask("actors") == ""
    finally:
        camera_server.ask("fault", "late_pictures", 0)


def test_pictures_of_another_size_end_the_run(camera_server: StandIn) -> None:
    """Pictures that suddenly have another size are counted and never used; the run ends with both sizes named."""
    with first_picture(camera_server.port) as (setup, vehicle):
        assert camera_server.ask("fault", "missing_rows", 1) == "set"
        vehicle.advance(2 * NS_PER_S)
        expect_no_picture(setup)
        with pytest.raises(VehicleError, match="sends pictures of 320x239 pixels instead of 320x240"):
            setup.camera.capture(2, 2 * NS_PER_S, None)
        assert setup.camera.counts["pictures_malformed"] > 0  # type: ignore[attr-defined]
        camera_server.ask("fault", "missing_rows", 0)
    assert camera_server.ask("actors") == ""
