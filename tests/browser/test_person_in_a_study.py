from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from tests.browser.chromium import Browser, Tab, wait_until
from tests.browser.conftest import ATTEMPTS, field, press, release, repeat_keys, status

from lavt.config_file import shipped
from lavt.experiment.study.answers import read_answers

SETTINGS = (
    "controller.kind=human",
    "time=real",
    "fidelity=video",
    "participants=1",
    "conditions=[L0, L3]",
    "network.inherent=loopback",
    "vehicle.scenery=none",
    "camera.width_px=320",
    "camera.height_px=240",
    "instructions=Keep your lane.",
)


@contextmanager
def running_study(out: Path) -> Iterator[subprocess.Popen[str]]:
    """Start `lavt study` for a person, with pipes for the texts and the answers, and end it."""
    changes = [part for change in SETTINGS for part in ("--set", change)]
    arguments = ["study", str(shipped("configs/study.yaml")), *changes, "--participant", "1", "--no-browser"]
    with subprocess.Popen(
        [sys.executable, "-m", "lavt", *arguments, "--questions-in-page", "--out", str(out), "--json"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONUNBUFFERED": "1"},
    ) as process:
        try:
            yield process
        finally:
            process.terminate()


def read_until(process: subprocess.Popen[str], text: str) -> str:
    """Return the next line of standard error that contains `text`."""
    assert process.stderr is not None
    for line in process.stderr:
        if text in line:
            return line
    raise AssertionError(f"lavt study ended without {text!r}")


def answer(process: subprocess.Popen[str], text: str) -> None:
    assert process.stdin is not None
    process.stdin.write(f"{text}\n")
    process.stdin.flush()


def is_over(tab: Tab) -> bool:
    """Return whether the client has ended, as it does after the drive."""
    return (status(tab) or {}).get("phase") in (None, "watching")


def drive_blind(browser: Browser, url: str) -> None:
    """Drive from the page at `url`, which shows neither latencies nor conditions, and stop.

    On a busy machine the page can lose the hand before the vehicle drives, and then it must hold again.
    """
    tab = browser.open(url)
    wait_until("the page has a status", lambda: (status(tab) or {}).get("safety") not in (None, ""))
    repeat_keys(tab)
    shown = "[...document.querySelectorAll('[data-latency], #network')].filter((part) => part.checkVisibility())"
    wait_until("the latencies are hidden", lambda: tab.evaluate(f"{shown}.length") == 0)
    assert tab.evaluate("document.querySelector('#speed').checkVisibility()")
    assert field(tab, "shows_latency") is False
    assert (field(tab, "video_ms"), field(tab, "round_trip_ms"), field(tab, "delay")) == (None, None, None)
    for _ in range(ATTEMPTS):
        wait_until("the vehicle can be armed", lambda: field(tab, "hand") == "open" or is_over(tab))
        if is_over(tab):
            break
        press(tab, "Space")
        wait_until("the hand holds", lambda: field(tab, "hand") != "open")
        wait_until("the car drives", lambda: field(tab, "phase") == "driving" or field(tab, "hand") != "held")
        release(tab, "Space")
    browser.close_tab(tab)


def answer_in_page(browser: Browser, url: str) -> None:
    """Choose a point on each scale, write a comment, and send the answers."""
    tab = browser.open(url)
    wait_until("the questions are asked", lambda: tab.evaluate("document.querySelectorAll('fieldset').length") == 6)
    tab.evaluate("document.querySelector('button').click()")
    assert tab.evaluate("document.querySelector('#form').checkValidity()") is False
    assert tab.evaluate("document.querySelector('#form').checkVisibility()")
    choose = "[...document.querySelectorAll('fieldset')].forEach((scale, number) => scale.elements[number].click())"
    tab.evaluate(f"{choose}; document.querySelector('#comment').value = 'fine'")
    tab.evaluate("document.querySelector('button').click()")
    wait_until("the page says thanks", lambda: "Thank you" in tab.evaluate("document.body.innerText"))
    browser.close_tab(tab)


def test_a_person_drives_a_study_blind(browser: Browser, tmp_path: Path) -> None:
    """A person drives each block from a page without latencies and conditions, and answers in another page."""
    with running_study(tmp_path / "out") as process:
        for _ in range(2):
            read_until(process, "Keep your lane.")
            read_until(process, "press Enter")
            answer(process, "")
            drive_blind(browser, read_until(process, "drive from").split()[-1])
            read_until(process, "press Enter to keep it")
            answer(process, "")
            answer_in_page(browser, read_until(process, "answer the questions at").split()[-1])
        read_until(process, "driven all blocks")
        assert process.stdout is not None
        printed = json.loads(process.stdout.read())
        assert process.wait() == 0
    runs = [json.loads(path.read_text()) for path in sorted((tmp_path / "out" / "runs").glob("*/result.json"))]
    assert {run["condition"] for run in runs} == {"L0", "L3"}
    assert [(run["driver"], run["participant"], run["block"], run["ending"]) for run in runs] == [
        ("human", "1", number, "safe_stop") for number in (1, 2)
    ]
    (study,) = printed["studies"]
    assert study["measures"]["raw_tlx"]["values"] == {"1": [12.5, 12.5]}
    assert [entry["comment"] for entry in read_answers(tmp_path / "out")] == ["fine", "fine"]
