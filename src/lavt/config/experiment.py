"""The schema of the config section `experiment`: whether a sweeping machine may drive runs on this server."""

from __future__ import annotations

from pydantic import Field

from lavt.config.section import Section


class ExperimentConfig(Section):
    """Runs that another machine requests (`lavt sweep --server`); for the simulator only."""

    remote_runs: bool = False
    """Whether an operator may request runs. The server then drives nothing else."""
    operator: str = ""
    """The only operator who can acquire control; empty: any. In a run, it is the one who requested the run."""
    max_stored_mb: int = Field(20_000, ge=1, le=10_000_000)
    """The most that the records of these runs may occupy in the output directory; then no further run begins."""
