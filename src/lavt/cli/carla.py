"""`lavt carla`: check a CARLA server, and measure the steering of its car."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Final

import msgspec
import typer

from lavt.assembly.simulators import car_of
from lavt.assembly.vehicles import carla_settings
from lavt.cli import console
from lavt.clock import MachineClock
from lavt.config import RunConfig
from lavt.config_file import build_config
from lavt.errors import LavtError, UserError, WorkError
from lavt.recording.output_directory import check_directory, disk_errors_named, prepare_directory
from lavt.recording.provenance import provenance
from lavt.vehicle.carla.check import (
    CarlaCheck,
    check_driving,
    check_steering,
    check_vehicle_contract,
    describe_times,
    measure_steering,
    steering_disagreement,
    steering_share,
    time_ticks,
)
from lavt.vehicle.carla.session import CarlaSession

Host = Annotated[str, typer.Argument(help="The machine of the CARLA server.")]
Port = Annotated[int, typer.Option(min=1, max=65_534, help="The server's RPC port.")]

DRIVE_S: Final = 20.0
"""The drive of the lane keeper lasts this long at most."""
DRIVE_P95_LIMIT_M: Final = 0.5
"""The largest 95th percentile of the cross-track error that the check accepts."""
DRIVE_ENDINGS: Final = ("completed", "timeout")
OUTCOMES: Final[dict[bool | None, str]] = {True: "passed ", False: "FAILED ", None: "not run"}


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
    out: Annotated[Path, typer.Option(help="The directory for the log and the records of the drive.")] = Path(
        "carla-check"
    ),
) -> None:
    """Check whether a CARLA server does what LAVT assumes, and write a log.

    The command spawns a car at a place that the town recommends, runs the contract that all vehicles of LAVT fulfil,
    drives, brakes and steers, measures how long ticks and pictures take, and lets the lane keeper drive on
    `vehicle.route` for 20 s. Each item is passed, failed or not run, with a reason. LAVT was never tried with a real
    server: please attach the log to an issue. Exits with 1 if an item failed.

    Example: lavt carla check 192.0.2.7 --set vehicle.carla.town=Town04
    """
    check_directory(out)
    run = _config(host, port, changes)
    log: dict[str, Any] = {"settings": {"host": host, "port": port, "set": changes or []}, "provenance": provenance()}
    with console.interruptible(), _session(run, with_camera=False) as session:  # pictures would only cost time
        prepare_directory(out)
        checks = [
            CarlaCheck(
                "connection",
                True,
                f"version {session.ask_version()}, town {session.town}, wheelbase {session.wheelbase_m:.3f} m, largest "
                f"steering angle {math.degrees(session.max_steering_rad):.1f} degrees",
            )
        ]
        for name, stage in STAGES.items():
            checks += _attempt(name, lambda stage=stage: stage(session, run, log))  # type: ignore[misc]
    checks += _attempt("pictures and latency", lambda: _latency(run, log))
    checks += _attempt("drive of the lane keeper", lambda: _drive(run, out / "drive", log))
    for item in checks:
        console.print_result(f"{OUTCOMES[item.passed]}  {item.name}: {item.detail}")
    log["checks"] = msgspec.to_builtins(checks)
    with disk_errors_named(out):
        (out / "log.json").write_bytes(msgspec.json.format(msgspec.json.encode(log), indent=2) + b"\n")
    console.print_result(f"the log is {out / 'log.json'}")
    if any(item.passed is False for item in checks):
        raise WorkError("the server does not do what LAVT assumes: see the failed items")


def calibrate(host: Host = "127.0.0.1", port: Port = 2000, changes: console.SetOption = None) -> None:
    """Measure the steering angle that the car drives for a commanded one, and print the config key that corrects it.

    Example: lavt carla calibrate 192.0.2.7
    """
    with console.interruptible(), _session(_config(host, port, changes), with_camera=False) as session:
        steps = measure_steering(session)
        for step in steps:
            console.print_result(
                f"commanded {step.commanded_rad:+.4f} rad, reported {step.reported_rad:+.4f} rad, driven "
                f"{step.driven_rad:+.4f} rad"
            )
        share = steering_share(steps)
        if disagreement := steering_disagreement(steps):
            raise WorkError(f"{disagreement}: check the place where the car was spawned")
        console.print_result(f"vehicle.carla.max_steering_deg: {math.degrees(session.max_steering_rad) * share:.2f}")


def _contract(session: CarlaSession, run: RunConfig, _log: dict[str, Any]) -> list[CarlaCheck]:
    return check_vehicle_contract(session, car_of(run.vehicle))


def _driving(session: CarlaSession, _run: RunConfig, _log: dict[str, Any]) -> list[CarlaCheck]:
    return check_driving(session)


def _steering(session: CarlaSession, _run: RunConfig, log: dict[str, Any]) -> list[CarlaCheck]:
    steps = measure_steering(session)
    log |= {
        "wheelbase_m": session.wheelbase_m,
        "max_steering_rad": session.max_steering_rad,
        "step_steers": msgspec.to_builtins(steps),
    }
    return check_steering(steps)


STAGES: Final[dict[str, Callable[[CarlaSession, RunConfig, dict[str, Any]], Sequence[CarlaCheck]]]] = {
    "contract": _contract,
    "driving": _driving,
    "steering": _steering,
}
"""The parts of the check that share a session, by the name of the item if they fail as a whole."""


def _latency(run: RunConfig, log: dict[str, Any]) -> list[CarlaCheck]:
    with _session(run, with_camera=True) as session:
        times = time_ticks(session, MachineClock())
        text = describe_times(times, session.settings.tick_s)
    log["ticks"] = msgspec.to_builtins(times)
    return [CarlaCheck("pictures and latency", times.pictures_missing == 0, text)]


def _drive(run: RunConfig, out: Path, log: dict[str, Any]) -> list[CarlaCheck]:
    """Drive on the configured route with the lane keeper, in virtual time and without delay."""
    from lavt.experiment.runs.plan import plan_run  # noqa: PLC0415 (slow: scipy)
    from lavt.experiment.runs.run import run_once  # noqa: PLC0415 (the same)

    result = run_once(plan_run(run), out)
    log["drive"] = result
    p95_m, ending, reasons = result["p95_m"], result["ending"], result["invalid_reasons"]
    passed = ending in DRIVE_ENDINGS and not reasons and p95_m is not None and p95_m < DRIVE_P95_LIMIT_M
    error = "unknown" if p95_m is None else f"{p95_m:.3f} m (p95, limit {DRIVE_P95_LIMIT_M:g} m)"
    invalid = "".join(f"; {reason['text']}" for reason in reasons)
    text = f"on {run.vehicle.route} it ended with {ending}, cross-track error {error}{invalid}"
    return [CarlaCheck("drive of the lane keeper", passed, text)]


def _attempt(name: str, work: Callable[[], Sequence[CarlaCheck]]) -> Sequence[CarlaCheck]:
    """Return the checks of a part; one that names the reason if the part failed, or could not be run as configured."""
    try:
        return work()
    except UserError as error:
        return [CarlaCheck(name, None, str(error))]
    except LavtError as error:
        return [CarlaCheck(name, False, str(error))]


def _config(host: str, port: int, changes: list[str] | None) -> RunConfig:
    vehicle = {"kind": "carla", "carla": {"host": host, "port": port}, "time_limit_s": DRIVE_S}
    return build_config(RunConfig, {"vehicle": vehicle, "time": "virtual"}, changes or [], "the options")


@contextmanager
def _session(run: RunConfig, *, with_camera: bool) -> Iterator[CarlaSession]:
    from lavt.experiment.runs.side_configs import server_config  # noqa: PLC0415 (slow)

    settings = carla_settings(server_config(run, run.seed), None)
    camera = settings.camera if with_camera else None
    with closing(CarlaSession(replace(settings, camera=camera, is_asynchronous=False))) as session:
        yield session
