"""`result.json`: what one run was, how it ended, and what was measured."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from lavt.errors import WorkError
from lavt.experiment.analysis.injection_validity import absent_reasons
from lavt.experiment.analysis.metrics import measure
from lavt.experiment.analysis.validity import invalid_reasons
from lavt.recording.json_payload import without_nan
from lavt.recording.record import Record

FAILED = "failed.json"
"""In a sweep's directory: the runs that failed and why; absent or empty where none did."""

IDENTITY = (
    "run",
    "time",
    "fidelity",
    "injection",
    "inherent",
    "route",
    "condition",
    "controller",
    "preset",
    "driver",
    "participant",
    "block",
    "order",
    "repetition",
    "seed",
)
"""What says which run it was: known before it is driven. What does not apply is null."""

FURTHER = ("axes", "changes", "injected_ms", "injected_least_ms")
"""What some runs have beside it."""

MEASURES = (
    "route_length_m",
    "distance_m",
    "duration_s",
    "mae_m",
    "rms_m",
    "p95_m",
    "max_m",
    "p95_by_10m",
    "heading_mae_rad",
    "heading_rms_rad",
    "heading_p95_rad",
    "steering_rms_rad",
    "steering_rate_rms_radps",
    "steering_reversals_per_s",
    "steering_reversals_per_km",
    "oscillation_hz",
    "collisions",
    "lane_invasions",
    "collisions_per_km",
    "lane_invasions_per_km",
    "loop_ms",
    "picture_age_ms",
    "age_at_actuation_ms",
    "tau_v_ms",
    "tau_c_ms",
    "stages_ms",
    "delta",
    "frames_sent",
    "frames_decoded",
    "frames_unreadable",
)


def run_result(
    identity: Mapping[str, Any],
    server: Record,
    client: Record,
    *,
    digest: str | None = None,
    reasons: Sequence[str] = (),
) -> dict[str, Any]:
    """Compute the run's entry of `summary.json` from its records.

    `identity` has the keys `IDENTITY`, and may have `axes` (values of a sweep's further axes), `changes` (of the
    condition), `injected_ms` (what was asked of the network) and `injected_least_ms` (where that is less); these are
    kept. `reasons` are those against the run that records do not show.
    """
    measured = measure(server, client)
    against = [*invalid_reasons(server, client, measured), *reasons]
    if not against and "injected_ms" in identity:  # where clocks are wrong, latencies are
        against = absent_reasons(measured.entry, identity.get("injected_least_ms", identity["injected_ms"]))
    further = {key: identity[key] for key in FURTHER if key in identity}
    return {
        **{key: identity.get(key) for key in IDENTITY},
        **further,
        "digest": digest,
        "ending": measured.entry["ending"],
        "valid": not against,
        "invalid_reasons": against,
        **{key: measured.entry[key] for key in MEASURES},
    }


def write_json(path: Path, value: Any) -> None:
    """Write `value` as JSON that people can read, all at once: nobody ever sees half a file. NaN becomes null."""
    text = json.dumps(without_nan(value), indent=2, allow_nan=False, ensure_ascii=False) + "\n"
    unfinished = path.with_name(path.name + ".part")
    unfinished.write_text(text, encoding="utf-8")
    unfinished.replace(path)


def read_json(path: Path) -> Any:
    """Read a JSON file. Raises `WorkError` where it is missing or is no JSON."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise WorkError(f"cannot read {path}: {error}") from error
