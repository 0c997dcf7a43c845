"""Run `lavt server` without its checks of commands, to show that the tests of outages can fail."""

from __future__ import annotations

from unittest.mock import patch

from lavt.cli.main import main
from lavt.safety.gate import SafetyGate
from lavt.safety.issued_stamps import IssuedStamps


def no_rejection_reason(*_: object) -> str:
    return ""


def number_or_oldest(issued: IssuedStamps, stamp_ns: int) -> int:
    """Return the number of a recent frame, or -1, older than all others, for an unknown stamp."""
    return issued._written.get(stamp_ns, (-1, 0))[0]


with (
    patch.object(SafetyGate, "rejection_reason", no_rejection_reason),
    patch.object(IssuedStamps, "number", number_or_oldest),
):
    main()
