from __future__ import annotations

import threading

import pytest

from lavt.runtime.wakeup import WakeEvent


def test_setting_twice_wakes_once() -> None:
    """However often an event is set, it ends one wait. After that wait, or after `clear`, it is not set."""
    event = WakeEvent()
    event.set()
    event.set()
    event.wait(None)
    event.set()
    event.clear()
    event.clear()
    sleeper = threading.Thread(target=event.wait, args=(None,), daemon=True)
    sleeper.start()
    sleeper.join(0.01)
    assert sleeper.is_alive()
    event.set()
    sleeper.join(10)
    assert not sleeper.is_alive()


@pytest.mark.parametrize("timeout_s", [-1.0, 0.0, 0.001])
def test_a_wait_times_out(timeout_s: float) -> None:
    """A wait ends after its timeout, even if the event is not set; with a timeout of 0 or less it returns at once."""
    event = WakeEvent()
    event.wait(timeout_s)
    event.set()
    event.wait(None)


def test_no_wake_is_lost() -> None:
    """Two threads that wake each other 2000 times in turns both finish."""
    wakes_main, wakes_thread = WakeEvent(), WakeEvent()

    def answer() -> None:
        for _ in range(2000):
            wakes_thread.wait(10)
            wakes_main.set()

    thread = threading.Thread(target=answer, daemon=True)
    thread.start()
    for _ in range(2000):
        wakes_thread.set()
        wakes_main.wait(10)
    thread.join(10)
    assert not thread.is_alive()
