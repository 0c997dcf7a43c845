"""Tests with third-party video tools over real UDP on the loopback."""

from __future__ import annotations

import pytest
from tests.interop.tools import PACKAGES, missing_tools
from tests.require import need


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup() -> None:
    if absent := missing_tools():
        need("gstreamer", f"needs {', '.join(absent)}: apt-get install {' '.join(PACKAGES)}")


@pytest.fixture(autouse=True)
def _own_switch_interval(own_switch_interval: None) -> None:
    """Restore the switch interval, because our runtime runs in this process and sets it."""
