"""Tests of `benchmarks/boundary_map.py`."""

from __future__ import annotations

from pathlib import Path

import pytest
from benchmarks.boundary_map import Cell, Onset, draw_map, read_onsets, search_cells, table_row

from lavt.experiment.boundary.boundary import theoretical_ms

CELLS = [Cell(lag_ms, 30.0, rate_hz, "paper_calibrated", 1) for rate_hz in (15.0, 30.0) for lag_ms in (50.0, 120.0)]


def onset_of(cell: Cell) -> Onset:
    """Return an onset as a search finds it; the cell of 15 Hz and 120 ms is below the searched range."""
    outside = "below" if (cell.rate_hz, cell.lag_ms) == (15.0, 120.0) else ""
    return Onset(cell.lag_ms, cell.speed_kmh, cell.rate_hz, 200.0, None if outside else 201.5, outside)


def test_an_interrupted_map_continues_where_it_was(tmp_path: Path) -> None:
    """The cells of an earlier search are read from the CSV, and only the others are searched."""
    first = search_cells(CELLS[:3], tmp_path, jobs=1, search=onset_of)
    searched = []

    def search(cell: Cell) -> Onset:
        searched.append(cell)
        return onset_of(cell)

    assert search_cells(CELLS, tmp_path, jobs=1, search=search) == [*first, onset_of(CELLS[3])]
    assert searched == CELLS[3:]
    assert read_onsets(tmp_path / "boundary_map.csv") == [onset_of(cell) for cell in CELLS]


def test_a_row_that_was_cut_off_is_searched_again(tmp_path: Path) -> None:
    """If the program was ended while it wrote a row, the row's cell is searched again."""
    search_cells(CELLS, tmp_path, jobs=1, search=onset_of)
    path = tmp_path / "boundary_map.csv"
    path.write_bytes(path.read_bytes()[:-12])
    assert search_cells(CELLS, tmp_path, jobs=1, search=onset_of) == [onset_of(cell) for cell in CELLS]
    assert read_onsets(path) == [onset_of(cell) for cell in CELLS]


def test_cells_of_other_settings_are_not_continued(tmp_path: Path) -> None:
    """A directory with cells of another seed is refused."""
    search_cells(CELLS, tmp_path, jobs=1, search=onset_of)
    with pytest.raises(SystemExit, match="other settings"):
        search_cells([Cell(50.0, 30.0, 15.0, "paper_calibrated", 2)], tmp_path, jobs=1, search=onset_of)


def test_a_cell_drives_its_lag_speed_and_rate() -> None:
    """A cell's config has its lag, speed and rate, and so its theoretical margin: more lag, less margin."""
    config = CELLS[0].config()
    assert (config.vehicle.steering_lag_ms, config.camera.rate_hz) == (50.0, 15.0)
    assert config.controller.speed_mps == pytest.approx(30 / 3.6, abs=1e-4)
    margins_ms = [theoretical_ms(cell.config()) for cell in CELLS[:2]]
    assert margins_ms[0] is not None
    assert margins_ms[1] is not None
    assert margins_ms[0] > margins_ms[1] + 30


def test_the_map_has_a_panel_for_each_rate_and_kind(tmp_path: Path) -> None:
    """The map draws measurement above theory, one column for each rate, and a dash where no onset was found."""
    figure = draw_map(search_cells(CELLS, tmp_path, jobs=1, search=onset_of))
    titles = [axes.get_title(loc="left") for axes in figure.axes]
    assert titles[:4] == ["measured, 15 Hz", "measured, 30 Hz", "theory, 15 Hz", "theory, 30 Hz"]
    assert [text.get_text() for text in figure.axes[0].texts] == ["202", "–"]


def test_a_cell_outside_the_searched_range_has_no_difference() -> None:
    """A row says on which side of the searched range an onset is."""
    assert table_row(onset_of(CELLS[1])) == "| 120 ms | 30 km/h | 15 Hz | 200.0 ms | below | – |"
    assert table_row(onset_of(CELLS[0])) == "| 50 ms | 30 km/h | 15 Hz | 200.0 ms | 201.5 ms | +1.5 ms |"
