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


class Kernel(NetemInterface):
    """A netem interface with a simulated tc that records its commands and fails those that `rejects` selects.

    Its verification always succeeds.
    """

    def __init__(self, directory: Path, *, delayed: bool) -> None:
        super().__init__("eth0", directory=directory, run=self.run_tc, persistent=True)
        self.commands = ["tc qdisc add dev eth0 root"] if delayed else list[str]()
        self.is_delayed = delayed
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

    def verify(self, *_arguments: object, **_more: object) -> Verification:
        """Return a successful verification."""
        return Verification([], {})


def apply_to(kernel: Kernel, monkeypatch: pytest.MonkeyPatch) -> None:
    """Run `lavt netem apply L4 --role server --interface eth0`."""
    monkeypatch.setattr(command, "NetemInterface", lambda *_arguments, **_more: kernel)
    command.apply("L4", "eth0", "server")


def interrupted(*_: object) -> None:
    raise KeyboardInterrupt


def pipe_broken(*_: object) -> None:
    raise BrokenPipeError


@pytest.mark.parametrize(
    ("module", "function", "failure"),
    [
        (console, "print_result", pipe_broken),
        (console, "print_result", interrupted),
        (command, "_print_verification", pipe_broken),
    ],
)
def test_a_failed_apply_restores_a_free_interface(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, module: object, function: str, failure: Callable[..., None]
) -> None:
    """After any failure, such as a broken pipe while printing, an interface that was free is free again."""
    kernel = Kernel(tmp_path, delayed=False)
    monkeypatch.setattr(module, function, failure)
    with pytest.raises((BrokenPipeError, KeyboardInterrupt)):
        apply_to(kernel, monkeypatch)

    assert kernel.commands[0] == "tc qdisc add dev eth0 root handle 4c56: prio bands 6"
    assert kernel.commands[-1] == "tc qdisc del dev eth0 root"
    assert not kernel.is_delayed


def test_a_failed_change_explains_how_to_find_what_is_left(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """If tc rejects a change on a delayed interface, the message names the command that shows what is left."""
    kernel = Kernel(tmp_path, delayed=True)
    kernel.rejects = lambda line: "filter add" in line
    with pytest.raises(LavtError, match="rejected"):
        apply_to(kernel, monkeypatch)

    assert kernel.is_delayed
    assert "`lavt netem show --interface eth0`" in capsys.readouterr().err


def test_a_verified_condition_stays_in_force(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without --hold, a verified condition stays in force after the command."""
    kernel = Kernel(tmp_path, delayed=False)
    apply_to(kernel, monkeypatch)
    assert kernel.is_delayed


@pytest.mark.parametrize("owner", ["L4 on eth0", "by hand"])
def test_clear_names_the_owner(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], owner: str
) -> None:
    """`lavt netem clear` removes the delay of an earlier command or of a script, and says which of these it was."""
    kernel = Kernel(tmp_path, delayed=owner == "by hand")
    if not kernel.is_delayed:
        apply_to(kernel, monkeypatch)
    monkeypatch.setattr(command, "NetemInterface", lambda *_arguments: kernel)
    command.clear("eth0", at_once=True)

    assert not kernel.is_delayed
    assert owner in capsys.readouterr().err
