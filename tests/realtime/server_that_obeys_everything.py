"""`lavt server` without its checks: every command that can be read is obeyed. It shows that the tests of outages can fail."""

from __future__ import annotations

from lavt.cli.main import main
from lavt.control.safety import SafetyGate
from lavt.domain import Command, VehicleState


def no_objection(_gate: SafetyGate, _command: Command, _vehicle: VehicleState, _now_ns: int) -> str:
    return ""


SafetyGate._objection = no_objection  # type: ignore[method-assign]
main()
