"""A page that floods the console while it, or another page, drives."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from benchmarks.pages.floods import PING, TEXT, flooding, frame
from benchmarks.pages.python_page import PythonPage
from tests.support.stalls import LONG_STALL_MS, Stalls

from lavt.clock import MachineClock, pause
from lavt.control.human_controls import HUMAN_LIMITS
from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.experiment.runs.processes import Process, Processes
from lavt.recording.record import read_record
from lavt.transport.console.site import TOO_MANY_MESSAGES

SETTINGS = ("vehicle.scenery=none", "camera.width_px=320", "camera.height_px=240")
FLOOD_NS = 3 * NS_PER_S
SENDING_NS = 50 * NS_PER_MS
"""From the decision for a command to its record, on a machine that is not stalled."""
Wait = Callable[[str, Callable[[], bool], float], None]


class FloodedDrive:
    """A running `lavt drive` with its record."""

    def __init__(self, process: Process, out: Path) -> None:
        self.process, self.out = process, out
        self.url: str = process.wait_ready()["ready"]["console"]

    def end(self) -> None:
        """End the drive, so that its records are complete."""
        self.process.end()
        assert self.process.popen.returncode == 0


@pytest.fixture
def flooded_drive(tmp_path: Path) -> Iterator[FloodedDrive]:
    settings = [word for setting in SETTINGS for word in ("--set", setting)]
    with Processes(tmp_path) as processes:
        out = tmp_path / "out"
        yield FloodedDrive(processes.start("drive", "drive", "--no-browser", "--out", str(out), *settings), out)


@pytest.mark.parametrize("kind", ["inputs", "pings"])
def test_a_page_that_drives_and_floods_stops_the_vehicle(
    flooded_drive: FloodedDrive, wait_until: Wait, stalls: Stalls, kind: str
) -> None:
    """The vehicle stops by its own stages, and no command is made from inputs that the flood has delayed."""
    page = PythonPage(flooded_drive.url)
    page.arm()
    page.throttle = 1.0
    wait_until("the car drives", lambda: (page.status["speed_mps"] or 0) > 2, 30)
    watching = PythonPage(flooded_drive.url)
    wait_until("the other page has a status", lambda: bool(watching.status), 30)
    page.be_silent()
    since_ns = MachineClock().now().mono_ns
    with suppress(OSError):  # the console reads only a part
        page.connection.socket.sendall((frame(TEXT, page.input()) if kind == "inputs" else frame(PING)) * 20_000)
    assert page.wait_closed() == TOO_MANY_MESSAGES
    wait_until("the vehicle has stopped", lambda: watching.status["safety"] == "safe_stop", 10)
    wait_until("the car is stationary", lambda: abs(watching.status["speed_mps"]) < 0.05, 30)
    watching.close()
    flooded_drive.end()
    commands = read_record(flooded_drive.out / "client" / "client.mcap").table("control")
    last_ns = int(commands.mono_ns[np.array(commands.texts("mode")) == "drive"].max())
    with stalls.excusing_failures(since_ns, stall_ms=LONG_STALL_MS):
        limit_ns = HUMAN_LIMITS.input_age_ns + HUMAN_LIMITS.input_timeout_ns + SENDING_NS
        assert last_ns - since_ns < limit_ns
    safety = read_record(flooded_drive.out / "server" / "server.mcap").table("state").texts("safety")
    stages = [state for state, before in zip(safety, ["", *safety], strict=False) if state != before]
    assert stages[-1] == "safe_stop"
    with stalls.excusing_failures(since_ns, stall_ms=LONG_STALL_MS):  # a stalled server is not degraded in between
        assert stages[-3:] == ["driving", "degraded", "safe_stop"]


@pytest.mark.parametrize("attack", ["empty pings", "new pages"])
def test_another_page_drives_on(flooded_drive: FloodedDrive, stalls: Stalls, attack: str) -> None:
    """While a hostile page with the token floods the console, the car stays armed, and commands are in time."""
    page = PythonPage(flooded_drive.url)
    page.arm()
    since_ns = MachineClock().now().mono_ns
    with flooding(flooded_drive.url, attack):
        pause(FLOOD_NS)
    until_ns = MachineClock().now().mono_ns
    safety = page.status["safety"]
    page.close()
    flooded_drive.end()
    times_ns = read_record(flooded_drive.out / "client" / "client.mcap").table("control").mono_ns
    during_ns = times_ns[(times_ns > since_ns) & (times_ns < until_ns)]
    with stalls.excusing_failures(since_ns, stall_ms=LONG_STALL_MS):
        assert safety == "driving"
        assert np.diff(during_ns).max() < 200 * NS_PER_MS
