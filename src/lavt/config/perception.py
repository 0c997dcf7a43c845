"""The schema of the config section `perception`."""

from __future__ import annotations

from pydantic import model_validator

from lavt.config.section import Section

BUILT_IN = "built_in"
"""The name of LAVT's own lane detector."""


class PerceptionConfig(Section):
    """The lane detector (`docs/perception.md`)."""

    detector: str = BUILT_IN
    """built_in: LAVT's own lane detector; onnx: a neural network in an ONNX file; or the name of your own."""
    file: str = ""
    """The file with the detector's own settings; empty: it needs none."""

    @model_validator(mode="after")
    def _check_file(self) -> PerceptionConfig:
        if self.detector == BUILT_IN and self.file:
            raise ValueError("the detector built_in has no file of its own: leave out file, or name another detector")
        return self

    @property
    def settings(self) -> str | None:
        """The detector and its file, as results show them; None for LAVT's own detector."""
        if self.detector == BUILT_IN:
            return None
        return f"{self.detector} {self.file}".strip()
