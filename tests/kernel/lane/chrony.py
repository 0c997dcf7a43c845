"""chronyd and chronyc on a machine of the lane."""

from __future__ import annotations

import os

from tests.kernel.lane.machine import Machine, MachineError, StartedProgram, wait_until

FOLDER = "/run/chrony"
"""The directory that chronyc uses by default. chronyd makes its command socket only in a directory that other users
cannot read."""
FILES = (f"bindcmdaddress {FOLDER}/chronyd.sock", f"pidfile {FOLDER}/chronyd.pid")
SERVE_OWN_CLOCK = ("local stratum 8", "allow")
"""Serve the machine's own clock to every client."""
SYNCHRONISATION_TIMEOUT_S = 60


def follow_server(address: str, port: int = 123) -> str:
    """Return the directive that makes chrony poll a server twice a second, with true send times (interleaved mode)."""
    return f"server {address} port {port} iburst minpoll -1 maxpoll -1 xleave"


def start_chronyd(machine: Machine, *lines: str, adjusts_clock: bool = False) -> StartedProgram:
    """Start chronyd with these lines of configuration; by default it does not adjust the clock."""
    machine.call(os.makedirs, FOLDER, 0o750, True)
    machine.write(f"{FOLDER}/chrony.conf", "\n".join([*FILES, *lines, ""]))
    flags = [] if adjusts_clock else ["-x"]
    chronyd = machine.start(["chronyd", *flags, "-d", "-u", "root", "-f", f"{FOLDER}/chrony.conf"])
    wait_until(
        f"chronyd answers on the {machine.name}'s machine",
        lambda: machine.call(os.path.exists, f"{FOLDER}/chronyd.sock") or not chronyd.running,
        SYNCHRONISATION_TIMEOUT_S,
    )
    if not chronyd.running:
        raise MachineError(f"{machine.name}: chronyd did not start: {chronyd.errors}")
    return chronyd


def chronyc(machine: Machine, report: str) -> list[str]:
    """Query chrony for a report; return the fields of its first line."""
    return machine.run(["chronyc", "-n", "-c", report]).splitlines()[0].split(",")


def correction_s(machine: Machine) -> float:
    """Return chrony's reference time minus the machine's wall clock: field 5 of `chronyc -c tracking`."""
    return float(chronyc(machine, "tracking")[4])


def wait_synchronised(machine: Machine, *, updates: int = 1) -> None:
    """Wait until chrony has selected a source and received at least `updates` good answers."""

    def is_synchronised() -> bool:
        fields = chronyc(machine, "tracking")
        return fields[0] != "00000000" and fields[13] == "Normal" and _count_good_answers(machine) >= updates

    wait_until(f"chrony is synchronised on the {machine.name}'s machine", is_synchronised, SYNCHRONISATION_TIMEOUT_S)


def _count_good_answers(machine: Machine) -> int:
    """Return how many good answers the best source gave; 99 without a source (chrony serves its own clock)."""
    answers = [line.split(",") for line in machine.run(["chronyc", "-n", "-c", "ntpdata"]).splitlines()]
    return max((int(fields[-1]) for fields in answers if len(fields) > 30), default=99)
