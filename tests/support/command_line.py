"""Commands of `lavt` in the test's own process."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple


class CommandResult(NamedTuple):
    """What a command left: exit code, standard output, standard error."""

    code: int
    out: str
    err: str

    def rejected(self) -> str:
        """Check that the input was refused as it must be, and return the sentence."""
        assert self.code == 2, self
        assert self.out == ""
        return self.sentence()

    def sentence(self) -> str:
        """Check that standard error has one sentence of LAVT's and nothing else, and return it."""
        assert self.err.startswith("lavt: "), self
        assert self.err.count("\n") == 1, self
        assert "Traceback" not in self.err
        return self.err


Run = Callable[..., CommandResult]
