"""Schema of by-wire vehicles: a profile's YAML file, and the section `vehicle.dbw` that names one and its bus."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field

from lavt.config.section import Section

CommandSet = Literal["remote", "user"]
Word = Literal["enabled", "angle", "command", "speed", "gear"]


class CommandConfig(Section):
    """How one thing is commanded: a message, and which of its signals says what; an empty name: it has none."""

    message: str | dict[CommandSet, str] = ""
    """Of each set of commands, where the kit has more than one."""
    value: str = ""
    """What is asked for; its unit is the DBC's, and its multiplexer follows from it."""
    enable: str = ""
    clear: str = ""
    rate: str = ""
    """How fast the steering wheel may turn."""
    rate_unit_degps: float = Field(1.0, gt=0)
    """What one of the rate stands for, where the DBC gives it no unit."""
    count: str = ""
    """Counts frames, as far as its bits reach."""
    checksum: str = ""
    """CRC-8 of SAE J1850 over identifier and data; the last byte."""


class SystemCommandConfig(Section):
    """How the kit as a whole is enabled and disabled; an empty message: it needs no such command."""

    message: str = ""
    value: str = ""
    enable: int = 1
    disable: int = 2
    count: str = ""
    checksum: str = ""


class SentConfig(Section):
    """Everything that is sent."""

    steering: CommandConfig
    brake: CommandConfig
    throttle: CommandConfig
    gear: CommandConfig
    system: SystemCommandConfig = SystemCommandConfig()
    clearing_bytes: int | None = Field(None, ge=1, le=8)
    """So many bytes of a command are sent to clear an override; null: all, with counter and checksum."""
    gears: dict[Literal["park", "reverse", "neutral", "drive"], int] = Field(default_factory=dict)


class ReportConfig(Section):
    """How one report is read; an empty message: there is none.

    The keys of `override`, `trip`, `lapse` and `fault` are signs, the values what they mean in words: `SIGNAL` is a
    sign where it is not 0, `SIGNAL=7` where it is 7.
    """

    message: str = ""
    timeout_ms: int = Field(200, ge=10, le=5000)
    """Without the report for so long there is no driving."""
    values: dict[Word, str] = Field(default_factory=dict)
    """Which signal has which value; in the DBC's unit."""
    override: dict[str, str] = Field(default_factory=dict)
    """The driver has taken over; CLEAR takes it back."""
    trip: dict[str, str] = Field(default_factory=dict)
    """The kit's watchdog has tripped; CLEAR takes it back, once somebody has taken over."""
    lapse: dict[str, str] = Field(default_factory=dict)
    """What the kit found wrong with our commands, until the next right one."""
    fault: dict[str, str] = Field(default_factory=dict)
    """What hinders driving as long as it is reported."""
    needs: dict[str, list[int] | dict[CommandSet, list[int]]] = Field(default_factory=dict)
    """Numbers that a signal must have; any other hinders driving."""
    reasons: list[str] = Field(default_factory=list)
    """Signals that tell why, wherever something is refused: by the names that the DBC has for their numbers."""
    checksum: str = ""
    """As in a command; a report with a wrong one is dropped."""


class ReportsConfig(Section):
    """Everything that is read."""

    steering: ReportConfig
    brake: ReportConfig
    throttle: ReportConfig
    gear: ReportConfig
    speed: ReportConfig = ReportConfig()
    system: ReportConfig = ReportConfig()
    remote: ReportConfig = ReportConfig()


class OwnBrakeConfig(Section):
    """How the brake's report tells that the kit brakes by itself; an empty signal: it does not."""

    signal: str = ""
    above: float = Field(0.0, ge=0)
    """It brakes where the signal is more, and the brake is not reported enabled."""


class ByWireCarConfig(Section):
    """The car that the kit is in."""

    wheelbase_m: float = Field(gt=0.5, lt=10)
    steering_ratio: float = Field(gt=1, lt=50)
    """Angle of the steering wheel over that of the road wheels."""
    steering_sign: Literal[1, -1] | None = None
    """1: left is positive on the bus; null: not known."""
    max_acceleration_mps2: float = Field(gt=0, le=20)
    max_braking_mps2: float = Field(gt=0, le=20)


class ByWireLimitsConfig(Section):
    """What is never exceeded on the bus, whatever is asked. Rates of pedals are of pressing; letting go is free."""

    steering_wheel_deg: float = Field(gt=0, le=3000)
    steering_wheel_rate_degps: float = Field(gt=0, le=3000)
    throttle: float = Field(1.0, ge=0, le=1)
    brake: float = Field(1.0, gt=0, le=1)
    throttle_rate_per_s: float = Field(gt=0, le=1000)
    brake_rate_per_s: float = Field(gt=0, le=1000)
    holding_brake: float = Field(0.3, gt=0, le=1)
    """The least brake while the kit is being enabled and while the car is being parked."""


class ProfileConfig(Section):
    """How one kind of by-wire kit is spoken to (`docs/by_wire.md`)."""

    kit: Literal["dataspeed_1", "dataspeed_2"]
    """What a software car has to play to be driven by this profile."""
    dbc: str
    """The file with the bits, beside the profile."""
    commands: CommandSet | None = None
    """Which of the kit's sets of commands; null: it has one."""
    vehicle: ByWireCarConfig
    limits: ByWireLimitsConfig
    command_step_deg: float = Field(0.1, gt=0)
    """One of the reported `command` of the steering."""
    sent: SentConfig
    reports: ReportsConfig
    watchdog: OwnBrakeConfig = OwnBrakeConfig()
    """By what `lavt can test-watchdog` sees that the kit's watchdog brakes."""


class DbwConfig(Section):
    """A by-wire kit and the bus it is on."""

    profile: str = "dataspeed_gen2"
    """A profile that comes with LAVT, or the path of one's YAML file; `:user` behind it takes its other commands."""
    dbc: str = ""
    """The vendor's DBC file instead of the profile's."""
    interface: str = "socketcan"
    """python-can's name, or `inside`: a software car in this very process."""
    channel: str = "can0"
    options: dict[str, Any] = Field(default_factory=dict)
    """Further arguments of python-can's `Bus`."""
    truth: str = ""
    """`host:port` of UDP where a software car's truth is heard; empty: a real car."""
    watchdog_proof: str = ""
    """File that `lavt can test-watchdog` wrote."""
    steering_sign: Literal[1, -1] | None = None
    """1: left is positive on the bus; for a profile that leaves it open."""

    @property
    def is_inside(self) -> bool:
        """Whether the kit is a software car in the server's own process, also in virtual time."""
        return self.interface == "inside"

    def __hash__(self) -> int:
        """Hash what is written: `options` has no hash of its own."""
        return hash(self.model_dump_json())


class WatchdogProof(Section):
    """The file of `lavt can test-watchdog`: on this bus, by this profile, the kit's watchdog was seen to brake."""

    version: Literal[1] = 1
    at: str
    """Day and time (UTC)."""
    profile: str
    commands: CommandSet | None
    digest: str
    """SHA-256 of the profile's YAML file and DBC."""
    interface: str
    channel: str
    options: dict[str, Any]
    is_virtual: bool
    gear: str
    brake: float
    """What was asked before the silence."""
    release_ms: float = Field(ge=0)
    """From the last frame until the brake was reported not enabled."""
    braked_ms: float = Field(ge=0)
    """From the last frame until the kit was reported to brake by itself."""
    reports: int
    """So many reports of the brake came in the silence."""
    said: str
    """What else the kit reported."""
