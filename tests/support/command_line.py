"""The result of a `lavt` command that a test has run."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple


class CommandResult(NamedTuple):
    """The exit code, standard output and standard error of a command."""

    code: int
    out: str
    err: str

    def rejection(self) -> str:
        """Check that the command rejected its input with exit code 2 and one sentence; return the sentence."""
        assert self.code == 2, self
        assert self.out == ""
        return self.sentence()

    def sentence(self) -> str:
        """Check that standard error has one sentence of LAVT and nothing else; return the sentence."""
        assert self.err.startswith("lavt: "), self
        assert self.err.count("\n") == 1, self
        assert "Traceback" not in self.err
        return self.err


Run = Callable[..., CommandResult]
