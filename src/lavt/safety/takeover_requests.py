"""Requests of other clients for a controlled vehicle, and the reservation of the vehicle for the requester."""

from __future__ import annotations

from dataclasses import dataclass

from lavt.domain import SessionRequest


@dataclass(frozen=True, slots=True)
class _TakeoverRequest:
    client_name: str
    instance: int
    until_ns: int

    def is_from(self, request: SessionRequest) -> bool:
        return (request.who, request.instance) == (self.client_name, self.instance)


class TakeoverRequests:
    """The pending handover request of at most one client, which becomes a reservation when control is released.

    The first requester has priority. Request and reservation both expire. Times are on the server's monotonic clock.
    """

    def __init__(self, *, handover_request_timeout_ns: int, reservation_ns: int) -> None:
        self._handover_request_timeout_ns = handover_request_timeout_ns
        self._reservation_ns = reservation_ns
        self._request: _TakeoverRequest | None = None
        self._reservation: _TakeoverRequest | None = None

    def add(self, request: SessionRequest, now_ns: int) -> str:
        """Store or renew a handover request; return why it is rejected, or an empty string."""
        if self._request is not None and now_ns < self._request.until_ns and not self._request.is_from(request):
            return f"{self._request.client_name} has requested control already"
        self._request = _TakeoverRequest(request.who, request.instance, now_ns + self._handover_request_timeout_ns)
        return ""

    def requested_by(self, now_ns: int) -> str:
        """Return the name of the client whose request is pending; empty if there is none."""
        return self._request.client_name if self._request is not None and now_ns < self._request.until_ns else ""

    def reserve(self, now_ns: int) -> None:
        """Reserve the released vehicle for the client whose request is pending, if there is one."""
        pending = self._request if self.requested_by(now_ns) else None
        until_ns = now_ns + self._reservation_ns
        self._reservation = _TakeoverRequest(pending.client_name, pending.instance, until_ns) if pending else None
        self._request = None

    def reserved_for(self, request: SessionRequest, now_ns: int) -> str:
        """Return the name of another client for which the vehicle is reserved; empty if there is none."""
        reservation = self._reservation
        if reservation is None or now_ns >= reservation.until_ns or reservation.is_from(request):
            return ""
        return reservation.client_name

    def clear(self) -> None:
        """Drop request and reservation, because a client has acquired control."""
        self._request = self._reservation = None
