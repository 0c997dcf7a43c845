"""Skip tests whose requirements are missing, or fail them if LAVT_REQUIRE names the requirement."""

from __future__ import annotations

import os
from typing import NoReturn

import pytest


def need(requirement: str, reason: str) -> NoReturn:
    """Skip the calling test; fail it if LAVT_REQUIRE, a comma-separated list, names the requirement."""
    required = os.environ.get("LAVT_REQUIRE", "").replace(" ", "").split(",")
    if requirement in required:
        pytest.fail(f"LAVT_REQUIRE names {requirement}: {reason}", pytrace=False)
    pytest.skip(reason)
