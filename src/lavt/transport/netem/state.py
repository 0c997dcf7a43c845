"""What is written down of an interface that is held, so that it is put back after a crash.

One file for each interface and network namespace, written before tc is told anything. It says who owns the delay: a
process, which takes it away when it ends, or nobody, where `lavt netem apply` left it in place.
"""

from __future__ import annotations

import fcntl
import json
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

from lavt.errors import UserError
from lavt.transport.emulation.impairment import ImpairedFlow, Impairment
from lavt.value import value

DIRECTORY: Final = Path("/run/lavt")
NO_OWNER: Final = (0, 0)
"""Instead of an owner: left in place."""
_START_TICKS: Final = 19
"""Index of a process's start among what follows its name in /proc/PID/stat (proc(5): field 22)."""

Owner = tuple[int, int]
"""Number of a process and when it was started: numbers come again."""


@value
class AppliedState:
    """What was applied to an interface, and by whom."""

    interface: str
    namespace: int
    boot: str
    owner: Owner
    condition: str
    flows: tuple[ImpairedFlow, ...]

    @property
    def is_abandoned(self) -> bool:
        """Whether it belongs to a process that is no more, or to an earlier boot of the machine."""
        if self.boot != boot_id():
            return True
        return self.owner != NO_OWNER and self.owner[1] != start_ticks(self.owner[0])

    @property
    def description(self) -> str:
        """What and whose it is."""
        whose = "left in place" if self.owner == NO_OWNER else f"of process {self.owner[0]}"
        return f"{self.condition or 'a delay'} on {self.interface}, {whose}"


def current_process() -> Owner:
    """Give this process as an owner."""
    return os.getpid(), start_ticks(os.getpid())


def start_ticks(pid: int) -> int:
    """Tell when a process was started, in the kernel's ticks; 0 where there is none."""
    try:
        words = Path(f"/proc/{pid}/stat").read_text(errors="replace").rpartition(")")[2].split()
        return 0 if words[0] in "ZX" else int(words[_START_TICKS])
    except (OSError, ValueError, IndexError):
        return 0


def boot_id() -> str:
    """Tell which boot of the machine this is."""
    return Path("/proc/sys/kernel/random/boot_id").read_text().strip()


def network_namespace() -> int:
    """Tell the network namespace of the calling thread."""
    return os.stat("/proc/thread-self/ns/net").st_ino  # noqa: PTH116 (it is a link that leads to no path)


class StateFiles:
    """The files in a directory. Raises `UserError` where it cannot be written."""

    def __init__(self, directory: Path = DIRECTORY) -> None:
        self.directory = directory

    @contextmanager
    def alone(self) -> Iterator[None]:
        """Keep all others that use this directory, processes and threads, from changing an interface meanwhile."""
        try:
            self.directory.mkdir(parents=True, exist_ok=True)
            lock = os.open(self.directory / "netem.lock", os.O_CREAT | os.O_RDWR | os.O_CLOEXEC, 0o600)
        except OSError as error:
            raise UserError(
                f"{self.directory} cannot be written ({error.strerror}): netem needs root; run it with sudo, or use "
                "the relay, which needs none"
            ) from error
        try:
            fcntl.flock(lock, fcntl.LOCK_EX)
            yield
        finally:
            os.close(lock)

    def write(self, applied: AppliedState) -> None:
        """Write down what is going to be applied."""
        self.write_text(self._path(applied.interface).name, json.dumps(asdict(applied)))

    def write_text(self, name: str, text: str) -> None:
        """Write a file; there is never half of one."""
        part = self.directory / f"{name}.part"
        with self._writing():
            part.write_text(text)
            part.replace(self.directory / name)

    def read(self, interface: str) -> AppliedState | None:
        """Give what was applied to an interface of this namespace; None for nothing, or what cannot be read."""
        return self._read(self._path(interface))

    def all(self) -> list[AppliedState]:
        """Give everything that was applied in this namespace."""
        found = [self._read(path) for path in sorted(self.directory.glob(f"netem-{network_namespace()}-*.json"))]
        return [each for each in found if each is not None]

    def forget(self, interface: str) -> None:
        """Take away what was written down of an interface."""
        with self._writing():
            self._path(interface).unlink(missing_ok=True)

    @contextmanager
    def _writing(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise UserError(
                f"{self.directory} cannot be written ({error.strerror}): make room there, and let root write to it"
            ) from error

    def _path(self, interface: str) -> Path:
        return self.directory / f"netem-{network_namespace()}-{interface}.json"

    @staticmethod
    def _read(path: Path) -> AppliedState | None:
        try:
            data = json.loads(path.read_text())
            pid, start = data["owner"]
            return AppliedState(
                str(data["interface"]), int(data["namespace"]), str(data["boot"]), (int(pid), int(start)),
                str(data["condition"]), flows_from(data["flows"]),
            )  # fmt: skip
        except (OSError, ValueError, TypeError, KeyError, AttributeError):
            return None


def flows_from(data: Sequence[Any]) -> tuple[ImpairedFlow, ...]:
    """Make flows of what `dataclasses.asdict` made of them; raises `TypeError` or `KeyError` for anything else."""
    return tuple(ImpairedFlow(**{**each, "impairment": Impairment(**each["impairment"])}) for each in data)
