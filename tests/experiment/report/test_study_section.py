from __future__ import annotations

from pathlib import Path
from typing import Any

from lavt.experiment.report.study_section import pair_table, sentence, study_parts
from lavt.experiment.report.table_format import csv_of
from lavt.experiment.statistics.participants import compare_studies


def runs(participants: int, driver: str = "two_point") -> list[dict[str, Any]]:
    return [
        {
            "participant": str(number),
            "condition": condition,
            "p95_m": number + added_m,
            "completed_in_own_lane": True,
            "lane_invasions": 0,
            "steering_reversals_per_km": 10.0,
            "distance_m": 200.0,
            "route": "a_key",
            "repetition": 0,
            "valid": True,
            "ending": "completed",
            "driver": driver,
        }
        for number in range(1, participants + 1)
        for condition, added_m in (("L0", 0.0), ("L5", 0.5))
    ]


def test_the_sentence_has_n_p_its_smallest_value_and_the_effect() -> None:
    """Friedman's test is printed with the participants, p, how it was computed, the smallest p, and Kendall's W."""
    (study,) = compare_studies(runs(3))
    assert sentence("p95_m", study["measures"]["p95_m"]) == (
        "P95 of the cross-track error (m) (primary measure, 3 participants): Friedman's chi-squared 3.00, p = 0.25 "
        "(exact; smallest p = 0.25), Kendall's W = 1.00."
    )


def test_left_out_participants_are_named() -> None:
    """A participant who is left out is named; without any participant, the sentence says that there is no test."""
    (study,) = compare_studies([*runs(2), {**runs(3)[-1]}])
    assert sentence("p95_m", study["measures"]["p95_m"]).endswith("no valid drive: 3.")
    (study,) = compare_studies([runs(1)[0], runs(2)[-1]])
    assert "(primary measure, 0 participants): no test" in sentence("p95_m", study["measures"]["p95_m"])


def test_without_any_complete_participant_there_are_sentences_only(tmp_path: Path) -> None:
    """If nobody has a value under every condition, the section has no table."""
    parts = study_parts(compare_studies([runs(1)[0], runs(2)[-1]]), tmp_path)
    assert any("no test" in part for part in parts)
    assert not (tmp_path / "tables").exists()


def test_the_table_of_pairs_has_all_numbers() -> None:
    """Each pair has the participants, those with a difference, the effect, and all p values."""
    (study,) = compare_studies(runs(6))
    head, first, *_ = csv_of(pair_table(study)).splitlines()
    assert head.endswith("median difference,effect r,p,p (Holm),smallest p (Holm)")
    assert first == "P95 of the cross-track error (m),L0 and L5,6,6,0.5,1.0,0.03125,0.03125,0.03125"


def test_only_a_model_is_named_as_such(tmp_path: Path) -> None:
    """The section says that a model is no person, and gives the reasons for the tests; without a study it is empty."""
    texts = {
        driver: "".join(study_parts(compare_studies(runs(2, driver)), tmp_path)) for driver in ("two_point", "human")
    }
    assert "two_point, no person" in texts["two_point"]
    assert "no person" not in texts["human"]
    assert all("Wilcoxon" in text and "mixed-effects" in text for text in texts.values())
    assert (tmp_path / "tables" / "study_pairs.csv").is_file()
    assert study_parts([], tmp_path) == []
