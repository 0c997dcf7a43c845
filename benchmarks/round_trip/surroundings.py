"""What the carriers of the round trips need around them: separate routers and keys."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

from benchmarks.round_trip.ends import LOOPBACK
from benchmarks.round_trip.zenoh_end import OPERATOR, PLAIN_LINK, TLS_LINK, VEHICLE, Places, tls_changes

from lavt.errors import WorkError
from lavt.experiment.runs.processes import Processes


def make_keys(folder: Path) -> str:
    """Make certificates and signing keys with `lavt keys`, and return their folder."""
    words = ["keys", str(folder), "--vehicle", VEHICLE, "--operator", OPERATOR, "--host", LOOPBACK]
    made = subprocess.run([sys.executable, "-m", "lavt", *words], capture_output=True, text=True, check=False)
    if made.returncode:
        raise WorkError(f"the keys could not be made: {made.stderr.strip()}")
    return str(folder)


def start_routers(processes: Processes, folder: Path, keys: str = "") -> Places:
    """Start the vehicle's router, then the operator's, which dials the vehicle's; with keys, both use certificates."""
    link = TLS_LINK if keys else PLAIN_LINK
    kind = "-tls" if keys else ""
    sessions = []
    dialled: list[str] = []
    for side, name in (("server", VEHICLE), ("client", OPERATOR)):
        local = f"unixsock-stream/{folder}/{side}.sock" if keys else f"tcp/{LOOPBACK}:0"
        listen = [local] if dialled else [local, link.format(f"{LOOPBACK}:0")]
        changes: dict[str, Any] = {"listen/endpoints": listen, "connect/endpoints": dialled}
        if keys:
            changes |= tls_changes(keys, name, "connect" if dialled else "listen")
        words = [word for key, value in changes.items() for word in ("--set", f"{dotted(key)}={json.dumps(value)}")]
        router = processes.start(f"{side}-router{kind}", "router", f"zenoh-configs/router-{side}{kind}.json5", *words)
        locators = router.wait_ready()["locators"]
        sessions.append(local if keys else next(locator for locator in locators if locator.startswith("tcp/")))
        remote = [locator for locator in locators if locator.startswith(("udp/", "quic/"))]
        dialled = [link.format(locator.partition("/")[2].partition("?")[0]) for locator in remote]
    return Places(sessions[0], sessions[1], keys)


def dotted(key: str) -> str:
    """Return a key of a Zenoh config as `lavt router --set` takes it."""
    return key.replace("/", ".")
