"""LAVT: a testbed that measures how network latency affects vision-based teleoperation."""

__version__ = "0.1.0"
