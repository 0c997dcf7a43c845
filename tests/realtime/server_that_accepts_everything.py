"""`lavt server` without command checks: it accepts every readable command, so that the outage tests can fail."""

from __future__ import annotations

from unittest.mock import patch

from lavt.cli.main import main
from lavt.safety.gate import SafetyGate
from lavt.safety.issued_stamps import IssuedStamps


def accept(*_: object) -> None:
    """Return no rejection reason."""


def number_if_known(issued_stamps: IssuedStamps, stamp_ns: int) -> int:
    """Return the frame number of a known stamp; for another stamp -1, which is older than all frames."""
    frame = issued_stamps._issued.get(stamp_ns)
    return -1 if frame is None else frame.number


with (
    patch.object(SafetyGate, "rejection_reason", accept),
    patch.object(IssuedStamps, "frame_number", number_if_known),
):
    main()
