"""State files of interfaces with impairments, so that an interface is restored after a crash.

There is one file for each interface and network namespace, written before tc is called. It names the owner: the process
that clears the interface when it ends. Impairments that `lavt netem apply` leaves in place have no owner.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

import msgspec
from msgspec import Struct

from lavt.errors import UserError
from lavt.transport.emulation.impairment import ImpairedFlow

DIRECTORY: Final = Path("/run/lavt")
NO_OWNER: Final = (0, 0)
"""The value for persistent impairments, which no process owns."""
_START_TICKS: Final = 19
"""Index of a process's start time among the fields after its name in /proc/PID/stat. In proc(5), which counts all
fields from 1, it is field 22."""

Owner = tuple[int, int]
"""A process ID and the start time of the process in kernel ticks, because process IDs are reused."""


class AppliedState(Struct, frozen=True):
    """What was applied to an interface, and which process owns it."""

    interface: str
    namespace: int
    boot: str
    owner: Owner
    condition: str
    flows: tuple[ImpairedFlow, ...]

    @property
    def is_abandoned(self) -> bool:
        """Whether the owner no longer runs, or the state is from an earlier boot."""
        if self.boot != boot_id():
            return True
        pid, owner_start_ticks = self.owner
        return self.owner != NO_OWNER and owner_start_ticks != start_ticks(pid)

    @property
    def description(self) -> str:
        """Condition, interface and owner, for messages."""
        owner = "left in place" if self.owner == NO_OWNER else f"owned by process {self.owner[0]}"
        return f"{self.condition or 'a delay'} on {self.interface}, {owner}"


def current_process() -> Owner:
    """Return this process as an owner."""
    return os.getpid(), start_ticks(os.getpid())


def start_ticks(pid: int) -> int:
    """Return when a process started, in kernel ticks; 0 if it does not run."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text(errors="replace").rpartition(")")[2].split()
        return 0 if fields[0] in "ZX" else int(fields[_START_TICKS])
    except (OSError, ValueError, IndexError):
        return 0


def boot_id() -> str:
    """Return the identifier of the machine's current boot."""
    return Path("/proc/sys/kernel/random/boot_id").read_text().strip()


def network_namespace() -> int:
    """Return the identifier of the calling thread's network namespace."""
    return os.stat("/proc/thread-self/ns/net").st_ino  # noqa: PTH116 (the link's target is not a path)


class StateFiles:
    """The state files in a directory. Raises `UserError` if the directory is not writable."""

    def __init__(self, directory: Path = DIRECTORY) -> None:
        self.directory = directory

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Lock the directory, so that no other process or thread changes an interface meanwhile."""
        try:
            self.directory.mkdir(parents=True, exist_ok=True)
            lock = os.open(self.directory / "netem.lock", os.O_CREAT | os.O_RDWR | os.O_CLOEXEC, 0o600)
        except OSError as error:
            raise UserError(
                f"cannot write {self.directory} ({error.strerror}): netem needs root; use sudo, or the relay, which "
                "does not need it"
            ) from error
        try:
            import fcntl  # noqa: PLC0415 (not on every system, and this module is imported on every system)

            fcntl.flock(lock, fcntl.LOCK_EX)
            yield
        finally:
            os.close(lock)

    def write(self, applied: AppliedState) -> None:
        """Store the state that is going to be applied."""
        self.write_text(self._path(applied.interface).name, msgspec.json.encode(applied).decode())

    def write_text(self, name: str, text: str) -> None:
        """Write a file atomically."""
        part = self.directory / f"{name}.part"
        with self._reporting_errors():
            part.write_text(text)
            part.replace(self.directory / name)

    def read(self, interface: str) -> AppliedState | None:
        """Return what was applied to an interface of this namespace, or None if there is no readable state."""
        return self._read(self._path(interface))

    def all(self) -> list[AppliedState]:
        """Return everything that was applied in this namespace."""
        found = [self._read(path) for path in sorted(self.directory.glob(f"netem-{network_namespace()}-*.json"))]
        return [applied for applied in found if applied is not None]

    def remove(self, interface: str) -> None:
        """Delete the state of an interface."""
        with self._reporting_errors():
            self._path(interface).unlink(missing_ok=True)

    @contextmanager
    def _reporting_errors(self) -> Iterator[None]:
        """Raise `UserError` for an `OSError` in the block."""
        try:
            yield
        except OSError as error:
            raise UserError(
                f"cannot write {self.directory} ({error.strerror}): free space there, and let root write to it"
            ) from error

    def _path(self, interface: str) -> Path:
        return self.directory / f"netem-{network_namespace()}-{interface}.json"

    @staticmethod
    def _read(path: Path) -> AppliedState | None:
        try:
            return msgspec.json.decode(path.read_bytes(), type=AppliedState)
        except (OSError, ValueError):
            return None
