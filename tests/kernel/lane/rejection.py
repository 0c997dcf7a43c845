"""What ends the lane before it has begun."""

from __future__ import annotations


class Refusal(Exception):
    """The lane cannot run here: one sentence that says what to do."""
