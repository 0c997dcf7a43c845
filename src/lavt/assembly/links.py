"""The construction of emulated links, and the reading of their traces."""

from __future__ import annotations

from hashlib import sha256
from pathlib import Path
from typing import Final

from lavt.assembly.injection import build_impairment
from lavt.config import Condition, ImpairmentConfig
from lavt.config_file import shipped
from lavt.errors import UserError
from lavt.transport.emulation.link import LinkInjection, check_injection
from lavt.transport.emulation.trace import Trace, parse_delays, parse_mahimahi

TRACES: Final = "netem/traces"
MAX_TRACE_BYTES: Final = 50_000_000


def link_injection(name: str, delay_ms: float, impairment: ImpairmentConfig, seed: int) -> LinkInjection | None:
    """Return what an emulated link injects into the flow `name`; None if no more than a constant delay is requested.

    Raises `UserError` for contradictory values and for a missing or invalid trace.
    """
    if impairment == ImpairmentConfig():
        return None
    trace = read_trace(impairment.trace) if impairment.trace else None
    injection = LinkInjection(build_impairment(delay_ms, impairment), seed, name, trace, impairment.queue_packets)
    check_injection(injection)
    return injection


def trace_path(name: str) -> Path:
    """Return the path of a shipped trace or of a file; raise `UserError` if neither exists."""
    known = sorted(path.name for path in shipped(TRACES).iterdir() if path.suffix != ".py")
    if name in known:
        return shipped(TRACES) / name
    path = Path(name)
    try:
        exists = path.is_file()
    except OSError:  # the name is too long, or its directory is not accessible
        exists = False
    if not exists:
        raise UserError(f"unknown trace {name!r}: name one of {', '.join(known)}, or an existing file")
    return path


def trace_digests(requested: Condition) -> dict[str, str]:
    """Return the SHA-256 of each trace of a condition by name; runs record it, so that later changes are detected."""
    names = [flow.trace for flow in (requested.video, requested.control) if flow.trace]
    return {name: sha256(trace_path(name).read_bytes()).hexdigest() for name in names}


def read_trace(name: str) -> Trace:
    """Read a trace: a delay over time if the name ends with .csv, otherwise a capacity in Mahimahi's format."""
    path = trace_path(name)
    try:
        if path.stat().st_size > MAX_TRACE_BYTES:
            raise UserError(f"the trace {path} is larger than {MAX_TRACE_BYTES} bytes: shorten it")
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise UserError(f"the trace {path} cannot be read ({error.strerror}): name another file") from error
    except UnicodeDecodeError as error:
        raise UserError(f"the trace {path} is not text: name another file") from error
    return parse_delays(text, str(path)) if path.suffix == ".csv" else parse_mahimahi(text, str(path))
