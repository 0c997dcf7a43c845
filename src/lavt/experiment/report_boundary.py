"""The section of a report that shows what `lavt boundary` found."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any


def boundary_parts(boundaries: Sequence[Mapping[str, Any]], report_dir: Path) -> list[str]:
    """Show each boundary, the contents of a `boundary.json`, as a figure and a table."""
    return []
