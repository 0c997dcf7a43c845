"""Driving one planned run into a run directory: config, records, result."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import yaml

from lavt.errors import UserError, WorkError
from lavt.experiment.plan import PlannedRun
from lavt.experiment.real_run import Progress, drive_real
from lavt.experiment.record import read_record
from lavt.experiment.results import run_result, write_json
from lavt.experiment.virtual_run import build_loop, drive

RESULT = "result.json"


def run_once(planned: PlannedRun, out: Path, *, progress: Progress | None = None) -> dict[str, Any]:
    """Drive, compute the result, and leave everything in `out`; raises `WorkError` where nobody got to drive."""
    cv2.setNumThreads(1)  # with more, sums are in another order, and runs would not repeat
    prepare_directory(out)
    (out / "config.yaml").write_text(yaml.safe_dump(planned.config.model_dump(mode="json"), sort_keys=False))
    digest, reasons = None, []
    if planned.config.time == "virtual":
        loop = build_loop(planned, out)
        drive(loop)
        digest = loop.digest.hexdigest()
        if not loop.tap.began:
            raise WorkError(f"{planned.name}: the vehicle was never armed: {loop.client.driver.session.because}")
    else:
        reasons = drive_real(planned, out, progress=progress)
    return compute_result(out, planned.identity, digest, reasons)


def compute_result(
    out: Path, identity: Mapping[str, Any], digest: str | None, reasons: Sequence[str] = ()
) -> dict[str, Any]:
    """Compute `result.json` from the records in `out`; `reasons` are those against the run that records do not show."""
    server, client = read_record(out / "server.mcap"), read_record(out / "client.mcap")
    result = run_result(identity, server, client, digest=digest, reasons=reasons)
    write_json(out / RESULT, result)
    return result


def prepare_directory(out: Path) -> None:
    """Make the directory; what is in it is never overwritten."""
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise UserError(f"{out} is not an empty directory: name another with --out, or remove it")
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"{out} cannot be made ({error.strerror}): name another directory with --out") from error
