"""`tests/kernel/run`: start two machines, run pytest on the first, and return pytest's exit code."""

from __future__ import annotations

import argparse
import compileall
import os
import secrets
import select
import shutil
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory

from tests.kernel.lane.guests import Guest, prepare, start_guest
from tests.kernel.lane.packages import fetch_packages
from tests.kernel.lane.unavailable import LaneUnavailable

REPOSITORY = Path(__file__).resolve().parents[3]
HERE = REPOSITORY / "tests" / "kernel"
SERVER_ADDRESSES = {"vec0": "10.9.0.1", "vec1": "10.9.1.1"}
"""Addresses of the first machine, which runs pytest: vec0 is the network under test, vec1 is for management."""
CLIENT_ADDRESSES = {"vec0": "10.9.0.2", "vec1": "10.9.1.2"}
EPILOG = """Other options go to pytest, which runs in the repository's top directory; a test file of this directory can
be given by its name alone. Environment variables are passed through. LAVT_KERNEL is the directory for downloads, by
default .kernel/ of the repository. Example: tests/kernel/run test_lane.py -x"""


def main(arguments: Sequence[str]) -> int:
    """Run the lane. Return 2 if it cannot run here, 1 if a machine died, and pytest's exit code otherwise."""
    parser = argparse.ArgumentParser(
        prog="tests/kernel/run",
        description="Run tests/kernel on a real kernel: two machines that are unprivileged processes.",
        epilog=EPILOG,
        allow_abbrev=False,
    )
    parser.add_argument("--native", action="store_true", help="run on this machine's own kernel (needs root and netem)")
    parser.add_argument("--out", type=Path, help="directory that the tests, and options of pytest, can write to")
    options, extra = parser.parse_known_args(arguments)
    for number in (signal.SIGTERM, signal.SIGHUP, signal.SIGINT):
        signal.signal(number, _stop)
    try:
        out = writable_directories(options.out)
        os.chdir(REPOSITORY)
        python = find_interpreter()
        compileall.compile_dir(REPOSITORY / "src", quiet=2)  # the slow machines start LAVT a hundred times
        pytest_command = [python, "-B", "-m", "pytest", "-p", "no:cacheprovider", *pytest_arguments(extra)]
        return _run_natively(pytest_command) if options.native else _run_on_two_machines(python, pytest_command, out)
    except LaneUnavailable as error:
        print(f"tests/kernel/run: {error}", file=sys.stderr)
        return 2


def pytest_arguments(extra: Sequence[str]) -> list[str]:
    """Return pytest's arguments: names of test files are completed, and tests/kernel is added if no test is named."""
    arguments = [_complete_path(argument) for argument in extra]
    has_tests = any(REPOSITORY / argument.partition("::")[0] in (HERE, *HERE.glob("*.py")) for argument in arguments)
    return arguments if has_tests else [*arguments, "tests/kernel"]


def _complete_path(argument: str) -> str:
    file, separator, test = argument.partition("::")
    path = Path(file)
    if argument.startswith("-") or path.suffix != ".py" or not (HERE / path.name).is_file():
        return argument
    return f"tests/kernel/{path.name}{separator}{test}"


def find_interpreter() -> str:
    """Return a Python that has LAVT and pytest: this one, or the repository's environment."""
    for python in (sys.executable, str(REPOSITORY / ".venv/bin/python")):
        import_both = [python, "-c", "import lavt, pytest"]
        with suppress(OSError):
            if subprocess.run(import_both, capture_output=True, env=_environment(), check=False).returncode == 0:
                return python
    raise LaneUnavailable(
        "no Python here has LAVT and pytest: python3 -m venv .venv && .venv/bin/pip install -e '.[all]'"
    )


def writable_directories(out: Path | None) -> list[Path]:
    """Return the directories that the machines may write to: `out`, and the directory of LAVT_PROGRESS."""
    progress = os.environ.get("LAVT_PROGRESS")
    directories = [Path(progress).resolve().parent] if progress else []
    if out is None:
        return directories
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise LaneUnavailable(f"cannot create {out} ({error.strerror}): name another directory with --out") from None
    return [*directories, out.resolve()]


def _environment() -> dict[str, str]:
    """Return the environment of this program, with absolute paths in PYTHONPATH."""
    python_path = os.environ.get("PYTHONPATH")
    absolute = {"PYTHONPATH": os.pathsep.join(_ABSOLUTE_PYTHON_PATH)} if python_path else {}
    return {**os.environ, **absolute, "PYTHONDONTWRITEBYTECODE": "1"}


_ABSOLUTE_PYTHON_PATH = [
    str(Path(part).absolute()) for part in os.environ.get("PYTHONPATH", "").split(os.pathsep) if part
]


def _run_natively(pytest_command: Sequence[str]) -> int:
    """Run the tests on this kernel, in a network namespace of their own."""
    netem_trial = "ip link set lo up && tc qdisc add dev lo root netem delay 1ms"
    in_own_network = ["unshare", "--net", "sh", "-c"]
    if os.geteuid() != 0 or any(shutil.which(program) is None for program in ("unshare", "ip", "tc")):
        raise LaneUnavailable("--native needs root, iproute2 and util-linux: become root, or leave --native out")
    if subprocess.run([*in_own_network, netem_trial], capture_output=True, check=False).returncode != 0:
        raise LaneUnavailable("this machine's own kernel has no netem: leave --native out")
    environment = {**_environment(), "LAVT_KERNEL_LANE": "native"}
    process = subprocess.Popen(
        [*in_own_network, 'ip link set lo up; exec "$@"', "sh", *pytest_command], env=environment
    )
    try:
        return process.wait()
    finally:
        process.terminate()
        process.wait()


def _run_on_two_machines(python: str, pytest_command: Sequence[str], writable_directories: Sequence[Path]) -> int:
    """Run the tests on the first of two machines."""
    tools = fetch_packages(Path(os.environ.get("LAVT_KERNEL") or REPOSITORY / ".kernel").absolute())
    environment = {**_environment(), "LAVT_KERNEL_LANE": "pair", "LAVT_KERNEL_KEY": secrets.token_hex(16)}
    environment.setdefault("COLUMNS", str(shutil.get_terminal_size().columns))
    if sys.stdout.isatty():
        environment.setdefault("FORCE_COLOR", "1")  # pytest writes to a pipe
    agent = [python, "-B", "-m", "tests.kernel.lane.agent", CLIENT_ADDRESSES["vec1"]]
    processors = sorted(os.sched_getaffinity(0))
    guests: list[Guest] = []
    with TemporaryDirectory(prefix="lavt-kernel-") as folder, _host_stalls(python) as stall_line:
        scratch = Path(folder)
        prepare(tools, scratch)
        links = {device: socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM) for device in SERVER_ADDRESSES}
        output, output_writer = os.pipe()
        agent_output = os.open(scratch / "client.output", os.O_WRONLY | os.O_CREAT)
        try:
            for index, (name, command, addresses, guest_output, guest_line) in enumerate(
                [
                    ("server", pytest_command, SERVER_ADDRESSES, output_writer, stall_line),
                    ("client", agent, CLIENT_ADDRESSES, agent_output, None),
                ]
            ):
                ends = {device: (pair[index].fileno(), addresses[device]) for device, pair in links.items()}
                guest = start_guest(
                    name,
                    command,
                    tools=tools,
                    scratch=scratch,
                    environment=environment,
                    links=ends,
                    writable=writable_directories,
                    output=guest_output,
                    serial_line=guest_line,
                    processor=processors[index % len(processors)],
                )
                guests.append(guest)
            os.close(output_writer)
            return _watch_guests(guests, output)
        finally:
            for guest in guests:
                guest.stop()


@contextmanager
def _host_stalls(python: str) -> Iterator[tuple[int, int]]:
    """Start `host_stalls`; yield the file descriptors to read its answers from and to write questions to."""
    question_reader, question_writer = os.pipe()
    answer_reader, answer_writer = os.pipe()
    recorder = [python, "-B", "-m", "tests.kernel.lane.host_stalls"]
    process = subprocess.Popen(
        recorder, stdin=question_reader, stdout=answer_writer, env=_environment(), start_new_session=True
    )
    os.close(question_reader)
    os.close(answer_writer)
    try:
        yield answer_reader, question_writer
    finally:
        os.close(question_writer)
        os.close(answer_reader)
        process.wait()


def _watch_guests(guests: Sequence[Guest], output: int) -> int:
    """Forward the first machine's output until one of the machines ends; return the exit code."""
    is_open = True
    while all(guest.process.poll() is None for guest in guests):
        is_open = _forward_output(output, 0.2)
        if not is_open:
            guests[0].process.wait()
    while is_open and _forward_output(output, 0):
        pass
    code = guests[0].exit_code()
    if code is not None:
        return code
    dead = next(guest for guest in guests if guest.process.poll() is not None)
    client_output = (
        (dead.scratch / "client.output").read_text(errors="replace")[-2000:] if dead.name == "client" else ""
    )
    print(f"tests/kernel/run: the {dead.name}'s machine died:\n{client_output}{dead.console()}", file=sys.stderr)
    return 1


def _forward_output(output: int, wait_s: float) -> bool:
    """Forward a chunk of output if one comes within `wait_s`; return False at the end of the output."""
    if not select.select([output], [], [], wait_s)[0]:
        return wait_s > 0
    chunk = os.read(output, 65536)
    sys.stdout.buffer.write(chunk)
    sys.stdout.buffer.flush()
    return bool(chunk)


def _stop(number: int, _frame: object) -> None:
    raise SystemExit(128 + number)
