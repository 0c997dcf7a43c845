"""Evaluate the drives of a fleet from their records, and write the compliance report: JSON, CSV and a page."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from lavt.errors import LavtError, UserError, WorkError
from lavt.experiment.analysis.results import read_result, write_json
from lavt.experiment.compliance.criteria import CRITERIA, ComplianceLimits, Verdict, worst_of
from lavt.experiment.compliance.drive_compliance import SERVER_CHANNELS, DriveCompliance, evaluate_drive
from lavt.experiment.compliance.fleet import fleet_totals
from lavt.recording.record import evaluating, read_record
from lavt.safety.limits import LIMITS

SCHEMA = 1
"""The version of `compliance.json`: it changes if a key is removed or its meaning changes."""

JSON_NAME = "compliance.json"
CSV_NAME = "compliance.csv"
PERSON = "human"
"""The controller of a run that a person drives."""


@dataclass(frozen=True, slots=True)
class FleetCompliance:
    """The compliance of all drives of a fleet: those that count, and those that do not, each with the reason."""

    limits: ComplianceLimits
    drives: Sequence[DriveCompliance]
    excluded: Sequence[Mapping[str, str]]

    @property
    def verdict(self) -> Verdict:
        """The verdict over all drives that count."""
        return worst_of([drive.entry["verdict"] for drive in self.drives])

    def content(self) -> dict[str, Any]:
        """Return the content of `compliance.json`, in which infinity and unknown values are null."""
        limits = self.limits
        content: dict[str, Any] = _finite(
            {
                "schema": SCHEMA,
                "limit_ms": limits.latency_ms,
                "outage_ms": limits.outage_ms,
                "camera_ms": limits.camera_ms,
                "thresholds": {key: limits.threshold(key) for key in CRITERIA},
                "verdict": self.verdict,
                "fleet": fleet_totals([drive.entry for drive in self.drives]),
                "drives": [{**drive.entry, "directory": str(drive.directory)} for drive in self.drives],
                "excluded": [dict(run) for run in self.excluded],
            }
        )
        return content


def evaluate_fleet(
    runs: Sequence[Path],
    limits: ComplianceLimits,
    *,
    sweeps: Mapping[Path, str] | None = None,
    failed: Sequence[Mapping[str, str]] = (),
) -> FleetCompliance:
    """Evaluate the runs in these directories; `failed` are runs of sweeps without a result (`run`, `reason`).

    If the runs are from several sweeps, `sweeps` has the name of the sweep of each run directory. A run that is invalid
    or cannot be evaluated is excluded, with the reason. Raises `UserError` if no run is left.
    """
    drives: list[DriveCompliance] = []
    excluded = [{"run": run["run"], "reason": f"failed: {run['reason']}"} for run in failed]
    for directory in runs:
        sweep = (sweeps or {}).get(directory)
        name = directory.name if sweep is None else f"{sweep}/{directory.name}"
        try:
            result = read_result(directory / "result.json")
            drives.append(_evaluate_run(directory, {**result, "run": name}, limits))
        except LavtError as error:
            excluded.append({"run": name, "reason": str(error)})
    if not drives:
        raise UserError(f"no drive can be judged; the first, {excluded[0]['run']}: {excluded[0]['reason']}")
    return FleetCompliance(limits, drives, excluded)


def write_compliance(fleet: FleetCompliance, out: Path) -> Path:
    """Write JSON, CSV and the page into the directory `out`, and return the path of the page."""
    from lavt.experiment.compliance.page import write_page  # noqa: PLC0415 (slow: matplotlib)
    from lavt.experiment.compliance.tables import csv_table  # noqa: PLC0415 (needs the page's templates)
    from lavt.experiment.report.table_format import csv_of  # noqa: PLC0415 (the same)

    content = fleet.content()
    write_json(out / JSON_NAME, content)
    (out / CSV_NAME).write_text(csv_of(csv_table(content)), encoding="utf-8")
    return write_page(fleet, content, out, (CSV_NAME, JSON_NAME))


def _evaluate_run(directory: Path, result: Mapping[str, Any], limits: ComplianceLimits) -> DriveCompliance:
    """Evaluate the drive of one run; raise `LavtError` with the reason if it does not count."""
    if result.get("valid") is not True:
        raise WorkError(f"invalid: {_invalid_text(result)}")
    server = read_record(directory / "server.mcap", channels=SERVER_CHANNELS)
    if not server.complete:
        raise WorkError("damaged: server.mcap is cut or damaged, so a part of the drive may be missing")
    if limits.nominal_mps is None:
        limits = replace(limits, nominal_mps=recorded_speed_limit(directory / "config.yaml"))
    page_pictures = None
    if result.get("controller") == PERSON:
        client = read_record(directory / "client.mcap", channels=("page_picture",))
        if not client.complete:
            raise WorkError("damaged: client.mcap is cut or damaged, so pictures of the page may be missing")
        page_pictures = client.table("page_picture")
    with evaluating(directory):
        return evaluate_drive(directory, result, server, page_pictures, limits)


def recorded_speed_limit(config: Path) -> float:
    """Return the speed limit in m/s in the config of a run, or the default limit if it has none.

    Raises `UserError` for a config that cannot be read.
    """
    try:
        content = yaml.safe_load(config.read_text(encoding="utf-8")) if config.exists() else {}
        speed_mps = float(((content or {}).get("safety") or {}).get("speed_limit_mps", LIMITS.speed_limit_mps))
    except (OSError, ValueError, TypeError, AttributeError, yaml.YAMLError):
        speed_mps = math.nan
    if not (math.isfinite(speed_mps) and speed_mps > 0):
        raise UserError(f"{config} has no speed limit that can be read: give the nominal speed with --nominal-kmh")
    return speed_mps


def _invalid_text(result: Mapping[str, Any]) -> str:
    reasons = result.get("invalid_reasons")
    texts = [str(reason.get("text")) for reason in reasons if isinstance(reason, dict)] if reasons else []
    return "; ".join(texts) or "result.json does not say that the run is valid"


def _finite(value: Any) -> Any:
    """Return a value for JSON: pairs as lists, and null for numbers that are not finite."""
    if isinstance(value, Mapping):
        return {key: _finite(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(entry) for entry in value]
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value
