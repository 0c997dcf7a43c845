"""The theoretical delay margin of the lateral loop, from a sampled-data model of lane keeping by pure pursuit.

The car is the linearised dynamic bicycle on a straight lane (R. Rajamani, Vehicle Dynamics and Control, chapter 2)
behind a first-order steering lag; the controller is pure pursuit linearised about the lane's centre,

    command = -(2 wheelbase / lookahead^2) (lateral error + lookahead x heading error),

computed once per frame from an exponential moving average of the lane, and constant until the next command takes
effect. The total delay lasts from the middle of the exposure to the moment when the command is in force. It consists of
a number of whole frame periods and a fraction of one. So in each frame period the old command acts first and then the
new one, and the sampled plant has two input matrices (Astrom and Wittenmark, Computer-Controlled Systems, section 3.2).
The wait for the next frame, half a frame period on average, is the zero-order hold of this model and must not be added
to the delay again. The dead time of a car's steering is added to the total delay.

Without the lag, the average, the zero-order hold and the tyres, the delay margin is `DELAY_PER_LOOKAHEAD` x lookahead /
speed (Heredia and Ollero, Advanced Robotics 21, 2007, analyse that case), which is two to three times too large for a
real car.
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
from lavt.vehicle.sim.dynamics import LINCOLN_MKZ, CarParameters

ComplexArray = NDArray[np.complex128]

DELAY_PER_LOOKAHEAD = math.acos(math.sqrt(2) - 1) / math.sqrt(2 + 2 * math.sqrt(2))
"""The delay margin of the simplified loop (2 a s + 2 a^2) / s^2 in units of 1 / a, a = speed / lookahead: 0.5205.

|L(jw)| = 1 at (w / a)^2 = 2 + 2 sqrt(2); the phase margin there, atan(w / a), is acos(sqrt(2) - 1)."""

DEFAULT_CAR = LINCOLN_MKZ
"""The simulator's car. The model uses only its parameters of the lateral motion at small slip."""

_LONGEST_DELAY_S = 3.0  # the search ends here, beyond every delay of interest
_SEARCH_STEP_S = 0.005


@dataclass(frozen=True, slots=True)
class LateralLoop:
    """A car at constant speed with a camera, steered by pure pursuit with a lookahead of `lookahead_s` x speed."""

    lookahead_s: float
    speed_mps: float = 30 / 3.6
    frame_rate_hz: float = 30.0
    smoothing: float = SMOOTHING
    """The weight of the newest frame in the moving average; 1 means no averaging."""
    car: CarParameters = DEFAULT_CAR
    controller_wheelbase_m: float | None = None
    """The wheelbase that the controller assumes; None for the car's own."""

    @property
    def gain(self) -> FloatArray:
        """The gains of pure pursuit for the lateral error of the rear axle and for the heading error, (2,)."""
        distance_m = self.lookahead_s * self.speed_mps
        wheelbase_m = self.controller_wheelbase_m or self.car.wheelbase_m
        return -2 * wheelbase_m / distance_m**2 * np.array([1.0, distance_m])


def configured_loop(config: RunConfig) -> LateralLoop | None:
    """Return the loop of a run, with the run's controller settings, frame rate and car.

    The lookahead is that at the preset's speed, within the controller's bounds. None if the car or the controller is
    not LAVT's, because there is no model of it. Raises `UserError` for a preset or car that does not exist.
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
        controller_wheelbase_m=controller.wheelbase_m,
    )


def plant(loop: LateralLoop) -> tuple[FloatArray, FloatArray]:
    """Return A (5 x 5) and B (5,) of the car in continuous time.

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
    """Return the state transition over `duration_s`, and the state change by a constant command of 1 in it."""
    size = len(b)
    augmented = np.zeros((size + 1, size + 1))
    augmented[:size, :size], augmented[:size, size] = a, b
    transition = np.asarray(expm(augmented * duration_s), dtype=np.float64)
    return transition[:size, :size], transition[:size, size]


@dataclass(frozen=True, slots=True)
class _SampledPlant:
    """The plant sampled once per frame; in each frame period the old command u acts first and then the new one.

    x[k + 1] = transition x[k] + by_old u[k - frames - 1] + by_new u[k - frames]
    """

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
    _, by_old_at_change = _advance(a, b, fraction_s)
    after_change, by_new = _advance(a, b, period_s - fraction_s)
    return _SampledPlant(transition, by_old=after_change @ by_old_at_change, by_new=by_new, frames=frames)


def closed_loop(loop: LateralLoop, total_delay_s: float) -> FloatArray:
    """Return the state transition matrix of the closed loop over one frame.

    The state consists of the car's five states, and the commands u[k - 1], u[k - 2] .. that still act. The newest of
    these commands is also the state of the moving average: the command is a linear function of the lane, so the average
    of the commands is the command for the average of the lanes.
    """
    sampled = _sampled(loop, total_delay_s)
    size, past = 5, sampled.frames + 1
    command = np.zeros(size + past)  # u[k] as a row on (x[k], u[k - 1], ..)
    command[2:4] = loop.smoothing * loop.gain
    command[size] = 1 - loop.smoothing
    step = np.zeros((size + past, size + past))
    step[:size, :size] = sampled.transition
    step[:size, size + sampled.frames] += sampled.by_old
    if sampled.frames == 0:
        step[:size] += np.outer(sampled.by_new, command)
    else:
        step[:size, size + sampled.frames - 1] += sampled.by_new
    step[size] = command
    step[size + 1 :, size:-1] = np.eye(past - 1)
    return step


def spectral_radius(loop: LateralLoop, total_delay_s: float) -> float:
    """Return the factor by which the least damped mode grows per frame; the loop is stable if it is below 1."""
    return float(np.max(np.abs(np.linalg.eigvals(closed_loop(loop, total_delay_s)))))


def critical_delay_s(loop: LateralLoop) -> float:
    """Return the delay margin: the smallest total delay in seconds at which `loop` is unstable; infinity above 3 s."""
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
    """Return the frequency response of the loop, opened at the controller's output, (n,)."""
    z = np.exp(1j * frequencies_radps / loop.frame_rate_hz)[:, np.newaxis]
    delayed = sampled.by_new * z**-sampled.frames + sampled.by_old * z ** -(sampled.frames + 1)
    resolvents = z[..., np.newaxis] * np.eye(5) - sampled.transition
    states = np.linalg.solve(resolvents, delayed[..., np.newaxis])[..., 0]
    averages = loop.smoothing / (1 - (1 - loop.smoothing) / z[:, 0])
    return np.asarray(-(states[:, 2:4] @ loop.gain) * averages, dtype=np.complex128)


def phase_margin_rad(loop: LateralLoop, total_delay_s: float) -> float:
    """Return the phase margin in radians at the highest frequency where the loop gain falls through 1.

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
    # The phase is unwrapped from low frequencies, where two integrators make it -180 degrees, so that a margin below
    # -180 degrees remains negative.
    upwards = np.append(frequencies[: last + 1], crossover)
    phases = np.unwrap(np.angle(_response(loop, sampled, upwards)))
    return float(math.pi + phases[-1] - (2 * math.pi if phases[0] > 0 else 0.0))


def smallest_lookahead_s(margin_rad: float, total_delay_s: float) -> float:
    """Return the smallest lookahead in seconds with a phase margin of `margin_rad` at `total_delay_s`.

    All other parameters are the defaults of `LateralLoop`. The phase margin grows with the lookahead, because the
    crossover frequency falls.
    """
    return _crossing(
        lambda lookahead_s: phase_margin_rad(LateralLoop(lookahead_s), total_delay_s) - margin_rad, low=0.3, high=5.0
    )


def _crossing(function: Callable[[float], float], low: float, high: float) -> float:
    """Find the value in [low, high] at which `function` rises through 0, by bisection."""
    for _ in range(30):
        middle = (low + high) / 2
        if function(middle) < 0:
            low = middle
        else:
            high = middle
    return (low + high) / 2
