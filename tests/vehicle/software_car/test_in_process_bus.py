"""The software car at the other end of a bus in this process."""

from __future__ import annotations

from functools import cache

import pytest
from tests.vehicle.software_car.rig import START_NS, Asked, Hand1, Hand2, both

from lavt.domain import NS_PER_MS, NS_PER_S, GroundTruth, VehicleEvent
from lavt.vehicle.can_frame import BusGone, ReceivedCanFrame
from lavt.vehicle.sim.road.road import Road, load_road
from lavt.vehicle.sim.simulator import Simulator
from lavt.vehicle.software_car.car import SoftwareCar
from lavt.vehicle.software_car.in_process_bus import FRAME_NS, InProcessPort
from lavt.vehicle.software_car.kit import Kit


@cache
def road() -> Road:
    return load_road("a_key")


def port_of(generation: int, delay_ns: int = FRAME_NS) -> InProcessPort:
    simulator = Simulator(road=road(), seed=1, start_mono_ns=START_NS)
    car = SoftwareCar(Kit(1 if generation == 1 else 2, start_ns=START_NS), simulator)
    return InProcessPort(car, delay_ns=delay_ns)


def hand_of(generation: int) -> Hand1 | Hand2:
    return Hand1() if generation == 1 else Hand2()


def drive(
    generation: int, looks_each_ms: int, *, requested: Asked, duration_ms: int = 3_000
) -> tuple[list[ReceivedCanFrame], GroundTruth, list[VehicleEvent]]:
    """Command every 20 ms, look at the port however often, and tell all that came."""
    port, hand = port_of(generation), hand_of(generation)
    heard: list[ReceivedCanFrame] = []
    events: list[VehicleEvent] = []
    truth: GroundTruth | None = None
    for passed_ms in range(0, duration_ms + 1, looks_each_ms):
        now_ns = START_NS + passed_ms * NS_PER_MS
        heard += port.take(now_ns)
        truth, new = port.truth(now_ns)
        events += new
        if passed_ms % 20 == 0:
            early = passed_ms < 100
            port.send(hand.commands(Asked(brake=0.5) if early else requested), now_ns)
            if early:
                port.send([*([hand.system(1)] if isinstance(hand, Hand2) else []), hand.gear(4)], now_ns)
    assert truth is not None
    return heard, truth, events


@both
def test_a_drive_is_the_same_however_often_it_is_looked_at(generation: int) -> None:
    """The same frames at the same times give the same frames back at the same times, the same truth and events."""
    requested = Asked(throttle=0.5, angle_deg=200.0)
    seldom, often = drive(generation, 20, requested=requested), drive(generation, 1, requested=requested)
    assert seldom == often
    _, truth, events = seldom
    assert truth.speed_mps > 1.0
    assert {event.kind for event in events} >= {"lane_invasion"}


@both
def test_frames_come_one_after_another(generation: int) -> None:
    """Reports that leave together come 250 us apart, the first 250 us after it left, in the kit's order."""
    port = port_of(generation)
    heard = port.take(START_NS + 15 * NS_PER_MS)
    assert [(each.frame.identifier, each.arrived_ns - START_NS) for each in heard] == [
        (identifier, 10 * NS_PER_MS + place * FRAME_NS)
        for place, identifier in enumerate([0x065, 0x06A] if generation == 1 else [0x100, 0x2A4], start=1)
    ]


def test_frames_come_in_time_and_not_before() -> None:
    """A frame under way is taken from its time on and once."""
    port = port_of(2)
    assert port.take(START_NS + 10 * NS_PER_MS + FRAME_NS - 1) == []
    assert [each.frame.identifier for each in port.take(START_NS + 10 * NS_PER_MS + FRAME_NS)] == [0x100]
    assert [each.frame.identifier for each in port.take(START_NS + 12 * NS_PER_MS)] == [0x2A4]
    assert port.take(START_NS + 12 * NS_PER_MS) == []


def test_the_car_hears_frames_one_after_another() -> None:
    """A set of three frames is with the kit 250, 500 and 750 us after it was sent."""
    port, hand = port_of(2), Hand2()
    port.send(hand.commands(Asked(brake=0.5)), START_NS)
    actuators = port.car.kit.state.actuators
    had = []
    for quarters in range(5):
        port.take(START_NS + quarters * FRAME_NS)
        had.append([axis for axis, actuator in actuators.items() if actuator.order])
    assert had == [[], ["steering"], ["steering", "brake"], *[["steering", "brake", "throttle"]] * 2]


def test_a_set_waits_for_the_one_before() -> None:
    """A set sent while another is under way comes after it."""
    port, hand = port_of(1), Hand1()
    port.send(hand.commands(Asked()), START_NS)
    port.send([hand.gear(4)], START_NS + FRAME_NS)
    port.take(START_NS + 4 * FRAME_NS - 1)
    assert port.car.kit.state.gear_order == 0
    port.take(START_NS + 4 * FRAME_NS)
    assert port.car.kit.state.gear_order == 4


def test_a_bus_without_delay() -> None:
    """Without delay frames are with the car at once, and what leaves is there at once; none is heard before it left."""
    port, hand = port_of(2, delay_ns=0), Hand2()
    assert [each.arrived_ns for each in port.take(START_NS + 10 * NS_PER_MS)] == [START_NS + 10 * NS_PER_MS] * 2
    port.send(hand.commands(Asked(brake=0.5)), START_NS + 10 * NS_PER_MS)
    port.take(START_NS + 10 * NS_PER_MS)
    assert port.car.kit.state.actuators["brake"].order is not None


def test_a_set_from_the_past_goes_now() -> None:
    """A set made before the car's present is taken in the car's present: its time never goes back."""
    port, hand = port_of(2, delay_ns=0), Hand2()
    port.take(START_NS + 50 * NS_PER_MS)
    port.send(hand.commands(Asked(brake=0.5)), START_NS)
    port.take(START_NS + 51 * NS_PER_MS)
    assert port.car.kit.state.actuators["brake"].received_ns == START_NS + 50 * NS_PER_MS


def test_waking_as_it_asks_hears_everything() -> None:
    """Who takes at each `next_wake_ns` hears every report of a second, each at most 2 ms after it came."""
    port = port_of(2)
    heard: list[ReceivedCanFrame] = []
    now_ns = START_NS
    while now_ns < START_NS + NS_PER_S + 10 * NS_PER_MS:
        came = port.take(now_ns)
        assert all(now_ns - each.arrived_ns <= 2 * NS_PER_MS for each in came)
        heard += came
        assert port.next_wake_ns() > now_ns
        now_ns = port.next_wake_ns()
    assert len(heard) == 100 * 2 + 50 * 3 + 10 * 3


def test_events_are_told_once() -> None:
    """An event is told with the first truth after it, and not again."""
    port = port_of(2)
    port.car.events.append(VehicleEvent(START_NS, "off_road", ""))
    truth, events = port.truth(START_NS + NS_PER_S)
    assert (truth.speed_mps, events) == (0.0, [VehicleEvent(START_NS, "off_road", "")])
    assert START_NS + NS_PER_S - truth.mono_ns < NS_PER_S / 240 + 1
    assert port.truth(START_NS + NS_PER_S)[1] == []


def test_a_cut_bus() -> None:
    """A cut bus says why on both ways and carries nothing; mended it carries again, and the car has lived on."""
    port, hand = port_of(2), Hand2()
    port.send(hand.commands(Asked(brake=0.5)), START_NS)
    port.cut("the cable is cut")
    with pytest.raises(BusGone, match="the cable is cut"):
        port.take(START_NS + 100 * NS_PER_MS)
    with pytest.raises(BusGone, match="the cable is cut"):
        port.send(hand.commands(Asked()), START_NS + 100 * NS_PER_MS)
    assert port.car.kit.state.actuators["brake"].order is None
    port.cut("")
    assert [each.frame.identifier for each in port.take(START_NS + 115 * NS_PER_MS)] == [0x100, 0x2A4]
