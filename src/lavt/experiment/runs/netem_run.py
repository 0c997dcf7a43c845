"""A run on one machine whose delay is the kernel's: netem on the loopback, measured before and after the drive."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from types import TracebackType
from typing import Any

from lavt.assembly.injection import netem_flows
from lavt.experiment.analysis.validity import injection_reasons
from lavt.experiment.runs.plan import PlannedRun
from lavt.transport.emulation.impairment import ImpairedFlow, Impairment
from lavt.transport.netem.netem import NetemInterface
from lavt.transport.netem.probe import ProbeResult, judge
from lavt.transport.netem.state import flows_from

NETEM = "netem.json"
"""In a run directory: what was asked of netem, and what was measured before and after the drive."""
LOOPBACK = "lo"
DISCARD = 9
"""A port that nobody uses (RFC 863)."""


def check_netem(planned: PlannedRun) -> list[str]:
    """Raise `UserError` where a run wants netem and cannot have it; tell what was put back after a crash.

    It is tried, with nothing to hold: whether there are root, tc and a netem in the kernel is not known before.
    """
    if not by_netem(planned):
        return []
    with NetemInterface(LOOPBACK) as netem:
        restored = netem.check()
        netem.apply([ImpairedFlow("video", "udp", DISCARD, "source", Impairment())])
        return restored


def by_netem(planned: PlannedRun) -> bool:
    """Whether netem injects the delay of a run."""
    return planned.config.time == "real" and planned.config.network.injection == "netem"


class NetemRun:
    """Holds the flows of one run on the loopback while it is entered, and leaves the loopback as it was.

    Raises `UserError` before anything is changed where netem cannot be had.
    """

    def __init__(self, planned: PlannedRun, netem: NetemInterface | None = None) -> None:
        self._network = planned.config.network
        self._requested = planned.requested
        self._netem = netem or NetemInterface(LOOPBACK, seed=planned.seed)
        self._flows: list[ImpairedFlow] = []
        self._restored: list[str] = []
        self._report: dict[str, Any] = {}

    def __enter__(self) -> NetemRun:
        self._restored = self._netem.check()
        return self

    def __exit__(
        self, _kind: type[BaseException] | None, _error: BaseException | None, _trace: TracebackType | None
    ) -> None:
        self._netem.clear()

    def apply(self, *, video_port: int, control_port: int) -> None:
        """Hold the flows of the condition from now on, and measure what happens to them."""
        network = self._network
        self._flows = netem_flows(
            self._requested, "both", video_port=video_port, control_port=control_port,
            state_delay=network.state_delay,
        )  # fmt: skip
        commands = self._netem.apply(self._flows, condition=network.condition)
        self._report = {
            "restored": self._restored,
            "commands": commands,
            "flows": [asdict(flow) for flow in self._flows],
            "before": self._measured(),
        }

    def report(self) -> dict[str, Any]:
        """Measure again, and tell what was asked and what was measured: the content of `netem.json`."""
        after = self._measured()
        return {
            **self._report,
            "after": after,
            "read_back": self._netem.read_back(self._flows) + self._netem.problems(),
        }

    def _measured(self) -> dict[str, Any]:
        return {name: asdict(each) for name, each in self._netem.measure(self._flows).items()}


def netem_reasons(report: Mapping[str, Any]) -> list[str]:
    """Compare what netem did with what was asked of it (the content of `netem.json`), in sentences."""
    try:
        flows = flows_from(report["flows"])
        reasons = [str(each) for each in report["read_back"]]
        for when in ("before", "after"):
            measured = {name: ProbeResult(**each) for name, each in report[when].items()}
            reasons += [f"{when} the drive: {reason}" for reason in judge(flows, (), measured)]
    except (KeyError, TypeError, AttributeError):
        return injection_reasons({"video": 0.0, "control": 0.0}, {})
    return reasons
