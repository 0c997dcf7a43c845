"""From what a condition says of a flow to the link that does it, with its trace."""

from __future__ import annotations

from hashlib import sha256
from pathlib import Path
from typing import Final

from lavt.assembly.injection import plain_law
from lavt.config import Condition, ImpairmentConfig
from lavt.config_file import shipped
from lavt.errors import UserError
from lavt.transport.emulation.link import LinkInjection, check_injection
from lavt.transport.emulation.trace import Trace, parse_delays, parse_mahimahi

TRACES: Final = "netem/traces"
LONGEST_TRACE_BYTES: Final = 50_000_000


def injected(name: str, delay_ms: float, impairment: ImpairmentConfig, seed: int) -> LinkInjection | None:
    """Give what is injected into the flow `name`; None where that is at most a constant delay.

    Raises `UserError` for what contradicts itself, and for a trace that is missing or wrong.
    """
    if impairment == ImpairmentConfig():
        return None
    trace = read_trace(impairment.trace) if impairment.trace else None
    requested = LinkInjection(plain_law(delay_ms, impairment), seed, name, trace, impairment.queue_packets)
    check_injection(requested)
    return requested


def trace_path(name: str) -> Path:
    """Find a trace that comes with LAVT by its name, or a file; raises `UserError` where there is neither."""
    known = sorted(path.name for path in shipped(TRACES).iterdir() if path.suffix != ".py")
    if name in known:
        return shipped(TRACES) / name
    path = Path(name)
    try:
        exists = path.is_file()
    except OSError:  # a name that is too long, or in a directory that is not ours to look into
        exists = False
    if not exists:
        raise UserError(f"there is no trace {name!r}: name one of {', '.join(known)}, or an existing file")
    return path


def trace_digests(requested: Condition) -> dict[str, str]:
    """Give the SHA-256 of each trace that a condition names, by name: a file can be changed after a run."""
    names = [flow.trace for flow in (requested.video, requested.control) if flow.trace]
    return {name: sha256(trace_path(name).read_bytes()).hexdigest() for name in names}


def read_trace(name: str) -> Trace:
    """Read a trace: a delay over time where the name ends in .csv, else a capacity in Mahimahi's format."""
    path = trace_path(name)
    try:
        if path.stat().st_size > LONGEST_TRACE_BYTES:
            raise UserError(f"the trace {path} is larger than {LONGEST_TRACE_BYTES} bytes: cut it")
        text = path.read_text()
    except OSError as error:
        raise UserError(f"the trace {path} cannot be read ({error.strerror}): name another file") from error
    except UnicodeDecodeError as error:
        raise UserError(f"the trace {path} is not text: name another file") from error
    return parse_delays(text, str(path)) if path.suffix == ".csv" else parse_mahimahi(text, str(path))
