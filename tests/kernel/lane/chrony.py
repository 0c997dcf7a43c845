"""chronyd and chronyc on a machine of the lane."""

from __future__ import annotations

import os

from tests.kernel.lane.machine import Machine, MachineError, Started, wait_until

FOLDER = "/run/chrony"
"""Where chronyc looks by itself. chronyd makes no command socket in a directory that others may read."""
OWN = (f"bindcmdaddress {FOLDER}/chronyd.sock", f"pidfile {FOLDER}/chronyd.pid")
SERVING = ("local stratum 8", "allow")
"""Serve the own clock to whoever asks."""
SYNCHRONISED_S = 60


def following(address: str, port: int = 123) -> str:
    """Follow a server closely: twice a second, by time stamps of what was really sent."""
    return f"server {address} port {port} iburst minpoll -1 maxpoll -1 xleave"


def start_chronyd(machine: Machine, *lines: str, adjusts_clock: bool = False) -> Started:
    """Start chronyd with these lines of configuration; unless told otherwise it touches no clock."""
    machine.call(os.makedirs, FOLDER, 0o750, True)
    machine.write(f"{FOLDER}/chrony.conf", "\n".join([*OWN, *lines, ""]))
    hands = [] if adjusts_clock else ["-x"]
    chronyd = machine.start(["chronyd", *hands, "-d", "-u", "root", "-f", f"{FOLDER}/chrony.conf"])
    wait_until(
        f"chronyd answers on the {machine.name}'s machine",
        lambda: machine.call(os.path.exists, f"{FOLDER}/chronyd.sock") or not chronyd.running,
        SYNCHRONISED_S,
    )
    if not chronyd.running:
        raise MachineError(f"{machine.name}: chronyd did not start: {chronyd.errors}")
    return chronyd


def chronyc(machine: Machine, report: str) -> list[str]:
    """Ask chrony for a report; give the fields of its first line."""
    return machine.run(["chronyc", "-n", "-c", report]).splitlines()[0].split(",")


def correction_s(machine: Machine) -> float:
    """Reference time less the machine's wall clock, as chrony has it: of `chronyc -c tracking` the fifth field."""
    return float(chronyc(machine, "tracking")[4])


def wait_synchronised(machine: Machine, *, updates: int = 1) -> None:
    """Wait until chrony has chosen a source and has heard it so many times."""

    def synchronised() -> bool:
        fields = chronyc(machine, "tracking")
        return fields[0] != "00000000" and fields[13] == "Normal" and _heard(machine) >= updates

    wait_until(f"chrony is synchronised on the {machine.name}'s machine", synchronised, SYNCHRONISED_S)


def _heard(machine: Machine) -> int:
    """Count the good answers of the best heard source; 99 where chrony has none, as it serves its own clock."""
    answers = [line.split(",") for line in machine.run(["chronyc", "-n", "-c", "ntpdata"]).splitlines()]
    return max((int(fields[-1]) for fields in answers if len(fields) > 30), default=99)
