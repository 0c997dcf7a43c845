"""Map the onset of growing oscillations over steering lag, speed and frame rate, beside the theoretical delay margin.

    python -m benchmarks.boundary_map [--out out/boundary_map] [--jobs 1] [--picture docs/pictures/boundary_map.png]

The loop computes one command from each frame, so the frame rate is the control rate. Each cell of the grid is a search
on a straight road in virtual time, with geometry fidelity, the inherent latency `loopback` and a constant delay of the
video, as in `benchmarks/growth_onset.py`. Each finished cell is appended to `boundary_map.csv`; a program that was
interrupted continues there. `docs/boundary.md` has the output.
"""

from __future__ import annotations

import argparse
import csv
import itertools
import json
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from benchmarks.growth_onset import onset_bracket, onset_ms
from matplotlib.figure import Figure

from lavt.config import RunConfig
from lavt.config_file import load_config, shipped
from lavt.experiment.boundary.boundary import theoretical_ms
from lavt.experiment.report.table_format import NOTHING

LAGS_MS = (50.0, 120.0, 200.0, 270.0)
"""Steering lags: the ends of the range of published by-wire cars, the simulated car's lag, and one in between."""
SPEEDS_KMH = (20.0, 30.0, 50.0, 80.0)
RATES_HZ = (15.0, 30.0, 60.0)
COLUMNS = ("lag_ms", "speed_kmh", "rate_hz", "theory_ms", "measured_ms", "outside")
SETTINGS = "settings.json"
"""The file next to the CSV that has the settings of all cells, so that no cell of another search is continued."""


@dataclass(frozen=True, slots=True)
class Cell:
    """One cell of the grid."""

    lag_ms: float
    speed_kmh: float
    rate_hz: float
    preset: str
    seed: int

    def config(self) -> RunConfig:
        """Return the config of the cell's drives, with limits so wide that none depends on the delay."""
        changes = [
            "fidelity=geometry",
            f"seed={self.seed}",
            f"controller.preset={self.preset}",
            f"controller.speed_mps={self.speed_kmh / 3.6:.4f}",
            f"camera.rate_hz={self.rate_hz}",
            f"vehicle.steering_lag_ms={self.lag_ms}",
            "safety.picture_age_limit_ms=2000",
            "safety.stopping_distance_limit_m=200",
            "safety.lateral_acceleration_mps2=6.0",
            "safety.speed_limit_mps=22.3",
        ]
        return load_config(RunConfig, shipped("configs/demo.yaml"), changes)


@dataclass(frozen=True, slots=True)
class Onset:
    """The delays of one cell, one row of the CSV."""

    lag_ms: float
    speed_kmh: float
    rate_hz: float
    theory_ms: float | None
    measured_ms: float | None
    outside: str
    """`below` if the oscillation grows without added delay, `beyond` if it does not at the longest; else empty."""


def search_cell(cell: Cell) -> Onset:
    """Find the onset of one cell."""
    config = cell.config()
    theory_ms = theoretical_ms(config)
    bracket = onset_bracket(config, theory_ms)
    outside = "below" if bracket.low_ms is None else "beyond" if bracket.high_ms is None else ""
    return Onset(cell.lag_ms, cell.speed_kmh, cell.rate_hz, theory_ms, onset_ms(bracket), outside)


def read_onsets(path: Path) -> list[Onset]:
    """Return the complete rows of a CSV; none if it does not exist."""
    if not path.exists():
        return []
    lines = [line for line in path.read_text().splitlines(keepends=True) if line.endswith("\n")]

    def number(text: str) -> float | None:
        return float(text) if text else None

    return [
        Onset(
            float(row["lag_ms"]),
            float(row["speed_kmh"]),
            float(row["rate_hz"]),
            number(row["theory_ms"]),
            number(row["measured_ms"]),
            row["outside"],
        )
        for row in csv.DictReader(lines)
    ]


def search_cells(
    cells: Sequence[Cell], out: Path, *, jobs: int, search: Callable[[Cell], Onset] = search_cell
) -> list[Onset]:
    """Search all cells that `boundary_map.csv` in `out` does not have yet, append them in order, and return all rows.

    Raises `SystemExit` if `out` has cells that were searched with another preset or seed.
    """
    out.mkdir(parents=True, exist_ok=True)
    path, settings = out / "boundary_map.csv", {"preset": cells[0].preset, "seed": cells[0].seed}
    if (out / SETTINGS).exists() and json.loads((out / SETTINGS).read_text()) != settings:
        raise SystemExit(f"{out} has a search with other settings: choose another directory")
    (out / SETTINGS).write_text(json.dumps(settings))
    found = {(onset.lag_ms, onset.speed_kmh, onset.rate_hz): onset for onset in read_onsets(path)}
    todo = [cell for cell in cells if (cell.lag_ms, cell.speed_kmh, cell.rate_hz) not in found]
    with path.open("w", newline="") as file:  # a row that was cut off is left out
        writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows(asdict(onset) for onset in found.values())
        file.flush()

        def keep(onset: Onset) -> None:
            found[onset.lag_ms, onset.speed_kmh, onset.rate_hz] = onset
            writer.writerow(asdict(onset))
            file.flush()
            print(table_row(onset), flush=True)

        if jobs == 1:
            for cell in todo:
                keep(search(cell))
        else:
            with ProcessPoolExecutor(jobs) as executor:
                for onset in executor.map(search, todo):
                    keep(onset)
    return [found[cell.lag_ms, cell.speed_kmh, cell.rate_hz] for cell in cells]


def table_row(onset: Onset) -> str:
    """Return the Markdown row of one cell, with a dash for each value that does not exist."""
    theory_ms, measured_ms = onset.theory_ms, onset.measured_ms
    difference_ms = None if theory_ms is None or measured_ms is None else measured_ms - theory_ms
    cells = [
        f"{onset.lag_ms:g} ms",
        f"{onset.speed_kmh:g} km/h",
        f"{onset.rate_hz:g} Hz",
        NOTHING if theory_ms is None else f"{theory_ms:.1f} ms",
        onset.outside or f"{measured_ms:.1f} ms",
        NOTHING if difference_ms is None else f"{difference_ms:+.1f} ms",
    ]
    return f"| {' | '.join(cells)} |"


def draw_map(onsets: Sequence[Onset]) -> Figure:
    """Draw the measured onset (upper row) and the theoretical delay margin (lower row), one column for each rate."""
    lags, speeds, rates = (sorted({getattr(onset, name) for onset in onsets}) for name in COLUMNS[:3])
    values = {(onset.lag_ms, onset.speed_kmh, onset.rate_hz): onset for onset in onsets}
    known = [ms for onset in onsets for ms in (onset.theory_ms, onset.measured_ms) if ms is not None]
    figure = Figure(figsize=(3.4 * len(rates) + 1.2, 6.6), dpi=100, layout="constrained")
    grid = figure.subplots(2, len(rates), squeeze=False, sharex=True, sharey=True)
    for column, rate_hz in enumerate(rates):
        for row, (name, title) in enumerate((("measured_ms", "measured"), ("theory_ms", "theory"))):
            axes = grid[row][column]
            cells = [[getattr(values[lag, speed, rate_hz], name) for lag in lags] for speed in speeds]
            shown = np.array([[np.nan if ms is None else ms for ms in line] for line in cells])
            image = axes.imshow(shown, origin="lower", cmap="viridis", vmin=min(known), vmax=max(known), aspect="auto")
            for y, x in itertools.product(range(len(speeds)), range(len(lags))):
                text = NOTHING if cells[y][x] is None else f"{cells[y][x]:.0f}"
                dark = cells[y][x] is not None and cells[y][x] < (min(known) + max(known)) / 2
                axes.text(x, y, text, ha="center", va="center", color="white" if dark else "black")
            axes.set_xticks(range(len(lags)), [f"{lag:g}" for lag in lags])
            axes.set_yticks(range(len(speeds)), [f"{speed:g}" for speed in speeds])
            axes.set_title(f"{title}, {rate_hz:g} Hz", fontsize=10, loc="left")
    for axes in grid[1]:
        axes.set_xlabel("steering lag / ms")
    for axes in grid[:, 0]:
        axes.set_ylabel("speed / (km/h)")
    figure.colorbar(image, ax=grid, label="total delay at the onset / ms")
    return figure


def main() -> None:
    """Search the grid, print it as a Markdown table, and draw the map."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name, default in (("lags", LAGS_MS), ("speeds", SPEEDS_KMH), ("rates", RATES_HZ)):
        parser.add_argument(
            f"--{name}", type=lambda text: [float(item) for item in text.split(",")], default=list(default)
        )
    parser.add_argument("--preset", default="paper_calibrated")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("out/boundary_map"))
    parser.add_argument("--picture", type=Path, default=None, help="default: boundary_map.png in --out")
    options = parser.parse_args()
    cells = [
        Cell(lag_ms, speed_kmh, rate_hz, options.preset, options.seed)
        for rate_hz, speed_kmh, lag_ms in itertools.product(options.rates, options.speeds, options.lags)
    ]
    print("| steering lag | speed | frame rate | theory | measured | difference |")
    print("|---" * 6 + "|")
    onsets = search_cells(cells, options.out, jobs=options.jobs)
    differences_ms = [
        onset.measured_ms - onset.theory_ms
        for onset in onsets
        if onset.measured_ms is not None and onset.theory_ms is not None
    ]
    if differences_ms:
        largest_ms, mean_ms = max(map(abs, differences_ms)), float(np.mean(differences_ms))
        print(f"\n{len(differences_ms)} cells: largest difference {largest_ms:.1f} ms, mean {mean_ms:+.1f} ms")
    picture: Path = options.picture or options.out / "boundary_map.png"
    picture.parent.mkdir(parents=True, exist_ok=True)
    draw_map(onsets).savefig(picture)
    print(f"{picture}: {picture.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
