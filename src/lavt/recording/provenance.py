"""Where a record comes from: versions and machine. They are annotations of the record and stay out of its digest."""

from __future__ import annotations

import functools
import os
import platform
from collections.abc import Mapping
from importlib.metadata import version

import lavt

LIBRARIES = ("numpy", "opencv-python-headless", "av", "eclipse-zenoh")


@functools.cache  # every run asks, and nothing of it changes
def provenance() -> Mapping[str, Mapping[str, str]]:
    """Give the versions of what computes and the machine that it computes on."""
    return {
        "versions": {"lavt": lavt.__version__, **{each: version(each) for each in LIBRARIES}},
        "machine": {
            "system": platform.platform(),
            "processor": platform.machine(),
            "cores": str(os.cpu_count()),
            "python": platform.python_version(),
        },
    }
