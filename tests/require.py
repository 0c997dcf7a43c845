"""Skip tests whose requirements are missing, or fail them if LAVT_REQUIRE names the requirement."""

from __future__ import annotations

import os
from typing import NoReturn

import pytest


def need(part: str, reason: str) -> NoReturn:
    """Skip the calling test; fail it if LAVT_REQUIRE, a comma-separated list, names the part."""
    required = os.environ.get("LAVT_REQUIRE", "").replace(" ", "").split(",")
    if part in required:
        pytest.fail(f"LAVT_REQUIRE names {part}: {reason}", pytrace=False)
    pytest.skip(reason)
