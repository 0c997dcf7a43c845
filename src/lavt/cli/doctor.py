"""`lavt doctor`: check whether a machine, or a pair of machines, is ready to drive, and suggest fixes."""

from __future__ import annotations

import os
import platform
import shutil
import sys
import textwrap
from collections.abc import Iterator
from contextlib import closing, suppress
from pathlib import Path
from typing import Annotated

import msgspec
import typer

import lavt
from lavt.assembly.by_wire import listen
from lavt.assembly.cameras import client_camera
from lavt.assembly.zenoh import program_sessions, side_session
from lavt.cli import console
from lavt.cli.clock import probe
from lavt.clock import MachineClock
from lavt.config import ClientConfig, ServerCameraConfig, ServerConfig
from lavt.config_file import find_file, load_config, read_yaml, split_change
from lavt.doctor import checks, key_checks, measurements
from lavt.doctor.checks import Check
from lavt.doctor.clock_checks import compare_with_server
from lavt.domain import NS_PER_S
from lavt.errors import LavtError, UserError
from lavt.runtime import process_priority
from lavt.runtime.resident_memory import lift_lock_limit
from lavt.transport.clock_sync.clock_report import ClockReport
from lavt.transport.udp_link import resolve_host
from lavt.transport.zenoh_link import ZenohLink
from lavt.transport.zenoh_session import configured_endpoints, quiet_logs

PROBE_DURATION_NS = NS_PER_S
LISTEN_NS = NS_PER_S
"""How long to listen to a CAN bus; a kit's slowest report comes every 0.1 s."""
CLIENT_NAME = "doctor"
ANY_ADDRESS = "0.0.0.0"  # noqa: S104 (no socket is bound to it)
Settings = ServerConfig | ClientConfig
CLIENT_ONLY_KEYS = {*(ClientConfig.model_fields.keys() - ServerConfig.model_fields.keys()), "video.server"}


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("doctor")(doctor)


def doctor(
    config: Annotated[
        Path | None, typer.Argument(help="A server or client config; default: check this machine only.")
    ] = None,
    changes: console.SetOption = None,
    as_json: console.JsonOption = False,
) -> None:
    """Check whether this machine is ready to drive.

    With a config, the command also checks the requirements of that side and, for a client, the connection to the
    vehicle. It changes nothing and does not acquire control. It exits with 1 if there is a problem.

    Example: lavt doctor configs/client.yaml --set video.server=192.0.2.7
    """
    console.reserve_stdout()
    process_priority.raise_priority()
    if config is None and changes:
        raise UserError("--set changes a value of a config: name a config before it")
    settings = None if config is None else _load(config, changes or [])
    quiet_logs()
    results = []
    for check in _checks(settings, MachineClock()):
        results.append(check)
        if not as_json:
            _print_check(check)
    problems = sum(check.verdict == "problem" for check in results)
    if as_json:
        console.print_json({"good": problems == 0, "checks": msgspec.to_builtins(results)})
    if problems:
        raise typer.Exit(1)


def _load(path: Path, changes: list[str]) -> Settings:
    """Read a client's config if the file or a change has a key of clients only, otherwise a server's config."""
    data = read_yaml(find_file(path))
    video = data.get("video")
    keys = {*data, *(f"video.{key}" for key in (video if isinstance(video, dict) else {}))}
    for parts, _ in map(split_change, changes):
        keys |= {parts[0], ".".join(parts[:2])}
    if keys & CLIENT_ONLY_KEYS:
        return load_config(ClientConfig, path, changes)
    return load_config(ServerConfig, path, changes)


def _checks(settings: Settings | None, clock: MachineClock) -> Iterator[Check]:
    config = ServerConfig() if settings is None else settings
    yield from _machine_checks(config, "" if settings is None else _side_name(settings), clock)
    report = measurements.clock_report(config.clock, clock)
    yield checks.check_clock(report)
    yield checks.check_netem(measurements.netem_rejection(config.injection.interface), config.injection.interface)
    if settings is None:
        return
    yield from _security_checks(settings, clock)
    if isinstance(settings, ServerConfig):
        if settings.camera.source == "device":
            yield _camera_check(settings, clock)
        if settings.vehicle.kind == "dbw" and not settings.vehicle.dbw.is_inside:
            yield _by_wire_check(settings, clock)
            yield checks.check_memory_lock(lift_lock_limit())
        yield from _port_checks(settings, clock)
        yield from _zenoh_checks(settings, clock)
    else:
        yield from _zenoh_checks(settings, clock)
        yield _probe_check(settings, report, clock)
        yield checks.check_video(settings.video.server, settings.video.port)


def _side_name(settings: Settings) -> str:
    return "client" if isinstance(settings, ClientConfig) else "server"


def _machine_checks(config: Settings, side: str, clock: MachineClock) -> Iterator[Check]:
    versions, requirements = measurements.packages()
    yield checks.check_versions(platform.python_version(), versions, requirements)
    yield _codec_check(config, side, clock)
    yield checks.check_buffer(measurements.receive_buffer_bytes())
    yield checks.check_arrival(measurements.kernel_records_arrivals())
    yield checks.check_timer(*measurements.timer_accuracy(clock))
    yield checks.check_process_priority(measurements.niceness(), process_priority.session_niceness())
    yield checks.check_governor(measurements.governors())


def _codec_check(config: Settings, side: str, clock: MachineClock) -> Check:
    """Time the codec with the config's settings; for a client, the encoder has its default settings."""
    server = config if isinstance(config, ServerConfig) else _assumed_server(config)
    size = f"{server.camera.width_px}x{server.camera.height_px}"
    try:
        times = measurements.codec_times(server, clock)
    except (LavtError, OSError, ValueError) as error:  # PyAV's errors derive from OSError or ValueError
        do = "check that PyAV has libx264 (`pip install --force-reinstall av`) and that the picture size is supported"
        return Check("processor", "problem", f"pictures of {size} cannot be encoded and decoded here: {error}", do)
    cores = len(os.sched_getaffinity(0))
    return checks.check_codec(times, size=size, rate_hz=server.camera.rate_hz, side=side, cores=cores)


def _camera_check(settings: ServerConfig, clock: MachineClock) -> Check:
    camera = settings.camera
    size = f"{camera.width_px}x{camera.height_px}"
    sample = measurements.sample_camera(settings, clock)
    return checks.check_camera(sample, name=str(camera.device), size=size, rate_hz=camera.rate_hz)


def _by_wire_check(settings: ServerConfig, clock: MachineClock) -> Check:
    bus = f"{settings.vehicle.dbw.interface} {settings.vehicle.dbw.channel}"
    try:
        frames, inhibit_reason = listen(settings, clock, LISTEN_NS)
    except UserError as error:
        frames, inhibit_reason = 0, str(error)
    return checks.check_by_wire(frames, inhibit_reason, name=bus)


def _assumed_server(config: ClientConfig) -> ServerConfig:
    """Return a server config with the client's camera settings."""
    camera = client_camera(config.camera)
    return ServerConfig(
        camera=ServerCameraConfig(width_px=camera.width_px, height_px=camera.height_px, rate_hz=config.camera.rate_hz)
    )


def _security_checks(settings: Settings, clock: MachineClock) -> Iterator[Check]:
    files = measurements.key_files(settings.security)
    yield key_checks.check_keys_configured(bool(files))
    for key, path, is_private in files:
        rejection, mode = measurements.file_state(path)
        yield key_checks.check_key_file(key, path, rejection=rejection, mode=mode, is_private=is_private)
        with suppress(UserError):  # `keys_rejection` reports an invalid key
            days_left = measurements.signing_key_days_left(path, clock.now().wall_ns, is_private=is_private)
            yield key_checks.check_signing_key(path, days_left)
    rejection = measurements.keys_rejection(settings)
    if rejection:
        yield Check(
            "keys", "problem", rejection, "copy the files that `lavt keys` lists for this machine (docs/deployment.md)"
        )
    for folder in sorted({path.parent for _, path, _ in files}):
        for path, days_left in measurements.certificates(folder, clock.now().wall_ns):
            yield key_checks.check_certificate(path, days_left)


def _port_checks(settings: ServerConfig, clock: MachineClock) -> Iterator[Check]:
    host, probe_port = settings.video.bind, settings.clock.probe_port
    ports = (("video port", "video.port", settings.video.port), ("probe port", "clock.probe_port", probe_port))
    rejections = {key: measurements.bind_rejection(host, port) for _, key, port in ports}
    is_served = False
    if any(rejections.values()) and probe_port:
        address = "127.0.0.1" if host == ANY_ADDRESS else host
        clock_probes, _ = probe(clock, address, probe_port, PROBE_DURATION_NS // 10)  # this machine answers fast
        is_served = bool(clock_probes)
    for name, key, port in ports:
        yield checks.check_port(name, key, host, port, rejection=rejections[key], is_served=is_served)


def _zenoh_checks(settings: Settings, clock: MachineClock) -> Iterator[Check]:
    if measurements.keys_rejection(settings):
        yield Check("router", "not checked", "fix the keys first")
        return
    listener, endpoint = measurements.StateListener(settings), settings.zenoh.router
    try:
        session = program_sessions(settings)[-1]
        endpoint = ", ".join(configured_endpoints(session.path, "connect/endpoints", session.changes))
        link = ZenohLink(clock, side="client", settings=session, vehicle=settings.vehicle_id, who=CLIENT_NAME)
    except UserError as error:
        if settings.zenoh.is_embedded and isinstance(settings, ServerConfig):
            yield _embedded_router_check(settings, clock)
        else:
            yield checks.check_router(endpoint, str(error), is_embedded=settings.zenoh.is_embedded)
        return
    with closing(link):
        yield checks.check_router(endpoint, "")
        if isinstance(settings, ServerConfig):
            yield checks.check_link(link.routers(), has_vehicle=False)
            return
        sample = listener.listen(link, clock)
        yield checks.check_vehicle(sample, settings.vehicle_id, lavt.__version__)
        yield checks.check_link(link.routers(), has_vehicle=bool(sample.states or sample.unreadable))


def _embedded_router_check(settings: ServerConfig, clock: MachineClock) -> Check:
    """Check that the server, which is not running, can start its embedded router."""
    session = side_session(settings)
    try:
        with closing(
            ZenohLink(clock, side="server", settings=session, vehicle=settings.vehicle_id, who=CLIENT_NAME)
        ) as link:
            return checks.check_embedded_router(link.locators(), "")
    except UserError as error:
        return checks.check_embedded_router([], str(error))


def _probe_check(settings: ClientConfig, report_before: ClockReport | None, clock: MachineClock) -> Check:
    host, port = settings.video.server, settings.clock.probe_port
    try:
        address = resolve_host("video.server", host)
    except UserError as error:
        return Check("clock probe", "problem", str(error), "set video.server to the vehicle's address")
    clock_probes, last_reply = probe(clock, address, port, PROBE_DURATION_NS)
    report = measurements.clock_report(settings.clock, clock)
    if last_reply is None or report is None:
        return checks.check_probe(None, host, port)
    comparison = compare_with_server(report_before or report, report, clock_probes, last_reply, address)
    return checks.check_probe(comparison, host, port)


def _print_check(check: Check) -> None:
    """Print a check, wrapped to the width of the terminal if there is one."""
    indent = " " * 30
    width = shutil.get_terminal_size().columns if sys.stdout.isatty() else 10**6
    lines = [check.found, *([f"-> {check.do}"] if check.do else [])]
    wrapped_lines = [part for line in lines for part in textwrap.wrap(line, max(30, width - len(indent)))]
    console.print_result(f"{check.verdict:<12}{check.name:<17} " + f"\n{indent}".join(wrapped_lines))
