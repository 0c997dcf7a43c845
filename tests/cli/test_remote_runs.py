"""`lavt sweep --server` and `lavt server` with `experiment.remote_runs`: what they reject before they begin."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from tests.support.command_line import Run
from tests.support.ports import free_port

from lavt.config_file import shipped

SWEEP, SERVER = (str(shipped(f"configs/{name}.yaml")) for name in ("sweep", "server"))


@pytest.mark.parametrize(
    "options",
    [
        ("--set", "time=virtual"),
        ("--set", "network.injection=netem", "--set", "network.inherent=loopback"),
        ("--set", "vehicle.kind=dbw", "--set", "vehicle.dbw.interface=inside"),
        ("--cluster", "local"),
        ("--client", "no_such_file.yaml"),
    ],
)
def test_a_sweep_that_a_server_cannot_drive_is_rejected(run: Run, tmp_path: Path, options: tuple[str, ...]) -> None:
    """Virtual time, netem, other vehicles, a cluster and a missing config of the client are mistakes of the user."""
    out = tmp_path / "out"
    assert run("sweep", SWEEP, "--server", "127.0.0.1", "--out", str(out), *options).rejection()
    assert not out.exists()


def test_a_sweep_without_a_server_does_not_begin(run: Run, tmp_path: Path) -> None:
    """If no router answers at the server's address, the sweep ends with one sentence and creates nothing."""
    port = free_port()
    endpoint = f"udp/127.0.0.1:{port}?rel=1;mixed_rel=1"
    client = tmp_path / "client.yaml"
    client.write_text(json.dumps({"zenoh": {"router_settings": {"connect": {"endpoints": [endpoint]}}}}))
    out = tmp_path / "out"
    result = run("sweep", SWEEP, "--server", "127.0.0.1", "--client", str(client), "--out", str(out))
    assert f"127.0.0.1:{port}" in result.rejection()
    assert not out.exists()


@pytest.mark.parametrize("change", ["vehicle.kind=dbw", "vehicle.kind=mine", "camera.source=device"])
def test_a_server_of_another_vehicle_allows_no_remote_runs(run: Run, change: str) -> None:
    """`experiment.remote_runs` with another vehicle or camera than the simulator's is a mistake of the user."""
    options = ("--set", "experiment.remote_runs=true", "--set", change)
    assert "experiment.remote_runs" in run("server", SERVER, *options).rejection()
