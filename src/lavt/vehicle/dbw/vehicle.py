"""A car with a by-wire kit, as a `Vehicle`: an adapter on a port, and the truth where a software car tells it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Protocol

from lavt.domain import NS_PER_MS, Actuation, GroundTruth, VehicleEvent, VehicleState
from lavt.vehicle.can_frame import BusGone, BusPort, CanFrame
from lavt.vehicle.vehicle import Capabilities, ReachedCommand

HEAR_PERIOD_NS = 10 * NS_PER_MS
"""So often the bus is listened to; a kit's fastest report comes as often."""


class KitAdapter(Protocol):
    """What speaks to a kind of kit, sans-IO: frames and times in, frames out."""

    @property
    def counts(self) -> Mapping[str, int]:
        """What was counted."""
        ...

    @property
    def is_silent(self) -> bool:
        """Whether nothing is sent: the kit has let go, or a driver has the car."""
        ...

    def receive(self, frame: CanFrame, now_ns: int) -> None:
        """Take a frame from the bus, whatever it is."""
        ...

    def bus_gone(self, why: str, now_ns: int) -> None:
        """The bus cannot be written to or read from."""
        ...

    def ask(self, actuation: Actuation, now_ns: int) -> None:
        """A tick: this is what the vehicle shall do now."""
        ...

    def engage(self, wanted: bool, now_ns: int) -> None:
        """Get the kit to obey, or let go of it."""
        ...

    def frames_due(self, now_ns: int) -> list[CanFrame]:
        """Give the frames that have to leave now, of the newest tick."""
        ...

    def next_wake_ns(self) -> int:
        """Tell when frames are due, or something is missing, at the latest."""
        ...

    def state(self) -> VehicleState:
        """Tell what the kit reports of the car."""
        ...

    def take_events(self) -> list[VehicleEvent]:
        """Take what has happened since the last call."""
        ...

    def take_reached(self) -> list[ReachedCommand]:
        """Take what was seen to have reached the wheels since the last call."""
        ...


Truth = Callable[[int], tuple[GroundTruth | None, list[VehicleEvent]]]
"""What a software car tells of itself by a time, beside the bus: the newest, and what has happened since then."""


class DbwVehicle:
    """A `lavt.vehicle.vehicle.Vehicle`. Frames leave in `advance` and `apply` only: of the tick that is being made."""

    def __init__(
        self,
        adapter: KitAdapter,
        port: BusPort,
        capabilities: Capabilities,
        *,
        start_ns: int,
        truth: Truth | None = None,
    ) -> None:
        self._adapter, self._port, self._truth = adapter, port, truth
        self._capabilities = capabilities
        self._told = None if truth is None else truth(start_ns)[0]
        self._heard_ns = start_ns

    @property
    def capabilities(self) -> Capabilities:
        """What this vehicle is and can do."""
        return self._capabilities

    @property
    def counts(self) -> Mapping[str, int]:
        """What was counted here and there."""
        return {**self._adapter.counts, **self._port.counts}

    @property
    def is_silent(self) -> bool:
        """Whether nothing is sent: the kit has let go, or a driver has the car."""
        return self._adapter.is_silent

    def advance(self, to_ns: int) -> list[VehicleEvent]:
        """Hear what the kit has said, and return what happened, in order."""
        self._hear(to_ns)
        events = self._adapter.take_events()
        if self._truth is not None:
            truth, happened = self._truth(to_ns)
            self._told = truth or self._told
            events += happened
        return sorted(events, key=lambda event: event.mono_ns)

    def apply(self, actuation: Actuation, now_ns: int) -> None:
        """Ask the kit for `actuation`; what is due leaves at once, after what the kit has said by now was heard."""
        self._hear(now_ns)
        self._adapter.ask(actuation, now_ns)
        try:
            self._port.send(self._adapter.frames_due(now_ns), now_ns)
        except BusGone as gone:
            self._adapter.bus_gone(str(gone), now_ns)

    def _hear(self, now_ns: int) -> None:
        self._heard_ns = now_ns
        try:
            for heard in self._port.take(now_ns):
                self._adapter.receive(heard.frame, min(heard.arrived_ns, now_ns))
        except BusGone as gone:
            self._adapter.bus_gone(str(gone), now_ns)

    def engage(self, wanted: bool, now_ns: int) -> None:
        """Get the kit to obey, or let go of it once the car stands."""
        self._adapter.engage(wanted, now_ns)

    def take_reached(self) -> list[ReachedCommand]:
        """Take what the kit has reported to steer by since the last call."""
        return self._adapter.take_reached()

    def state(self) -> VehicleState:
        """Tell what the kit reports."""
        return self._adapter.state()

    def ground_truth(self) -> GroundTruth | None:
        """Tell the newest truth of a software car."""
        return self._told

    def next_wake_ns(self) -> int:
        """Tell when frames are due or expected."""
        port_ns = self._port.next_wake_ns()
        return min(self._adapter.next_wake_ns(), self._heard_ns + HEAR_PERIOD_NS if port_ns is None else port_ns)

    def close(self) -> None:
        """Let go of the bus."""
        self._port.close()
