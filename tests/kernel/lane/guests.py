"""Machines that are processes: user-mode kernels with the host's files, and with clocks and qdiscs of their own."""

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
STOP_TIMEOUT_S = 3
PR_SET_PDEATHSIG = 1
NICENESS = -20
"""The highest priority of a program that is not real-time. Linux interrupts a busy real-time program for 50 ms in each
second in which other programs wait, even those with the lowest priority (`dl_server`)."""
KEEP_MEMORY = {
    "MALLOC_ARENA_MAX": "1",
    "MALLOC_MMAP_THRESHOLD_": str(2**30),
    "MALLOC_TRIM_THRESHOLD_": str(2**32),
    "MALLOC_TOP_PAD_": str(2**26),
}
"""Environment that makes programs keep freed memory, because the first access to a page costs 50 us and more."""

SERIAL_LINE = "/run/line"
"""Device of a serial line: the second console, for a machine that gets one."""

MODULES = "usr/lib/uml/modules/*"
KERNEL, LIBRARY_FOLDER = "linux.uml", "libraries"
"""Names of the kernel's file and its libraries' folder in the guests' shared directory."""

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
"""Process 1. The guest's output goes through a pipe, because programs would colour it for a terminal."""

MODPROBE = """#!{busybox} sh
export LD_LIBRARY_PATH={libraries}
exec {scratch}/modprobe.d/modprobe -d {scratch}/modules "$@"
"""
"""The kernel runs this to load the modules that tc, ip and sockets need."""


@dataclass(frozen=True, slots=True)
class Guest:
    """A running machine."""

    name: str
    process: subprocess.Popen[bytes]
    scratch: Path

    def exit_code(self) -> int | None:
        """Return the exit code of the machine's command; None if the command has not ended, or the machine died."""
        with suppress(OSError, ValueError):
            return int((self.scratch / f"{self.name}.code").read_text())
        return None

    def console(self) -> str:
        """Return the last lines of the console of the machine's kernel."""
        return "\n".join((self.scratch / f"{self.name}.console").read_text(errors="replace").splitlines()[-8:])

    def stop(self) -> None:
        """Stop the machine with all of its processes."""
        self.process.terminate()
        with suppress(subprocess.TimeoutExpired):
            self.process.wait(STOP_TIMEOUT_S)
        with suppress(ProcessLookupError):
            os.killpg(self.process.pid, signal.SIGKILL)
        self.process.wait()


def prepare(tools: Path, scratch: Path) -> None:
    """Create the files that the guests share."""
    modules = scratch / "modules/lib/modules"
    modules.mkdir(parents=True)
    for version in [*tools.glob(MODULES), *tools.glob(f"{newer.FOLDER}/{MODULES}")]:
        (modules / version.name).symlink_to(version)
    if not newer.install(tools, scratch / KERNEL, scratch / LIBRARY_FOLDER):
        (scratch / KERNEL).symlink_to(program(tools, "linux.uml"))
        (scratch / LIBRARY_FOLDER).mkdir()
    (scratch / "modprobe.d").mkdir()
    (scratch / "modprobe.d" / "modprobe").symlink_to(
        program(tools, "kmod")
    )  # kmod does what the name says by which it is called
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
    serial_line: tuple[int, int] | None = None,
    processor: int,
) -> Guest:
    """Start a machine that runs `command` and ends with it.

    `links` maps each network device to its socket and address. `writable` lists the directories of the host that the
    machine may write to. The command's output goes to the descriptor `output`, and `serial_line` has the descriptors
    that SERIAL_LINE reads from and writes to. The machine runs on one of the host's processors, because each system
    call of the guest is two switches between processes. A switch between two processors took four times as long.
    """
    busybox = program(tools, "busybox")
    setup = ["ip link set lo up"]
    devices = []
    for device, (descriptor, address) in links.items():
        setup.append(f"ip address add {address}/24 dev {device} && ip link set {device} up")
        mac_end = ":".join(f"{int(byte):02x}" for byte in address.split(".")[2:])
        devices.append(f"{device}:transport=fd,fd={descriptor},mac=02:00:00:00:{mac_end}")
    _write_program(
        scratch / f"{name}.init",
        INIT.format(
            busybox=busybox,
            name=name,
            line=SERIAL_LINE,
            writable=shlex.join(str(path) for path in (scratch, *writable)),
            modprobe=scratch / "modprobe",
            environment=shlex.join([str(busybox), "env", "-i", *_guest_environment(environment, tools)]),
            setup=shlex.quote(" && ".join(setup)),
            cwd=shlex.quote(str(Path.cwd())),
            command=shlex.join(command),
            scratch=shlex.quote(str(scratch)),
        ),
    )
    kernel = [str(scratch / KERNEL), "seccomp=auto", f"mem={MEMORY_MB}M", "rootfstype=hostfs", "rootflags=/", "ro"]
    kernel += [f"init={scratch / name}.init", "quiet", "loglevel=1", f"umid={name}", f"uml_dir={scratch}/"]
    kernel += ["con=null", "con0=null,fd:1", f"con1=null,fd:{output}", "ssl=null", *devices]
    kernel += [f"con2=fd:{serial_line[0]},fd:{serial_line[1]}"] if serial_line else []
    with (scratch / f"{name}.console").open("wb") as console:
        process = subprocess.Popen(
            kernel,
            stdin=subprocess.DEVNULL,
            stdout=console,
            stderr=subprocess.STDOUT,
            pass_fds=[output, *(serial_line or ()), *(descriptor for descriptor, _ in links.values())],
            start_new_session=True,  # Ctrl-C must reach only the parent, which then stops the machine
            preexec_fn=partial(_configure_process, processor),  # noqa: PLW1509 (there are no threads here)
            env={
                "PATH": os.environ.get("PATH", os.defpath),
                "TMPDIR": _memory_directory(scratch),
                "LD_LIBRARY_PATH": str(scratch / LIBRARY_FOLDER),
            },
        )
    return Guest(name, process, scratch)


def _guest_environment(environment: Mapping[str, str], tools: Path) -> list[str]:
    """Return the environment of the guest's programs, which includes the tools' paths."""
    path = os.pathsep.join([search_path(tools, PROGRAMS), environment.get("PATH", os.defpath), "/usr/sbin", "/sbin"])
    libraries = os.pathsep.join(
        filter(None, [environment.get("LD_LIBRARY_PATH", ""), search_path(tools, LIBRARIES)])
    )  # only libraries that the host lacks were fetched
    distributions = next(iter(tools.rglob("normal.dist")), tools)
    replaced = {"PATH": path, "TMPDIR": "/run/tmp", "TC_LIB_DIR": str(distributions.parent)}
    if libraries:
        replaced["LD_LIBRARY_PATH"] = libraries
    return [f"{key}={value}" for key, value in {**KEEP_MEMORY, **environment, **replaced}.items()]


def _memory_directory(scratch: Path) -> str:
    """Return the directory for the file with the guest's memory: /dev/shm if it has room, or else `scratch`."""
    with suppress(OSError):
        shared = os.statvfs("/dev/shm")
        if shared.f_bavail * shared.f_frsize > 2 * MEMORY_MB * 2**20:
            return "/dev/shm"
    return str(scratch)


def _write_program(path: Path, text: str) -> None:
    path.write_text(text)
    path.chmod(0o755)


def _configure_process(processor: int) -> None:
    """Bind the kernel to a processor, make it end with its parent, and raise its priority if possible."""
    os.sched_setaffinity(0, [processor])
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGTERM)
    with suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, 0, NICENESS)
        Path("/proc/self/autogroup").write_text(str(NICENESS))  # of the session
