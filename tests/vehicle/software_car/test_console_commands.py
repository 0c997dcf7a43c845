"""Words by which somebody acts on a software car."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.vehicle.software_car.rig import START_NS, Rig, driving

from lavt.domain import NS_PER_S
from lavt.errors import UserError
from lavt.vehicle.software_car.console_commands import WORDS, act, help_lines
from lavt.vehicle.software_car.kit import Kit
from lavt.vehicle.software_car.state import Gear, ReleaseReason

NO_DEEDS = {"receive", "frames_due", "actuation", "next_wake_ns", "sense"}
"""What a kit does by itself."""


@pytest.mark.parametrize(
    ("line", "has_come"),
    [
        ("driver_steers -3", lambda kit: kit.state.driver_torque_nm == -3.0),
        ("driver_brakes 0.3", lambda kit: kit.state.driver_brake == 0.3),
        ("driver_throttles 0.25", lambda kit: kit.state.driver_throttle == 0.25),
        ("driver_shifts neutral", lambda kit: kit.state.gear == Gear.NEUTRAL),
        ("driver_shifts PARK", lambda kit: kit.state.gear == Gear.PARK),
        ("  fault   steering.fault  ", lambda kit: kit.state.actuators["steering"].faults == {"fault"}),
        ("fault gear.fault", lambda kit: kit.state.gear_faults == {"fault"}),
        ("unknown speed", lambda kit: kit.state.invalid == {"speed"}),
        ("hinder seat belt", lambda kit: kit.state.not_ready == ReleaseReason.SEAT_BELT),
        ("switch_remote emergency_stop", lambda kit: kit.state.remote_state == 0),
        ("switch_remote pause", lambda kit: kit.state.remote_state == 1),
        ("switch_remote control_allowed", lambda kit: kit.state.remote_state == 3),
        ("bus_off", lambda kit: kit.frames_due(START_NS + 10**9) == []),
    ],
)
def test_what_a_word_does(line: str, has_come: Callable[[Kit], bool]) -> None:
    """Each word does to the kit what it says."""
    rig = driving(2)
    assert not has_come(rig.kit)
    act(rig.kit, line, rig.now_ns)
    assert has_come(rig.kit)


@pytest.mark.parametrize(
    ("there", "back"),
    [
        ("fault steering.fault", "mend steering.fault"),
        ("unknown angle", "known angle"),
        ("hinder door", "unhinder"),
        ("bus_off", "bus_on"),
        ("switch_remote pause", "switch_remote remote"),
    ],
)
def test_what_a_word_takes_back(there: str, back: str) -> None:
    """What one word breaks another mends: the kit is as it was."""
    rig = Rig(2)
    before = life_of(rig)
    act(rig.kit, there, rig.now_ns)
    assert life_of(rig) != before
    act(rig.kit, back, rig.now_ns)
    assert life_of(rig) == before


def life_of(rig: Rig) -> tuple[object, ...]:
    """What is broken of a kit, and how much it says in a second."""
    rig.now_ns += NS_PER_S
    state, said = rig.kit.state, len(rig.kit.frames_due(rig.now_ns))
    broken = [sorted(actuator.faults) for actuator in state.actuators.values()]
    return broken, sorted(state.invalid), state.not_ready, state.remote_state, said


@pytest.mark.parametrize(("words", "brake"), [([], 0.5), (["no_watchdog"], 0.0), (["no_watchdog", "watchdog"], 0.5)])
def test_a_kit_with_and_without_watchdog(words: list[str], brake: float) -> None:
    """Without its watchdog a kit that hears nothing any more lets the car roll; with it, it brakes."""
    rig = driving(2)
    for word in words:
        act(rig.kit, word, rig.now_ns)
    rig.wait_ms(200)
    assert rig.wheels()[2] == brake


@pytest.mark.parametrize(
    ("line", "sentence"),
    [
        ("frobnicate", "there is no word 'frobnicate': help lists them"),
        ("x" * 1000, f"there is no word {'x' * 40!r}: help lists them"),
        ("driver_brakes", "driver_brakes needs a FRACTION: a foot on the brake, 0 to 1"),
        ("driver_brakes hard", "'hard' is no number"),
        ("driver_brakes nan", "'nan' is no number"),
        ("driver_steers inf", "'inf' is no number"),
        ("driver_shifts reverse", "there is no gear of this car 'REVERSE': the known ones are DRIVE, NEUTRAL, PARK"),
        ("fault wheel", "there is no fault 'wheel': the known ones are brake.fault, gear.fault, steering.fault, "
                        "throttle.fault"),
        ("mend wheel", "there is no fault 'wheel': the known ones are brake.fault, gear.fault, steering.fault, "
                       "throttle.fault"),
        ("unknown weather", "there is no value that can be unknown 'weather': the known ones are angle, speed, "
                            "wheel_speed"),
        ("hinder me", "there is no hindrance 'me': the known ones are acceleration, door, reverse, seat belt, speed"),
        ("switch_remote 2", "there is no state of the remote's switch '2': the known ones are control_allowed, "
                            "emergency_stop, pause, remote"),
        ("bus_off now", "bus_off takes nothing after it, not 'now'"),
    ],
)  # fmt: skip
def test_what_cannot_be_done(line: str, sentence: str) -> None:
    """A line that cannot be done is answered by one sentence, and nothing is done."""
    rig = driving(2)
    before = repr(rig.kit.state)
    with pytest.raises(UserError) as error:
        act(rig.kit, line, rig.now_ns)
    assert str(error.value) == sentence
    assert repr(rig.kit.state) == before


@given(st.text() | st.tuples(st.sampled_from(sorted(WORDS)), st.text()).map(" ".join))
def test_any_line(line: str) -> None:
    """Whatever is typed is done or answered by a sentence."""
    rig, sentences = driving(2), [""]
    try:
        act(rig.kit, line, rig.now_ns)
    except UserError as error:
        sentences.append(str(error))
    assert "\n" not in sentences[-1]


def test_every_deed_has_a_word() -> None:
    """There is a word for every method of a kit that is not its own doing."""
    deeds = {name for name, _ in inspect.getmembers(Kit, inspect.isfunction) if not name.startswith("_")} - NO_DEEDS
    done = {name for word in WORDS.values() for name in word.act.__code__.co_names}
    assert deeds <= done


def test_help_lists_every_word() -> None:
    """`help` has a line for each word and for itself."""
    assert [line.split()[0] for line in help_lines()] == [*WORDS, "help"]


def test_the_page_lists_every_word() -> None:
    """`docs/software_car.md` has the list that `help` gives."""
    page = Path(__file__).parents[3].joinpath("docs", "software_car.md").read_text(encoding="utf-8")
    assert "\n".join(f"    {line}" for line in help_lines()) in page
