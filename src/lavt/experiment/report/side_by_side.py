"""The results of several sweeps side by side, as text for a terminal: a line for each route and condition."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import fmean
from typing import Any, Final

NOTHING: Final = "-"

Results = Sequence[Mapping[str, Any]]
"""The contents of `result.json` files."""


def side_by_side(sweeps: Mapping[str, Results]) -> list[str]:
    """Return a table: for each route and condition the completed runs and the mean P95 of each sweep.

    The last column has the largest difference of the mean P95 from the first sweep (m). P95 is the 95th percentile of a
    run's absolute cross-track error; runs without one are left out of its mean.
    """
    keys = sorted({(str(run["route"]), str(run["condition"])) for runs in sweeps.values() for run in runs})
    header = ["route", "condition"]
    for name in sweeps:
        header += [f"{name}: completed", "P95 (m)"]
    rows = [[*header, "difference (m)"]]
    for route, condition in keys:
        row, means_m = [Path(route).stem, condition], []
        for runs in sweeps.values():
            own = [run for run in runs if (str(run["route"]), str(run["condition"])) == (route, condition)]
            errors_m = [run["p95_m"] for run in own if run["p95_m"] is not None]
            means_m.append(fmean(errors_m) if errors_m else None)
            completed = sum(run["ending"] == "completed" for run in own)
            row += [f"{completed} of {len(own)}", NOTHING if means_m[-1] is None else f"{means_m[-1]:.3f}"]
        rows.append([*row, _difference(means_m)])
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    return ["  ".join(text.ljust(width) for text, width in zip(row, widths, strict=True)).rstrip() for row in rows]


def _difference(means_m: Sequence[float | None]) -> str:
    """Return the difference from the first mean that is largest in absolute value, with its sign."""
    first = means_m[0]
    differences_m = [] if first is None else [mean - first for mean in means_m[1:] if mean is not None]
    return f"{max(differences_m, key=abs):+.3f}" if differences_m else NOTHING
