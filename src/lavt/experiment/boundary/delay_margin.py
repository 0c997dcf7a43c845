"""The theoretical delay margin of the lateral loop, from a sampled-data model of lane keeping by pure pursuit.

The car is the linearised dynamic bicycle on a straight lane (R. Rajamani, Vehicle Dynamics and Control, chapter 2) with
a first-order steering lag. The controller is pure pursuit, linearised about the lane's centre:

    command = -(2 wheelbase / lookahead^2) (lateral error + lookahead x heading error)

A command is computed once per frame from an exponential moving average of the lane, and is constant until the next
command takes effect. The total delay begins in the middle of the exposure and ends when the command is in force. It
consists of a number of whole frame periods and a fraction of a period. In each frame period, the previous command
therefore acts first and the new command afterwards, and the sampled plant has two input matrices (Astrom and
Wittenmark, Computer-Controlled Systems, section 3.2). The wait for the next frame, half a frame period on average, is
the zero-order hold of this model and must not be added to the delay again. The dead time of a car's steering is added
to the total delay.

A model without lag, average, zero-order hold and tyres (Heredia and Ollero, Advanced Robotics 21, 2007) has a delay
margin of `DELAY_PER_LOOKAHEAD` x lookahead / speed. This is two to three times too large for a real car.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from lavt.assembly.simulators import car_of
from lavt.config import RunConfig
from lavt.control.pure_pursuit import lookahead_m
from lavt.domain import FloatArray
from lavt.perception.lane_detector import SMOOTHING
from lavt.vehicle.sim.dynamics import LINCOLN_MKZ, CarParameters

ComplexArray = NDArray[np.complex128]

DELAY_PER_LOOKAHEAD = math.acos(math.sqrt(2) - 1) / math.sqrt(2 + 2 * math.sqrt(2))
"""The delay margin of the simplified loop (2 a s + 2 a^2) / s^2 in units of 1 / a, a = speed / lookahead: 0.5205.

|L(jw)| = 1 at (w / a)^2 = 2 + 2 sqrt(2); the phase margin there, atan(w / a), is acos(sqrt(2) - 1)."""

DEFAULT_CAR = LINCOLN_MKZ
"""The simulator's car. The model uses only the parameters of its lateral motion at small slip."""

_SHORTEST_LAG_S = 0.001
"""A shorter steering lag counts as this one, because the model has no car without a lag."""
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
    """The wheelbase that the controller assumes; None: the car's wheelbase."""
    speed_report_factor: float = 1.0
    """The speed that the car reports, divided by its true speed, which is `speed_mps`."""

    @property
    def gain(self) -> FloatArray:
        """The two gains of pure pursuit: for the lateral error of the rear axle, and for the heading error."""
        distance_m = self.lookahead_s * self.speed_mps
        wheelbase_m = self.controller_wheelbase_m or self.car.wheelbase_m
        return -2 * wheelbase_m / distance_m**2 * np.array([1.0, distance_m])


def configured_loop(config: RunConfig) -> LateralLoop | None:
    """Return the loop of a run, with the run's controller settings, frame rate and car.

    The lookahead is the controller's lookahead at the preset's speed. The result is None if the car or the controller
    is not LAVT's, because these have no model. Raises `UserError` for a preset or car that does not exist.
    """
    if (config.controller.kind, config.vehicle.kind) != ("lane_keeper", "simulator"):
        return None
    return run_loop(config, None)


def run_loop(config: RunConfig, lookahead_s: float | None) -> LateralLoop:
    """Return the loop of a run with this lookahead; None: that of its preset, with the run's changes."""
    controller = config.controller
    preset = controller.effective_preset()
    lookahead_s = preset.lookahead_s if lookahead_s is None else lookahead_s
    speed_mps = preset.speed_mps / config.vehicle.speed_report_factor  # the controller keeps the reported speed
    return LateralLoop(
        lookahead_s=lookahead_m(lookahead_s, preset.speed_mps) / speed_mps,
        speed_mps=speed_mps,
        frame_rate_hz=config.camera.rate_hz,
        car=car_of(config.vehicle),
        controller_wheelbase_m=controller.wheelbase_m,
        speed_report_factor=config.vehicle.speed_report_factor,
    )


def plant(loop: LateralLoop) -> tuple[FloatArray, FloatArray]:
    """Return the matrices A (5 x 5) and B (5,) of the car's linear model in continuous time.

    States: lateral speed of the centre of gravity, yaw rate, lateral error of the rear axle, heading error, wheel
    angle.
    """
    car, speed = loop.car, loop.speed_mps
    front_arm, rear_arm = car.front_axle_to_gravity_m, car.wheelbase_m - car.front_axle_to_gravity_m
    front, rear = car.front_stiffness_nprad, car.rear_stiffness_nprad
    mass, inertia = car.mass_kg, car.yaw_inertia_kgm2
    coupling = rear * rear_arm - front * front_arm
    a = np.zeros((5, 5))
    a[0] = [-(front + rear) / (mass * speed), coupling / (mass * speed) - speed, 0, 0, front / mass]
    yaw_damping = (front * front_arm**2 + rear * rear_arm**2) / (inertia * speed)
    a[1] = [coupling / (inertia * speed), -yaw_damping, 0, 0, front * front_arm / inertia]
    a[2] = [1, -rear_arm, 0, speed, 0]
    a[3, 1] = 1
    lag_s = max(car.steering_lag_s, _SHORTEST_LAG_S)
    a[4, 4] = -1 / lag_s
    return a, np.array([0, 0, 0, 0, 1 / lag_s])


def _advance(a: FloatArray, b: FloatArray, duration_s: float) -> tuple[FloatArray, FloatArray]:
    """Return the state transition over `duration_s`, and the change of state that a constant command of 1 causes."""
    size = len(b)
    augmented = np.zeros((size + 1, size + 1))
    augmented[:size, :size], augmented[:size, size] = a, b
    transition = np.asarray(expm(augmented * duration_s), dtype=np.float64)
    return transition[:size, :size], transition[:size, size]


@dataclass(frozen=True, slots=True)
class SampledPlant:
    """The plant, sampled once per frame; x is its state, u a command.

    x[k + 1] = transition x[k] + previous_input u[k - delay_frames - 1] + new_input u[k - delay_frames]
    """

    transition: FloatArray
    previous_input: FloatArray
    new_input: FloatArray
    delay_frames: int
    """The whole frame periods in the total delay."""


def sampled_plant(loop: LateralLoop, total_delay_s: float) -> SampledPlant:
    """Return the plant, sampled once per frame, with a total delay between exposure and wheel command."""
    a, b = plant(loop)
    period_s = 1 / loop.frame_rate_hz
    total_delay_s += loop.car.steering_dead_time_s
    delay_frames = int(total_delay_s / period_s)
    fraction_s = min(max(total_delay_s - delay_frames * period_s, 0.0), period_s)
    transition, _ = _advance(a, b, period_s)
    _, input_until_change = _advance(a, b, fraction_s)
    transition_after_change, new_input = _advance(a, b, period_s - fraction_s)
    previous_input = transition_after_change @ input_until_change
    return SampledPlant(transition, previous_input, new_input, delay_frames)


def closed_loop(loop: LateralLoop, total_delay_s: float) -> FloatArray:
    """Return the state transition matrix of the closed loop over one frame.

    The state consists of the car's five states, and the past commands u[k - 1], u[k - 2] .. that are not over yet. The
    newest of these commands is also the state of the moving average: because the command is a linear function of the
    lane, the average of the commands is the command for the average of the lanes.
    """
    sampled = sampled_plant(loop, total_delay_s)
    size, past = 5, sampled.delay_frames + 1
    command = np.zeros(size + past)  # u[k] is this row times the column (x[k], u[k - 1], ..)
    command[2:4] = loop.smoothing * loop.gain
    command[size] = 1 - loop.smoothing
    step = np.zeros((size + past, size + past))
    step[:size, :size] = sampled.transition
    step[:size, size + sampled.delay_frames] += sampled.previous_input
    if sampled.delay_frames == 0:
        step[:size] += np.outer(sampled.new_input, command)
    else:
        step[:size, size + sampled.delay_frames - 1] += sampled.new_input
    step[size] = command
    step[size + 1 :, size:-1] = np.eye(past - 1)
    return step


def spectral_radius(loop: LateralLoop, total_delay_s: float) -> float:
    """Return the factor by which the least damped mode grows per frame; the loop is stable if this is less than 1."""
    return float(np.max(np.abs(np.linalg.eigvals(closed_loop(loop, total_delay_s)))))


def critical_delay_s(loop: LateralLoop) -> float:
    """Return the delay margin: the smallest total delay in seconds at which `loop` is unstable; over 3 s, infinity."""
    return smallest_unstable_s(lambda delay_s: spectral_radius(loop, delay_s))


def smallest_unstable_s(radius: Callable[[float], float]) -> float:
    """Return the smallest delay in seconds at which the spectral radius is 1 or more; over 3 s, infinity."""
    for number in range(int(_LONGEST_DELAY_S / _SEARCH_STEP_S)):
        if radius(number * _SEARCH_STEP_S) >= 1:
            if number == 0:
                return 0.0
            return _crossing(
                lambda delay_s: radius(delay_s) - 1,
                low=(number - 1) * _SEARCH_STEP_S,
                high=number * _SEARCH_STEP_S,
            )
    return math.inf


def _response(loop: LateralLoop, sampled: SampledPlant, frequencies_radps: FloatArray) -> ComplexArray:
    """Return the response of the loop, opened at the controller's output, at each frequency."""
    z = np.exp(1j * frequencies_radps / loop.frame_rate_hz)[:, np.newaxis]
    delay = sampled.delay_frames
    delayed = sampled.new_input * z**-delay + sampled.previous_input * z ** -(delay + 1)
    resolvents = z[..., np.newaxis] * np.eye(5) - sampled.transition
    states = np.linalg.solve(resolvents, delayed[..., np.newaxis])[..., 0]
    averages = loop.smoothing / (1 - (1 - loop.smoothing) / z[:, 0])
    return np.asarray(-(states[:, 2:4] @ loop.gain) * averages, dtype=np.complex128)


def phase_margin_rad(loop: LateralLoop, total_delay_s: float) -> float:
    """Return the phase margin in radians at the highest frequency where the loop gain falls through 1.

    The margin is negative if the loop is unstable, and infinite if the gain never reaches 1.
    """
    sampled = sampled_plant(loop, total_delay_s)
    frequencies = np.geomspace(0.05, math.pi * loop.frame_rate_hz * 0.999, 200)
    responses = _response(loop, sampled, frequencies)
    large = np.flatnonzero(np.abs(responses) > 1)
    if len(large) == 0:
        return math.inf
    last = int(large[-1])
    if last + 1 == len(frequencies):
        return -math.inf
    crossover = _crossing(
        lambda frequency: 1 - float(np.abs(_response(loop, sampled, np.array([frequency])))[0]),
        low=float(frequencies[last]),
        high=float(frequencies[last + 1]),
    )
    # The phase is unwrapped from low frequencies on, where two integrators make it -180 degrees. So a margin of less
    # than -180 degrees remains negative.
    up_to_crossover = np.append(frequencies[: last + 1], crossover)
    phases = np.unwrap(np.angle(_response(loop, sampled, up_to_crossover)))
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
