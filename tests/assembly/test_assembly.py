from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import closing, suppress
from dataclasses import replace
from importlib.metadata import EntryPoint
from itertools import repeat
from pathlib import Path
from typing import Any, Literal

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError
from tests.nodes.stand_ins import NoiseCamera
from tests.vehicle.moving_video import write_video

from lavt.assembly import cameras
from lavt.assembly.addresses import parse_address
from lavt.assembly.cameras import build_camera, camera_model, camera_of_file
from lavt.assembly.clock_source import clock_source
from lavt.assembly.entropy import MachineEntropy, SeededEntropy, run_seed
from lavt.assembly.fidelity import FIDELITIES
from lavt.assembly.injection import injection_client
from lavt.assembly.nodes import build_controller, build_predictor, build_server, check_names
from lavt.assembly.simulators import car_of
from lavt.assembly.vehicles import build_geometry_setup, build_vehicle_setup
from lavt.clock import MachineClock
from lavt.config import (
    CameraConfig,
    ClientConfig,
    ClientInjectionConfig,
    ClockConfig,
    ControllerConfig,
    PredictionConfig,
    RunConfig,
    ServerCameraConfig,
    ServerConfig,
    TwoPointConfig,
    VehicleConfig,
)
from lavt.domain import Lane, Now
from lavt.errors import UserError
from lavt.experiment.runs.plan import plan_run
from lavt.experiment.runs.side_configs import client_config
from lavt.node import WAKE, Message
from lavt.perception.lane_detector import GroundTruthLaneDetector, LaneDetector
from lavt.runtime.pipeline import run_stages
from lavt.transport.clock_sync.persistent_process import Shell
from lavt.vehicle.sim.dynamics import LINCOLN_MKZ
from lavt.vehicle.video_device import VideoDevice


@given(st.integers(0, 2**63 - 1), st.text(max_size=10), st.integers(0, 10_000))
def test_run_seed(seed: int, route: str, repetition: int) -> None:
    """The seed of a run is reproducible and valid in a config."""
    assert 0 <= run_seed(seed, route, repetition) < 2**63
    assert run_seed(seed, route, repetition) == run_seed(seed, route, repetition)


def test_run_seeds_differ() -> None:
    """Different seeds, routes and repetitions give different seeds of runs."""
    seeds = {run_seed(seed, route, number) for seed in range(5) for route in ("a", "b", "a 1") for number in range(50)}
    assert len(seeds) == 5 * 3 * 50


def test_seeded_entropy() -> None:
    """Seeded entropy depends only on seed and name, and returns numbers and tokens of the requested length."""
    entropy, equal_entropy, client_entropy = (
        SeededEntropy(seed, name) for seed, name in ((1, "server"), (1, "server"), (1, "client"))
    )
    values = [entropy.number(64), entropy.number(32), entropy.token(16)]
    assert values == [equal_entropy.number(64), equal_entropy.number(32), equal_entropy.token(16)]
    assert values[0] != client_entropy.number(64)
    assert len(entropy.token(16)) == 16
    assert all(0 <= entropy.number(16) < 2**16 for _ in range(200))


def test_machine_entropy() -> None:
    """The machine's entropy does not repeat."""
    entropy = MachineEntropy()
    assert len({entropy.number(64) for _ in range(100)}) == 100
    assert len({entropy.token(16) for _ in range(100)}) == 100


def test_camera_model() -> None:
    """Angles in degrees in the config become radians in the geometry."""
    model = camera_model(CameraConfig(field_of_view_deg=60.0, pitch_deg=-3.0, x_m=1.0, z_m=2.0))
    assert (model.width_px, model.height_px, model.x_m, model.z_m) == (640, 480, 1.0, 2.0)
    assert model.field_of_view_rad == pytest.approx(math.pi / 3)
    assert model.pitch_rad == pytest.approx(-0.05236, abs=1e-5)


@given(st.text(max_size=20))
def test_any_address(text: str) -> None:
    """Any text either is an address or raises `UserError`."""
    with suppress(UserError):
        host, port = parse_address("video.send_to", text)
        assert host
        assert 0 <= port <= 65535


def test_addresses() -> None:
    """An address has the form host:port, and any other text is rejected."""
    assert parse_address("key", "127.0.0.1:5600") == ("127.0.0.1", 5600)
    assert parse_address("key", "desk.example:0") == ("desk.example", 0)
    for bad in ("5600", ":5600", "desk:", "desk:65536", "desk:-1", "desk:²", "desk:1 ", "desk:" + "9" * 5000):
        with pytest.raises(UserError, match="host:port"):
            parse_address("key", bad)


def test_configured_lags_replace_those_of_the_car() -> None:
    """Configured dead times, lags and stiffness replace the car's own, and other parameters stay unchanged."""
    assert car_of(VehicleConfig()) == LINCOLN_MKZ
    config = VehicleConfig(
        steering_dead_time_ms=240.0,
        steering_lag_ms=270.0,
        pedal_dead_time_ms=100.0,
        throttle_lag_ms=0.0,
        brake_lag_ms=50.0,
        front_stiffness_nprad=116_621.0,
    )
    assert car_of(config) == replace(
        LINCOLN_MKZ,
        steering_dead_time_s=0.24,
        steering_lag_s=0.27,
        pedal_dead_time_s=0.1,
        throttle_lag_s=0.0,
        brake_lag_s=0.05,
        front_stiffness_nprad=116_621.0,
    )


@pytest.mark.parametrize(
    ("vehicle", "controller", "reason"),
    [
        ({"kind": "boat"}, {}, "'boat'.*simulator"),
        ({"route": "z_key"}, {}, "'z_key'.*a_key"),
        ({"route": "../a_key"}, {}, r"'\.\./a_key'"),
        ({"route": "nowhere.yaml"}, {}, r"nowhere\.yaml"),
        ({"car": "boat"}, {}, "'boat'.*lincoln_mkz"),
        ({}, {"kind": "wizard"}, "'wizard'.*lane_keeper"),
        ({}, {"preset": "magic"}, "'magic'.*designed, paper_calibrated"),
    ],
)
def test_unknown_names(vehicle: dict[str, str], controller: dict[str, str], reason: str) -> None:
    """An unknown vehicle, route, car, controller or preset is rejected with an error that quotes it."""
    with pytest.raises(UserError, match=reason):
        check_names(VehicleConfig(**vehicle), ControllerConfig(**controller))  # type: ignore[arg-type]


def test_unknown_vehicle() -> None:
    """An unknown kind of vehicle is rejected when the server is built."""
    with pytest.raises(UserError, match=r"'boat'.*simulator"):
        build_vehicle_setup(ServerConfig(vehicle=VehicleConfig(kind="boat")))


def test_configured_settings_replace_those_of_the_preset() -> None:
    """A configured lookahead, limit or speed changes the commands, and results list the changed settings."""
    changed = ControllerConfig(preset="designed", lookahead_s=2.0, speed_mps=5.0)
    lane = Lane(centre=(0.5, 0.0, 0.0), width_m=3.5, near_m=3.6, far_m=20.0, confidence=1.0)
    by_changed, by_preset = (build_controller(config).decide(lane, 8.0, 0) for config in (changed, ControllerConfig()))

    assert 0 < by_changed.steering_rad < by_preset.steering_rad
    assert (by_changed.throttle, by_preset.brake) == (0.0, 0.0)
    assert by_changed.brake > 0
    assert changed.settings == "designed, lookahead_s 2, speed_mps 5"
    assert ControllerConfig().settings == "designed"


@pytest.mark.parametrize("kind", ["lane_keeper", "two_point"])
def test_the_configured_confidence_decides_whether_a_lane_is_followed(kind: str) -> None:
    """A lane below `controller.lane_confidence` is neither steered by nor driven along, and results name the value."""
    changed = ControllerConfig(kind=kind, lane_confidence=0.5)
    lane = Lane(centre=(0.5, 0.0, 0.0), width_m=3.5, near_m=3.6, far_m=20.0, confidence=0.4)
    by_changed, by_default = (build_controller(config).decide(lane, 2.0, 0) for config in (changed, ControllerConfig()))
    assert (by_changed.steering_rad, by_changed.throttle) == (0.0, 0.0)
    assert by_default.steering_rad > 0
    assert by_default.throttle > 0
    assert "lane_confidence 0.5" in changed.settings


@pytest.mark.parametrize(("lane_confidence", "expected"), [(0.1, 0.1), (None, 0.2), (0.6, 0.2)])
def test_a_lane_that_may_be_followed_is_tracked(lane_confidence: float | None, expected: float) -> None:
    """The detector tracks lanes down to the configured confidence, and in any case down to 0.2."""
    config = ClientConfig(controller=ControllerConfig(lane_confidence=lane_confidence))
    for name in ("pixels", "geometry"):
        detector = FIDELITIES[name]().detector(config)
        assert isinstance(detector, LaneDetector | GroundTruthLaneDetector)
        assert detector._track_confidence == expected


def test_the_configured_human_model_drives() -> None:
    """The section `two_point` sets the model, and results list its changed settings, for this controller only."""
    model = TwoPointConfig(far_gain=3.5, reaction_delay_s=0.0, neuromuscular_lag_s=0.0, noise_rad=0.0025)
    changed = ControllerConfig(kind="two_point", two_point=model)
    undelayed = TwoPointConfig(reaction_delay_s=0.0, neuromuscular_lag_s=0.0)
    default = ControllerConfig(kind="two_point", two_point=undelayed)
    lane = Lane(centre=(0.0, 0.0, 0.005), width_m=3.5, near_m=3.6, far_m=20.0, confidence=1.0)
    by_changed, by_default = (build_controller(config).decide(lane, 8.0, 0) for config in (changed, default))

    assert 0 < by_changed.steering_rad < by_default.steering_rad
    assert changed.settings == (
        "designed, two_point.far_gain 3.5, two_point.reaction_delay_s 0, two_point.neuromuscular_lag_s 0, "
        "two_point.noise_rad 0.0025"
    )
    assert ControllerConfig(two_point=model).settings == "designed"


def test_lazy_physics_advances_for_frames_and_states_only() -> None:
    """With lazy physics the simulator advances only for the 30 frames and the 50 states of each second.

    A vehicle that cannot catch up still advances at every step.
    """
    config = ServerConfig(camera=ServerCameraConfig(width_px=128, height_px=128))
    every_step, lazy, without_catching_up = (
        build_server(
            config,
            lambda: Now(10**12, 10**18),
            SeededEntropy(1, "server"),
            host="",
            video_port=1,
            fidelity=replace(FIDELITIES["geometry"](), vehicle_setup=build),
            lazy_physics=is_lazy,
        ).actuator
        for build, is_lazy in (
            (build_geometry_setup, False),
            (build_geometry_setup, True),
            (lambda config: replace(build_geometry_setup(config), catches_up=False), True),
        )
    )
    wake_counts = []
    for actuator in (every_step, lazy, without_catching_up):
        wakes = 0
        assert actuator is not None
        while (wake_ns := actuator.next_wake_ns()) < 10**12 + 10**9:
            now = Now(max(wake_ns, 10**12), 10**18)
            run_stages("actuator", actuator.pipelines[WAKE], Message(WAKE, None, now), now, repeat(now))
            wakes += 1
        wake_counts.append(wakes)
    every_step_wakes, lazy_wakes, wakes_without_catching_up = wake_counts
    assert every_step_wakes == wakes_without_catching_up > 240
    assert lazy_wakes <= 82


def test_a_condition_that_cannot_be_injected_is_rejected_at_the_start() -> None:
    """A client without an interface rejects a condition that delays control; any client rejects an unknown one."""
    with pytest.raises(UserError, match=r"injection\.interface"):
        injection_client(ClientInjectionConfig(condition="L4"), "alice", 7, 0)
    with pytest.raises(UserError, match="'L9'"):
        injection_client(ClientInjectionConfig(condition="L9", interface="eth0"), "alice", 7, 0)
    injection_client(ClientInjectionConfig(condition="L2"), "alice", 7, 0)


def fail(command: Sequence[str], _timeout_s: float) -> None:
    raise AssertionError(f"unexpected command {command}")


def test_an_external_time_source_reports_the_configured_values() -> None:
    """The correction and the bound of an external time source are those of the config, in seconds."""
    report = clock_source(ClockConfig(source="external", correction_ms=-2.5, bound_ms=0.5), MachineClock(), fail)()
    assert report is not None
    assert (report.source, report.correction_s, report.bound_s) == ("external", -0.0025, 0.0005)


def test_the_probe_as_the_only_source() -> None:
    """With the time source `probe` no command is run, and the report has no correction."""
    report = clock_source(ClockConfig(source="probe"), MachineClock(), fail)()
    assert report is not None
    assert (report.source, report.correction_s, report.bound_s) == ("probe", None, None)


@pytest.mark.parametrize("source", ["chrony", "ptp"])
def test_a_source_that_is_not_installed(source: Literal["chrony", "ptp"], monkeypatch: pytest.MonkeyPatch) -> None:
    """Without the program of a time source, the report says that it is not installed."""
    monkeypatch.setenv("PATH", "")
    with closing(Shell()) as shell:
        report = clock_source(ClockConfig(source=source), MachineClock(), shell.run)()
    assert report is not None
    assert (report.source, report.correction_s) == (source, None)
    assert report.status.endswith("is not installed")


def device_config(device: str | int, **camera: Any) -> ServerConfig:
    return ServerConfig(
        camera=ServerCameraConfig(source="device", device=device, width_px=320, height_px=240, **camera)
    )


def test_camera_device(tmp_path: Path) -> None:
    """With the camera source `device` the configured device is opened; by default there is no camera device."""
    assert build_camera(ServerConfig()) is None
    camera = build_camera(device_config(str(write_video(tmp_path / "video.avi", rate_hz=30.0)), z_m=2.5))
    assert isinstance(camera, VideoDevice)
    with closing(camera):
        assert (camera.model.width_px, camera.model.z_m, camera.rate_hz, camera.phase_ns) == (320, 2.5, 30.0, 0)


def test_camera_device_by_number() -> None:
    """A number selects a V4L2 device."""
    with pytest.raises(UserError, match=r"^/dev/video97 "):
        build_camera(device_config(97))


def test_unknown_camera() -> None:
    """An unknown camera source is rejected, and the error lists the known sources."""
    config = ServerConfig(camera=ServerCameraConfig(source="webcam"))
    with pytest.raises(UserError, match=r"'webcam'.*simulated, device"):
        build_camera(config)


def noise_camera(config: ServerConfig) -> NoiseCamera:
    return NoiseCamera(camera_model(config.camera))


def test_a_package_adds_a_camera_by_entry_point(monkeypatch: pytest.MonkeyPatch) -> None:
    """A camera registered in the group `lavt.cameras` is found by its name and built from the server's config."""
    entry = EntryPoint("noise", f"{__name__}:noise_camera", cameras.CUSTOM_CAMERAS)
    monkeypatch.setattr(cameras, "entry_points", lambda group: [entry] if group == "lavt.cameras" else [])
    camera = build_camera(ServerConfig(camera=ServerCameraConfig(source="noise", width_px=256)))
    assert camera is not None
    assert camera.model.width_px == 256


def test_the_simulator_rejects_a_camera_device() -> None:
    """The simulator renders its own pictures, so a camera device is rejected."""
    with pytest.raises(UserError, match=r"'simulator'.*camera\.source"):
        build_vehicle_setup(device_config("/dev/video0"))


def test_a_server_config_contains_the_camera_geometry(tmp_path: Path) -> None:
    """The camera geometry is read from a server config with any camera source."""
    path = tmp_path / "server.yaml"
    path.write_text("vehicle_id: v-1\ncamera: {source: device, device: /dev/video0, format: MJPG, width_px: 800}\n")
    assert camera_of_file(path).width_px == 800


@pytest.mark.parametrize("pixel_format", ["MJP", "MJPEG", "MJ\nP"])
def test_a_pixel_format_has_four_characters(pixel_format: str) -> None:
    """A V4L2 pixel format has four printable characters; anything else is rejected."""
    with pytest.raises(ValidationError):
        ServerCameraConfig(format=pixel_format)


def test_the_predictive_display_is_a_setting_of_a_person_s_drive() -> None:
    """It is off by default; results name it for a person's drive only; the outline is the built-in car's."""
    shown = PredictionConfig(shown=True)
    person = ControllerConfig(kind="human", prediction=shown)
    assert build_predictor(ClientConfig()) is None
    assert build_predictor(ClientConfig(controller=person)) is not None
    assert ControllerConfig(kind="human").settings == ControllerConfig(prediction=shown).settings == "designed"
    assert person.settings == "designed, prediction.shown"
    run = RunConfig(controller=person, time="real")
    assert plan_run(run, driver="human").identity["preset"] == "designed, prediction.shown"
    assert client_config(run, 1).controller.prediction.shown
    assert (shown.front_m, shown.rear_m, shown.width_m) == (
        LINCOLN_MKZ.rear_axle_to_front_m,
        LINCOLN_MKZ.rear_axle_to_rear_m,
        LINCOLN_MKZ.body_width_m,
    )
    assert shown.steering_lag_s == LINCOLN_MKZ.steering_lag_s
