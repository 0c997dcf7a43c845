"""Console commands that act on a software car."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from copy import deepcopy
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.vehicle.software_car.rig import START_NS, KitRig, driving_rig

from lavt.domain import NS_PER_S
from lavt.errors import UserError
from lavt.vehicle.software_car.console_commands import COMMANDS, execute, help_lines
from lavt.vehicle.software_car.kit import Kit
from lavt.vehicle.software_car.sensor_faults import MAX_REPORTED_MPS
from lavt.vehicle.software_car.state import Gear, ReleaseReason

INTERNAL_METHODS = {"receive", "frames_due", "actuation", "next_wake_ns", "sense"}
"""Methods of a kit that need no command."""


@pytest.mark.parametrize(
    ("line", "has_effect"),
    [
        ("driver_steers -3", lambda kit: kit.state.driver_torque_nm == -3.0),
        ("driver_brakes 0.3", lambda kit: kit.state.driver_brake == 0.3),
        ("driver_throttles 0.25", lambda kit: kit.state.driver_throttle == 0.25),
        ("driver_shifts neutral", lambda kit: kit.state.gear == Gear.NEUTRAL),
        ("driver_shifts PARK", lambda kit: kit.state.gear == Gear.PARK),
        ("  fault   steering.fault  ", lambda kit: kit.state.actuators["steering"].faults == {"fault"}),
        ("fault gear.fault", lambda kit: kit.state.gear_faults == {"fault"}),
        ("unknown speed", lambda kit: kit.state.invalid == {"speed"}),
        ("stick_speed speed", lambda kit: kit.state.sensor_faults.stuck_mps == {"speed": kit.state.speed_mps}),
        ("stick_speed wheel_speed=3.5", lambda kit: kit.state.reported_mps("wheel_speed") == 3.5),
        ("stick_speed speed = 1e9", lambda kit: kit.state.reported_mps("speed") == MAX_REPORTED_MPS),
        ("scale_speed second_speed=0.5", lambda kit: kit.state.sensor_faults.factors == {"second_speed": 0.5}),
        ("drop_speed speed", lambda kit: kit.state.sensor_faults.dropped == {"speed"}),
        ("weaken_brake 0.25", lambda kit: kit.state.brake_share == 0.25),
        ("inhibit seat belt", lambda kit: kit.state.not_ready_reason == ReleaseReason.SEAT_BELT),
        ("switch_remote emergency_stop", lambda kit: kit.state.remote_state == 0),
        ("switch_remote pause", lambda kit: kit.state.remote_state == 1),
        ("switch_remote control_allowed", lambda kit: kit.state.remote_state == 3),
        ("bus_off", lambda kit: kit.frames_due(START_NS + 10**9) == []),
    ],
)
def test_a_command_has_its_effect(line: str, has_effect: Callable[[Kit], bool]) -> None:
    """Each command changes the kit as its name says."""
    rig = driving_rig(2)
    assert not has_effect(rig.kit)
    execute(rig.kit, line, rig.now_ns)
    assert has_effect(rig.kit)


@pytest.mark.parametrize(
    ("command", "inverse"),
    [
        ("fault steering.fault", "clear_fault steering.fault"),
        ("unknown angle", "known angle"),
        ("stick_speed speed=1", "restore_speed speed"),
        ("scale_speed wheel_speed=2", "restore_speed wheel_speed"),
        ("drop_speed wheel_speed", "restore_speed wheel_speed"),
        ("weaken_brake 0.5", "weaken_brake 1"),
        ("inhibit door", "clear_inhibit"),
        ("bus_off", "bus_on"),
        ("switch_remote pause", "switch_remote remote"),
    ],
)
def test_an_inverse_command_restores_the_kit(command: str, inverse: str) -> None:
    """A command and then its inverse leave the kit's faults and reports unchanged."""
    rig = KitRig(2)
    before = faults_and_frames_in_a_second(rig)
    execute(rig.kit, command, rig.now_ns)
    assert faults_and_frames_in_a_second(rig) != before
    execute(rig.kit, inverse, rig.now_ns)
    assert faults_and_frames_in_a_second(rig) == before


def faults_and_frames_in_a_second(rig: KitRig) -> tuple[object, ...]:
    """Let a second pass; return a kit's faults and the number of its frames in this second."""
    rig.now_ns += NS_PER_S
    state, frame_count = rig.kit.state, len(rig.kit.frames_due(rig.now_ns))
    faults = [sorted(actuator.faults) for actuator in state.actuators.values()]
    reports = faults, sorted(state.invalid), deepcopy(state.sensor_faults), state.brake_share
    return *reports, state.not_ready_reason, state.remote_state, frame_count


@pytest.mark.parametrize(("lines", "brake"), [([], 0.5), (["no_watchdog"], 0.0), (["no_watchdog", "watchdog"], 0.5)])
def test_the_watchdog_can_be_disabled(lines: list[str], brake: float) -> None:
    """After a command timeout a kit with a watchdog brakes, and a kit without a watchdog coasts."""
    rig = driving_rig(2)
    for line in lines:
        execute(rig.kit, line, rig.now_ns)
    rig.wait_ms(200)
    assert rig.executed().brake == brake


@pytest.mark.parametrize(
    ("line", "key_words"),
    [
        ("frobnicate", ["'frobnicate'", "help"]),
        ("x" * 1000, [f"{'x' * 40!r}", "help"]),
        ("driver_brakes", ["driver_brakes", "FRACTION"]),
        ("driver_brakes hard", ["'hard'", "number"]),
        ("driver_brakes nan", ["'nan'", "number"]),
        ("driver_steers inf", ["'inf'", "number"]),
        ("driver_shifts reverse", ["'REVERSE'", "DRIVE, NEUTRAL, PARK"]),
        ("fault wheel", ["'wheel'", "brake.fault, gear.fault, steering.fault, throttle.fault"]),
        ("clear_fault wheel", ["'wheel'", "brake.fault, gear.fault, steering.fault, throttle.fault"]),
        ("stick_speed weather", ["'weather'", "second_speed, speed, wheel_speed"]),
        ("stick_speed speed=fast", ["'fast'"]),
        ("scale_speed speed", ["scale_speed"]),
        ("unknown weather", ["'weather'", "angle, speed, wheel_speed"]),
        ("inhibit me", ["'me'", "acceleration, door, reverse, seat belt, speed"]),
        ("switch_remote 2", ["'2'", "control_allowed, emergency_stop, pause, remote"]),
        ("bus_off now", ["bus_off", "'now'"]),
        ("scale_speed 0\n0", ["'0\\n0'", "SOURCE=0.5"]),
    ],
)
def test_an_invalid_command_changes_nothing(line: str, key_words: list[str]) -> None:
    """An invalid command is rejected with an error that names the input and the alternatives, and changes nothing."""
    rig = driving_rig(2)
    before = repr(rig.kit.state)
    with pytest.raises(UserError) as error:
        execute(rig.kit, line, rig.now_ns)
    assert [word for word in key_words if word not in str(error.value)] == []
    assert len(str(error.value)) < 200
    assert repr(rig.kit.state) == before


@given(st.text() | st.tuples(st.sampled_from(sorted(COMMANDS)), st.text()).map(" ".join))
def test_any_line_is_executed_or_rejected(line: str) -> None:
    """Any input is executed or rejected with an error of one line."""
    rig, errors = driving_rig(2), [""]
    try:
        execute(rig.kit, line, rig.now_ns)
    except UserError as error:
        errors.append(str(error))
    assert "\n" not in errors[-1]


def test_every_action_has_a_command() -> None:
    """Every public method of a kit has a command, except the methods that need no command."""
    methods = {name for name, _ in inspect.getmembers(Kit, inspect.isfunction) if not name.startswith("_")}
    called = {name for command in COMMANDS.values() for name in command.execute.__code__.co_names}
    assert methods - INTERNAL_METHODS <= called


def test_help_lists_every_command() -> None:
    """`help` has a line for each command and for itself."""
    assert [line.split()[0] for line in help_lines()] == [*COMMANDS, "help"]


def test_the_page_lists_every_command() -> None:
    """`docs/software_car.md` has the list that `help` prints."""
    page = Path(__file__).parents[3].joinpath("docs", "software_car.md").read_text(encoding="utf-8")
    assert "\n".join(f"    {line}" for line in help_lines()) in page
