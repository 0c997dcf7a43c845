from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

from lavt.config import ClientConfig, RunConfig, ServerConfig
from lavt.config_file import load_config, parse_config
from lavt.domain import Now
from lavt.errors import UserError
from lavt.experiment.runs.join import join_sides
from lavt.experiment.runs.run import compute_result
from lavt.recording.record import RecordWriter, read_record

MakeRun = Callable[..., Path]


def write_sides(make_run: MakeRun, folder: Path, **settings: Any) -> tuple[Path, Path]:
    """Write the directories that `lavt server --out` and `lavt client --out` write for a drive."""
    records = make_run(folder / "records", **settings)
    controller, client_video = {"preset": "paper_calibrated"}, {"reorder_hold_ms": 25.0}
    server_video = {"bit_rate_bps": 2_000_000, "reorder_hold_ms": 40.0}
    client = parse_config(ClientConfig, {"controller": controller, "video": client_video}, "the client")
    server = parse_config(ServerConfig, {"vehicle": {"route": "b_key"}, "video": server_video}, "the server")
    for side, config in (("server", server), ("client", client)):
        (folder / side).mkdir()
        (folder / side / "config.yaml").write_text(yaml.safe_dump(config.model_dump(mode="json")))
        (records / f"{side}.mcap").rename(folder / side / f"{side}.mcap")
    return folder / "server", folder / "client"


def test_two_directories_become_one_run(make_run: MakeRun, tmp_path: Path) -> None:
    """The joined run has both records, a readable config, and a result with the settings of both sides."""
    server, client = write_sides(make_run, tmp_path)
    result = join_sides(server, client, tmp_path / "run")
    assert (result["route"], result["preset"], result["ending"]) == ("b_key", "paper_calibrated", "completed")
    identity = [result[key] for key in ("time", "injection", "inherent", "condition")]
    assert identity == ["real", "none", "network", "none"]
    assert (result["valid"], result["invalid_reasons"]) == (True, [])
    config = load_config(RunConfig, tmp_path / "run" / "config.yaml")
    assert (config.vehicle.route, config.video.bit_rate_bps, config.time) == ("b_key", 2_000_000, "real")
    written = json.loads((tmp_path / "run" / "result.json").read_text())
    assert compute_result(tmp_path / "run", written, None) == written


def test_records_of_two_drives_are_rejected(make_run: MakeRun, tmp_path: Path) -> None:
    """Directories of different drives are rejected, and no run directory is created."""
    server, _ = write_sides(make_run, tmp_path / "one")
    _, client = write_sides(make_run, tmp_path / "two", began_s=100.0)
    with pytest.raises(UserError, match="same drive"):
        join_sides(server, client, tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_the_joined_config_has_the_clients_hold(make_run: MakeRun, tmp_path: Path) -> None:
    """The joined config has the client's hold of the jitter buffer, not the server's."""
    server, client = write_sides(make_run, tmp_path)
    join_sides(server, client, tmp_path / "run")
    assert load_config(RunConfig, tmp_path / "run" / "config.yaml").video.reorder_hold_ms == 25.0


def test_a_client_of_a_later_drive_is_rejected(make_run: MakeRun, tmp_path: Path) -> None:
    """A client that received no frame of the server's first drive is rejected."""
    server, client = write_sides(make_run, tmp_path)
    received = read_record(client / "client.mcap").table("picture").ints("stamp_ns").tolist()
    writer = RecordWriter(server / "server.mcap", "server")
    for mono_ns, kind in ((100, "drive_began"), (200, "ending"), (300, "drive_began")):
        writer.write("event", {"mono_ns": mono_ns, "kind": kind, "detail": ""}, Now(mono_ns, mono_ns))
    for mono_ns, stamp_ns in ((50, received[0]), (150, received[0] - 1), (350, received[1])):
        writer.write("frame", {"number": 0, "stamp_ns": stamp_ns, "stamped_mono_ns": mono_ns}, Now(mono_ns, mono_ns))
    writer.close()
    with pytest.raises(UserError, match="only the first"):
        join_sides(server, client, tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_swapped_directories_are_rejected(make_run: MakeRun, tmp_path: Path) -> None:
    """If the directories of server and client are swapped, the error says which directory to name."""
    server, client = write_sides(make_run, tmp_path)
    with pytest.raises(UserError, match="--out of `lavt server`"):
        join_sides(client, server, tmp_path / "run")
