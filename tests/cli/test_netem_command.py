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
    """A netem whose tc notes what it is told; whatever `rejects` says is refused, and what is measured is as asked."""

    def __init__(self, directory: Path, *, held: bool) -> None:
        super().__init__("eth0", directory=directory, run=self.told, persistent=True)
        self.commands = ["tc qdisc add dev eth0 root"] if held else list[str]()
        self.held = held
        self.rejects: Callable[[str], bool] = lambda _words: False

    def told(self, words: Command) -> str:
        """Take a command: the interface has nothing of ours until the root is added."""
        line = " ".join(words)
        if "show" in words:
            root = {"kind": "prio" if self.held else "noqueue", "handle": "4c56:" if self.held else "0:", "root": True}
            return "" if "filter" in words else json.dumps([root])
        if self.rejects(line):
            raise WorkError("rejected")
        self.held = (self.held or "dev eth0 root handle" in line) and "qdisc del" not in line
        self.commands.append(line)
        return ""

    def verify(self, *_arguments: object, **_more: object) -> Verification:
        """Find everything as asked."""
        return Verification([], {})


def apply_to(kernel: Kernel, monkeypatch: pytest.MonkeyPatch) -> None:
    """Run `lavt netem apply L4 --role server --interface eth0`."""
    monkeypatch.setattr(command, "NetemInterface", lambda *_arguments, **_more: kernel)
    command.apply("L4", "eth0", "server")


def interrupted(*_: object) -> None:
    raise KeyboardInterrupt


def pipe_broken(*_: object) -> None:
    raise BrokenPipeError


@pytest.mark.parametrize(("says", "fails"), [("show", pipe_broken), ("show", interrupted), ("_tell", pipe_broken)])
def test_an_apply_that_fails_half_way_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, says: str, fails: Callable[..., None]
) -> None:
    """Whatever fails after a free interface was changed, printing also, the interface is free again."""
    kernel = Kernel(tmp_path, held=False)
    monkeypatch.setattr(console if says == "show" else command, says, fails)
    with pytest.raises((BrokenPipeError, KeyboardInterrupt)):
        apply_to(kernel, monkeypatch)

    assert kernel.commands[0] == "tc qdisc add dev eth0 root handle 4c56: prio bands 6"
    assert kernel.commands[-1] == "tc qdisc del dev eth0 root"
    assert not kernel.held


def test_a_change_that_fails_half_way_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Where a delay was there before and a filter of the new one is refused, it is said that something is left."""
    kernel = Kernel(tmp_path, held=True)
    kernel.rejects = lambda line: "filter add" in line
    with pytest.raises(LavtError, match="rejected"):
        apply_to(kernel, monkeypatch)

    assert kernel.held
    assert "`lavt netem show --interface eth0`" in capsys.readouterr().err


def test_an_apply_that_succeeds_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without --hold, what was applied and is as asked stays."""
    kernel = Kernel(tmp_path, held=False)
    apply_to(kernel, monkeypatch)
    assert kernel.held


@pytest.mark.parametrize("owner", ["L4 on eth0, left in place", "what was made by hand"])
def test_clear_says_whose_it_was(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], owner: str
) -> None:
    """`lavt netem clear` clears what a command has left, or a script, and says which."""
    kernel = Kernel(tmp_path, held=owner == "what was made by hand")
    if not kernel.held:
        apply_to(kernel, monkeypatch)
    monkeypatch.setattr(command, "NetemInterface", lambda *_arguments: kernel)
    command.clear("eth0", at_once=True)

    assert not kernel.held
    assert capsys.readouterr().err == f"lavt: taken away: {owner}\n"
