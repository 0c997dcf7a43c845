"""Who may drive, and which vehicle is the right one: keys on both sides."""

from __future__ import annotations

from pydantic import Field, model_validator

from lavt.config.section import Section


class ServerSecurityConfig(Section):
    """Who may drive; where nothing is said, whoever reaches the router may."""

    key: str = ""
    """File of the vehicle's signing key (NAME.sign.key of `lavt keys`)."""
    operators: dict[str, str] = Field(default_factory=dict)
    """Names of operators, and files of their keys (NAME.sign.pub)."""

    @model_validator(mode="after")
    def _both(self) -> ServerSecurityConfig:
        if bool(self.key) != bool(self.operators):
            raise ValueError("key and operators belong together: give both, or none where nothing shall be signed")
        return self


class ClientSecurityConfig(Section):
    """Who one is, and which vehicle is the right one."""

    key: str = ""
    """File of the operator's signing key (NAME.sign.key of `lavt keys`)."""
    vehicle: str = ""
    """File of the vehicle's key (NAME.sign.pub)."""

    @model_validator(mode="after")
    def _both(self) -> ClientSecurityConfig:
        if bool(self.key) != bool(self.vehicle):
            raise ValueError("key and vehicle belong together: give both, or none where nothing is signed")
        return self
