"""Tests of real time and real processes whose machine was held up by other work are run again."""

from __future__ import annotations

import pytest


class HeldUp(Exception):
    """The machine was held up: what a test saw says nothing of what it asks."""


again_where_held_up = pytest.mark.flaky(reruns=7, only_rerun="^HeldUp:")
"""Up to eight times in all, and only after `HeldUp`; the summary says which and why."""
