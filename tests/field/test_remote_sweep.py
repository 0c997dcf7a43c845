"""`lavt sweep --server` between two network namespaces: server, routers, relay, UDP and codec are real."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from tests.field.driving import wait_until
from tests.field.namespaces import VEHICLE, FieldNetworks, plain_field
from tests.field.secured_routers import make_keys

from lavt.clock import pause
from lavt.domain import NS_PER_S
from lavt.experiment.runs.processes import Process, Processes

pytestmark = pytest.mark.usefixtures("namespaces")

RUNS_LIMIT_S = 240.0
OUTAGE_S = 18.0
"""Longer than a request is repeated, shorter than the lease of the run."""
SWEEP = {
    "vehicle": {"scenery": "none", "time_limit_s": 2.0},
    "record": {"video": False},
    "time": "real",
    "routes": ["straight"],
}


@pytest.fixture
def networks() -> Iterator[FieldNetworks]:
    with plain_field() as field:
        yield field


class RemoteSweep:
    """A server in the vehicle's network, and sweeps in the operator's."""

    def __init__(self, networks: FieldNetworks, processes: Processes, work: Path, *changes: tuple[str, ...]) -> None:
        self.networks, self.processes, self.work = networks, processes, work
        server_config, self.client_config = (f"configs/{side}.yaml" for side in ("server", "client"))
        server_changes, self.client_changes = changes or ((), ())
        if changes:
            server_config, self.client_config = (f"configs/{side}-secure.yaml" for side in ("server", "client"))
        options = ["clock.source=probe", "experiment.remote_runs=true", *server_changes]
        arguments = [word for change in options for word in ("--set", change)]
        self.server = self._start("vehicle", "server", server_config, *arguments, "--out", str(work / "server"))

    def start(self, conditions: list[str], *options: str) -> Process:
        """Start a sweep."""
        config, client = self.work / "sweep.yaml", self.work / "client.yaml"
        config.write_text(yaml.safe_dump({**SWEEP, "conditions": conditions}))
        data: dict[str, Any] = yaml.safe_load(Path(self.client_config).read_text()) | {"clock": {"source": "probe"}}
        for change in self.client_changes:
            data |= yaml.safe_load(change)
        client.write_text(yaml.safe_dump(data))
        where = ("--server", VEHICLE, "--client", str(client), "--out", str(self.work / "sweep"))
        return self._start("operator", "sweep", str(config), *where, *options, is_ready=False)

    def summary(self, sweep: Process) -> dict[str, Any]:
        """Wait for the end of a sweep, and return its summary."""
        wait_until("the sweep ends", lambda: not sweep.running, RUNS_LIMIT_S)
        assert sweep.popen.returncode == 0, sweep.last_message()
        summary: dict[str, Any] = json.loads((self.work / "sweep" / "summary.json").read_text())
        return summary

    def stored(self) -> list[str]:
        """Return the runs whose files the server keeps."""
        return sorted(path.name for path in (self.work / "server").iterdir())

    def _start(self, part: str, *arguments: str, is_ready: bool = True) -> Process:
        name = f"{arguments[0]}-{len(self.processes.started)}"
        process = self.networks.inside(part, lambda: self.processes.start(name, *arguments))
        if is_ready:
            process.wait_ready()
        return process


def test_a_sweep_drives_on_another_machine_and_resumes(networks: FieldNetworks, tmp_path: Path) -> None:
    """Each run has both records and a result like a run on one machine; resuming drives nothing again."""
    with Processes(tmp_path) as processes:
        remote = RemoteSweep(networks, processes, tmp_path)
        summary = remote.summary(remote.start(["L0", "L1"]))
        assert [(run["condition"], run["time"], run["inherent"]) for run in summary["runs"]] == [
            ("L0", "real", "network"),
            ("L1", "real", "network"),
        ]
        for condition in ("L0", "L1"):
            directory = tmp_path / "sweep" / "runs" / f"straight_{condition}_00"
            files = {"server.mcap", "client.mcap", "relay.json", "result.json", "config.yaml"}
            assert {path.name for path in directory.iterdir()} >= files
        assert remote.stored() == ["0001", "0002"]
        (tmp_path / "sweep" / "runs" / "straight_L1_00" / "result.json").unlink()
        assert len(remote.summary(remote.start(["L0", "L1"], "--resume"))["runs"]) == 2
        assert remote.stored() == ["0001", "0002", "0003"], "only the broken run is driven again"
        assert (tmp_path / "sweep" / "report" / "index.html").is_file()


def test_with_keys_a_run_is_driven_again_after_an_outage(networks: FieldNetworks, tmp_path: Path) -> None:
    """With encryption and signatures, a run that loses its connection is reported, and driven again."""
    pytest.importorskip("cryptography")
    pytest.importorskip("pylibsrtp")
    keys = tmp_path / "keys"
    make_keys(keys, "--vehicle=vehicle-1", "--operator=operator-1", f"--host={VEHICLE}")
    tls = {
        side: {
            "root_ca_certificate": f"{keys}/authority.pem",
            f"{action}_certificate": f"{keys}/{name}.pem",
            f"{action}_private_key": f"{keys}/{name}.key",
        }
        for side, action, name in (("server", "listen", "vehicle-1"), ("client", "connect", "operator-1"))
    }
    listen = {"endpoints": [f"unixsock-stream/{tmp_path}/zenoh.sock", "quic/0.0.0.0:7448?mixed_rel=1"]}
    server_zenoh = {"router_settings": {"listen": listen, "transport": {"link": {"tls": tls["server"]}}}}
    client_zenoh = {"router_settings": {"transport": {"link": {"tls": tls["client"]}}}}
    operators = f"{{operator-1: {keys}/operator-1.sign.pub}}"
    client_security = {"key": f"{keys}/operator-1.sign.key", "vehicle": f"{keys}/vehicle-1.sign.pub"}
    server_changes = (
        f"zenoh={json.dumps(server_zenoh)}",
        f"security={{key: {keys}/vehicle-1.sign.key, operators: {operators}}}",
    )
    client_changes = (json.dumps({"zenoh": client_zenoh}), json.dumps({"security": client_security}))
    with Processes(tmp_path) as processes:
        remote = RemoteSweep(networks, processes, tmp_path, server_changes, client_changes)
        sweep = remote.start(["L1"])
        wait_until("the run begins", lambda: "running" in str(remote.server.latest.get("said")), RUNS_LIMIT_S)
        networks.block(["uplink", "downlink"])
        pause(round(OUTAGE_S * NS_PER_S))
        networks.unblock()
        [run] = remote.summary(sweep)["runs"]
        assert (run["condition"], run["injection"]) == ("L1", "relay")
        assert remote.stored() == ["0001", "0002"]
        assert "attempt 1 of 3" in (tmp_path / f"{sweep.name}.log").read_text()
