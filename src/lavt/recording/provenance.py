"""The provenance of a record: versions and machine, as annotations, which the digest of the record does not cover."""

from __future__ import annotations

import functools
import os
import platform
from collections.abc import Mapping
from importlib.metadata import version

import lavt

LIBRARIES = ("numpy", "opencv-python-headless", "av", "eclipse-zenoh")


@functools.cache  # the result is constant, and every run needs it
def provenance() -> Mapping[str, Mapping[str, str]]:
    """Return the versions of LAVT and its libraries, and a description of the machine."""
    return {
        "versions": {"lavt": lavt.__version__, **{library: version(library) for library in LIBRARIES}},
        "machine": {
            "system": platform.platform(),
            "processor": platform.machine(),
            "cores": str(os.cpu_count()),
            "python": platform.python_version(),
        },
    }
