from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest

from lavt.config import RunConfig
from lavt.config_file import load_config, shipped
from lavt.errors import UserError
from lavt.experiment.runs.netem_run import NetemRun, netem_reasons
from lavt.experiment.runs.plan import plan_run
from lavt.transport.emulation.impairment import ExemptPort, ImpairedFlow, Impairment
from lavt.transport.netem.netem import NetemInterface
from lavt.transport.netem.probe import ProbeResult, probes
from lavt.transport.netem.state import AppliedState, StateFiles, boot_id, network_namespace, start_ticks
from lavt.transport.netem.tc import Command


class Kernel(NetemInterface):
    """A netem whose tc notes what it is told, and that measures what is asked and `more_ms`."""

    def __init__(self, directory: Path) -> None:
        super().__init__("lo", directory=directory, run=self.told)
        self.commands: list[str] = []
        self.more_ms = 0.0
        self.stopped: list[str] = []

    def told(self, command: Command) -> str:
        """Take a command: the interface has nothing of ours until the root is added."""
        if "show" in command:
            ours = any("add dev lo root" in each for each in self.commands)
            root = {"kind": "prio" if ours else "noqueue", "handle": "4c56:" if ours else "0:", "root": True}
            return "" if "filter" in command else json.dumps([root])
        self.commands.append(" ".join(command))
        return ""

    def measure(
        self, flows: Sequence[ImpairedFlow], *, exempt: Sequence[ExemptPort] = (), count: int = 50
    ) -> dict[str, ProbeResult]:
        """Measure nothing."""
        return {
            each.name: ProbeResult(count, 0, 0, 0, *[each.impairment.delay_ms + self.more_ms] * 3)
            for each in probes(flows, exempt)
        }

    def problems(self) -> list[str]:
        """Doubt what is said to have stopped."""
        return self.stopped

    def read_back(self, flows: Sequence[ImpairedFlow]) -> list[str]:
        """Read nothing back."""
        del flows
        return []


def run_by(kernel: NetemInterface, condition: str) -> NetemRun:
    changes = ["time=real", "network.injection=netem", f"network.condition={condition}"]
    return NetemRun(plan_run(load_config(RunConfig, shipped("configs/demo.yaml"), changes)), kernel)


def test_a_run_holds_its_own_ports_and_leaves_nothing(tmp_path: Path) -> None:
    """The flows of L4 are held at the ports of the run, measured before and after, and deleted at the end."""
    kernel = Kernel(tmp_path)
    with run_by(kernel, "L4") as netem:
        netem.apply(video_port=40_001, control_port=40_002)
        report = json.loads(json.dumps(netem.report()))

    told = "\n".join(kernel.commands)
    assert "match ip sport 40001 0xffff match u8 0x80 0xc0 at 28" in told
    assert "match ip dport 40002 0xffff" in told
    assert kernel.commands[-1] == "tc qdisc del dev lo root"
    assert (report["before"]["video"]["median_ms"], report["after"]["control"]["median_ms"]) == (150, 75)
    assert netem_reasons(report) == []


def test_a_run_that_fails_leaves_nothing(tmp_path: Path) -> None:
    """Whatever ends a run, its queue is deleted."""
    kernel = Kernel(tmp_path)

    def stopped() -> None:
        with run_by(kernel, "L1") as netem:
            netem.apply(video_port=40_001, control_port=40_002)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        stopped()
    assert kernel.commands[-1] == "tc qdisc del dev lo root"


def test_a_run_that_is_rejected_leaves_what_another_holds(tmp_path: Path) -> None:
    """Where another program holds the loopback a run is refused, and that program's queue stays."""
    kernel = Kernel(tmp_path)
    kernel.commands = ["tc qdisc add dev lo root"]
    owner = os.getppid(), start_ticks(os.getppid())
    StateFiles(tmp_path).write(AppliedState("lo", network_namespace(), boot_id(), owner, "L3", ()))
    with pytest.raises(UserError, match="L3 on lo"), kernel, run_by(kernel, "L1"):
        pass
    assert kernel.commands == ["tc qdisc add dev lo root"]


def test_what_was_not_done_as_requested_makes_a_run_invalid(tmp_path: Path) -> None:
    """A delay that is 3 ms longer after the drive is said for each flow, held or not, with when it was measured."""
    kernel = Kernel(tmp_path)
    with run_by(kernel, "L1") as netem:
        netem.apply(video_port=40_001, control_port=40_002)
        kernel.more_ms = 3.0
        report = netem.report()

    assert "after the drive: video was delayed by 78.00 ms instead of 75 ms" in netem_reasons(report)
    assert all(reason.startswith("after the drive: ") for reason in netem_reasons(report))
    kernel.stopped = ["video: its correlated jitter has stopped"]
    assert netem_reasons(netem.report())[0].startswith("video: ")
    assert netem_reasons({**report, "read_back": ["lo has no queue of ours"]})[0] == "lo has no queue of ours"


@pytest.mark.parametrize("report", [{}, {"flows": 3}, {"flows": [], "read_back": [], "before": {"video": {}}}])
def test_a_broken_report_of_netem_is_no_measurement(report: dict[str, Any]) -> None:
    """Where `netem.json` does not tell what was asked and measured, nobody has measured."""
    assert netem_reasons(report) == [
        "nobody measured the injected delay of video",
        "nobody measured the injected delay of control",
    ]


def test_a_flow_that_was_not_measured_is_said() -> None:
    """A flow of the report without a measurement is a reason of its own."""
    flow = ImpairedFlow("video", "udp", 5600, "source", Impairment(75))
    report = {"flows": [asdict(flow)], "read_back": [], "before": {}, "after": {}}
    assert "before the drive: video: no packet came through" in netem_reasons(report)
