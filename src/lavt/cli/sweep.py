"""`lavt sweep`: execute many runs and write their summary and report."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from lavt.cli import console
from lavt.cli.progress import progress
from lavt.config import ClientConfig, SweepConfig
from lavt.config_file import load_config
from lavt.errors import UserError
from lavt.experiment.runs.plan import plan_sweep
from lavt.recording.output_directory import check_output, disk_errors_named, make_directory, reserve_directory


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("sweep")(sweep)


def sweep(
    config: Annotated[Path, typer.Argument(help="A sweep config in YAML, such as configs/sweep.yaml.")],
    changes: console.SetOption = None,
    out: console.OutOption = None,
    jobs: Annotated[int | None, typer.Option(min=1, help="Number of parallel runs; default: one per core.")] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Continue a stopped sweep in --out.")] = False,
    cluster: Annotated[
        str | None,
        typer.Option(metavar="ADDRESS|local", help="Run on the Dask workers of a scheduler, or on local workers."),
    ] = None,
    server: Annotated[
        str | None, typer.Option(metavar="HOST", help="Drive in real time on the server at this address.")
    ] = None,
    client: Annotated[Path, typer.Option(help="With --server: the config of this machine's client.")] = Path(
        "configs/client.yaml"
    ),
    as_json: console.JsonOption = False,
) -> None:
    """Drive routes under network conditions and report.

    Each combination is repeated as the config says. Finished runs of a stopped sweep are kept; see --resume. With
    --server, the vehicle's side of each run is on that machine, whose server allows it (experiment.remote_runs).

    Example: lavt sweep configs/sweep.yaml --set 'conditions=[L0, L3]' --out out/sweep
    """
    from lavt.assembly.vehicles import check_carla_servers  # noqa: PLC0415 (slow: numpy)
    from lavt.experiment.runs.remote_run import RemoteServer  # noqa: PLC0415
    from lavt.experiment.sweep.cluster import check_cluster  # noqa: PLC0415 (slow: scipy)
    from lavt.experiment.sweep.sweep import SWEEP, drive_sweep  # noqa: PLC0415 (slow: scipy)
    from lavt.experiment.sweep.workers import is_finished  # noqa: PLC0415

    if cluster and server:
        raise UserError("--cluster and --server exclude each other: a server drives one run at a time")
    settings = load_config(SweepConfig, config, [*(["time=real"] if server else []), *(changes or [])])
    planned_runs = plan_sweep(settings)
    remote = None
    if server:
        console.reserve_stdout()
        remote_client = load_config(ClientConfig, client, [f"video.server={server}"])
        remote = RemoteServer(remote_client, console.print_message)
        remote.check(planned_runs)
    if cluster and any(run.config.time == "real" for run in planned_runs):
        raise UserError("--cluster needs virtual time: set time: virtual, or run without --cluster")
    out = out or Path("out") / "sweep"
    check_output(out, SWEEP, resume=resume)
    if cluster:
        check_cluster(cluster, jobs)
    remaining = sum(not is_finished(out / "runs" / run.name) for run in planned_runs)
    if remote and remaining:
        remote.check_connection()
    if remaining and not (remote or cluster):  # otherwise, the server may be reachable for other machines only
        check_carla_servers(run.config.vehicle for run in planned_runs)
    make_directory(out)
    with (
        reserve_directory(out),
        disk_errors_named(out),
        console.interruptible("runs"),
        progress(f"sweep, results in {out}", remaining) as report_done,
    ):
        page, result = drive_sweep(
            settings, planned_runs, out, jobs=jobs, on_progress=report_done, cluster_address=cluster, server=remote
        )
    console.print_report(page, out / "summary.json", result.failed, as_json=as_json)
