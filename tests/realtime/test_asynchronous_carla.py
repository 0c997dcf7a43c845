"""A car in a stand-in for a CARLA server whose world runs by itself: it drives, and is braked if LAVT hangs or dies."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from statistics import median

import pytest
from tests.carla.contract_vehicle import server_config
from tests.carla.stand_in import REPOSITORY, StandIn, stand_in
from tests.support.stalls import LONG_STALL_MS, Stalls

from lavt.assembly.vehicles import VehicleSetup, build_carla
from lavt.clock import MachineClock, pause
from lavt.config import RunConfig, ServerCameraConfig, ServerConfig
from lavt.config_file import load_config, shipped
from lavt.domain import NS_PER_MS, NS_PER_S, Actuation
from lavt.errors import VehicleError
from lavt.experiment.runs.plan import plan_run
from lavt.experiment.runs.run import run_once
from lavt.recording.record import read_record
from lavt.vehicle.vehicle import Vehicle

PICTURE = ("320", "240")
TIME_LIMIT_S = 6.0
MEDIAN_ERROR_MS = 2.0
MAX_LATE_SHARE = 0.1
PATIENCE_S = 60.0
FAST_MPS = 1.5
THROTTLE = Actuation(0.0, 1.0, 0.0)
DRIVER = """
import sys
from tests.realtime.test_asynchronous_carla import drive_on, opened
with opened(int(sys.argv[1])) as (setup, vehicle):
    drive_on(vehicle)
"""


@contextmanager
def opened(port: int) -> Iterator[tuple[VehicleSetup, Vehicle]]:
    """Build a car in the stand-in's world, which runs by itself, and start its threads."""
    clock = MachineClock()
    setup = build_carla(asynchronous_config(port))
    assert setup.start is not None
    try:
        vehicle = setup.start(clock.now())
        setup.run(clock)
        yield setup, vehicle
    finally:
        setup.close()


def asynchronous_config(port: int) -> ServerConfig:
    config = server_config(port, asynchronous=True, timeout_s=30.0)
    return config.model_copy(update={"camera": ServerCameraConfig(source="carla", width_px=320, height_px=240)})


def drive_on(vehicle: Vehicle, until_mps: float = 1e9) -> None:
    """Do the actuator's work with full throttle until the car has a speed."""
    clock = MachineClock()
    while vehicle.state().speed_mps < until_mps:
        now_ns = clock.now().mono_ns
        vehicle.advance(now_ns)
        vehicle.engage(True, now_ns)
        vehicle.apply(THROTTLE, now_ns)
        pause(5 * NS_PER_MS)


def speed_mps(server: StandIn) -> float:
    """Return the speed of the car, the world's first actor, as the stand-in knows it."""
    words = server.ask("speed").split()
    return float(words[0]) if words else 0.0


def await_speed(server: StandIn, *, is_fast: bool) -> None:
    """Wait until the car is faster than `FAST_MPS`, or stationary; how long that takes is not judged."""
    clock = MachineClock()
    end_ns = clock.now().mono_ns + round(PATIENCE_S * NS_PER_S)
    while (speed_mps(server) <= FAST_MPS) if is_fast else (speed_mps(server) > 0.0):
        assert clock.now().mono_ns < end_ns, f"the car drives at {speed_mps(server)} m/s"
        pause(50 * NS_PER_MS)


@pytest.fixture(scope="module")
def server() -> Iterator[StandIn]:
    """Start a stand-in server that all tests share."""
    with stand_in("--scenery", "none", "--camera", *PICTURE) as started:
        yield started


@pytest.fixture
def driver(server: StandIn) -> Iterator[subprocess.Popen[bytes]]:
    """Start a process that drives with full throttle, and wait until the car is fast."""
    process = subprocess.Popen(
        [sys.executable, "-c", DRIVER, str(server.port)],
        cwd=REPOSITORY,
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(REPOSITORY / "src"), str(REPOSITORY)])},
    )
    with process:
        try:
            await_speed(server, is_fast=True)
            yield process
        finally:
            process.kill()


def test_a_drive_in_a_world_that_runs_by_itself(server: StandIn, tmp_path: Path, stalls: Stalls) -> None:
    """The car drives and is removed, the world runs on, and frames have the times of their states within 2 ms."""
    changes = (
        "time=real",
        "vehicle.kind=carla",
        "vehicle.carla.asynchronous=true",
        f"vehicle.carla.port={server.port}",
        "vehicle.carla.timeout_s=30.0",
        f"vehicle.time_limit_s={TIME_LIMIT_S}",
        f"camera.width_px={PICTURE[0]}",
        f"camera.height_px={PICTURE[1]}",
    )
    began_ns = MachineClock().now().mono_ns
    run_once(plan_run(load_config(RunConfig, shipped("configs/demo.yaml"), changes)), tmp_path / "run")
    ended_ns = MachineClock().now().mono_ns
    tick_times_ns = [int(text) for text in server.ask("tick_times").split()]
    assert (server.ask("actors"), server.ask("settings")) == ("", "False [False]")
    record = read_record(tmp_path / "run" / "server.mcap")
    assert "drive_began" in record.table("event").texts("kind")
    capture_ns = record.table("frame").ints("capture_ns").tolist()
    errors_ms = [min(abs(at_ns - tick_ns) for tick_ns in tick_times_ns) / NS_PER_MS for at_ns in capture_ns]
    with stalls.excusing_failures(began_ns, ended_ns, stall_ms=LONG_STALL_MS):
        assert max(record.table("truth").floats("progress_m")) > 5.0
        assert len(capture_ns) > 30
        assert median(errors_ms) <= MEDIAN_ERROR_MS
        states, late = (
            max(record.table("counts").ints(f"carla_{name}").tolist()) for name in ("states", "states_late")
        )
        assert late <= MAX_LATE_SHARE * states


def test_a_frozen_and_an_aborted_process_are_braked(server: StandIn, driver: subprocess.Popen[bytes]) -> None:
    """A process that is stopped is braked until it goes on; one that an unreadable state aborts is braked for good."""
    driver.send_signal(signal.SIGSTOP)
    await_speed(server, is_fast=False)
    driver.send_signal(signal.SIGCONT)
    await_speed(server, is_fast=True)
    assert server.ask("fault", "garbled_states", 1) == "set"
    assert driver.wait(PATIENCE_S) == -signal.SIGABRT
    await_speed(server, is_fast=False)
    assert "vehicle.lincoln.mkz_2020" in server.ask("actors")
    with opened(server.port):
        assert server.ask("actors").count("vehicle.lincoln.mkz_2020") == 1
    assert server.ask("actors") == ""


def test_the_car_is_braked_when_commands_stop(server: StandIn) -> None:
    """If only the actuator hangs, its process brakes the car; when the actuator goes on, the car drives again."""
    with opened(server.port) as (_, vehicle):
        drive_on(vehicle, until_mps=FAST_MPS)
        await_speed(server, is_fast=False)
        drive_on(vehicle, until_mps=FAST_MPS)
        assert vehicle.counts["carla_silences"] >= 1  # type: ignore[attr-defined]


@pytest.mark.parametrize(("number", "reason"), [(signal.SIGKILL, "has ended"), (signal.SIGSTOP, "does not answer")])
def test_without_its_guard_a_car_does_not_drive(server: StandIn, number: signal.Signals, reason: str) -> None:
    """If the guard ends or hangs, the actuator fails, which ends the run; closing then brakes and removes the car."""
    with opened(server.port) as (_, vehicle):
        drive_on(vehicle, until_mps=FAST_MPS)
        # The newest, because the guard of an aborted process goes on braking for a while.
        guard = int(subprocess.check_output(["pgrep", "-nf", "lavt.vehicle.carla.guard.*" + str(server.port)]))
        os.kill(guard, number)
        with pytest.raises(VehicleError, match=reason):
            drive_on(vehicle)
    assert server.ask("actors") == ""
