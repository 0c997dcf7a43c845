"""The schema of by-wire vehicles: the profile of a kit, and the section `vehicle.dbw` with a profile and a bus."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field

from lavt.config.section import Section

CommandSet = Literal["remote", "user"]
"""The sets of command messages of a generation 2 kit; the state of its remote control determines which it accepts."""
ReportedValue = Literal[
    "enabled", "angle", "command", "gear", "speed", "second_speed", "wheel_1", "wheel_2", "wheel_3", "wheel_4"
]


class CommandConfig(Section):
    """A command: its message, and the names of its signals by role. An empty name: the message has no such signal."""

    message: str | dict[CommandSet, str] = ""
    """The message's name, or one name for each command set of the kit."""
    value: str = ""
    """The commanded value, in the DBC's unit. If the signal is multiplexed, its multiplexer is set accordingly."""
    enable: str = ""
    """The signal that enables the axis."""
    clear: str = ""
    """The signal that resets the conditions that the kit has latched, such as an override."""
    rate: str = ""
    """The maximum rate of the steering wheel."""
    rate_unit_degps: float = Field(1.0, gt=0)
    """The unit of the rate, if the DBC has none."""
    count: str = ""
    """The frame counter, which wraps around."""
    checksum: str = ""
    """The CRC-8 of SAE J1850 over identifier and data; this signal must be the last byte."""


class SystemCommandConfig(Section):
    """The command that enables and disables the kit as a whole; an empty message: the kit needs none."""

    message: str = ""
    """The message's name; empty: none."""
    value: str = ""
    """The signal of the value."""
    enable: int = 1
    """The value that enables the kit."""
    disable: int = 2
    """The value that disables the kit."""
    count: str = ""
    """The frame counter, which wraps around."""
    checksum: str = ""
    """The checksum's signal."""


class SentConfig(Section):
    """All commands that LAVT sends to the kit."""

    steering: CommandConfig
    brake: CommandConfig
    throttle: CommandConfig
    gear: CommandConfig
    system: SystemCommandConfig = SystemCommandConfig()
    clearing_bytes: int | None = Field(None, ge=1, le=8)
    """The number of bytes of a command that clears an override; null: all bytes, with counter and checksum."""
    gears: dict[Literal["park", "reverse", "neutral", "drive"], int] = Field(default_factory=dict)
    """The value that commands each gear on the bus."""


class ReportConfig(Section):
    """A report of the kit; an empty message: the kit has no such report.

    The keys of `override`, `trip`, `command_error` and `fault` are conditions, and their values are texts that describe
    them. The condition `SIGNAL` is true if the signal is not 0, and `SIGNAL=7` if the signal is 7.
    """

    message: str = ""
    """The message's name; empty: none."""
    timeout_ms: int = Field(200, ge=10, le=5000)
    """Driving is inhibited if the report is missing for longer than this."""
    values: dict[ReportedValue, str] = Field(default_factory=dict)
    """The signal of each value, in the DBC's unit."""
    override: dict[str, str] = Field(default_factory=dict)
    """Conditions under which the driver has taken over; the signal `clear` of a command resets them."""
    trip: dict[str, str] = Field(default_factory=dict)
    """Conditions under which the kit's watchdog has tripped; `clear` resets them after a driver has taken over."""
    command_error: dict[str, str] = Field(default_factory=dict)
    """Errors that the kit found in LAVT's commands; it reports them until the next correct command."""
    fault: dict[str, str] = Field(default_factory=dict)
    """Faults that inhibit driving while they are reported."""
    needs: dict[str, list[int] | dict[CommandSet, list[int]]] = Field(default_factory=dict)
    """For each of these signals, the values that it may have; any other value inhibits driving."""
    reasons: list[str] = Field(default_factory=list)
    """Signals whose value explains why driving is inhibited; the value is shown by its name in the DBC."""
    count: str = ""
    """The frame counter; a report with the same count as the previous report is dropped."""
    checksum: str = ""
    """The checksum, as in a command; a report with a wrong checksum is dropped."""


class ReportsConfig(Section):
    """All reports of the kit that LAVT reads."""

    steering: ReportConfig
    brake: ReportConfig
    throttle: ReportConfig
    gear: ReportConfig
    speed: ReportConfig = ReportConfig()
    wheels: ReportConfig = ReportConfig()
    system: ReportConfig = ReportConfig()
    remote: ReportConfig = ReportConfig()
    """The report of the kit's remote control."""


class OwnBrakeConfig(Section):
    """How the brake's report shows that the kit brakes by itself; an empty signal: the report does not show it."""

    signal: str = ""
    """The signal that shows it."""
    above: float = Field(0.0, ge=0)
    """The kit brakes by itself if the signal is above this value while the brake is reported as not enabled."""


class ByWireCarConfig(Section):
    """The car with the kit."""

    wheelbase_m: float = Field(gt=0.5, lt=10)
    """The car's wheelbase."""
    steering_ratio: float = Field(gt=1, lt=50)
    """The angle of the steering wheel divided by the angle of the road wheels."""
    steering_sign: Literal[1, -1] | None = None
    """1: left is positive on the bus; null: unknown."""
    wheel_radius_m: float = Field(0.33, gt=0.1, lt=1)
    """The radius with which reported wheel speeds are converted to the speed of the car."""
    max_acceleration_mps2: float = Field(gt=0, le=20)
    """The acceleration at full throttle."""
    max_braking_mps2: float = Field(gt=0, le=20)
    """The deceleration at full brake."""


class ByWireLimitsConfig(Section):
    """The limits of all commands on the bus. The rates of pedals limit only how fast a pedal is pressed."""

    steering_wheel_deg: float = Field(gt=0, le=3000)
    """The largest angle of the steering wheel."""
    steering_wheel_rate_degps: float = Field(gt=0, le=3000)
    """The largest rate of the steering wheel."""
    throttle: float = Field(1.0, ge=0, le=1)
    """The largest throttle."""
    brake: float = Field(1.0, gt=0, le=1)
    """The largest brake."""
    throttle_rate_per_s: float = Field(gt=0, le=1000)
    """How fast the throttle may be pressed."""
    brake_rate_per_s: float = Field(gt=0, le=1000)
    """How fast the brake may be pressed."""
    holding_brake: float = Field(0.3, gt=0, le=1)
    """The minimum brake while the kit is being enabled and while the car is being parked."""


class ProfileConfig(Section):
    """The profile of a kind of by-wire kit (`docs/by_wire.md`)."""

    kit: Literal["dataspeed_1", "dataspeed_2"]
    """The kind of kit that a software car must simulate for this profile."""
    dbc: str
    """The DBC file, in the directory of the profile."""
    commands: CommandSet | None = None
    """The command set to use; null: the kit has only one."""
    vehicle: ByWireCarConfig
    limits: ByWireLimitsConfig
    command_step_deg: float = Field(0.1, gt=0)
    """The resolution of the steering command that the kit reports. LAVT recognizes its own commands by it."""
    sent: SentConfig
    reports: ReportsConfig
    watchdog: OwnBrakeConfig = OwnBrakeConfig()
    """How `lavt can test-watchdog` detects that the kit's watchdog brakes."""


class DbwConfig(Section):
    """A by-wire kit and its bus."""

    profile: str = "dataspeed_gen2"
    """The name of a shipped profile or the path of a profile; the suffix `:user` or `:remote` selects the command
    set."""
    dbc: str = ""
    """The vendor's DBC file, to use instead of the profile's."""
    interface: str = "socketcan"
    """The name of an interface of python-can, or `inside`: a software car in the server's process."""
    channel: str = "can0"
    """The name of the bus, such as can0."""
    options: dict[str, Any] = Field(default_factory=dict)
    """Further arguments of python-can's `Bus`."""
    truth: str = ""
    """The UDP address, as `host:port`, at which a software car's ground truth is received; empty: a real car."""
    watchdog_proof: str = ""
    """The file that `lavt can test-watchdog` wrote."""
    watchdog_proof_days: int = Field(30, ge=1, le=365)
    """For how many days a proof is accepted."""
    car: str = Field("", max_length=64)
    """The car's serial number or VIN. The watchdog proof of a real bus contains it, because no kit is known to report
    which car it is in."""
    steering_sign: Literal[1, -1] | None = None
    """1: left is positive on the bus. Only for a profile without a sign."""

    @property
    def is_inside(self) -> bool:
        """Whether the kit is a software car in the server's process, which is also possible in virtual time."""
        return self.interface == "inside"

    def __hash__(self) -> int:
        """Return the hash of the JSON, because `options` is not hashable."""
        return hash(self.model_dump_json())


class WatchdogProof(Section):
    """The file of a passed `lavt can test-watchdog`: this car's watchdog braked, on this bus, with this profile."""

    version: Literal[2] = 2
    car: str
    at: str
    """The date and time of the test (UTC)."""
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
    """The brake command before the commands stopped."""
    release_ms: float = Field(ge=0)
    """The time between the last command and the first report that the brake was not enabled."""
    braked_ms: float = Field(ge=0)
    """The time between the last command and the first report that the kit braked by itself."""
    reports: int
    """The number of brake reports after the commands stopped."""
    said: str
    """The texts of the trips, command errors, faults and reasons that the kit reported at the end of the test."""
