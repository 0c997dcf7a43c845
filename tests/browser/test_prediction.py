"""The predictive display in a real page: it is drawn with the setting only, and for the right pictures."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import yaml
from tests.browser.chromium import Browser, Tab, wait_until
from tests.browser.conftest import PersonDrive, drive_off, field

from lavt.experiment.runs.processes import Processes

SETTINGS = ("vehicle.scenery=none", "camera.width_px=320", "camera.height_px=240", "network.condition=L3")
SHAPES = """(() => {
  const {data} = document.querySelector('#picture').getContext('2d').getImageData(0, 0, 320, 240);
  const found = {path: [], stop: []};
  for (let i = 0; i < data.length; i += 4) {
    const [red, green, blue] = data.slice(i, i + 3);
    const row = Math.floor(i / 4 / 320);
    if (blue > red + 30 && blue > green + 10 && row > 130) found.path.push(row);
    if (red > green + 80 && blue > green + 60) found.stop.push(row);
  }
  return Object.fromEntries(Object.entries(found).map(([name, rows]) => [name, [rows.length, Math.min(...rows)]]));
})()"""
"""For path and stopping line, the number of pixels on the canvas with its colour, and the highest row."""


@pytest.fixture
def start(browser: Browser, tmp_path: Path) -> Iterator[Callable[..., PersonDrive]]:
    """Return a function that starts `lavt drive` at L3 with further settings."""
    drives = []
    with Processes(tmp_path) as processes:

        def start(*settings: str) -> PersonDrive:
            options = [option for setting in (*SETTINGS, *settings) for option in ("--set", setting)]
            process = processes.start("drive", "drive", "--no-browser", "--out", str(tmp_path / "out"), *options)
            drives.append(PersonDrive(process, process.wait_ready()["ready"]["console"], browser, tmp_path / "out"))
            return drives[-1]

        try:
            yield start
        finally:
            for drive in drives:
                drive.close()


def drawn(tab: Tab) -> int:
    """Return how many predictions the page has drawn over the pictures that they are for."""
    return int(tab.evaluate("lavtConsole.video.predictionsDrawn"))


def are_on_the_road(shapes: dict[str, list[int]]) -> bool:
    """Return whether both shapes are on the canvas, below the horizon, and the stopping line is beyond the path."""
    (path, path_row), (stop, stop_row) = shapes["path"], shapes["stop"]
    return path > 30 and stop > 30 and 120 < stop_row < path_row


def test_the_prediction_is_drawn_while_the_car_drives(start: Callable[..., PersonDrive]) -> None:
    """With the setting, path and stopping line are on the road while the car drives, and gone when it stops."""
    drive = start("controller.prediction.shown=true")
    tab = drive.open()
    assert drawn(tab) == 0
    drive_off(tab, until=lambda: drawn(tab) > 30 and are_on_the_road(tab.evaluate(SHAPES)))
    assert tab.evaluate("lavtConsole.video.errors") == 0  # also counts predictions over other pictures
    tab.key("Space", down=False)
    wait_until("the car stops", lambda: field(tab, "safety") == "safe_stop")
    wait_until("the shapes are gone", lambda: tab.evaluate(SHAPES)["stop"][0] == 0)
    drive.process.end()
    config = yaml.safe_load((drive.out / "client" / "config.yaml").read_text())
    assert config["controller"]["prediction"]["shown"] is True


def test_without_the_setting_nothing_is_drawn(start: Callable[..., PersonDrive]) -> None:
    """By default, the page draws no prediction, and the record says so."""
    drive = start()
    tab = drive.open()
    drive_off(tab)
    shown = tab.evaluate("lavtConsole.video.shown")
    wait_until("pictures are shown", lambda: tab.evaluate("lavtConsole.video.shown") > shown + 30)
    assert drawn(tab) == 0
    assert tab.evaluate(SHAPES)["stop"][0] == 0
    drive.process.end()
    config = yaml.safe_load((drive.out / "client" / "config.yaml").read_text())
    assert config["controller"]["prediction"]["shown"] is False
