"""A drive of two programs whose output nobody reads."""

from __future__ import annotations

import fcntl
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import IO, Any

import yaml
from pydantic import BaseModel

from lavt.clock import pause
from lavt.domain import NS_PER_S
from lavt.experiment.runs.plan import PlannedRun
from lavt.experiment.runs.side_configs import client_config, embedded_router, server_config
from lavt.recording.record import read_record

DRIVING_WITHIN_S = 150.0
UNREAD_S = 3
"""A pipe of one page is full after two seconds of status lines."""
END_LIMIT_S = 15.0
PIPE_BYTES = 4096


@contextmanager
def start_unread(program: str, config: BaseModel, work: Path) -> Iterator[subprocess.Popen[bytes]]:
    """Yield a running program whose standard output and error are small pipes; end it afterwards."""
    path = work / f"{program}.yaml"
    path.write_text(yaml.safe_dump(config.model_dump(mode="json")))
    command = [sys.executable, "-m", "lavt", program, str(path), "--out", str(work / program), "--json"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        for pipe in (process.stdout, process.stderr):
            assert pipe is not None
            fcntl.fcntl(pipe, fcntl.F_SETPIPE_SZ, PIPE_BYTES)
        try:
            yield process
        finally:
            process.kill()


def first_line(stream: IO[bytes] | None) -> Any:
    """Read one line and nothing after it."""
    assert stream is not None
    line = b""
    while not line.endswith(b"\n"):
        line += stream.raw.read(1)  # type: ignore[attr-defined]
    return yaml.safe_load(line)


def is_driving(record: Path) -> bool:
    if not record.is_file():
        return False
    truth = read_record(record, channels=("truth",)).table("truth")
    return len(truth) > 0 and bool(truth.floats("speed_mps")[-1] > 3.0)


def test_signals_end_a_client_and_a_server_whose_output_is_not_read(
    tmp_path: Path,
    planned: Callable[..., PlannedRun],
    wait_until: Callable[[str, Callable[[], bool], float], None],
) -> None:
    """SIGTERM ends a client and a server whose output pipes are full; the client releases the vehicle first."""
    run = planned("vehicle.scenery=none")
    with ExitStack() as stack:
        server = stack.enter_context(start_unread("server", server_config(run.config, run.seed), tmp_path))
        ready = first_line(server.stdout)["ready"]
        ports = {key: ready[key] for key in ("video_port", "probe_port")}
        zenoh = embedded_router(dialled=[next(locator for locator in ready["locators"] if locator.startswith("udp/"))])
        config = client_config(run.config, run.seed, zenoh=zenoh, **ports)
        client = stack.enter_context(start_unread("client", config, tmp_path))
        wait_until("the car drives", lambda: is_driving(tmp_path / "server" / "server.mcap"), DRIVING_WITHIN_S)
        pause(UNREAD_S * NS_PER_S)
        client.send_signal(signal.SIGTERM)
        assert client.wait(END_LIMIT_S) == 0
        server.send_signal(signal.SIGTERM)
        assert server.wait(END_LIMIT_S) == 0
    records = {side: read_record(tmp_path / side / f"{side}.mcap") for side in ("server", "client")}
    assert all(record.complete for record in records.values())
    assert any("release" in detail for detail in records["server"].table("event").texts("detail"))
