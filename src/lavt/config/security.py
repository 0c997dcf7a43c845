"""The schema of the config section `security`: the signing keys of the vehicle and of its operators."""

from __future__ import annotations

from pydantic import Field, model_validator

from lavt.config.section import Section


class ServerSecurityConfig(Section):
    """The vehicle's key, and the operators who may drive. Without keys, anyone who can reach the router can drive."""

    key: str = ""
    """The file of the vehicle's signing key (NAME.sign.key of `lavt keys`)."""
    operators: dict[str, str] = Field(default_factory=dict)
    """The files of the operators' keys (NAME.sign.pub) by name."""

    @model_validator(mode="after")
    def _check_complete(self) -> ServerSecurityConfig:
        if bool(self.key) != bool(self.operators):
            raise ValueError("key and operators belong together: give both, or neither for unsigned messages")
        return self


class ClientSecurityConfig(Section):
    """The operator's own key, and the key of the expected vehicle."""

    key: str = ""
    """The file of the operator's signing key (NAME.sign.key of `lavt keys`)."""
    vehicle: str = ""
    """The file of the vehicle's key (NAME.sign.pub)."""

    @model_validator(mode="after")
    def _check_complete(self) -> ClientSecurityConfig:
        if bool(self.key) != bool(self.vehicle):
            raise ValueError("key and vehicle belong together: give both, or neither for unsigned messages")
        return self
