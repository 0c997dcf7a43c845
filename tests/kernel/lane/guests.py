"""Machines that are processes: user-mode kernels that see this machine's files, with their own clocks and queues."""

from __future__ import annotations

import ctypes
import os
import shlex
import signal
import subprocess
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from tests.kernel.lane import newer
from tests.kernel.lane.packages import LIBRARIES, PROGRAMS, program, search_path

MEMORY_MB = 1536
END_S = 3
PR_SET_PDEATHSIG = 1
PRIORITY = 1
"""Of those that go before all ordinary programs, the lowest: other work on the machine must not show.
Nice alone was not enough: with two busy processors a drive did not get to its end."""
KEEP_MEMORY = {
    "MALLOC_ARENA_MAX": "1",
    "MALLOC_MMAP_THRESHOLD_": str(2**30),
    "MALLOC_TRIM_THRESHOLD_": str(2**32),
    "MALLOC_TOP_PAD_": str(2**26),
}
"""A page that is touched first costs a user-mode kernel 50 us and more: programs keep what they have been given."""

LINE = "/run/line"
"""A serial line: the second console, where a machine is given the other end."""

MODULES = "usr/lib/uml/modules/*"
KERNEL, LOADED = "linux.uml", "libraries"
"""The kernel that runs, and what it loads, in the directory that the guests share."""

INIT = """#!{busybox} sh
b={busybox}
$b mount -t proc proc /proc
$b mount -t sysfs sys /sys
$b mkdir -p /dev/pts /dev/shm
$b mount -t devpts devpts /dev/pts
$b mount -t tmpfs shm /dev/shm
$b mount -t tmpfs run /run
$b ln -s /proc/self/fd /dev/fd
$b mknod {line} c 4 2
for d in {writable}; do $b mkdir -p "$d"; $b mount -t hostfs -o "$d" none "$d"; done
echo {modprobe} > /proc/sys/kernel/modprobe
$b mkdir -p /run/tmp /run/netns
$b hostname {name}
$b stty -F /dev/tty1 raw -echo
{environment} $b sh -c {setup} || $b poweroff -f
cd {cwd}
{{ {environment} {command}; echo $? > {scratch}/{name}.code; }} < /dev/null 2>&1 | $b cat > /dev/tty1
exec $b poweroff -f
"""
"""Process 1. What the guest prints goes through a pipe: a program that sees a terminal would colour it."""

MODPROBE = """#!{busybox} sh
export LD_LIBRARY_PATH={libraries}
exec {scratch}/modprobe.d/modprobe -d {scratch}/modules "$@"
"""
"""The kernel calls it: tc, ip and sockets get the modules that they need by themselves."""


@dataclass(frozen=True, slots=True)
class Guest:
    """A machine that runs."""

    name: str
    process: subprocess.Popen[bytes]
    scratch: Path

    def exit_code(self) -> int | None:
        """Exit code of its command; None where it has not ended, or has died before."""
        with suppress(OSError, ValueError):
            return int((self.scratch / f"{self.name}.code").read_text())
        return None

    def console(self) -> str:
        """Last words of its kernel."""
        return "\n".join((self.scratch / f"{self.name}.console").read_text(errors="replace").splitlines()[-8:])

    def end(self) -> None:
        """End it and every process that it is made of."""
        self.process.terminate()
        with suppress(subprocess.TimeoutExpired):
            self.process.wait(END_S)
        with suppress(ProcessLookupError):
            os.killpg(self.process.pid, signal.SIGKILL)
        self.process.wait()


def prepare(tools: Path, scratch: Path) -> None:
    """Lay out what the guests share."""
    modules = scratch / "modules/lib/modules"
    modules.mkdir(parents=True)
    for version in [*tools.glob(MODULES), *tools.glob(f"{newer.FOLDER}/{MODULES}")]:
        (modules / version.name).symlink_to(version)
    if not newer.lay_out(tools, scratch / KERNEL, scratch / LOADED):
        (scratch / KERNEL).symlink_to(program(tools, "linux.uml"))
        (scratch / LOADED).mkdir()
    (scratch / "modprobe.d").mkdir()
    (scratch / "modprobe.d" / "modprobe").symlink_to(program(tools, "kmod"))  # it looks at its own name
    text = MODPROBE.format(
        busybox=program(tools, "busybox"), libraries=search_path(tools, LIBRARIES), scratch=shlex.quote(str(scratch))
    )
    _write_program(scratch / "modprobe", text)


def start_guest(
    name: str,
    command: Sequence[str],
    *,
    tools: Path,
    scratch: Path,
    environment: Mapping[str, str],
    links: Mapping[str, tuple[int, str]],
    writable: Sequence[Path],
    output: int,
    line: tuple[int, int] | None = None,
    processor: int,
) -> Guest:
    """Start a machine that runs `command` and ends with it.

    `links` says of each network device which socket it is joined to and its address; `writable` are the directories of
    this machine that it may write. Its command's output goes to the descriptor `output`; its device LINE reads from and
    writes to those of `line`. All of it runs on one processor of this machine, as a system call of the guest is a
    change from one process to another, and back: from one processor to another that took four times as long.
    """
    busybox = program(tools, "busybox")
    setup = ["ip link set lo up"]
    devices = []
    for device, (descriptor, address) in links.items():
        setup.append(f"ip address add {address}/24 dev {device} && ip link set {device} up")
        station, host = address.split(".")[2:]
        devices.append(f"{device}:transport=fd,fd={descriptor},mac=02:00:00:00:{int(station):02x}:{int(host):02x}")
    _write_program(
        scratch / f"{name}.init",
        INIT.format(
            busybox=busybox,
            name=name,
            line=LINE,
            writable=shlex.join(str(path) for path in (scratch, *writable)),
            modprobe=scratch / "modprobe",
            environment=shlex.join([str(busybox), "env", "-i", *_inside(environment, tools)]),
            setup=shlex.quote(" && ".join(setup)),
            cwd=shlex.quote(str(Path.cwd())),
            command=shlex.join(command),
            scratch=shlex.quote(str(scratch)),
        ),
    )
    kernel = [str(scratch / KERNEL), "seccomp=auto", f"mem={MEMORY_MB}M", "rootfstype=hostfs", "rootflags=/", "ro"]
    kernel += [f"init={scratch / name}.init", "quiet", "loglevel=1", f"umid={name}", f"uml_dir={scratch}/"]
    kernel += ["con=null", "con0=null,fd:1", f"con1=null,fd:{output}", "ssl=null", *devices]
    kernel += [f"con2=fd:{line[0]},fd:{line[1]}"] if line else []
    with (scratch / f"{name}.console").open("wb") as console:
        process = subprocess.Popen(
            kernel,
            stdin=subprocess.DEVNULL,
            stdout=console,
            stderr=subprocess.STDOUT,
            pass_fds=[output, *(line or ()), *(descriptor for descriptor, _ in links.values())],
            start_new_session=True,  # a process group of its own: Ctrl-C goes to who started it, who ends it
            preexec_fn=partial(_settle, processor),  # noqa: PLW1509 (there are no threads here)
            env={
                "PATH": os.environ.get("PATH", os.defpath),
                "TMPDIR": _memory_directory(scratch),
                "LD_LIBRARY_PATH": str(scratch / LOADED),
            },
        )
    return Guest(name, process, scratch)


def _inside(environment: Mapping[str, str], tools: Path) -> list[str]:
    """List the variables of the guest's programs: ours, and where the tools are."""
    path = os.pathsep.join([search_path(tools, PROGRAMS), environment.get("PATH", os.defpath), "/usr/sbin", "/sbin"])
    libraries = os.pathsep.join(
        filter(None, [environment.get("LD_LIBRARY_PATH", ""), search_path(tools, LIBRARIES)])
    )  # only those that this machine lacks were fetched
    distributions = next(iter(tools.rglob("normal.dist")), tools)
    changed = {"PATH": path, "TMPDIR": "/run/tmp", "TC_LIB_DIR": str(distributions.parent)}
    if libraries:
        changed["LD_LIBRARY_PATH"] = libraries
    return [f"{key}={value}" for key, value in {**KEEP_MEMORY, **environment, **changed}.items()]


def _memory_directory(scratch: Path) -> str:
    """Say where the file lies that is the guest's memory: in memory, where there is enough of it."""
    with suppress(OSError):
        shared = os.statvfs("/dev/shm")
        if shared.f_bavail * shared.f_frsize > 2 * MEMORY_MB * 2**20:
            return "/dev/shm"
    return str(scratch)


def _write_program(path: Path, text: str) -> None:
    path.write_text(text)
    path.chmod(0o755)


def _settle(processor: int) -> None:
    """Let the kernel end with the program that started it, even if that is killed outright, and go first if it may."""
    os.sched_setaffinity(0, [processor])
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGTERM)
    with suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(PRIORITY))
