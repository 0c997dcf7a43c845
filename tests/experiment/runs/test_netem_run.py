from __future__ import annotations

import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec
import pytest

from lavt.config import RunConfig
from lavt.config_file import load_config, shipped
from lavt.errors import UserError
from lavt.experiment.analysis.invalid_reason import not_measured
from lavt.experiment.runs.netem_run import NetemRun, netem_invalid_reasons
from lavt.experiment.runs.plan import plan_run
from lavt.transport.emulation.impairment import ExemptPort, ImpairedFlow, Impairment
from lavt.transport.netem.netem import NetemInterface
from lavt.transport.netem.queue_probe import ProbeResult, queue_probes
from lavt.transport.netem.state import AppliedState, StateFiles, boot_id, network_namespace, start_ticks
from lavt.transport.netem.tc import Command


class FakeNetemInterface(NetemInterface):
    """A netem interface that records the commands of tc, and measures the requested delay plus `added_ms`."""

    def __init__(self, directory: Path) -> None:
        super().__init__("lo", directory=directory, run=self.record)
        self.commands: list[str] = []
        self.added_ms = 0.0
        self.stopped_jitter_messages: list[str] = []

    def record(self, command: Command) -> str:
        """Record a command; the interface has no root queue of ours until one is added."""
        if "show" in command:
            has_our_root = any("add dev lo root" in recorded_command for recorded_command in self.commands)
            root = {
                "kind": "prio" if has_our_root else "noqueue",
                "handle": "4c56:" if has_our_root else "0:",
                "root": True,
            }
            return "" if "filter" in command else json.dumps([root])
        self.commands.append(" ".join(command))
        return ""

    def measure(
        self, flows: Sequence[ImpairedFlow], *, exempt: Sequence[ExemptPort] = (), count: int = 50
    ) -> dict[str, ProbeResult]:
        """Return the requested delays plus `added_ms`."""
        return {
            probe.name: self._probe_result(count, probe.impairment.delay_ms + self.added_ms)
            for probe in queue_probes(flows, exempt)
        }

    def _probe_result(self, count: int, delay_ms: float) -> ProbeResult:
        percentiles = {"p5_ms": delay_ms, "median_ms": delay_ms, "p95_ms": delay_ms}
        # `early` counts packets that netem sent at once, to reorder them.
        return ProbeResult(sent=count, lost=0, reordered=0, early=0, **percentiles)

    def problems(self) -> list[str]:
        """Return the messages about correlated jitter that has stopped."""
        return self.stopped_jitter_messages

    def read_back(self, flows: Sequence[ImpairedFlow]) -> list[str]:
        """Return no differences."""
        del flows
        return []


def netem_run(interface: NetemInterface, condition: str) -> NetemRun:
    changes = ["time=real", "network.injection=netem", f"network.condition={condition}"]
    return NetemRun(plan_run(load_config(RunConfig, shipped("configs/demo.yaml"), changes)), interface)


def test_a_run_delays_its_own_ports_and_cleans_up(tmp_path: Path) -> None:
    """A run delays the flows of L4 at its ports, measures them before and after the drive, and deletes its queue."""
    interface = FakeNetemInterface(tmp_path)
    with netem_run(interface, "L4") as netem:
        netem.apply(video_port=40_001, control_port=40_002)
        report = json.loads(json.dumps(netem.report()))

    commands = "\n".join(interface.commands)
    assert "match ip sport 40001 0xffff match u8 0x80 0xc0 at 28" in commands
    assert "match ip dport 40002 0xffff" in commands
    assert interface.commands[-1] == "tc qdisc del dev lo root"
    assert (report["before"]["video"]["median_ms"], report["after"]["control"]["median_ms"]) == (150, 75)
    assert netem_invalid_reasons(report) == []


def test_an_interrupted_run_cleans_up(tmp_path: Path) -> None:
    """The queue of a run is deleted even if the run is interrupted."""
    interface = FakeNetemInterface(tmp_path)

    def interrupted_run() -> None:
        with netem_run(interface, "L1") as netem:
            netem.apply(video_port=40_001, control_port=40_002)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted_run()
    assert interface.commands[-1] == "tc qdisc del dev lo root"


def test_a_rejected_run_keeps_the_queue_of_another_owner(tmp_path: Path) -> None:
    """If another program has already added a queue to the loopback, the run is rejected, and this queue remains."""
    interface = FakeNetemInterface(tmp_path)
    interface.commands = ["tc qdisc add dev lo root"]
    owner = os.getppid(), start_ticks(os.getppid())
    StateFiles(tmp_path).write(AppliedState("lo", network_namespace(), boot_id(), owner, "L3", ()))
    with pytest.raises(UserError, match="L3 on lo"), interface, netem_run(interface, "L1"):
        pass
    assert interface.commands == ["tc qdisc add dev lo root"]


def test_a_delay_that_differs_from_the_request_makes_the_run_invalid(tmp_path: Path) -> None:
    """A delay that is 3 ms too long after the drive makes the run invalid; the reason begins with "after the drive".

    Correlated jitter that has stopped and a missing queue make a run invalid, too.
    """
    interface = FakeNetemInterface(tmp_path)
    with netem_run(interface, "L1") as netem:
        netem.apply(video_port=40_001, control_port=40_002)
        interface.added_ms = 3.0
        report = netem.report()

    assert all(reason.text.startswith("after the drive: ") for reason in netem_invalid_reasons(report))
    assert any("video was delayed by 78.00 ms" in reason.text for reason in netem_invalid_reasons(report))
    interface.stopped_jitter_messages = ["video: its correlated jitter has stopped"]
    assert netem_invalid_reasons(netem.report())[0].text.startswith("video: ")
    assert (
        netem_invalid_reasons({**report, "read_back": ["lo has no queue of ours"]})[0].text == "lo has no queue of ours"
    )


@pytest.mark.parametrize("report", [{}, {"flows": 3}, {"flows": [], "read_back": [], "before": {"video": {}}}])
def test_delays_of_an_invalid_netem_report_are_not_measured(report: dict[str, Any]) -> None:
    """With an invalid `netem.json`, a run is invalid because the injected delay of each flow was not measured."""
    for reason, flow in zip(netem_invalid_reasons(report), ("video", "control"), strict=True):
        assert reason == not_measured(flow)


def test_a_flow_without_a_measurement_makes_the_run_invalid() -> None:
    """A flow of the report without a measurement makes a run invalid."""
    flow = ImpairedFlow("video", "udp", 5600, "source", Impairment(delay_ms=75))
    report = {"flows": msgspec.to_builtins([flow]), "read_back": [], "before": {}, "after": {}}
    assert "before the drive: video: no packet came through" in {
        reason.text for reason in netem_invalid_reasons(report)
    }
