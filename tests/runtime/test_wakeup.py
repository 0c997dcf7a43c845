from __future__ import annotations

import threading

import pytest

from lavt.runtime.wakeup import WakeEvent


def test_what_rang_before_is_heard_once() -> None:
    """Who rings first is heard by who sleeps next, however often; after that there is silence again."""
    bell = WakeEvent()
    bell.ring()
    bell.ring()
    bell.wait(None)
    bell.ring()
    bell.silence()
    bell.silence()
    sleeper = threading.Thread(target=bell.wait, args=(None,), daemon=True)
    sleeper.start()
    sleeper.join(0.01)
    assert sleeper.is_alive()
    bell.ring()
    sleeper.join(10)
    assert not sleeper.is_alive()


@pytest.mark.parametrize("pause_s", [-1.0, 0.0, 0.001])
def test_a_sleep_ends(pause_s: float) -> None:
    """Without a ring a sleep ends by itself; one that should be over already does not begin."""
    bell = WakeEvent()
    bell.wait(pause_s)
    bell.ring()
    bell.wait(None)


def test_no_ring_is_lost() -> None:
    """Two threads that ring each other in turns both come to the end."""
    here, there = WakeEvent(), WakeEvent()

    def answer() -> None:
        for _ in range(2000):
            there.wait(10)
            here.ring()

    thread = threading.Thread(target=answer, daemon=True)
    thread.start()
    for _ in range(2000):
        there.ring()
        here.wait(10)
    thread.join(10)
    assert not thread.is_alive()
