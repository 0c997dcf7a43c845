"""Joining the directories that `lavt server` and `lavt client` wrote on two machines into one run directory."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from lavt.config import ClientConfig, NetworkConfig, RunConfig, ServerConfig, VideoConfig
from lavt.config_file import condition, load_config
from lavt.errors import UserError
from lavt.experiment.analysis.latency import frames_within
from lavt.experiment.analysis.metrics import driving_interval
from lavt.experiment.runs.plan import injected_entry
from lavt.experiment.runs.run import CONFIG, NETWORK, compute_result
from lavt.recording.output_directory import check_directory, make_directory
from lavt.recording.record import evaluating, read_record
from lavt.recording.table import MISSING

SIDES = ("server", "client")


def join_sides(server_dir: Path, client_dir: Path, out: Path) -> dict[str, Any]:
    """Create the run directory `out` from the directories of the two sides, and return its result.

    Raises `UserError` if a directory does not have the files of its side, or if the two directories are not from the
    same drive.
    """
    check_directory(out)
    for side, directory in zip(SIDES, (server_dir, client_dir), strict=True):
        for name in (CONFIG, f"{side}.mcap"):
            if not (directory / name).is_file():
                raise UserError(f"{directory} has no {name}: name the --out of `lavt {side}`")
    server, client = load_config(ServerConfig, server_dir / CONFIG), load_config(ClientConfig, client_dir / CONFIG)
    check_same_drive(server_dir / "server.mcap", client_dir / "client.mcap")
    run = run_config(server, client)
    make_directory(out)
    (out / CONFIG).write_text(yaml.safe_dump(run.model_dump(mode="json"), sort_keys=False))
    for side, directory in zip(SIDES, (server_dir, client_dir), strict=True):
        shutil.copyfile(directory / f"{side}.mcap", out / f"{side}.mcap")
        shutil.copyfile(directory / CONFIG, out / f"{side}.yaml")
    return compute_result(out, _identity(out.name, run, client), None)


def run_config(server: ServerConfig, client: ClientConfig) -> RunConfig:
    """Return the config that a run of these two sides would have had on one machine."""
    injection = client.injection
    return RunConfig(
        vehicle=server.vehicle,
        controller=client.controller,
        perception=client.perception,
        camera=server.camera,
        video=VideoConfig(
            **{key: getattr(server.video, key) for key in VideoConfig.model_fields}
            | {"reorder_hold_ms": client.video.reorder_hold_ms}  # the client uses its own value
        ),
        network=NetworkConfig(
            condition=injection.condition or "L0",
            injection="netem" if injection.condition else "none",
            state_delay=injection.state_delay,
        ),
        safety=server.safety,
        record=server.record,
        time="real",
        seed=server.seed,
    )


def _identity(name: str, run: RunConfig, client: ClientConfig) -> dict[str, Any]:
    run_condition = condition(run.network.condition)
    return {
        "run": name,
        "time": "real",
        "fidelity": "video",
        "injection": run.network.injection,
        "inherent": NETWORK,
        "route": run.vehicle.route,
        "condition": run.network.condition if client.injection.condition else "none",
        "controller": run.controller.kind,
        "preset": run.controller.settings,
        "driver": run.controller.kind,
        "repetition": 0,
        "seed": run.seed,
        **({"detector": client.perception.settings} if client.perception.settings else {}),
        **injected_entry(run_condition),
    }


def check_same_drive(server: Path, client: Path) -> None:
    """Raise `UserError` if the client read none of the stamps that the server wrote during the drive."""
    server_record = read_record(server, channels=("event", "frame"))
    with evaluating(server):
        began_ns, ended_ns, _ = driving_interval(server_record)
        written_stamps = frames_within(server_record.table("frame"), began_ns, ended_ns).ints("stamp_ns")
    with evaluating(client):
        read_stamps = read_record(client, channels=("picture",)).table("picture").ints("stamp_ns")
    if not np.isin(read_stamps[read_stamps != MISSING], written_stamps).any():
        raise UserError(
            f"{client} has no frame of {server}: name two directories of the same drive; of a server with several "
            "drives, only the first can be joined"
        )
