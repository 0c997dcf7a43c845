"""Regenerate the marked blocks of docs/safety.md from the code: python docs/draw_safety.py."""

from __future__ import annotations

from pathlib import Path

from lavt.safety.safety_page import draw_page

PAGE = Path(__file__).with_name("safety.md")

if __name__ == "__main__":
    PAGE.write_text(draw_page(PAGE.read_text()))
