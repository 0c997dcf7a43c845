"""The reward of the environment."""

from __future__ import annotations

import math

import pytest

pytest.importorskip("gymnasium")

from lavt.domain import NS_PER_S, GroundTruth
from lavt.errors import UserError
from lavt.gym.reward import RewardMeter, RewardWeights, parse_weights

WHEELBASE_M = 2.8448


def truth(
    at_s: float, *, cross_track_m: float = 0.0, steering_rad: float = 0.0, progress_m: float = 0.0
) -> GroundTruth:
    return GroundTruth(round(at_s * NS_PER_S), 0.0, 0.0, 0.0, 8.0, steering_rad, cross_track_m, 0.0, progress_m)


def meter(**weights: float) -> RewardMeter:
    return RewardMeter(RewardWeights(**weights), WHEELBASE_M)


def test_progress_is_rewarded_by_the_metre() -> None:
    """The term of progress is the weight times the metres of progress."""
    terms = meter(progress=0.5).terms([truth(0, progress_m=3), truth(1, progress_m=11)], has_failed=False)
    assert terms == {"progress": 4.0, "cross_track": 0.0, "jerk": 0.0, "failure": 0.0}


def test_the_cross_track_error_is_penalized_by_its_square_and_its_time() -> None:
    """The term of the cross-track error is its squared integral over time."""
    truths = [truth(0.02 * k, cross_track_m=-0.5) for k in range(51)]
    assert meter(cross_track=2.0).terms(truths, has_failed=False)["cross_track"] == pytest.approx(-2.0 * 0.25 * 1.0)


def test_the_lateral_jerk_is_penalized_by_its_square_and_its_time() -> None:
    """The term of the jerk is the squared rate of v^2 tan(angle) / wheelbase, over time."""
    truths = [truth(0.02 * k, steering_rad=math.atan(0.1 * 0.02 * k)) for k in range(51)]
    jerk_mps3 = 8.0**2 * 0.1 / WHEELBASE_M
    assert meter(jerk=3.0).terms(truths, has_failed=False)["jerk"] == pytest.approx(-3.0 * jerk_mps3**2)


def test_the_sum_does_not_depend_on_the_lengths_of_the_steps() -> None:
    """Two steps that share their middle truth have the same terms as one long step."""
    truths = [truth(0.02 * k, cross_track_m=0.1 * k, steering_rad=0.01 * k, progress_m=0.2 * k) for k in range(9)]
    whole = meter().terms(truths, has_failed=False)
    parts = [meter().terms(part, has_failed=False) for part in (truths[:4], truths[3:])]
    assert {name: sum(part[name] for part in parts) for name in whole} == pytest.approx(whole)


@pytest.mark.parametrize("truths", [[], [truth(1)], [truth(1), truth(1, progress_m=5)]])
def test_a_step_without_time_has_no_reward(truths: list[GroundTruth]) -> None:
    """Without two different times the only term is that of a failure."""
    terms = meter(failure=7.0).terms(truths, has_failed=True)
    assert terms == {"progress": 0.0, "cross_track": -0.0, "jerk": -0.0, "failure": -7.0}


@pytest.mark.parametrize(
    ("weights", "message"),
    [
        ({"speed": 1.0}, "no term 'speed'"),
        ({"jerk": -1.0}, "jerk"),
        ({"jerk": math.nan}, "jerk"),
        ({"jerk": "1"}, "jerk"),
    ],
)
def test_wrong_weights_are_rejected(weights: dict[str, float], message: str) -> None:
    """An unknown term, and a weight that is negative or no number, is one sentence."""
    with pytest.raises(UserError, match=message):
        parse_weights(weights)


def test_given_weights_replace_the_defaults() -> None:
    """A given weight replaces the default, and the others stay."""
    assert parse_weights({"jerk": 0}) == RewardWeights(jerk=0)
    assert parse_weights(None) == RewardWeights()
