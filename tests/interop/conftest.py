"""Tests against video tools that nobody here wrote, over real UDP on the loopback."""

from __future__ import annotations

import sys
from collections.abc import Iterator

import pytest
from tests.interop.tools import PACKAGES, missing
from tests.require import need


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup() -> None:
    if absent := missing():
        need("gstreamer", f"needs {', '.join(absent)}: apt-get install {' '.join(PACKAGES)}")


@pytest.fixture(autouse=True)
def switch_interval() -> Iterator[None]:
    """Put back what our runtime sets for its process."""
    before = sys.getswitchinterval()
    yield
    sys.setswitchinterval(before)
