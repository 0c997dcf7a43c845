"""The error that ends the lane before it begins."""

from __future__ import annotations


class LaneUnavailable(Exception):
    """An error that the lane cannot run here; its message says what to do."""
