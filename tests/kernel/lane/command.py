"""`tests/kernel/run`: two machines, pytest on the first, its result passed through."""

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
from tests.kernel.lane.packages import fetched
from tests.kernel.lane.rejection import Refusal

REPOSITORY = Path(__file__).resolve().parents[3]
HERE = REPOSITORY / "tests" / "kernel"
SERVER = {"vec0": "10.9.0.1", "vec1": "10.9.1.1"}
"""Addresses of the first machine, whose pytest it is: vec0 is the network under test, vec1 only manages."""
CLIENT = {"vec0": "10.9.0.2", "vec1": "10.9.1.2"}
EPILOG = """What is not listed here goes to pytest, which runs in the repository's top directory; a test file of this
directory may be named by its name alone. Environment variables pass through. LAVT_KERNEL is the directory for what is
fetched, .kernel/ of the repository where it is not set. Example: tests/kernel/run test_lane.py -x"""


def main(arguments: Sequence[str]) -> int:
    """Run the lane; 2 where it cannot run here, 1 where a machine died, else what pytest said."""
    parser = argparse.ArgumentParser(
        prog="tests/kernel/run",
        description="Run tests/kernel on a real kernel: two machines that are processes, with no right but the user's.",
        epilog=EPILOG,
        allow_abbrev=False,
    )
    parser.add_argument("--native", action="store_true", help="run on this machine's own kernel (needs root and netem)")
    parser.add_argument("--out", type=Path, help="directory that tests and pytest's options may write")
    options, given = parser.parse_known_args(arguments)
    for number in (signal.SIGTERM, signal.SIGHUP, signal.SIGINT):
        signal.signal(number, _stop)
    try:
        out = writable(options.out)
        os.chdir(REPOSITORY)
        python = interpreter()
        compileall.compile_dir(REPOSITORY / "src", quiet=2)  # the machines are slow, and start LAVT a hundred times
        tests = [python, "-B", "-m", "pytest", "-p", "no:cacheprovider", *pytest_arguments(given)]
        return _native(tests) if options.native else _pair(python, tests, out)
    except Refusal as rejection:
        print(f"tests/kernel/run: {rejection}", file=sys.stderr)
        return 2


def pytest_arguments(given: Sequence[str]) -> list[str]:
    """Complete the names of tests of this directory, and name the directory where no test is named."""
    arguments = [_completed(argument) for argument in given]
    named = any(REPOSITORY / argument.partition("::")[0] in (HERE, *HERE.glob("*.py")) for argument in arguments)
    return arguments if named else [*arguments, "tests/kernel"]


def _completed(argument: str) -> str:
    file, separator, test = argument.partition("::")
    path = Path(file)
    if path.suffix != ".py" or not (HERE / path.name).is_file():
        return argument
    return f"tests/kernel/{path.name}{separator}{test}"


def interpreter() -> str:
    """Find a Python that has LAVT and pytest: the one that runs this, or the repository's environment."""
    for python in (sys.executable, str(REPOSITORY / ".venv/bin/python")):
        has_both = [python, "-c", "import lavt, pytest"]
        with suppress(OSError):
            if subprocess.run(has_both, capture_output=True, env=_environment(), check=False).returncode == 0:
                return python
    raise Refusal("no Python here has LAVT and pytest: python3 -m venv .venv && .venv/bin/pip install -e '.[all]'")


def writable(out: Path | None) -> list[Path]:
    """Return the directories that the machines may write to: below `out`, and beside the file of LAVT_PROGRESS."""
    progress = os.environ.get("LAVT_PROGRESS")
    directories = [Path(progress).resolve().parent] if progress else []
    if out is None:
        return directories
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise Refusal(f"{out} cannot be made ({error.strerror}): name another directory with --out") from None
    return [*directories, out.resolve()]


def _environment() -> dict[str, str]:
    """Give this program's variables, with paths that hold in every directory."""
    python_path = os.environ.get("PYTHONPATH")
    absolute = {"PYTHONPATH": os.pathsep.join(_START_PATHS)} if python_path else {}
    return {**os.environ, **absolute, "PYTHONDONTWRITEBYTECODE": "1"}


_START_PATHS = [str(Path(part).absolute()) for part in os.environ.get("PYTHONPATH", "").split(os.pathsep) if part]


def _native(tests: Sequence[str]) -> int:
    """Run the tests on this kernel, in a network of their own that ends with them."""
    trial = "ip link set lo up && tc qdisc add dev lo root netem delay 1ms"
    alone = ["unshare", "--net", "sh", "-c"]
    if os.geteuid() != 0 or any(shutil.which(each) is None for each in ("unshare", "ip", "tc")):
        raise Refusal("--native needs root, iproute2 and util-linux: become root, or leave --native out")
    if subprocess.run([*alone, trial], capture_output=True, check=False).returncode != 0:
        raise Refusal("this machine's own kernel has no netem: leave --native out")
    environment = {**_environment(), "LAVT_KERNEL_LANE": "native"}
    process = subprocess.Popen([*alone, 'ip link set lo up; exec "$@"', "sh", *tests], env=environment)
    try:
        return process.wait()
    finally:
        process.terminate()
        process.wait()


def _pair(python: str, tests: Sequence[str], writable: Sequence[Path]) -> int:
    tools = fetched(Path(os.environ.get("LAVT_KERNEL") or REPOSITORY / ".kernel").absolute())
    environment = {**_environment(), "LAVT_KERNEL_LANE": "pair", "LAVT_KERNEL_KEY": secrets.token_hex(16)}
    environment.setdefault("COLUMNS", str(shutil.get_terminal_size().columns))
    if sys.stdout.isatty():
        environment.setdefault("FORCE_COLOR", "1")  # pytest sees a pipe
    agent = [python, "-B", "-m", "tests.kernel.lane.agent", CLIENT["vec1"]]
    processors = sorted(os.sched_getaffinity(0))
    guests: list[Guest] = []
    with TemporaryDirectory(prefix="lavt-kernel-") as folder, _host_stalls(python) as line:
        scratch = Path(folder)
        prepare(tools, scratch)
        links = {device: socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM) for device in SERVER}
        output, inlet = os.pipe()
        agent_output = os.open(scratch / "client.output", os.O_WRONLY | os.O_CREAT)
        try:
            for side, (name, command, addresses, to, its_line) in enumerate(
                [("server", tests, SERVER, inlet, line), ("client", agent, CLIENT, agent_output, None)]
            ):
                ends = {device: (pair[side].fileno(), addresses[device]) for device, pair in links.items()}
                guest = start_guest(
                    name, command, tools=tools, scratch=scratch, environment=environment, links=ends,
                    writable=writable, output=to, line=its_line, processor=processors[side % len(processors)],
                )  # fmt: skip
                guests.append(guest)
            os.close(inlet)
            return _watch(guests, output)
        finally:
            for guest in guests:
                guest.end()


@contextmanager
def _host_stalls(python: str) -> Iterator[tuple[int, int]]:
    """Record this machine's stalls; give what a guest needs to ask for them: where it reads and where it writes."""
    questions, requested = os.pipe()
    answered, answers = os.pipe()
    recorder = [python, "-B", "-m", "tests.kernel.lane.host_stalls"]
    process = subprocess.Popen(
        recorder, stdin=questions, stdout=answers, env=_environment(), start_new_session=True
    )  # fmt: skip
    os.close(questions)
    os.close(answers)
    try:
        yield answered, requested
    finally:
        os.close(requested)
        os.close(answered)
        process.wait()


def _watch(guests: Sequence[Guest], output: int) -> int:
    """Pass the first machine's output on until one of the machines has ended; tell the exit code."""
    open_still = True
    while all(guest.process.poll() is None for guest in guests):
        open_still = _pass_on(output, 0.2)
        if not open_still:
            guests[0].process.wait()
    while open_still and _pass_on(output, 0):
        pass
    code = guests[0].exit_code()
    if code is not None:
        return code
    died = next(guest for guest in guests if guest.process.poll() is not None)
    said = (died.scratch / "client.output").read_text(errors="replace")[-2000:] if died.name == "client" else ""
    print(f"tests/kernel/run: the {died.name}'s machine died:\n{said}{died.console()}", file=sys.stderr)
    return 1


def _pass_on(output: int, wait_s: float) -> bool:
    """Pass a piece on, if there is one by then; False at the end."""
    if not select.select([output], [], [], wait_s)[0]:
        return wait_s > 0
    piece = os.read(output, 65536)
    sys.stdout.buffer.write(piece)
    sys.stdout.buffer.flush()
    return bool(piece)


def _stop(number: int, _frame: object) -> None:
    raise SystemExit(128 + number)
