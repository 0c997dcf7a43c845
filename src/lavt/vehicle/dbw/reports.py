"""The newest reports of a kit: values with their times, and texts about overrides, trips, errors and faults."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Final, Literal, get_args

from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.vehicle.can_frame import CanFrame
from lavt.vehicle.dbw.crc8 import has_valid_checksum
from lavt.vehicle.dbw.profile import AXES, Axis, Gear, Profile, ReportSpec, SignalCondition
from lavt.vehicle.dbw.speed_monitor import SpeedReport

Values = Mapping[str, float | None]
Kind = Literal["override", "trip", "command_error", "fault", "reason"]
"""The kinds of texts; a profile maps signals of reports to them."""
KINDS: Final[tuple[Kind, ...]] = get_args(Kind)
OTHER_COMMANDER_NS: Final = NS_PER_S
"""Our choice: another sender is assumed to be present for this long after its last command."""


class NewestReports:
    """The newest report of each message in a profile.

    `counts` counts the reports that could not be used (`wrong_checksum`, `repeated_counter`, `value_unknown`), and the
    commands that another sender sent to the kit (`foreign_commands`). The codec counts frames that it cannot decode.
    """

    def __init__(self, profile: Profile, start_ns: int) -> None:
        self._profile = profile
        self._texts_by_message: dict[str, dict[Kind, list[str]]] = {}
        """Texts of the newest report of each message, by kind."""
        self._texts: dict[Kind, list[str]] = {kind: [] for kind in KINDS}
        """Texts of all newest reports, by kind; computed again only when a text changes."""
        self._received_ns: dict[str, int] = {}
        """Time of the last report of each message in which all values were known."""
        self._commands = _commands(profile)
        self._foreign_command: tuple[str, int] | None = None
        """Name and arrival time of the last command from another sender."""
        self._gears = {code: gear for gear, code in profile.gear.codes.items()}
        self.counts: Counter[str] = Counter()
        self.speeds: dict[str, SpeedReport] = {"speed": SpeedReport(0.0, start_ns)}
        """The newest speeds by name (`profile.SPEEDS`). Before its first report, `speed` is 0, and another speed is
        missing."""
        self._report_counts: dict[str, float | None] = {}
        """Counter of the newest report of each message with a counter."""
        self.wheel_deg = 0.0
        """The steering wheel's angle, with the sign that it has on the bus."""
        self.steering_echo: int | None = None
        """The steering command that the kit reports, in steps of the kit's resolution; None before the first report."""
        self.gear: Gear | None = None
        """The reported gear; None if unknown."""
        self.enabled: frozenset[Axis] = frozenset()

    @property
    def speed_mps(self) -> float:
        """The car's speed, as the kit reports it."""
        return self.speeds["speed"].mps

    def receive(self, frame: CanFrame, now_ns: int) -> None:
        """Process any frame from the bus."""
        # A command is one of another sender, whatever its length.
        if (command := self._commands.get((frame.identifier, frame.is_extended))) is not None:
            self.counts["foreign_commands"] += 1
            self._foreign_command = command, now_ns
            return
        decoded = self._profile.codec.decode(frame)
        if decoded is None or (report := self._profile.reports.get(decoded[0])) is None:
            return
        message, values = decoded
        if report.checksum and not has_valid_checksum(frame):
            self.counts["wrong_checksum"] += 1
            return
        if report.count:
            before, self._report_counts[message] = self._report_counts.get(message), values[report.count]
            if before is not None and before == values[report.count]:
                self.counts["repeated_counter"] += 1
                return
        self._update_texts(message, self._texts_of(message, report, values))
        known = {
            name: number
            for name, signal in report.values.items()
            if (number := values[signal]) is not None and number != report.no_value.get(name)
        }
        self._update_values(report, known, now_ns)
        if len(known) == len(report.values):
            self._received_ns[message] = now_ns
        else:
            self.counts["value_unknown"] += 1

    def _update_texts(self, message: str, texts: dict[Kind, list[str]]) -> None:
        if texts != self._texts_by_message.get(message):
            self._texts_by_message[message] = texts
            self._texts = {
                kind: list(dict.fromkeys(text for by_kind in self._texts_by_message.values() for text in by_kind[kind]))
                for kind in KINDS
            }

    def _update_values(self, report: ReportSpec, known: Mapping[str, float], now_ns: int) -> None:
        for name, per_mps in self._profile.speeds_per_mps.items():
            if name in known:
                self.speeds[name] = SpeedReport(known[name] / per_mps, now_ns)
        if "angle" in known:
            self.wheel_deg = known["angle"] / self._profile.angle_per_deg
        if "command" in known:
            self.steering_echo = round(known["command"])
        if "gear" in known:
            self.gear = self._gears.get(round(known["gear"]))
        if "enabled" in known:
            axis = next(axis for axis in AXES if axis == report.part)
            self.enabled = self.enabled | {axis} if known["enabled"] else self.enabled - {axis}

    def missing(self, now_ns: int) -> list[str]:
        """Return a text for each report that is missing: it never came, or the last one is too old."""
        return [
            f"no {message} for {report.timeout_ns // NS_PER_MS} ms"
            if message in self._received_ns
            else f"no {message} yet"
            for message, report in self._profile.reports.items()
            if message not in self._received_ns or now_ns - self._received_ns[message] >= report.timeout_ns
        ]

    def other_commander(self, now_ns: int) -> str:
        """Return a text if another sender commands the kit, such as an ended server that still parks the car."""
        if self._foreign_command is None or now_ns - self._foreign_command[1] >= OTHER_COMMANDER_NS:
            return ""
        return f"another sender on the bus commands the kit ({self._foreign_command[0]})"

    def deadline_ns(self, now_ns: int) -> int | None:
        """Return the next time when a report becomes too old, or None if there is no such time."""
        reports = self._profile.reports
        deadlines = (received_ns + reports[message].timeout_ns for message, received_ns in self._received_ns.items())
        return min((deadline_ns for deadline_ns in deadlines if deadline_ns > now_ns), default=None)

    def texts(self, kind: Kind) -> Sequence[str]:
        """Return the texts of a kind in the newest reports, each once."""
        return self._texts[kind]

    def _texts_of(self, message: str, report: ReportSpec, values: Values) -> dict[Kind, list[str]]:
        """Return a report's texts by kind."""
        needs = [
            f"{message} has {signal} {self._value_name(message, signal, values[signal])}"
            for signal, numbers in report.needs.items()
            if values[signal] not in numbers
        ]
        reasons = [
            f"{message}: {self._value_name(message, signal, values[signal])}"
            for signal in report.reasons
            if values[signal]
        ]
        return {
            "override": _matching(report.override, values),
            "trip": _matching(report.trip, values),
            "command_error": _matching(report.command_error, values),
            "fault": _matching(report.fault, values) + needs,
            "reason": reasons,
        }

    def _value_name(self, message: str, signal: str, number: float | None) -> str:
        """Return the DBC's name of a signal's number, or the number itself."""
        names = self._profile.codec.messages[message].signals[signal].names
        return "no value" if number is None else names.get(round(number), f"{number:g}").lower().replace("_", " ")


def _commands(profile: Profile) -> dict[tuple[int, bool], str]:
    """Return the names of the profile's commands, by identifier and whether it has 29 bits.

    A received command was sent by another sender, because a port does not return the frames that it sent.
    """
    names = [*(command.message for command in profile.axes.values()), profile.gear.message]
    names += [] if profile.system is None else [profile.system.message]
    messages = profile.codec.messages
    return {(messages[name].identifier, messages[name].is_extended): name for name in names}


def _matching(conditions: Iterable[SignalCondition], values: Values) -> list[str]:
    """Return the texts of the conditions that a report meets."""
    return [
        condition.text
        for condition in conditions
        if (values[condition.signal] if condition.number is None else values[condition.signal] == condition.number)
    ]
