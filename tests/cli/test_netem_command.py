from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from lavt.cli import console
from lavt.cli import netem as command
from lavt.errors import LavtError, WorkError
from lavt.transport.netem.netem import NetemInterface, Verification
from lavt.transport.netem.tc import Command


class SimulatedInterface(NetemInterface):
    """A netem interface with a simulated tc: commands are recorded, and those for which `rejects` is true fail.

    Its verification always succeeds.
    """

    def __init__(self, directory: Path, *, is_delayed: bool) -> None:
        super().__init__("eth0", directory=directory, run=self.run_tc, persistent=True)
        self.commands = ["tc qdisc add dev eth0 root"] if is_delayed else list[str]()
        self.is_delayed = is_delayed
        self.rejects: Callable[[str], bool] = lambda _line: False

    def run_tc(self, words: Command) -> str:
        """Run a command: the interface has no delay queues until their root is added."""
        line = " ".join(words)
        if "show" in words:
            kind, handle = ("prio", "4c56:") if self.is_delayed else ("noqueue", "0:")
            return "" if "filter" in words else json.dumps([{"kind": kind, "handle": handle, "root": True}])
        if self.rejects(line):
            raise WorkError("rejected")
        self.is_delayed = (self.is_delayed or "dev eth0 root handle" in line) and "qdisc del" not in line
        self.commands.append(line)
        return ""

    def verify(self, *_arguments: object, **_keywords: object) -> Verification:
        """Return a successful verification."""
        return Verification([], {})


def apply_to(interface: SimulatedInterface, monkeypatch: pytest.MonkeyPatch) -> None:
    """Run `lavt netem apply L4 --role server --interface eth0`."""
    monkeypatch.setattr(command, "NetemInterface", lambda *_arguments, **_keywords: interface)
    command.apply("L4", "eth0", "server")


def interrupt(*_: object) -> None:
    raise KeyboardInterrupt


def break_pipe(*_: object) -> None:
    raise BrokenPipeError


@pytest.mark.parametrize(
    ("module", "function", "failure"),
    [
        (console, "print_result", break_pipe),
        (console, "print_result", interrupt),
        (command, "_print_verification", break_pipe),
    ],
)
def test_a_failed_apply_removes_its_queues(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, module: object, function: str, failure: Callable[..., None]
) -> None:
    """After any failure, such as a broken pipe while printing, an interface that had no delay queues has none again."""
    interface = SimulatedInterface(tmp_path, is_delayed=False)
    monkeypatch.setattr(module, function, failure)
    with pytest.raises((BrokenPipeError, KeyboardInterrupt)):
        apply_to(interface, monkeypatch)

    assert interface.commands[0] == "tc qdisc add dev eth0 root handle 4c56: prio bands 6"
    assert interface.commands[-1] == "tc qdisc del dev eth0 root"
    assert not interface.is_delayed


def test_a_failed_change_prints_how_to_find_the_remaining_queues(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """If tc rejects a change on a delayed interface, the message names the command that shows the remaining queues."""
    interface = SimulatedInterface(tmp_path, is_delayed=True)
    interface.rejects = lambda line: "filter add" in line
    with pytest.raises(LavtError, match="rejected"):
        apply_to(interface, monkeypatch)

    assert interface.is_delayed
    assert "`lavt netem show --interface eth0`" in capsys.readouterr().err


def test_a_verified_condition_stays_in_force(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without --hold, a verified condition stays in force after the command."""
    interface = SimulatedInterface(tmp_path, is_delayed=False)
    apply_to(interface, monkeypatch)
    assert interface.is_delayed


@pytest.mark.parametrize("owner", ["L4 on eth0", "by hand"])
def test_clear_names_the_owner(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], owner: str
) -> None:
    """`lavt netem clear` removes the delay of an earlier command or of a script, and prints which of the two set it."""
    interface = SimulatedInterface(tmp_path, is_delayed=owner == "by hand")
    if not interface.is_delayed:
        apply_to(interface, monkeypatch)
    monkeypatch.setattr(command, "NetemInterface", lambda *_arguments: interface)
    command.clear("eth0", at_once=True)

    assert not interface.is_delayed
    assert owner in capsys.readouterr().err
