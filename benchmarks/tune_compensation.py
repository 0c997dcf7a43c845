"""Find the settings of the controllers that know their delay (`lavt.control.compensation`), by one rule.

    python benchmarks/tune_compensation.py

The rule is that of the preset `designed`: 30 degrees of phase margin at 30 km/h in the model, here at each of the
conditions L0 to L5. Each controller gets the smallest lookahead (or the smallest assumed delay, or the highest speed)
that keeps the rule. The program drives nothing, so no road is used.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

from lavt.config_file import conditions
from lavt.control.compensation import VARIANTS, Schedule
from lavt.experiment.boundary.compensation_margin import (
    Predictor,
    compensated_phase_margin_rad,
    compensated_spectral_radius,
    scheduled_loop,
    variant_critical_delay_s,
)
from lavt.experiment.boundary.delay_margin import (
    LateralLoop,
    phase_margin_rad,
    smallest_lookahead_s,
)

MARGIN_RAD = math.radians(30)
OWN_S = 0.081
"""The total delay at L0, as for the preset `designed`: 62 + 9 ms of the network, 10 ms of processing."""
UNREPORTED_S = 0.009 + Predictor().unreported_s
"""The part of it without reports: the network's control latency and the age of a state."""
TUNED = ("L0", "L1", "L2", "L3", "L4", "L5")
"""The conditions at which the rule must hold."""
SHOWN = (*TUNED, "H1", "H2", "H3", "H4")
DESIGNED_M = 1.01 * 30 / 3.6
"""The lookahead distance of `designed` at 30 km/h."""


def delays_s(condition: str) -> tuple[float, float]:
    """Return the total delay under a condition, and the part of it without reports."""
    video_ms, control_ms = conditions()[condition].video_ms, conditions()[condition].control_ms
    return OWN_S + (video_ms + control_ms) / 1000, UNREPORTED_S + control_ms / 1000


def smallest(least: float, most: float, is_enough: Callable[[float], bool]) -> float:
    """Return the smallest value that is enough, if all larger ones are, rounded up to 0.01."""
    while most - least > 1e-4:
        middle = (least + most) / 2
        least, most = (least, middle) if is_enough(middle) else (middle, most)
    return math.ceil(100 * most - 1e-2) / 100


def margin_rad(kind: str, loop: LateralLoop, predictor: Predictor, condition: str) -> float:
    """Return the phase margin of a controller under a condition."""
    total_s, unreported_s = delays_s(condition)
    if VARIANTS[kind].predicts:
        return compensated_phase_margin_rad(loop, replace(predictor, unreported_s=unreported_s), total_s)
    return phase_margin_rad(scheduled_loop(VARIANTS[kind], loop, total_s), total_s)


def keeps_rule(kind: str, lookahead_s: float, predictor: Predictor) -> bool:
    """Return whether a controller that predicts has enough phase margin at all conditions of the rule."""
    loop = LateralLoop(lookahead_s)
    return all(margin_rad(kind, loop, predictor, condition) >= MARGIN_RAD for condition in TUNED)


def highest_speed_mps(total_delay_s: float) -> float:
    """Return the highest speed, up to 30 km/h, with enough phase margin if the lookahead distance is `DESIGNED_M`."""

    def is_enough(slower_mps: float) -> bool:
        speed_mps = 30 / 3.6 - slower_mps
        return phase_margin_rad(LateralLoop(DESIGNED_M / speed_mps, speed_mps), total_delay_s) >= MARGIN_RAD

    return 30 / 3.6 - smallest(0.0, 7.5, is_enough)


ERRORS: dict[str, tuple[tuple[float, ...], Callable[[Predictor, float], Predictor]]] = {
    "delay (ms)": (
        tuple(step * 10.0 for step in range(1, 61)),
        lambda known, error: replace(known, delay_error_s=error / 1000),
    ),
    "wheelbase (%)": (
        tuple(step * 5.0 for step in range(1, 41)),
        lambda known, error: replace(known, wheelbase_m=known.wheelbase_m * (1 + error / 100)),
    ),
    "steering lag (%)": (
        tuple(step * 25.0 for step in range(1, 17)),
        lambda known, error: replace(known, steering_lag_s=known.steering_lag_s * (1 + error / 100)),
    ),
}
"""What a controller that predicts can be wrong about: the sizes of the error, and how it changes what is assumed."""


def tolerated(kind: str, condition: str, name: str, sign: int) -> float | None:
    """Return the smallest error with which the loop is unstable; None: it is stable with all of them."""
    total_s, unreported_s = delays_s(condition)
    known = Predictor(uses_reports=VARIANTS[kind].uses_reports, unreported_s=unreported_s)
    sizes, change = ERRORS[name]
    for error in (sign * size for size in sizes if name == "delay (ms)" or sign * size > -100):
        wrong = change(known, error)
        if wrong.assumed_s(total_s) < 0.03:  # the assumed effect is before the newest state
            return None
        loop = LateralLoop(VARIANTS[kind].lookahead_s, controller_wheelbase_m=wrong.wheelbase_m)
        if compensated_spectral_radius(loop, wrong, total_s) >= 1:
            return error
    return None


def print_tolerated() -> None:
    """Print the smallest errors with which the loops that predict are unstable, by the model."""
    print("\nsmallest error of an assumption with which the loop is unstable (-: none of those tried)")
    for kind in ("predictive", "smith"):
        for name in ERRORS:
            cells = []
            for condition in ("L0", "L5", "H2", "H4"):
                bounds = [tolerated(kind, condition, name, sign) for sign in (-1, 1)]
                cells.append(f"{condition}: " + " / ".join("-" if b is None else f"{b:+.0f}" for b in bounds))
            print(f"{kind}, {name}: " + ", ".join(cells))


def main() -> None:
    """Print the settings, and what the model says about the controllers with the settings of the code."""
    exact, model = Predictor(), Predictor(uses_reports=False)
    predictive_s = smallest(0.4, 3.0, lambda lookahead_s: keeps_rule("predictive", lookahead_s, exact))
    smith_s = smallest(0.4, 3.0, lambda lookahead_s: keeps_rule("smith", lookahead_s, model))
    constant_s = smallest(
        0.1, 0.5, lambda s: keeps_rule("constant_delay", predictive_s, replace(exact, constant_delay_s=s))
    )
    totals_s = sorted({delays_s(condition)[0] for condition in SHOWN})
    lookaheads: Schedule = tuple(
        (total_s, math.ceil(100 * smallest_lookahead_s(MARGIN_RAD, total_s)) / 100) for total_s in totals_s
    )
    speeds: Schedule = tuple((total_s, highest_speed_mps(total_s)) for total_s in totals_s)
    print(f"predictive: lookahead {predictive_s:.2f} s")
    print(f"smith: lookahead {smith_s:.2f} s")
    print(f"constant_delay: the lookahead of predictive, assumed delay {constant_s:.2f} s")
    print("scheduled_lookahead:", ", ".join(f"({total_s:.3f}, {value:.2f})" for total_s, value in lookaheads))
    print("slow_down:", ", ".join(f"({total_s:.3f}, {value:.2f})" for total_s, value in speeds))
    print("\nphase margin (degrees) with the settings of the code, and the smallest unstable total delay")
    print("kind".ljust(20), *(condition.rjust(4) for condition in SHOWN))
    for kind, variant in VARIANTS.items():
        predictor = replace(
            exact, uses_reports=variant.uses_reports, constant_delay_s=None if variant.measures_delay else constant_s
        )
        loop = LateralLoop(variant.lookahead_s)
        margins = [math.degrees(margin_rad(kind, loop, predictor, condition)) for condition in SHOWN]
        critical_s = variant_critical_delay_s(variant, loop, predictor)
        print(kind.ljust(20), *(f"{margin:4.0f}" for margin in margins), f"{1000 * critical_s:.0f} ms")
    print_tolerated()


if __name__ == "__main__":
    main()
