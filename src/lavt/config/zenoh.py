"""The schema of the config section `zenoh`: the router of a side, in its process or separate."""

from __future__ import annotations

from typing import Any

from pydantic import Field, model_validator

from lavt.config.section import Section

EMBEDDED = "embedded"
"""The value of `router` for a router in the process of the side."""


class ZenohConfig(Section):
    """The router of this side: in the side's process, or a separate program to which the side has a session."""

    router: str = EMBEDDED
    """`embedded`, or the endpoint of a separate router; empty: a separate router, at the endpoint in `session`."""
    session: str = ""
    """For a separate router, the config of the session, in JSON5: a path, or the name of a shipped file; empty:
    `zenoh-configs/session.json5`."""
    router_file: str = ""
    """For the embedded router, its config, in JSON5: a path, or the name of a shipped file. Empty: the shipped file of
    this side, encrypted if the side has a signing key (`docs/deployment.md`)."""
    router_settings: dict[str, Any] = Field(default_factory=dict)
    """For the embedded router, values that replace those of its config, with the same nested keys, such as
    `listen: {endpoints: [...]}`."""
    scouting: bool = False
    """For the embedded router of a server, whether it answers the multicast of `lavt vehicles --scout`. Then everybody
    on the local network learns its address, and Zenoh programs with default settings connect to it by themselves."""

    @property
    def is_embedded(self) -> bool:
        """Whether the router runs in the process of the side."""
        return self.router == EMBEDDED

    @model_validator(mode="after")
    def _check_kind(self) -> ZenohConfig:
        if self.is_embedded and self.session:
            raise ValueError(
                "zenoh.session is for a separate router: leave it out, or set zenoh.router to the endpoint of a router"
            )
        if not self.is_embedded and (self.router_file or self.router_settings or self.scouting):
            raise ValueError(
                f"zenoh.router_file, zenoh.router_settings and zenoh.scouting are for an embedded router: leave them "
                f"out, or set zenoh.router: {EMBEDDED}"
            )
        return self
