"""Properties for any frames from the bus, and for all commands that a profile can send."""

from __future__ import annotations

import math
from functools import cache

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.vehicle.dbw.rig import START_NS, driving_rig, profile, stationary_rig

from lavt.domain import NS_PER_MS, Actuation
from lavt.vehicle.can_frame import CanFrame
from lavt.vehicle.dbw.adapter import ByWireAdapter
from lavt.vehicle.dbw.profile import AXES
from lavt.vehicle.dbw.sending import FrameSender
from lavt.vehicle.software_car import generation_1, generation_2
from lavt.vehicle.software_car.mechanics import Mechanics
from lavt.vehicle.software_car.state import AxisOrder

each_profile = pytest.mark.parametrize("name", ["dataspeed_gen1", "dataspeed_gen2", "dataspeed_gen2:user"])


def order_of(name: str, frame: CanFrame) -> AxisOrder:
    """Return the order that the software car, which shares no code with the adapter, parses from a frame."""
    parse_order = generation_1.parse_order if name == "dataspeed_gen1" else generation_2.parse_order
    order = parse_order(frame, Mechanics(), not name.endswith(":user"))
    assert isinstance(order, AxisOrder)
    return order


@each_profile
@given(data=st.data())
def test_all_commands_are_understood(name: str, data: st.DataObject) -> None:
    """The kit parses every command within the limits as valid and enabling, with its value within half a step."""
    base_profile, sender = profile(name), FrameSender(profile(name), START_NS)
    axis = data.draw(st.sampled_from(AXES))
    sender._frame_counts[base_profile.axes[axis].message] = data.draw(st.integers(0, 1000))
    if axis == "steering":
        most = base_profile.limits.steering_wheel_deg
        angle_deg = data.draw(st.floats(-most, most))
        order = order_of(name, sender.axis_frame(axis, angle_deg, is_enabled=True))
        assert math.degrees(order.target) == pytest.approx(angle_deg, abs=0.05 + 1e-9)
        assert math.degrees(order.rate_radps) == pytest.approx(452.0)
    else:
        fraction = data.draw(st.floats(0, 1))
        order = order_of(name, sender.axis_frame(axis, fraction, is_enabled=True))
        assert order.target == pytest.approx(fraction, abs=0.000126)
    assert (order.axis, order.is_valid, order.is_enabling, order.is_clearing, order.ignores_driver) == (
        axis,
        True,
        True,
        False,
        False,
    )


@each_profile
@given(data=st.data())
def test_all_reports_are_understood(name: str, data: st.DataObject) -> None:
    """The adapter reads every angle that a report can contain."""
    base_profile = profile(name)
    adapter = ByWireAdapter(base_profile, start_ns=START_NS)
    angle = data.draw(st.integers(-5500, 5500))
    raw = angle.to_bytes(2, "little", signed=True)
    if name == "dataspeed_gen1":
        adapter.receive(CanFrame(0x065, raw + bytes(6)), START_NS)
    else:
        angle_bits = (angle & 0x3FFF).to_bytes(2, "little")
        adapter.receive(frame_with_crc(0x100, angle_bits + bytes(6)), START_NS)
    assert adapter.state().steering_rad == pytest.approx(base_profile.road_rad(angle / 10), abs=1e-12)


def frame_with_crc(identifier: int, data: bytes) -> CanFrame:
    from lavt.vehicle.software_car.frames import with_crc

    return CanFrame(identifier, with_crc(identifier, data))


any_frame = st.builds(
    CanFrame,
    st.one_of(
        st.integers(0, 0x7FF),
        st.sampled_from([0x061, 0x063, 0x065, 0x067, 0x100, 0x101, 0x102, 0x103, 0x106, 0x107, 0x2D8]),
    ),
    st.binary(max_size=8),
    st.booleans(),
)
histories = st.lists(st.tuples(any_frame, st.integers(0, 200 * NS_PER_MS), st.integers(0, 3)), max_size=60)


@each_profile
@given(histories)
@settings(max_examples=150)
def test_any_frames_raise_nothing(name: str, history: list[tuple[CanFrame, int, int]]) -> None:
    """Any frames from the bus raise nothing, and without all reports the car is never engaged."""
    adapter = ByWireAdapter(profile(name), start_ns=START_NS)
    now_ns = START_NS
    for frame, passed_ns, request in history:  # a request of 1 disengages, 2 and 3 engage
        now_ns += passed_ns
        adapter.receive(frame, now_ns)
        adapter.set_actuation(Actuation(0.1, 0.5, 0.0), now_ns)
        if request:
            adapter.engage(request > 1, now_ns)
        adapter.frames_due(now_ns)
        assert adapter.next_wake_ns() > now_ns
        state = adapter.state()
        assert not state.is_engaged
        adapter.take_events()
        adapter.take_reached()


@cache
def reports_of(generation: int) -> tuple[CanFrame, ...]:
    """Return the reports that a driving kit sends in 100 ms."""
    rig, received = driving_rig(generation), []
    receive = rig.adapter.receive

    def keep(frame: CanFrame, now_ns: int) -> None:
        received.append(frame)
        receive(frame, now_ns)

    rig.adapter.receive = keep  # type: ignore[method-assign]
    rig.run_ms(100)
    return tuple(received)


@pytest.mark.parametrize("generation", [1, 2])
@given(st.lists(st.tuples(any_frame, st.integers(0, 30)), min_size=1, max_size=20))
@settings(max_examples=25)
def test_garbage_between_reports(generation: int, garbage: list[tuple[CanFrame, int]]) -> None:
    """Garbage between reports never engages a stationary car while driving is not wanted."""
    rig = stationary_rig(generation)
    for frame, wait_ms in garbage:
        rig.adapter.receive(frame, rig.now_ns)
        rig.run_ms(wait_ms)
        assert not rig.adapter.state().is_engaged
    assert rig.sent == []


@pytest.mark.parametrize("generation", [1, 2])
@given(st.data())
@settings(max_examples=100)
def test_a_flipped_bit(generation: int, data: st.DataObject) -> None:
    """A report with a flipped bit raises nothing, and generation 2's checksum detects it."""
    frame = data.draw(st.sampled_from(reports_of(generation)))
    bit = data.draw(st.integers(0, 8 * len(frame.data) - 1))
    flipped = (int.from_bytes(frame.data, "little") ^ 1 << bit).to_bytes(len(frame.data), "little")
    adapter = ByWireAdapter(profile(f"dataspeed_gen{generation}"), start_ns=START_NS)
    adapter.receive(CanFrame(frame.identifier, flipped), START_NS)
    names_by_identifier = {
        message.identifier: name for name, message in profile(f"dataspeed_gen{generation}").codec.messages.items()
    }
    report = profile(f"dataspeed_gen{generation}").reports.get(names_by_identifier[frame.identifier])
    if report is not None and report.checksum:
        assert adapter._reports.counts["wrong_checksum"] == 1
