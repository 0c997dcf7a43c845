"""The schema of `configs/costs.yaml`: how long stages and links take in virtual time."""

from __future__ import annotations

from itertools import pairwise
from typing import TypeVar

from pydantic import Field, model_validator

from lavt.config.section import Section

Value = TypeVar("Value")


class Costs(Section):
    """The times that stages and links take in virtual time, see `docs/virtual_time.md`.

    A stage or link without quantiles always takes its median.
    """

    measured_on: str
    """The machine and the load under which the times were measured."""
    stages_us: dict[str, dict[str, float]]
    """The median time of each stage, by node and stage."""
    links_us: dict[str, float]
    """The median time that each link needs for a message."""
    levels: list[float] = Field(default_factory=list)
    """The levels of all quantiles below, from 0 (the smallest value) to 1 (the largest)."""
    stage_quantiles_us: dict[str, dict[str, list[float]]] = Field(default_factory=dict)
    """The quantiles of the time of each stage, by node and stage."""
    link_quantiles_us: dict[str, list[float]] = Field(default_factory=dict)
    """The quantiles of the time that each link needs."""

    @model_validator(mode="after")
    def _check_quantiles(self) -> Costs:
        quantiles = {**_flat(self.stage_quantiles_us), **self.link_quantiles_us}
        medians = {**_flat(self.stages_us), **self.links_us}
        levels = self.levels
        if quantiles and not (
            levels and levels[0] == 0 and levels[-1] == 1 and all(low < high for low, high in pairwise(levels))
        ):
            raise ValueError("levels must grow from 0 to 1")
        for name, values_us in quantiles.items():
            if name not in medians:
                raise ValueError(f"{name} has quantiles but no median")
            if len(values_us) != len(levels) or values_us[0] < 0 or values_us != sorted(values_us):
                raise ValueError(f"{name} must have a quantile for each level, none negative or below the one before")
        return self

    @property
    def constant(self) -> Costs:
        """The same costs without their spread: only the medians."""
        return Costs(measured_on=self.measured_on, stages_us=self.stages_us, links_us=self.links_us)


def _flat(by_node: dict[str, dict[str, Value]]) -> dict[str, Value]:
    return {f"{node}.{stage}": value for node, stages in by_node.items() for stage, value in stages.items()}
