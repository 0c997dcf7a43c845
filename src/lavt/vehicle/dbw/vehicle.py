"""A car with a by-wire kit as a `Vehicle`: an adapter, a bus port and, for a software car, a source of ground truth."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Protocol

from lavt.domain import NS_PER_MS, Actuation, GroundTruth, VehicleEvent, VehicleState
from lavt.vehicle.can_frame import BusGone, BusPort, CanFrame
from lavt.vehicle.vehicle import Capabilities, ReachedCommand

POLL_PERIOD_NS = 10 * NS_PER_MS
"""Period at which the bus is read, which is the period of a kit's most frequent report."""


class KitAdapter(Protocol):
    """A controller for one kind of kit, without I/O: it takes frames and times, and returns frames."""

    @property
    def counts(self) -> Mapping[str, int]:
        """Event counters by name."""
        ...

    @property
    def is_idle_or_overridden(self) -> bool:
        """Whether no actuation is requested of the kit: the adapter is idle, or a driver overrides the kit."""
        ...

    def receive(self, frame: CanFrame, now_ns: int) -> None:
        """Process any frame from the bus."""
        ...

    def on_bus_gone(self, reason: str, now_ns: int) -> None:
        """Note that the bus cannot be written to or read from."""
        ...

    def set_actuation(self, actuation: Actuation, now_ns: int) -> None:
        """Set the actuation that is requested from now on; each call is a tick."""
        ...

    def engage(self, wanted: bool, now_ns: int) -> None:
        """Engage or disengage the kit."""
        ...

    def frames_due(self, now_ns: int) -> list[CanFrame]:
        """Return the frames to send now for the newest tick."""
        ...

    def on_dropped(self, frames: Sequence[CanFrame]) -> None:
        """Note that `frames` were not written; they are the last ones of the frames that were due."""
        ...

    def next_wake_ns(self) -> int:
        """Return the time by which `frames_due` should be called next: frames are due then, or a report is missing."""
        ...

    def state(self) -> VehicleState:
        """Return the state of the car as the kit reports it."""
        ...

    def take_events(self) -> list[VehicleEvent]:
        """Return the events since the last call."""
        ...

    def take_reached(self) -> list[ReachedCommand]:
        """Return the commands that the kit reported as reached since the last call."""
        ...


TruthSource = Callable[[int], tuple[GroundTruth | None, list[VehicleEvent]]]
"""Returns a software car's newest ground truth, which is not on the bus, and its events since the last call."""


class DbwVehicle:
    """A `lavt.vehicle.vehicle.Vehicle` with a by-wire kit. Only `apply` sends frames."""

    def __init__(
        self,
        adapter: KitAdapter,
        port: BusPort,
        capabilities: Capabilities,
        *,
        start_ns: int,
        truth: TruthSource | None = None,
    ) -> None:
        self._adapter, self._port, self._truth = adapter, port, truth
        self._capabilities = capabilities
        self._newest_truth = None if truth is None else truth(start_ns)[0]
        self._polled_ns = start_ns

    @property
    def capabilities(self) -> Capabilities:
        """The properties of this vehicle."""
        return self._capabilities

    @property
    def counts(self) -> Mapping[str, int]:
        """Counters of the adapter and the port."""
        return {**self._adapter.counts, **self._port.counts}

    @property
    def is_idle_or_overridden(self) -> bool:
        """Whether no actuation is requested of the kit: the adapter is idle, or a driver overrides the kit."""
        return self._adapter.is_idle_or_overridden

    def advance(self, to_ns: int) -> list[VehicleEvent]:
        """Process received frames and return the events since the last call, in order."""
        self._poll_bus(to_ns)
        events = self._adapter.take_events()
        if self._truth is not None:
            truth, new_events = self._truth(to_ns)
            self._newest_truth = truth or self._newest_truth
            events += new_events
        return sorted(events, key=lambda event: event.mono_ns)

    def apply(self, actuation: Actuation, now_ns: int) -> None:
        """Process received frames, then request `actuation` and send the frames that are due."""
        self._poll_bus(now_ns)
        self._adapter.set_actuation(actuation, now_ns)
        frames = self._adapter.frames_due(now_ns)
        try:
            self._adapter.on_dropped(frames[self._port.send(frames, now_ns) :])
        except BusGone as gone:
            self._adapter.on_dropped(frames[gone.written :])
            self._adapter.on_bus_gone(str(gone), now_ns)

    def _poll_bus(self, now_ns: int) -> None:
        self._polled_ns = now_ns
        try:
            for received in self._port.take(now_ns):
                self._adapter.receive(received.frame, min(received.arrived_ns, now_ns))
        except BusGone as gone:
            self._adapter.on_bus_gone(str(gone), now_ns)

    def engage(self, wanted: bool, now_ns: int) -> None:
        """Engage the kit, or disengage it once the car is stationary."""
        self._adapter.engage(wanted, now_ns)

    def take_reached(self) -> list[ReachedCommand]:
        """Return the commands that the kit reported as reached since the last call."""
        return self._adapter.take_reached()

    def state(self) -> VehicleState:
        """Return the state that the kit reports."""
        return self._adapter.state()

    def ground_truth(self) -> GroundTruth | None:
        """Return a software car's newest ground truth, or None."""
        return self._newest_truth

    def next_wake_ns(self) -> int:
        """Return the time by which `advance` should be called next."""
        port_ns = self._port.next_wake_ns()
        return min(self._adapter.next_wake_ns(), self._polled_ns + POLL_PERIOD_NS if port_ns is None else port_ns)

    def close(self) -> None:
        """Close the bus."""
        self._port.close()
