"""Checks of a CARLA server through a session: whether the car does what LAVT assumes, and how long ticks take.

No real server was ever used, so these checks are what a user with one runs first.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from statistics import median
from typing import Final

import numpy as np
from msgspec import Struct

from lavt.clock import Clock
from lavt.domain import NS_PER_MS, NS_PER_S, Actuation
from lavt.vehicle.carla.session import BRAKED, CarlaSession
from lavt.vehicle.carla.settings import Snapshot
from lavt.vehicle.carla.ticker import Ticker
from lavt.vehicle.carla.vehicle import CarlaVehicle
from lavt.vehicle.contract import ContractLimits, check_contract
from lavt.vehicle.sim.dynamics import CarParameters
from lavt.vehicle.sim.road.road import Road, parse_road
from lavt.vehicle.vehicle import Vehicle

CHECK_SPEED_MPS: Final = 5.0
MAX_RUN_UP_S: Final = 10.0
STEP_S: Final = 1.5
SETTLED_S: Final = 0.5
"""The yaw rate is measured in the last part of a step steer, of this length."""
STEER_STEPS_RAD: Final = (0.04, -0.04, 0.08, -0.08)
STEERING_TOLERANCE: Final = 0.1
"""The relative difference between commanded and driven steering angle that the check accepts."""
STATIONARY_MPS: Final = 0.05
MIN_BRAKED_MPS, MIN_BRAKING_MPS2 = 4.0, 3.0
"""The check of the brake begins at least at this speed, and expects at least this deceleration."""
TIMED_TICKS: Final = 100
CONTRACT_LIMITS: Final = ContractLimits(
    speed_mps=(0.3, 15.0), full_throttle_mps=0.5, steering_tolerance_rad=0.02, stop_s=6.0
)
"""What any car of CARLA must do: LAVT was never tried with a real one, so the limits are wide."""
CONTRACT_START_NS: Final = NS_PER_S


class CarlaCheck(Struct, frozen=True):
    """One check with its result."""

    name: str
    passed: bool | None
    """None: the check could not be made."""
    detail: str
    """What was measured or, if the check was not passed, the reason."""


class StepSteer(Struct, frozen=True):
    """A step steer: the commanded road wheel angle, and the angle that the driven curve corresponds to."""

    commanded_rad: float
    reported_rad: float
    driven_rad: float


class TickTimes(Struct, frozen=True):
    """How long ticks take (ms)."""

    tick_p50_ms: float
    tick_p95_ms: float
    picture_p50_ms: float
    """From the beginning of a tick until its picture has arrived."""
    picture_p95_ms: float
    pictures_missing: int
    request_p50_ms: float
    """The answer to the shortest request."""
    request_p95_ms: float


def check_vehicle_contract(session: CarlaSession, parameters: CarParameters) -> list[CarlaCheck]:
    """Run the contract of vehicles, each check from the session's start, on a straight road that is made up there."""
    road = _straight_road(session)

    def build(start_ns: int) -> Vehicle:
        session.reset()
        session.take_events()
        ticker = Ticker(session, first_due_ns=start_ns, period_s=session.settings.tick_s, actuation=BRAKED)
        return CarlaVehicle(session, ticker, road, parameters, start_ns=start_ns)

    return [
        CarlaCheck(f"contract: {result.name}", not result.violations, "; ".join(result.violations) or "as LAVT assumes")
        for result in check_contract(build, CONTRACT_START_NS, CONTRACT_LIMITS)
    ]


def _straight_road(session: CarlaSession) -> Road:
    x_m, y_m, heading_rad = session.snapshot.pose
    origin = f"{{x_m: {x_m:.4f}, y_m: {y_m:.4f}, heading_rad: {heading_rad:.6f}}}"
    return parse_road(f"title: check\norigin: {origin}\nsegments: [{{length_m: 300}}]\n", "the road of the check")


def check_driving(session: CarlaSession) -> list[CarlaCheck]:
    """Drive straight ahead and brake; return what was checked."""
    session.reset()
    waited = _drive(session, BRAKED, 1.0)
    rests = CarlaCheck("stationary", abs(waited.speed_mps) < STATIONARY_MPS, f"{waited.speed_mps:.3f} m/s when braked")
    half = _acceleration_mps2(session, Actuation(0.0, 0.5, 0.0))
    full = _acceleration_mps2(session, Actuation(0.0, 1.0, 0.0))
    pulls = CarlaCheck("throttle", full > half > 0.1, f"{half:.2f} m/s2 at throttle 0.5, {full:.2f} m/s2 at throttle 1")
    _run_up(session)
    before = session.snapshot.speed_mps
    ticks = 0
    while abs(session.snapshot.speed_mps) > STATIONARY_MPS and ticks * session.settings.tick_s < MAX_RUN_UP_S:
        session.tick(BRAKED)
        ticks += 1
    braking = before / max(ticks * session.settings.tick_s, session.settings.tick_s)
    stays = _drive(session, BRAKED, 1.0)
    is_braked = abs(stays.speed_mps) < STATIONARY_MPS and before >= MIN_BRAKED_MPS and braking >= MIN_BRAKING_MPS2
    brakes = CarlaCheck("brake", is_braked, f"{braking:.2f} m/s2 on average from {before:.1f} m/s with brake 1")
    return [rests, pulls, brakes]


def measure_steering(session: CarlaSession, angles_rad: Sequence[float] = STEER_STEPS_RAD) -> list[StepSteer]:
    """Return the driven steering angle of a step steer for each commanded angle.

    The driven angle is atan(yaw rate x wheelbase / speed), from the poses in the last part of the step.
    """
    return [_step_steer(session, angle_rad) for angle_rad in angles_rad]


def check_steering(steps: Sequence[StepSteer]) -> list[CarlaCheck]:
    """Return whether the car turns to the commanded side by the commanded angle."""
    sides = all(step.commanded_rad * step.driven_rad > 0.0 for step in steps)
    share = steering_share(steps)
    texts = ", ".join(f"{step.driven_rad:+.4f} for {step.commanded_rad:+.4f}" for step in steps)
    return [
        CarlaCheck("steering side", sides, f"driven angle in rad, left positive: {texts}"),
        CarlaCheck(
            "steering angle",
            sides and abs(share - 1.0) < STEERING_TOLERANCE,
            f"the driven angle is {share:.3f} times the commanded one",
        ),
    ]


def steering_share(steps: Sequence[StepSteer]) -> float:
    """Return the median ratio of driven and commanded angles."""
    return median(step.driven_rad / step.commanded_rad for step in steps)


def steering_disagreement(steps: Sequence[StepSteer]) -> str:
    """Return why no single factor describes the steps; empty if one does."""
    share = steering_share(steps)
    if share <= 0.0:
        return "the car did not turn to the commanded side"
    shares = [step.driven_rad / step.commanded_rad for step in steps]
    if any(abs(each / share - 1.0) > STEERING_TOLERANCE for each in shares):
        return f"the steps disagree: driven and commanded angle have ratios from {min(shares):.3f} to {max(shares):.3f}"
    return ""


def time_ticks(session: CarlaSession, clock: Clock, count: int = TIMED_TICKS) -> TickTimes:
    """Tick a stationary car, as fast as the server can, and return how long it takes."""
    ticks_ms, pictures_ms, missing = [], [], 0
    for _ in range(count):
        begin_ns = clock.now().mono_ns
        frame = session.tick(BRAKED, hand_brake=True).frame
        ticks_ms.append((clock.now().mono_ns - begin_ns) / NS_PER_MS)
        if session.pictures.take(frame, session.settings.tick_timeout_s) is None:
            missing += 1
        else:
            pictures_ms.append((clock.now().mono_ns - begin_ns) / NS_PER_MS)
    requests_ms = []
    for _ in range(count):
        begin_ns = clock.now().mono_ns
        session.ask_version()
        requests_ms.append((clock.now().mono_ns - begin_ns) / NS_PER_MS)
    return TickTimes(
        _percentile(ticks_ms, 50),
        _percentile(ticks_ms, 95),
        _percentile(pictures_ms, 50),
        _percentile(pictures_ms, 95),
        missing,
        _percentile(requests_ms, 50),
        _percentile(requests_ms, 95),
    )


def describe_times(times: TickTimes, tick_s: float) -> str:
    """Return the measured times, and whether they suffice for driving in real time."""
    verdict = "fast enough" if times.picture_p95_ms < tick_s * 1e3 else "too slow"
    parts = {
        "ticks take": (times.tick_p50_ms, times.tick_p95_ms),
        "pictures arrive after": (times.picture_p50_ms, times.picture_p95_ms),
        "requests take": (times.request_p50_ms, times.request_p95_ms),
    }
    measured = ", ".join(f"{text} {p50_ms:.1f} ms (p95 {p95_ms:.1f} ms)" for text, (p50_ms, p95_ms) in parts.items())
    return (
        f"{times.pictures_missing} pictures missing; {measured}; {verdict} for real time with a tick each "
        f"{tick_s * 1e3:.1f} ms"
    )


def _percentile(values: Sequence[float], percent: float) -> float:
    return float(np.percentile(values, percent)) if values else math.nan


def _drive(
    session: CarlaSession, actuation: Actuation, seconds: float, until: Callable[[Snapshot], bool] | None = None
) -> Snapshot:
    """Drive for some time, or until a condition; return the last snapshot."""
    snapshot = session.snapshot
    for _ in range(math.ceil(seconds / session.settings.tick_s)):
        snapshot = session.tick(actuation)
        if until is not None and until(snapshot):
            break
    return snapshot


def _acceleration_mps2(session: CarlaSession, actuation: Actuation) -> float:
    """Return the mean acceleration in the second second, when lags have passed."""
    session.reset()
    first = _drive(session, actuation, 1.0)
    second = _drive(session, actuation, 1.0)
    return (second.speed_mps - first.speed_mps) / (math.ceil(1.0 / session.settings.tick_s) * session.settings.tick_s)


def _run_up(session: CarlaSession) -> None:
    session.reset()
    throttle = Actuation(0.0, 1.0, 0.0)
    _drive(session, throttle, MAX_RUN_UP_S, lambda snapshot: snapshot.speed_mps >= CHECK_SPEED_MPS)


def _step_steer(session: CarlaSession, angle_rad: float) -> StepSteer:
    _run_up(session)
    coasting = Actuation(angle_rad, 0.1, 0.0)
    first = _drive(session, coasting, STEP_S - SETTLED_S)
    ticks = math.ceil(SETTLED_S / session.settings.tick_s)
    last, speeds_mps = first, []
    for _ in range(ticks):
        last = session.tick(coasting)
        speeds_mps.append(last.speed_mps)
    turned_rad = math.remainder(last.pose.heading_rad - first.pose.heading_rad, 2 * math.pi)
    driven_m = sum(speeds_mps) * session.settings.tick_s
    driven_rad = math.atan(turned_rad / driven_m * session.wheelbase_m) if driven_m > 0.1 else 0.0
    return StepSteer(angle_rad, last.steering_rad, driven_rad)
