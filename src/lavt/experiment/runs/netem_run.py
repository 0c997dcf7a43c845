"""A run on one machine with netem on the loopback interface, whose delay is measured before and after the drive."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from types import TracebackType
from typing import Any

import msgspec

from lavt.assembly.injection import netem_flows
from lavt.experiment.analysis.invalid_reason import InvalidCode, InvalidReason
from lavt.experiment.analysis.validity import injection_reasons
from lavt.experiment.runs.plan import PlannedRun
from lavt.transport.emulation.impairment import ImpairedFlow, Impairment
from lavt.transport.netem.netem import NetemInterface
from lavt.transport.netem.queue_probe import ProbeResult, judge

NETEM = "netem.json"
"""The file in a run directory with the flows that netem was asked to impair, and the measurements before and after the
drive."""
LOOPBACK = "lo"
DISCARD_PORT = 9
"""The port of the discard service (RFC 863), which has no traffic."""


def check_netem(planned: PlannedRun) -> list[str]:
    """Check that netem is available if the run needs it; return messages on what was restored after an earlier crash.

    The check applies netem to an unused port: only this shows whether the process is root, and whether tc and the
    kernel's netem exist. Raises `UserError` if netem is unavailable.
    """
    if not uses_netem(planned):
        return []
    with NetemInterface(LOOPBACK) as netem:
        restored = netem.check()
        netem.apply([ImpairedFlow("video", "udp", DISCARD_PORT, "source", Impairment())])
        return restored


def uses_netem(planned: PlannedRun) -> bool:
    """Return whether netem injects the delay of a run."""
    return planned.config.time == "real" and planned.config.network.injection == "netem"


def restore_abandoned(planned: Iterable[PlannedRun]) -> list[str]:
    """Restore the loopback interface if netem delayed one of these runs, and its process was killed before it could.

    Returns a message for each process whose impairment was found.
    """
    return NetemInterface(LOOPBACK).restore() if any(map(uses_netem, planned)) else []


class NetemRun:
    """A context manager that delays the flows of one run on the loopback interface, and restores the interface at exit.

    On entry, it raises `UserError` if netem is unavailable, before anything is changed.
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
        """Start to delay the flows of the condition, and measure their delay."""
        network = self._network
        self._flows = netem_flows(
            self._requested,
            "both",
            video_port=video_port,
            control_port=control_port,
            state_delay=network.state_delay,
        )
        commands = self._netem.apply(self._flows, condition=network.condition)
        self._report = {
            "restored": self._restored,
            "commands": commands,
            "flows": msgspec.to_builtins(self._flows),
            "before": self._measure(),
        }

    def report(self) -> dict[str, Any]:
        """Measure again, and return the requested flows with all measurements: the content of `netem.json`."""
        after = self._measure()
        return {
            **self._report,
            "after": after,
            "read_back": self._netem.read_back(self._flows) + self._netem.problems(),
        }

    def _measure(self) -> dict[str, Any]:
        return dict(msgspec.to_builtins(self._netem.measure(self._flows)))


def netem_invalid_reasons(report: Mapping[str, Any]) -> list[InvalidReason]:
    """Return a reason for each difference between request and measurement; `report` is the content of `netem.json`."""
    try:
        flows = msgspec.convert(report["flows"], tuple[ImpairedFlow, ...])
        texts = [str(text) for text in report["read_back"]]
        for moment in ("before", "after"):
            measured = msgspec.convert(report[moment], dict[str, ProbeResult])
            texts += [f"{moment} the drive: {text}" for text in judge(flows, (), measured)]
    except (KeyError, msgspec.ValidationError):  # the report has no measurements
        return injection_reasons({"video": 0.0, "control": 0.0}, {})
    return [InvalidReason(InvalidCode.INJECTION_DIFFERS, text) for text in texts]
