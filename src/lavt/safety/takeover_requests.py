"""Who asks for a vehicle that somebody else holds, and for whom it is kept once that one has released it."""

from __future__ import annotations

from dataclasses import dataclass

from lavt.domain import SessionRequest


@dataclass(frozen=True, slots=True)
class _TakeoverRequest:
    who: str
    instance: int
    until_ns: int

    def is_of(self, request: SessionRequest) -> bool:
        return (request.who, request.instance) == (self.who, self.instance)


class TakeoverRequests:
    """One client at a time asks, the first that does; then it is kept for that one. Both lapse by themselves.

    Times are of the server's monotonic clock.
    """

    def __init__(self, *, handover_request_timeout_ns: int, kept_ns: int) -> None:
        self._handover_request_timeout_ns = handover_request_timeout_ns
        self._kept_ns = kept_ns
        self._asking: _TakeoverRequest | None = None
        self._kept: _TakeoverRequest | None = None

    def ask(self, request: SessionRequest, now_ns: int) -> str:
        """Note that somebody asks, or asks on; give why not, empty: it is noted."""
        if self._asking is not None and now_ns < self._asking.until_ns and not self._asking.is_of(request):
            return f"{self._asking.who} asks for it already"
        self._asking = _TakeoverRequest(request.who, request.instance, now_ns + self._handover_request_timeout_ns)
        return ""

    def requested_by(self, now_ns: int) -> str:
        """Give the name of who asks; empty: nobody, or not any more."""
        return self._asking.who if self._asking is not None and now_ns < self._asking.until_ns else ""

    def release(self, now_ns: int) -> None:
        """Keep the vehicle, which is free now, for who asks for it."""
        requested = self.requested_by(now_ns) and self._asking
        self._kept = _TakeoverRequest(requested.who, requested.instance, now_ns + self._kept_ns) if requested else None
        self._asking = None

    def reserved_for(self, request: SessionRequest, now_ns: int) -> str:
        """Give the name of the other for whom the vehicle is kept; empty: who requests may have it."""
        kept = self._kept
        return "" if kept is None or now_ns >= kept.until_ns or kept.is_of(request) else kept.who

    def forget(self) -> None:
        """Somebody holds the vehicle now: all claims are over."""
        self._asking = self._kept = None
