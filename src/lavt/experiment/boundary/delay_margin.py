"""How much delay the lateral loop bears, computed: a sampled-data model of lane keeping by pure pursuit.

The car is the linearised dynamic bicycle on a straight lane (R. Rajamani, Vehicle Dynamics and Control, chapter 2)
behind a first-order steering lag; the controller is pure pursuit linearised about the lane's centre,

    command = -(2 wheelbase / lookahead^2) (lateral error + lookahead x heading error),

computed once a frame from an exponential moving average and held until the next command takes effect. The total delay,
from the middle of exposure to the wheel's command, splits into whole frames and a fraction: within one frame the old
command acts first and the new one after it, so the sampled plant has two input matrices (Astrom and Wittenmark,
Computer-Controlled Systems, section 3.2). The wait for the next picture, half a frame on average, is the hold of this
model and must not be added to the delay again. A car's dead time of steering comes on top of the total delay.

Without lag, filter, hold and tyres the bound is `DELAY_PER_LOOKAHEAD` x lookahead / speed (Heredia and Ollero, Advanced
Robotics 21, 2007, analyse that case); it is two to three times too generous for a real car.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from lavt.assembly.simulators import car_of
from lavt.config import RunConfig
from lavt.control.drive_controller import find_preset
from lavt.control.pure_pursuit import lookahead_m
from lavt.domain import FloatArray
from lavt.perception.lane_detector import SMOOTHING
from lavt.vehicle.sim.dynamics import CarParameters
from lavt.vehicle.sim.rendering.cars import LINCOLN_MKZ

ComplexArray = NDArray[np.complex128]

DELAY_PER_LOOKAHEAD = math.acos(math.sqrt(2) - 1) / math.sqrt(2 + 2 * math.sqrt(2))
"""Critical delay of the bare loop (2 a s + 2 a^2) / s^2 in units of 1 / a, a = speed / lookahead: 0.5205.

|L(jw)| = 1 at (w / a)^2 = 2 + 2 sqrt(2); the phase left there, atan(w / a), is acos(sqrt(2) - 1)."""

DEFAULT_CAR = LINCOLN_MKZ
"""The simulator's car; of its parameters the model takes those of the lateral motion at small slip."""

_LONGEST_DELAY_S = 3.0  # past every delay that is of interest; the search ends there
_SEARCH_STEP_S = 0.005


@dataclass(frozen=True, slots=True)
class LateralLoop:
    """A car at a speed, seen at a frame rate, steered by pure pursuit with lookahead = `lookahead_s` x speed."""

    lookahead_s: float
    speed_mps: float = 30 / 3.6
    frame_rate_hz: float = 30.0
    smoothing: float = SMOOTHING
    """Weight of the newest picture in the moving average; 1 is none."""
    car: CarParameters = DEFAULT_CAR
    supposed_wheelbase_m: float | None = None
    """What the controller takes for the car's wheelbase; None: what it is."""

    @property
    def gain(self) -> FloatArray:
        """Pure pursuit on (lateral error of the rear axle, heading error), a row of 2."""
        distance_m = self.lookahead_s * self.speed_mps
        wheelbase_m = self.supposed_wheelbase_m or self.car.wheelbase_m
        return -2 * wheelbase_m / distance_m**2 * np.array([1.0, distance_m])


def configured_loop(config: RunConfig) -> LateralLoop | None:
    """Give the loop as a run has it: preset and what replaces its settings, frame rate, car with lags and dead time.

    The lookahead is the one driven at the preset's speed, within the controller's bounds. None where the car or the
    controller is not of LAVT: nothing is known of them. Raises `UserError` for a preset or car that does not exist.
    """
    controller, vehicle = config.controller, config.vehicle
    if (controller.kind, vehicle.kind) != ("lane_keeper", "simulator"):
        return None
    preset = replace(find_preset(controller.preset), **controller.changes)
    return LateralLoop(
        lookahead_s=lookahead_m(preset.lookahead_s, preset.speed_mps) / preset.speed_mps,
        speed_mps=preset.speed_mps,
        frame_rate_hz=config.camera.rate_hz,
        car=car_of(vehicle),
        supposed_wheelbase_m=controller.wheelbase_m,
    )


def plant(loop: LateralLoop) -> tuple[FloatArray, FloatArray]:
    """Give A (5 x 5) and B (5,) of the car in continuous time.

    States: lateral speed of the centre of gravity, yaw rate, lateral error of the rear axle, heading error, wheel
    angle.
    """
    car, speed = loop.car, loop.speed_mps
    ahead, behind = car.front_axle_to_gravity_m, car.wheelbase_m - car.front_axle_to_gravity_m
    front, rear = car.front_stiffness_nprad, car.rear_stiffness_nprad
    mass, inertia = car.mass_kg, car.yaw_inertia_kgm2
    coupling = rear * behind - front * ahead
    a = np.zeros((5, 5))
    a[0] = [-(front + rear) / (mass * speed), coupling / (mass * speed) - speed, 0, 0, front / mass]
    yaw_damping = (front * ahead**2 + rear * behind**2) / (inertia * speed)
    a[1] = [coupling / (inertia * speed), -yaw_damping, 0, 0, front * ahead / inertia]
    a[2] = [1, -behind, 0, speed, 0]
    a[3, 1] = 1
    a[4, 4] = -1 / car.steering_lag_s
    return a, np.array([0, 0, 0, 0, 1 / car.steering_lag_s])


def _advance(a: FloatArray, b: FloatArray, duration_s: float) -> tuple[FloatArray, FloatArray]:
    """Give the transition of the state over `duration_s`, and what a constant command of 1 adds in it."""
    size = len(b)
    joined = np.zeros((size + 1, size + 1))
    joined[:size, :size], joined[:size, size] = a, b
    moved = np.asarray(expm(joined * duration_s), dtype=np.float64)
    return moved[:size, :size], moved[:size, size]


@dataclass(frozen=True, slots=True)
class _SampledPlant:
    """The plant from frame to frame: x' = transition x + by_old u[k - frames - 1] + by_new u[k - frames]."""

    transition: FloatArray
    by_old: FloatArray
    by_new: FloatArray
    frames: int


def _sampled(loop: LateralLoop, total_delay_s: float) -> _SampledPlant:
    a, b = plant(loop)
    period_s = 1 / loop.frame_rate_hz
    total_delay_s += loop.car.steering_dead_time_s
    frames = int(total_delay_s / period_s)
    fraction_s = min(max(total_delay_s - frames * period_s, 0.0), period_s)
    transition, _ = _advance(a, b, period_s)
    _, early = _advance(a, b, fraction_s)
    rest, late = _advance(a, b, period_s - fraction_s)
    return _SampledPlant(transition, by_old=rest @ early, by_new=late, frames=frames)


def closed_loop(loop: LateralLoop, total_delay_s: float) -> FloatArray:
    """Give the matrix that takes the closed loop from one frame to the next.

    The state is the car's five, then the commands u[k - 1], u[k - 2] .. as far back as one still acts. The newest of
    them is the memory of the moving average, because averaging the command is averaging the lane it is linear in.
    """
    sampled = _sampled(loop, total_delay_s)
    size, kept = 5, sampled.frames + 1
    command = np.zeros(size + kept)  # u[k] as a row on (x[k], u[k - 1], ..)
    command[2:4] = loop.smoothing * loop.gain
    command[size] = 1 - loop.smoothing
    step = np.zeros((size + kept, size + kept))
    step[:size, :size] = sampled.transition
    step[:size, size + sampled.frames] += sampled.by_old
    if sampled.frames == 0:
        step[:size] += np.outer(sampled.by_new, command)
    else:
        step[:size, size + sampled.frames - 1] += sampled.by_new
    step[size] = command
    step[size + 1 :, size:-1] = np.eye(kept - 1)
    return step


def spectral_radius(loop: LateralLoop, total_delay_s: float) -> float:
    """Give the factor by which the slowest mode grows in one frame; below 1 the loop is stable."""
    return float(np.max(np.abs(np.linalg.eigvals(closed_loop(loop, total_delay_s)))))


def critical_delay_s(loop: LateralLoop) -> float:
    """Give the smallest total delay in seconds at which `loop` is not stable any more; infinite past 3 s."""
    for number in range(int(_LONGEST_DELAY_S / _SEARCH_STEP_S)):
        if spectral_radius(loop, number * _SEARCH_STEP_S) >= 1:
            if number == 0:
                return 0.0
            return _crossing(
                lambda delay_s: spectral_radius(loop, delay_s) - 1,
                low=(number - 1) * _SEARCH_STEP_S,
                high=number * _SEARCH_STEP_S,
            )
    return math.inf


def _response(loop: LateralLoop, sampled: _SampledPlant, frequencies_radps: FloatArray) -> ComplexArray:
    """Give the frequency response from command to command, cut open at the controller's output, (n,)."""
    z = np.exp(1j * frequencies_radps / loop.frame_rate_hz)[:, np.newaxis]
    delayed = sampled.by_new * z**-sampled.frames + sampled.by_old * z ** -(sampled.frames + 1)
    resolvents = z[..., np.newaxis] * np.eye(5) - sampled.transition
    states = np.linalg.solve(resolvents, delayed[..., np.newaxis])[..., 0]
    averages = loop.smoothing / (1 - (1 - loop.smoothing) / z[:, 0])
    return np.asarray(-(states[:, 2:4] @ loop.gain) * averages, dtype=np.complex128)


def phase_margin_rad(loop: LateralLoop, total_delay_s: float) -> float:
    """Give the phase in radians that is left at the highest frequency where the loop gain falls through 1.

    Negative where the loop is unstable; infinite where the gain never reaches 1.
    """
    sampled = _sampled(loop, total_delay_s)
    frequencies = np.geomspace(0.05, math.pi * loop.frame_rate_hz * 0.999, 200)
    responses = _response(loop, sampled, frequencies)
    above = np.flatnonzero(np.abs(responses) > 1)
    if len(above) == 0:
        return math.inf
    last = int(above[-1])
    if last + 1 == len(frequencies):
        return -math.inf
    crossover = _crossing(
        lambda frequency: 1 - float(np.abs(_response(loop, sampled, np.array([frequency])))[0]),
        low=float(frequencies[last]),
        high=float(frequencies[last + 1]),
    )
    # Unwrapped from the low end, where two integrations make it -180 degrees: a margin below -180 stays one.
    upwards = np.append(frequencies[: last + 1], crossover)
    phases = np.unwrap(np.angle(_response(loop, sampled, upwards)))
    return float(math.pi + phases[-1] - (2 * math.pi if phases[0] > 0 else 0.0))


def smallest_lookahead_s(margin_rad: float, total_delay_s: float) -> float:
    """Give the smallest lookahead in seconds that leaves `margin_rad` of phase at `total_delay_s`.

    Everything else is the default of `LateralLoop`. The margin grows with the lookahead, because the crossover falls.
    """
    return _crossing(
        lambda lookahead_s: phase_margin_rad(LateralLoop(lookahead_s), total_delay_s) - margin_rad, low=0.3, high=5.0
    )


def _crossing(function: Callable[[float], float], low: float, high: float) -> float:
    """Bisect for the place in [low, high] where `function` rises through 0."""
    for _ in range(30):
        middle = (low + high) / 2
        if function(middle) < 0:
            low = middle
        else:
            high = middle
    return (low + high) / 2
