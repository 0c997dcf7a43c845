"""The schema of the config section `perception`, and of the file of the detector `onnx`."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, model_validator

from lavt.config.section import Section

BUILT_IN = "built_in"
"""The name of LAVT's own lane detector."""
ONNX = "onnx"
"""The name of the detector that finds paint with a neural network."""


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


class NetworkInputConfig(Section):
    """The picture as the network expects it: (value x scale - mean) / deviation, for values of 0 to 255."""

    width_px: int = Field(ge=16, le=4096)
    """The width to which pictures are scaled."""
    height_px: int = Field(ge=16, le=4096)
    """The height to which pictures are scaled."""
    resize: Literal["stretch", "letterbox"] = "stretch"
    """stretch: to both sizes; letterbox: as large as fits, in the middle of a grey picture."""
    channels: Literal["rgb", "bgr"] = "rgb"
    """The order of the colours."""
    scale: float = Field(1 / 255, gt=0)
    """The factor of the values."""
    mean: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """The mean of each colour, in the order of `channels`, after scaling."""
    deviation: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """The standard deviation of each colour, by which the difference is divided."""

    @model_validator(mode="after")
    def _check_deviation(self) -> NetworkInputConfig:
        if min(self.deviation) <= 0:
            raise ValueError("deviation must be above 0 for each colour")
        return self


class NetworkOutputConfig(Section):
    """The output of the network: one value for each class and pixel, (1, classes, h, w)."""

    name: str = ""
    """The name of the output; empty: the only one."""
    classes: tuple[str, ...] = ("background", "lane")
    """The classes in their order. With one class, a pixel is paint if its value exceeds `threshold`; with more, if the
    class with the largest value is one of `paint`."""
    paint: tuple[str, ...] = ("lane",)
    """The classes that are paint of a lane's marks."""
    threshold: float = 0.5
    """The threshold of a single class."""

    @model_validator(mode="after")
    def _check_classes(self) -> NetworkOutputConfig:
        unknown = [name for name in self.paint if name not in self.classes]
        if unknown or not self.paint:
            named = f"has {unknown[0]!r}, which is not a class" if unknown else "is empty"
            raise ValueError(f"paint {named}: name at least one of the classes {', '.join(self.classes)}")
        return self


class NeuralNetworkConfig(Section):
    """The file of the detector `onnx`: a network that marks the paint of lanes in a picture."""

    model: str
    """The ONNX file, relative to this file."""
    input: NetworkInputConfig
    output: NetworkOutputConfig = NetworkOutputConfig()
