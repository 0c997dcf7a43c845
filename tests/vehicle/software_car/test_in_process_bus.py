"""Test the bus that connects to a software car in the same process."""

from __future__ import annotations

from functools import cache

import pytest
from tests.vehicle.software_car.rig import START_NS, CommandValues, Sender1, Sender2, both_generations

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


def sender_of(generation: int) -> Sender1 | Sender2:
    return Sender1() if generation == 1 else Sender2()


def drive(
    generation: int, poll_period_ms: int, *, requested: CommandValues, duration_ms: int = 3_000
) -> tuple[list[ReceivedCanFrame], GroundTruth, list[VehicleEvent]]:
    """Send commands every 20 ms and poll the port; return all frames, the last ground truth and all events."""
    port, sender = port_of(generation), sender_of(generation)
    received: list[ReceivedCanFrame] = []
    events: list[VehicleEvent] = []
    truth: GroundTruth | None = None
    for passed_ms in range(0, duration_ms + 1, poll_period_ms):
        now_ns = START_NS + passed_ms * NS_PER_MS
        received += port.take(now_ns)
        truth, new = port.truth(now_ns)
        events += new
        if passed_ms % 20 == 0:
            is_enabling = passed_ms < 100
            port.send(sender.commands(CommandValues(brake=0.5) if is_enabling else requested), now_ns)
            if is_enabling:
                port.send([*([sender.system(1)] if isinstance(sender, Sender2) else []), sender.gear(4)], now_ns)
    assert truth is not None
    return received, truth, events


@both_generations
def test_a_drive_does_not_depend_on_polling(generation: int) -> None:
    """However often the port is polled, frames, their times, the ground truth and the events are the same."""
    requested = CommandValues(throttle=0.5, angle_deg=200.0)
    seldom, often = drive(generation, 20, requested=requested), drive(generation, 1, requested=requested)
    assert seldom == often
    _, truth, events = seldom
    assert truth.speed_mps > 1.0
    assert {event.kind for event in events} >= {"lane_invasion"}


@both_generations
def test_frames_are_transmitted_one_at_a_time(generation: int) -> None:
    """Reports sent together arrive in order, 250 us apart, the first report 250 us after it was sent."""
    port = port_of(generation)
    received = port.take(START_NS + 15 * NS_PER_MS)
    assert [(arrival.frame.identifier, arrival.arrived_ns - START_NS) for arrival in received] == [
        (identifier, 10 * NS_PER_MS + index * FRAME_NS)
        for index, identifier in enumerate([0x065, 0x06A] if generation == 1 else [0x100, 0x2A4], start=1)
    ]


def test_frames_are_received_at_their_arrival() -> None:
    """A frame in transit is returned once, from its arrival time on."""
    port = port_of(2)
    assert port.take(START_NS + 10 * NS_PER_MS + FRAME_NS - 1) == []
    assert [arrival.frame.identifier for arrival in port.take(START_NS + 10 * NS_PER_MS + FRAME_NS)] == [0x100]
    assert [arrival.frame.identifier for arrival in port.take(START_NS + 12 * NS_PER_MS)] == [0x2A4]
    assert port.take(START_NS + 12 * NS_PER_MS) == []


def test_the_car_receives_frames_one_at_a_time() -> None:
    """The frames of a set reach the kit 250, 500 and 750 us after the set was sent."""
    port, sender = port_of(2), Sender2()
    port.send(sender.commands(CommandValues(brake=0.5)), START_NS)
    actuators = port.car.kit.state.actuators
    commanded_axes = []
    for frame_times in range(5):
        port.take(START_NS + frame_times * FRAME_NS)
        commanded_axes.append([axis for axis, actuator in actuators.items() if actuator.order])
    assert commanded_axes == [[], ["steering"], ["steering", "brake"], *[["steering", "brake", "throttle"]] * 2]


def test_a_set_waits_for_the_previous_set() -> None:
    """A set of frames that is sent before the previous set has arrived arrives after the previous set."""
    port, sender = port_of(1), Sender1()
    port.send(sender.commands(CommandValues()), START_NS)
    port.send([sender.gear(4)], START_NS + FRAME_NS)
    port.take(START_NS + 4 * FRAME_NS - 1)
    assert port.car.kit.state.gear_order == 0
    port.take(START_NS + 4 * FRAME_NS)
    assert port.car.kit.state.gear_order == 4


def test_a_bus_without_delay() -> None:
    """On a bus without delay, frames arrive at the time at which they were sent, in either direction."""
    port, sender = port_of(2, delay_ns=0), Sender2()
    assert [arrival.arrived_ns for arrival in port.take(START_NS + 10 * NS_PER_MS)] == [START_NS + 10 * NS_PER_MS] * 2
    port.send(sender.commands(CommandValues(brake=0.5)), START_NS + 10 * NS_PER_MS)
    port.take(START_NS + 10 * NS_PER_MS)
    assert port.car.kit.state.actuators["brake"].order is not None


def test_a_set_from_the_past_is_sent_now() -> None:
    """A set made before the car's current time is received at the car's current time."""
    port, sender = port_of(2, delay_ns=0), Sender2()
    port.take(START_NS + 50 * NS_PER_MS)
    port.send(sender.commands(CommandValues(brake=0.5)), START_NS)
    port.take(START_NS + 51 * NS_PER_MS)
    assert port.car.kit.state.actuators["brake"].received_ns == START_NS + 50 * NS_PER_MS


def test_polling_at_wake_times() -> None:
    """Polling at each `next_wake_ns` returns all reports of a second, each at most 2 ms after its arrival."""
    port = port_of(2)
    received: list[ReceivedCanFrame] = []
    now_ns = START_NS
    while now_ns < START_NS + NS_PER_S + 10 * NS_PER_MS:
        arrived = port.take(now_ns)
        assert all(now_ns - arrival.arrived_ns <= 2 * NS_PER_MS for arrival in arrived)
        received += arrived
        assert port.next_wake_ns() > now_ns
        now_ns = port.next_wake_ns()
    assert len(received) == 100 * 2 + 50 * 3 + 10 * 3, "two reports have 100 Hz, three 50 Hz and three 10 Hz"


def test_events_are_returned_once() -> None:
    """An event is returned with the first ground truth after it, and not again."""
    port = port_of(2)
    port.car.events.append(VehicleEvent(START_NS, "off_road", ""))
    truth, events = port.truth(START_NS + NS_PER_S)
    assert (truth.speed_mps, events) == (0.0, [VehicleEvent(START_NS, "off_road", "")])
    assert START_NS + NS_PER_S - truth.mono_ns < NS_PER_S / 240 + 1
    _, later_events = port.truth(START_NS + NS_PER_S)
    assert later_events == []


def test_a_cut_bus() -> None:
    """A cut bus drops frames and raises `BusGone`; after it is restored it carries frames, and the car has advanced."""
    port, sender = port_of(2), Sender2()
    port.send(sender.commands(CommandValues(brake=0.5)), START_NS)
    port.cut("the cable is cut")
    with pytest.raises(BusGone, match="the cable is cut"):
        port.take(START_NS + 100 * NS_PER_MS)
    with pytest.raises(BusGone, match="the cable is cut"):
        port.send(sender.commands(CommandValues()), START_NS + 100 * NS_PER_MS)
    assert port.car.kit.state.actuators["brake"].order is None
    port.cut("")
    assert [arrival.frame.identifier for arrival in port.take(START_NS + 115 * NS_PER_MS)] == [0x100, 0x2A4]
