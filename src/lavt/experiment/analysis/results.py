"""`result.json`: the identity, the ending and the measurements of one run."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec

from lavt.errors import WorkError
from lavt.experiment.analysis.injection_validity import missing_delay_reasons, path_checks
from lavt.experiment.analysis.invalid_reason import InvalidReason, MeasuredCheck
from lavt.experiment.analysis.metrics import measure
from lavt.experiment.analysis.validity import invalid_reasons, measured_checks
from lavt.recording.json_payload import to_json
from lavt.recording.output_directory import replace_text
from lavt.recording.record import Record

FAILED = "failed.json"
"""The file in a sweep's directory that lists the failed runs with the reasons; absent or empty if no run failed."""

IDENTITY_KEYS = (
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
"""The keys that identify a run; their values are known before the run. A key that does not apply is null."""

OPTIONAL_IDENTITY_KEYS = ("detector", "axes", "changes", "injected_ms", "injected_least_ms")
"""Further keys that only some runs have in their identity."""


def run_result(
    identity: Mapping[str, Any],
    server: Record,
    client: Record,
    *,
    digest: str | None = None,
    reasons: Sequence[InvalidReason] = (),
    checks: Sequence[MeasuredCheck] = (),
) -> dict[str, Any]:
    """Compute the run's `result.json`, which is also its entry in `summary.json`, from its records.

    `identity` has the keys `IDENTITY_KEYS`. It can also have `detector` (if it is not LAVT's own), `axes` (the values
    of a sweep's further axes), `changes` (of the condition), `injected_ms` (the requested delay) and
    `injected_least_ms` (the smallest expected delay, if it is smaller than `injected_ms`); all of them are copied.
    `reasons` are further reasons why the run is invalid, and `checks` further measured checks, which its records do
    not show.
    """
    measured = measure(server, client)
    all_reasons = [*invalid_reasons(server, client, measured), *reasons]
    all_checks = [*measured_checks(server, client, measured), *checks]
    if not all_reasons and "injected_ms" in identity:  # with another reason, the latencies themselves can be wrong
        least_ms = identity.get("injected_least_ms", identity["injected_ms"])
        all_reasons = missing_delay_reasons(measured.entry, least_ms)
        all_checks += path_checks(measured.entry, least_ms)
    return {
        **{key: identity.get(key) for key in IDENTITY_KEYS},
        **{key: identity[key] for key in OPTIONAL_IDENTITY_KEYS if key in identity},
        "digest": digest,
        "ending": measured.entry["ending"],
        "valid": not all_reasons,
        "invalid_reasons": msgspec.to_builtins(all_reasons),
        "checks": msgspec.to_builtins(all_checks),
        **measured.entry,
    }


def write_json(path: Path, value: Any) -> None:
    """Write `value` as indented JSON, atomically: a reader never sees an incomplete file. NaN becomes null."""
    replace_text(path, msgspec.json.format(to_json(value), indent=2).decode() + "\n")


def read_json(path: Path) -> Any:
    """Read a JSON file; raise `WorkError` if it is missing or is not JSON."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise WorkError(f"cannot read {path}: {error}") from error


def read_failed(sweep_dir: Path) -> list[dict[str, str]]:
    """Return the failed runs of a sweep, each with its name (`run`) and its `reason`.

    Raises `WorkError` for a file with anything else.
    """
    if not (sweep_dir / FAILED).is_file():
        return []
    failed = read_json(sweep_dir / FAILED)
    if not isinstance(failed, list) or not all(
        isinstance(run, dict) and {"run", "reason"} <= set(run) for run in failed
    ):
        raise WorkError(f"{sweep_dir / FAILED} is not a list of failed runs: remove it, or sweep again")
    return failed


def read_result(path: Path) -> dict[str, Any]:
    """Read the result of a run; raise `WorkError` if the file is not a result."""
    result = read_json(path)
    if not isinstance(result, dict):
        raise WorkError(f"{path} is not the result of a run: it is not a JSON object: drive it again")
    missing = [key for key in IDENTITY_KEYS if key not in result]
    if missing:
        raise WorkError(f"{path} is not the result of a run: it lacks {', '.join(missing)}: drive it again")
    for key in ("axes", "injected_ms", "injected_least_ms"):
        if not isinstance(result.get(key, {}), dict):
            raise WorkError(f"{path} is not the result of a run: {key!r} is not a JSON object: drive it again")
    return result
