"""How the page draws pictures: those in memory are converted and put on the canvas, others are drawn by the browser."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import pytest
from tests.browser.chromium import Browser, Tab
from tests.browser.fake_client import FakeClient, wait_until_loaded

ROUNDING = 2
"""Levels of 255 by which two conversions of a colour may differ."""
PAINT = """(async (formats, colorSpace, setUp) => {
  const { Painter } = await import("/painter.js");
  const size = { codedWidth: 64, codedHeight: 48 };
  const context = new OffscreenCanvas(2, 2).getContext("2d", { alpha: false });
  const pictures = formats.map((format, timestamp) => {
    const isPacked = format !== "I420"; // the fourth byte of a pixel must be opaque
    const level = (at) => (isPacked && at % 4 === 3 ? 255 : (40 * timestamp + at * 7) % 251);
    const data = new Uint8Array(64 * 48 * (isPacked ? 4 : 1.5)).map((_, at) => level(at));
    return new VideoFrame(data, { format, timestamp, colorSpace, ...size });
  });
  const way = setUp(context, pictures);
  const painter = new Painter(context);
  await Promise.all(pictures.map((picture) => painter.paint(picture)));
  const { width, height } = context.canvas;
  const painted = [...context.getImageData(0, 0, width, height).data];
  context.drawImage(pictures.at(-1), 0, 0);
  const drawn = [...context.getImageData(0, 0, width, height).data];
  pictures.forEach((picture) => picture.close());
  return { width, height, difference: Math.max(...painted.map((value, at) => Math.abs(value - drawn[at]))), way };
})"""
COUNT_WAYS = """(context) => {
  const way = [];
  for (const name of ["drawImage", "putImageData"]) {
    const draw = context[name].bind(context);
    context[name] = (...values) => { way.push(name); draw(...values); };
  }
  return way;
}"""


@pytest.fixture
def tab(browser: Browser) -> Iterator[Tab]:
    client = FakeClient()
    tab = browser.open(client.url)
    try:
        wait_until_loaded(tab, client)
        yield tab
    finally:
        browser.close_tab(tab)
        client.close()


def paint(
    tab: Tab, formats: list[str], matrix: str = "bt709", *, full_range: bool = False, set_up: str = COUNT_WAYS
) -> Any:
    """Paint pictures at once, and return how, and how much the last differs from that of `drawImage`."""
    colours = {"matrix": matrix, "primaries": "bt709", "transfer": "bt709", "fullRange": full_range}
    return tab.evaluate(f"{PAINT}({json.dumps(formats)}, {json.dumps(colours)}, {set_up})")


@pytest.mark.parametrize("full_range", [False, True])
@pytest.mark.parametrize("matrix", ["bt709", "smpte170m"])
def test_a_picture_in_memory_has_the_right_colours(tab: Tab, matrix: str, *, full_range: bool) -> None:
    """A picture of a decoder in software is put on the canvas with the colours that the browser would draw."""
    painted = paint(tab, ["I420"], matrix, full_range=full_range)
    assert (painted["width"], painted["height"]) == (64, 48)
    assert painted["way"] == ["putImageData", "drawImage"]  # the last is the comparison of `PAINT`
    assert painted["difference"] <= ROUNDING


def test_pictures_are_drawn_in_their_order(tab: Tab) -> None:
    """Of several pictures, of which some must be converted, the last stays."""
    painted = paint(tab, ["I420", "BGRX", "I420", "I420", "RGBX"])
    assert painted["way"] == ["putImageData", "drawImage", "putImageData", "putImageData", "drawImage", "drawImage"]
    assert painted["difference"] == 0
    assert paint(tab, ["RGBX", "I420", "BGRX", "I420"])["difference"] <= ROUNDING


@pytest.mark.parametrize("size", ["() => 64 * 48 * 1.5", "() => { throw new DOMException('', 'NotSupportedError'); }"])
def test_a_browser_that_does_not_convert_draws(tab: Tab, size: str) -> None:
    """In a browser that ignores the format for a copy, or rejects it, the browser draws the picture."""
    set_up = f"(context, [picture]) => {{ picture.allocationSize = {size}; return ({COUNT_WAYS})(context); }}"
    painted = paint(tab, ["I420"], set_up=set_up)
    assert (painted["way"], painted["difference"]) == (["drawImage", "drawImage"], 0)
