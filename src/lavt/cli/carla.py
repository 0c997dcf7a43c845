"""`lavt carla`: check a CARLA server, and measure the steering of its car."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import msgspec
import typer

from lavt.assembly.vehicles import carla_settings
from lavt.cli import console
from lavt.clock import MachineClock
from lavt.config import ServerConfig
from lavt.config_file import build_config
from lavt.errors import WorkError
from lavt.recording.provenance import provenance
from lavt.vehicle.carla.check import (
    CarlaCheck,
    check_driving,
    check_steering,
    measure_steering,
    steering_share,
    time_ticks,
)
from lavt.vehicle.carla.session import CarlaSession

Host = Annotated[str, typer.Argument(help="The machine of the CARLA server.")]
Port = Annotated[int, typer.Option(min=1, max=65_534, help="The server's RPC port.")]


def register(app: typer.Typer) -> None:
    """Add the commands."""
    carla = typer.Typer(no_args_is_help=True, help="Check a CARLA server (docs/carla.md).")
    carla.command("check")(check)
    carla.command("calibrate")(calibrate)
    app.add_typer(carla, name="carla")


def check(
    host: Host = "127.0.0.1",
    port: Port = 2000,
    changes: console.SetOption = None,
    out: Annotated[Path, typer.Option(help="The log to write, in JSON.")] = Path("carla-check.json"),
) -> None:
    """Check whether a CARLA server does what LAVT assumes, and write a log.

    The command spawns a car at a place that the town recommends, drives it, steers it, and measures how long ticks and
    pictures take. LAVT was never tried with a real server: please attach the log to an issue.
    Exits with 1 if a check failed.

    Example: lavt carla check 192.0.2.7 --set vehicle.carla.town=Town04
    """
    with _session(host, port, changes, with_camera=True) as session:
        checks = check_driving(session)
        steps = measure_steering(session)
        checks += check_steering(steps)
        times = time_ticks(session, MachineClock())
        checks.append(
            CarlaCheck(
                "pictures",
                times.pictures_missing == 0,
                f"{times.pictures_missing} missing; ticks take {times.tick_p50_ms:.1f} ms (p95 {times.tick_p95_ms:.1f} "
                f"ms), pictures arrive after {times.picture_p50_ms:.1f} ms (p95 {times.picture_p95_ms:.1f} ms)",
            )
        )
        log: dict[str, Any] = {
            "settings": {"host": host, "port": port, "set": changes or []},
            "wheelbase_m": session.wheelbase_m,
            "max_steering_rad": session.max_steering_rad,
            "checks": msgspec.to_builtins(checks),
            "step_steers": msgspec.to_builtins(steps),
            "ticks": msgspec.to_builtins(times),
            "provenance": provenance(),
        }
    for item in checks:
        console.print_result(f"{'ok    ' if item.passed else 'FAILED'}  {item.name}: {item.detail}")
    out.write_bytes(msgspec.json.format(msgspec.json.encode(log), indent=2) + b"\n")
    console.print_result(f"the log is {out}")
    if not all(item.passed for item in checks):
        raise WorkError("the server does not do what LAVT assumes: see the failed checks")


def calibrate(host: Host = "127.0.0.1", port: Port = 2000, changes: console.SetOption = None) -> None:
    """Measure the steering angle that the car drives for a commanded one, and print the config key that corrects it.

    Example: lavt carla calibrate 192.0.2.7
    """
    with _session(host, port, changes, with_camera=False) as session:
        steps = measure_steering(session)
        for step in steps:
            console.print_result(
                f"commanded {step.commanded_rad:+.4f} rad, reported {step.reported_rad:+.4f} rad, driven "
                f"{step.driven_rad:+.4f} rad"
            )
        share = steering_share(steps)
        if share <= 0.0:
            raise WorkError("the car did not turn to the commanded side: check the place where it was spawned")
        console.print_result(f"vehicle.carla.max_steering_deg: {math.degrees(session.max_steering_rad) * share:.2f}")


@contextmanager
def _session(host: str, port: int, changes: list[str] | None, *, with_camera: bool) -> Iterator[CarlaSession]:
    data = {"vehicle": {"kind": "carla"}, "camera": {"source": "carla"}}
    config = build_config(ServerConfig, data, changes or [], "the options")
    settings = carla_settings(config, None)
    camera = settings.camera if with_camera else None
    with closing(CarlaSession(replace(settings, host=host, port=port, camera=camera))) as session:
        yield session
