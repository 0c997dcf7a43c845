from __future__ import annotations

import json
import socket
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml
from pydantic import BaseModel
from tests.support.ports import free_port

from lavt.config import ZenohConfig
from lavt.experiment.runs.plan import PlannedRun
from lavt.experiment.runs.processes import Process, Processes
from lavt.experiment.runs.side_configs import client_config, embedded_router, server_config

Wait = Callable[[str, Callable[[], bool], float], None]
LIMIT_S = 90.0
SMALL = ("camera.width_px=320", "camera.height_px=240", "camera.rate_hz=15")


class Fleet:
    """One separate router, servers with sessions at it, and clients whose embedded routers dial it."""

    def __init__(self, processes: Processes, work: Path, run: PlannedRun) -> None:
        self._processes, self._work, self._run = processes, work, run
        endpoint = f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"
        self._link = f"udp/127.0.0.1:{free_port()}?rel=1;mixed_rel=1"
        self._session = ZenohConfig(router=endpoint)
        self._probe_ports: dict[str, int] = {}
        change = f"listen.endpoints={json.dumps([endpoint, self._link])}"
        processes.start("router", "router", "zenoh-configs/router-server.json5", "--set", change).wait_ready()

    def start_server(self, vehicle: str) -> Process:
        """Start a server whose session is at the separate router."""
        self._probe_ports[vehicle] = free_port()
        config = server_config(self._run.config, self._run.seed, zenoh=self._session)
        clock = config.clock.model_copy(update={"probe_port": self._probe_ports[vehicle]})
        return self._start("server", vehicle, config.model_copy(update={"vehicle_id": vehicle, "clock": clock}))

    def start_client(self, name: str, operator: str, vehicle: str) -> Process:
        """Start a client of this vehicle."""
        router = embedded_router(dialled=[self._link])
        config = client_config(self._run.config, self._run.seed, zenoh=router, probe_port=self._probe_ports[vehicle])
        return self._start("client", name, config.model_copy(update={"vehicle_id": vehicle, "who": operator}))

    def _start(self, command: str, name: str, config: BaseModel) -> Process:
        path = self._work / f"{name}.yaml"
        path.write_text(yaml.safe_dump(config.model_dump(mode="json")))
        process = self._processes.start(name, command, str(path))
        process.wait_ready()
        return process


def status(process: Process) -> dict[str, Any]:
    latest: dict[str, Any] = process.latest.get("status", {})
    return latest


def is_driven_by(server: Process, operator: str) -> bool:
    now = status(server)
    return now.get("active_operator") == operator and now.get("safety") == "driving" and now["speed_mps"] > 0.5


def test_two_vehicles_behind_one_router(tmp_path: Path, wait_until: Wait, planned: Callable[..., PlannedRun]) -> None:
    """Two vehicles at one separate router are driven by a client each; then one of the operators drives the other."""
    run = planned("vehicle.scenery=none", "controller.preset=designed", *SMALL)
    with Processes(tmp_path) as processes:
        fleet = Fleet(processes, tmp_path, run)
        one, two = (fleet.start_server(vehicle) for vehicle in ("vehicle-1", "vehicle-2"))
        first = fleet.start_client("first", "operator-1", "vehicle-1")
        second = fleet.start_client("second", "operator-2", "vehicle-2")
        wait_until("operator-1 drives vehicle-1", lambda: is_driven_by(one, "operator-1"), LIMIT_S)
        wait_until("operator-2 drives vehicle-2", lambda: is_driven_by(two, "operator-2"), LIMIT_S)
        assert status(one)["active_operator"] == "operator-1", "the second client must not change the first vehicle"

        second.end()
        wait_until("vehicle-2 is free", lambda: status(two).get("active_operator") == "", LIMIT_S)
        assert status(one)["active_operator"] == "operator-1", "a release must not change the other vehicle"
        first.end()
        wait_until("vehicle-1 is free", lambda: status(one).get("active_operator") == "", LIMIT_S)

        switched = fleet.start_client("switched", "operator-1", "vehicle-2")
        wait_until("operator-1 drives vehicle-2", lambda: is_driven_by(two, "operator-1"), LIMIT_S)
        assert status(one)["active_operator"] == ""
        assert status(one)["speed_mps"] == pytest.approx(0.0, abs=0.05)
    assert [process.popen.returncode for process in (one, two, first, second, switched)] == [0] * 5
