"""`result.json`: the identity, the ending and the measurements of one run."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec

from lavt.errors import WorkError
from lavt.experiment.analysis.injection_validity import absent_reasons
from lavt.experiment.analysis.invalid_reason import InvalidReason
from lavt.experiment.analysis.metrics import measure
from lavt.experiment.analysis.validity import invalid_reasons
from lavt.recording.json_payload import to_json
from lavt.recording.record import Record

FAILED = "failed.json"
"""In a sweep's directory: the runs that failed, with the reasons; absent or empty where none did."""

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
"""The keys that identify a run; their values are known before it is driven. A key that does not apply is null."""

OPTIONAL_IDENTITY = ("axes", "changes", "injected_ms", "injected_least_ms")
"""Further keys of the identity, which only some runs have."""


def run_result(
    identity: Mapping[str, Any],
    server: Record,
    client: Record,
    *,
    digest: str | None = None,
    reasons: Sequence[InvalidReason] = (),
) -> dict[str, Any]:
    """Compute the run's `result.json`, which is also its entry in `summary.json`, from its records.

    `identity` has the keys `IDENTITY`. It may also have `axes` (the values of a sweep's further axes), `changes` (of
    the condition), `injected_ms` (the requested delay) and `injected_least_ms` (the least expected delay, where it is
    less than `injected_ms`); all of them are copied. `reasons` are further reasons for which the run is invalid, which
    its records do not show.
    """
    measured = measure(server, client)
    all_reasons = [*invalid_reasons(server, client, measured), *reasons]
    if not all_reasons and "injected_ms" in identity:  # otherwise the latencies may be wrong
        all_reasons = absent_reasons(measured.entry, identity.get("injected_least_ms", identity["injected_ms"]))
    return {
        **{key: identity.get(key) for key in IDENTITY},
        **{key: identity[key] for key in OPTIONAL_IDENTITY if key in identity},
        "digest": digest,
        "ending": measured.entry["ending"],
        "valid": not all_reasons,
        "invalid_reasons": msgspec.to_builtins(all_reasons),
        **measured.entry,
    }


def write_json(path: Path, value: Any) -> None:
    """Write `value` as indented JSON, atomically: a reader never sees an incomplete file. NaN becomes null."""
    text = msgspec.json.format(to_json(value), indent=2).decode() + "\n"
    unfinished = path.with_name(path.name + ".part")
    unfinished.write_text(text, encoding="utf-8")
    unfinished.replace(path)


def read_json(path: Path) -> Any:
    """Read a JSON file; raise `WorkError` where it is missing or is not JSON."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise WorkError(f"cannot read {path}: {error}") from error
