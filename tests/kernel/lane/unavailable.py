"""The error that is raised if the lane cannot run on this machine."""

from __future__ import annotations


class LaneUnavailable(Exception):
    """The lane cannot run on this machine; the message says what to do."""
