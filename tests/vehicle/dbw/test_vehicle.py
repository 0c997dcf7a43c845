"""A by-wire car as a `Vehicle`: its calls of the adapter, the port and the source of ground truth."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import pytest
from tests.vehicle.dbw.fuzzer import CAPABILITIES
from tests.vehicle.dbw.rig import START_NS, profile

from lavt.domain import NS_PER_MS, Actuation, GroundTruth, VehicleEvent
from lavt.vehicle.can_frame import BusGone, CanFrame, ReceivedCanFrame
from lavt.vehicle.dbw.adapter import ByWireAdapter
from lavt.vehicle.dbw.vehicle import DbwVehicle, TruthSource
from lavt.vehicle.vehicle import ReachedCommand

SPEED = CanFrame(0x065, bytes([0, 0, 0, 0, 100, 0, 0, 0]))
"""A SteeringReport of generation 1 with a speed above zero."""


class StandInPort:
    """A port that returns frames from a test and records the sent frames."""

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter(overflowed=3)
        self.waiting: list[ReceivedCanFrame] = []
        self.sent: list[tuple[CanFrame, int]] = []
        self.wake_ns: int | None = None
        self.taken_ns = 0
        self.is_gone = self.is_closed = False

    def send(self, frames: Sequence[CanFrame], made_ns: int) -> int:
        """Record frames with the time at which they were made."""
        self._check()
        self.sent += [(frame, made_ns) for frame in frames]
        return len(frames)

    def take(self, now_ns: int) -> list[ReceivedCanFrame]:
        """Return the waiting frames once, and record the time."""
        self._check()
        self.taken_ns = now_ns
        taken, self.waiting = self.waiting, []
        return taken

    def next_wake_ns(self) -> int | None:
        """Return the test's value."""
        return self.wake_ns

    def close(self) -> None:
        """Record the call."""
        self.is_closed = True

    def _check(self) -> None:
        if self.is_gone:
            raise BusGone("pulled out")


@pytest.fixture
def port() -> StandInPort:
    return StandInPort()


def new_vehicle(port: StandInPort, truth: TruthSource | None = None) -> DbwVehicle:
    adapter = ByWireAdapter(profile("dataspeed_gen1"), start_ns=START_NS)
    return DbwVehicle(adapter, port, CAPABILITIES, start_ns=START_NS, truth=truth)


def truth_at(mono_ns: int) -> GroundTruth:
    return GroundTruth(mono_ns, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


def test_without_truth(port: StandInPort) -> None:
    """Without a source of ground truth a vehicle returns none, and still processes its kit's reports."""
    vehicle = new_vehicle(port)
    port.waiting = [ReceivedCanFrame(SPEED, START_NS + 1)]
    assert vehicle.advance(START_NS + NS_PER_MS) == []
    assert vehicle.ground_truth() is None
    assert vehicle.state().speed_mps > 0
    assert port.taken_ns == START_NS + NS_PER_MS


def test_truth_and_events(port: StandInPort) -> None:
    """Events of the software car and of the kit are returned in order of time, with the newest truth."""
    truths: list[tuple[GroundTruth | None, list[VehicleEvent]]] = [
        (truth_at(START_NS), []),
        (truth_at(START_NS + 5), [VehicleEvent(START_NS + 5, "collision", ""), VehicleEvent(START_NS, "off_road", "")]),
        (None, []),
    ]
    vehicle = new_vehicle(port, lambda _: truths.pop(0))
    assert vehicle.ground_truth() == truth_at(START_NS)
    override = CanFrame(0x061, bytes([0, 0, 0, 0, 0, 0, 0, 0x10]))  # a foot on the brake
    port.waiting = [ReceivedCanFrame(override, START_NS + 3)]
    events = vehicle.advance(START_NS + 9)
    assert [(event.mono_ns - START_NS, event.kind) for event in events] == [
        (0, "off_road"),
        (3, "fault"),
        (5, "collision"),
    ]
    assert vehicle.ground_truth() == truth_at(START_NS + 5)
    vehicle.advance(START_NS + 20)
    assert vehicle.ground_truth() == truth_at(START_NS + 5)


@pytest.mark.parametrize(("arrived_ns", "counted_ns"), [(-7, -7), (0, 0), (1, 0)])
def test_arrival(port: StandInPort, arrived_ns: int, counted_ns: int) -> None:
    """A report has the time of its arrival, but never a time later than now."""
    vehicle = new_vehicle(port)
    now_ns = START_NS + NS_PER_MS
    port.waiting = [ReceivedCanFrame(SPEED, now_ns + arrived_ns)]
    vehicle.apply(Actuation(0.0, 0.0, 0.0), now_ns)
    assert vehicle.state().mono_ns == now_ns + counted_ns


def test_wake(port: StandInPort) -> None:
    """The bus is polled every 10 ms or when the port requires it, and no later than the adapter requires."""
    vehicle = new_vehicle(port)
    vehicle.advance(START_NS + NS_PER_MS)
    assert vehicle.next_wake_ns() == START_NS + 11 * NS_PER_MS
    port.wake_ns = START_NS + 2 * NS_PER_MS
    assert vehicle.next_wake_ns() == START_NS + 2 * NS_PER_MS
    port.wake_ns = START_NS + 10**12
    assert vehicle.next_wake_ns() == START_NS + 100 * NS_PER_MS


def test_bus_gone(port: StandInPort) -> None:
    """A lost bus inhibits driving until a frame arrives, and raises nothing in reading or writing."""
    vehicle = new_vehicle(port)
    port.is_gone = True
    vehicle.advance(START_NS + 1)
    vehicle.apply(Actuation(0.0, 0.0, 0.0), START_NS + 2)
    assert "pulled out" in vehicle.state().inhibit_reason
    port.is_gone = False
    port.waiting = [ReceivedCanFrame(SPEED, START_NS + 3)]
    vehicle.advance(START_NS + 3)
    assert "pulled out" not in vehicle.state().inhibit_reason


def test_apply(port: StandInPort, monkeypatch: pytest.MonkeyPatch) -> None:
    """Due frames are sent with the time of the tick, after received frames were processed."""
    adapter = ByWireAdapter(profile("dataspeed_gen1"), start_ns=START_NS)
    monkeypatch.setattr(adapter, "frames_due", lambda now_ns: [SPEED] if port.taken_ns == now_ns else [])
    vehicle = DbwVehicle(adapter, port, CAPABILITIES, start_ns=START_NS)
    vehicle.apply(Actuation(0.1, 0.2, 0.3), START_NS + 7)
    assert port.sent == [(SPEED, START_NS + 7)]
    assert adapter.tick_ns == START_NS + 7


def test_engage_and_reached(port: StandInPort, monkeypatch: pytest.MonkeyPatch) -> None:
    """`engage` is passed to the adapter, and the adapter's reached commands are returned."""
    adapter = ByWireAdapter(profile("dataspeed_gen1"), start_ns=START_NS)
    requests: list[tuple[bool, int]] = []
    monkeypatch.setattr(adapter, "engage", lambda *request: requests.append(request))
    monkeypatch.setattr(adapter, "take_reached", lambda: [ReachedCommand(1, 2)])
    vehicle = DbwVehicle(adapter, port, CAPABILITIES, start_ns=START_NS)
    vehicle.engage(True, 3)
    vehicle.engage(False, 4)
    assert requests == [(True, 3), (False, 4)]
    assert vehicle.take_reached() == [ReachedCommand(1, 2)]


def test_write_fails(port: StandInPort, monkeypatch: pytest.MonkeyPatch) -> None:
    """A bus that cannot be written to inhibits driving, even if it can be read."""
    vehicle = new_vehicle(port)

    def fail(*_: object) -> None:
        raise BusGone("no more room")

    monkeypatch.setattr(port, "send", fail)
    vehicle.apply(Actuation(0.0, 0.0, 0.0), START_NS + 2)
    assert "no more room" in vehicle.state().inhibit_reason


@pytest.mark.parametrize("is_gone", [False, True])
@pytest.mark.parametrize("written", [0, 1, 2])
def test_frames_that_were_not_written(
    port: StandInPort, monkeypatch: pytest.MonkeyPatch, written: int, is_gone: bool
) -> None:
    """The adapter gets back the frames that the port did not write, even if the bus was lost during the write."""
    vehicle = new_vehicle(port)
    frames = [CanFrame(number, bytes(8)) for number in range(3)]
    dropped: list[CanFrame] = []

    def send(*_: object) -> int:
        if is_gone:
            raise BusGone("no more room", written)
        return written

    monkeypatch.setattr(port, "send", send)
    monkeypatch.setattr(vehicle._adapter, "frames_due", lambda _: frames)
    monkeypatch.setattr(vehicle._adapter, "on_dropped", dropped.extend)
    vehicle.apply(Actuation(0.0, 0.0, 0.0), START_NS + 2)
    assert dropped == frames[written:]
    assert ("no more room" in vehicle.state().inhibit_reason) is is_gone


def test_delegation(port: StandInPort) -> None:
    """Capabilities, counts, silence and closing are those of the adapter and the port."""
    vehicle = new_vehicle(port)
    port.waiting = [ReceivedCanFrame(CanFrame(0x555, bytes(8)), START_NS)]
    before = vehicle.counts.get("unknown_identifier", 0)
    vehicle.advance(START_NS + 1)
    assert vehicle.capabilities == CAPABILITIES
    assert (vehicle.counts["unknown_identifier"] - before, vehicle.counts["overflowed"]) == (1, 3)
    assert vehicle.is_idle_or_overridden
    vehicle.close()
    assert port.is_closed
