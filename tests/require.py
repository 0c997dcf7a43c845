"""What a test needs of the machine, and what LAVT_REQUIRE makes of its absence."""

from __future__ import annotations

import os
from typing import NoReturn

import pytest


def need(part: str, reason: str) -> NoReturn:
    """Skip the test that asks; fail it where LAVT_REQUIRE, a list with commas, names the part."""
    required = os.environ.get("LAVT_REQUIRE", "").replace(" ", "").split(",")
    if part in required:
        pytest.fail(f"LAVT_REQUIRE names {part}: {reason}", pytrace=False)
    pytest.skip(reason)
