"""Drive one planned run, and write its run directory: config, records, result."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import yaml

from lavt.errors import WorkError
from lavt.experiment.analysis.drive_data import DriveData, extract_drive
from lavt.experiment.analysis.injection_validity import recorded_reasons
from lavt.experiment.analysis.invalid_reason import InvalidReason, MeasuredCheck
from lavt.experiment.analysis.results import read_json, run_result, write_json
from lavt.experiment.runs.netem_run import NETEM, netem_invalid_reasons
from lavt.experiment.runs.plan import PlannedRun
from lavt.experiment.runs.real_run import (
    RELAY,
    PersonPage,
    Progress,
    Show,
    drive_real,
    relay_checks,
    relay_invalid_reasons,
)
from lavt.experiment.runs.virtual_run import build_loop, drive, free_finished_loops
from lavt.recording.output_directory import check_directory, prepare_directory
from lavt.recording.record import evaluating, read_record

CONFIG = "config.yaml"
RESULT = "result.json"
NETWORK = "network"
"""The value of `inherent` for a run on two machines: the inherent latency is that of the network between them."""


def run_once(
    planned: PlannedRun, out: Path, *, progress: Progress | None = None, watch: Show | None = None
) -> dict[str, Any]:
    """Drive, write everything into `out`, and return the result; raise `WorkError` if the drive did not begin.

    In real time, `watch` shows a page that shows how the controller drives.
    """
    return dict(drive_once(planned, out, progress=progress, watch=watch).result)


def drive_once(
    planned: PlannedRun,
    out: Path,
    *,
    progress: Progress | None = None,
    page: PersonPage | None = None,
    watch: Show | None = None,
) -> DriveData:
    """Drive as `run_once` does, and return the result with the data that figures need.

    A drive by a person needs `page`.
    """
    cv2.setNumThreads(1)  # more threads would change the order of summation, and runs would not be reproducible
    check_directory(out)
    digest = None
    if planned.config.time == "virtual":
        loop = build_loop(planned, out)
        _write_config(planned, out)
        drive(loop, progress=None if progress is None else lambda _: progress(loop.observer.status(), {}))
        digest = loop.digest.hexdigest()
        if not loop.observer.began:
            reason = loop.client.driver.session.reason or "see its records"
            raise WorkError(f"{planned.name}: the vehicle was never armed: {reason}")
        del loop
        free_finished_loops(planned.config)
    else:
        prepare_directory(out)
        _write_config(planned, out)
        drive_real(planned, out, progress=progress, page=page, watch=watch)
    return _compute(out, planned.identity, digest)


def config_text(planned: PlannedRun) -> str:
    """Return the complete config of a run as YAML."""
    return yaml.safe_dump(planned.config.model_dump(mode="json"), sort_keys=False)


def _write_config(planned: PlannedRun, out: Path) -> None:
    (out / CONFIG).write_text(config_text(planned))


def compute_result(out: Path, identity: Mapping[str, Any], digest: str | None) -> dict[str, Any]:
    """Compute and write `result.json` from the files in `out`: the records, and `relay.json` or `netem.json`.

    Raises `UserError` for records with content that LAVT does not write.
    """
    with evaluating(out):
        return dict(_compute(out, identity, digest).result)


def _compute(out: Path, identity: Mapping[str, Any], digest: str | None) -> DriveData:
    server, client = read_record(out / "server.mcap"), read_record(out / "client.mcap")
    reasons: list[InvalidReason] = []
    checks: list[MeasuredCheck] = []
    if identity["injection"] == "relay":
        relay = read_json(out / RELAY) if (out / RELAY).is_file() else {}
        reasons, checks = relay_invalid_reasons(relay), relay_checks(relay)
    elif identity["inherent"] == NETWORK:
        requested = identity["condition"] if identity["injection"] == "netem" else ""
        reasons = recorded_reasons(server, client, requested, identity["injected_ms"])
    elif identity["injection"] == "netem":
        reasons = netem_invalid_reasons(read_json(out / NETEM) if (out / NETEM).is_file() else {})
    result = run_result(identity, server, client, digest=digest, reasons=reasons, checks=checks)
    write_json(out / RESULT, result)
    return extract_drive(server, out, result)
