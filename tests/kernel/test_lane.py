"""The lane itself."""

from __future__ import annotations

import subprocess


def test_each_guest_has_netem() -> None:
    """x."""
    subprocess.run(["tc", "qdisc", "add", "dev", "vec0", "root", "netem", "delay", "1ms"], check=True)
    subprocess.run(["tc", "qdisc", "del", "dev", "vec0", "root"], check=True)
    subprocess.run(["ping", "-c", "3", "10.9.0.2"], check=True)
    subprocess.run(["ping", "-c", "3", "10.9.1.2"], check=True)
