"""The reasons for which a run is invalid, each with a code for programs and a text for people."""

from __future__ import annotations

from enum import StrEnum

from msgspec import Struct


class InvalidCode(StrEnum):
    """What makes a run invalid; docs/metrics.md explains each code."""

    RECORD_INCOMPLETE = "record_incomplete"
    RECORD_OVERFLOW = "record_overflow"
    NO_ENDING = "no_ending"
    CLOCK_STEP = "clock_step"
    CLOCK_NOT_SAMPLED = "clock_not_sampled"
    CLOCK_UNKNOWN = "clock_unknown"
    NTP_THROUGH_DELAY = "ntp_through_delay"
    NTP_NO_SAMPLE = "ntp_no_sample"
    PTP_GRANDMASTERS = "ptp_grandmasters"
    CLOCK_DISAGREEMENT = "clock_disagreement"
    CLOCK_BOUND = "clock_bound"
    CLOCK_UNCHECKED = "clock_unchecked"
    CLOSURE = "closure"
    PHYSICS_LATE = "physics_late"
    FRAMES_MISSED = "frames_missed"
    STATES_LATE = "states_late"
    LOOP_JITTER = "loop_jitter"
    INJECTION_DIFFERS = "injection_differs"
    INJECTION_NOT_MEASURED = "injection_not_measured"
    INJECTION_NOT_IN_FORCE = "injection_not_in_force"
    INJECTION_NOT_REQUESTED = "injection_not_requested"
    INJECTION_NOT_ON_PATH = "injection_not_on_path"


class InvalidReason(Struct, frozen=True):
    """A reason for which a run is invalid."""

    code: InvalidCode
    text: str
    """A sentence with the measured value and its limit."""


class MeasuredCheck(Struct, frozen=True):
    """A check of a run's validity with a number: a value over its limit makes the run invalid."""

    code: InvalidCode
    value: float
    limit: float
    """Both in ms; in s for clock samples; a share for physics, frames and the path of the injected delay."""


def not_measured(flow: str) -> InvalidReason:
    """Return the reason for a flow whose injected delay was not measured."""
    return InvalidReason(InvalidCode.INJECTION_NOT_MEASURED, f"the injected delay of {flow} was not measured")
