"""What the kit has reported so far: values with their times, and what hinders driving, in words."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Final, Literal, get_args

from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.vehicle.can_frame import CanFrame
from lavt.vehicle.dbw.crc8 import frame_crc8
from lavt.vehicle.dbw.profile import AXES, Axis, Gear, Profile, ReportSpec, SignalCondition

Values = Mapping[str, float | None]
Kind = Literal["override", "trip", "lapse", "fault", "reason"]
"""What hinders driving, as the profile's reports distinguish it."""
KINDS: Final[tuple[Kind, ...]] = get_args(Kind)
FOREIGN_NS: Final = NS_PER_S
"""Ours: somebody else who commanded the kit is taken to do so for so long."""


class NewestReports:
    """The newest of each report of a profile.

    `counts` has the frames that could not be used: `wrong_checksum`, `value_unknown`; the codec's has the rest. And
    `foreign_commands`: somebody else commands the kit.
    """

    def __init__(self, profile: Profile, start_ns: int) -> None:
        self._profile = profile
        self._said: dict[str, dict[Kind, list[str]]] = {}
        """What each newest report says, by kind."""
        self._all_said: dict[Kind, list[str]] = {kind: [] for kind in KINDS}
        """What they say together; few reports say anything new."""
        self._heard_ns: dict[str, int] = {}
        """When each report came last with all its values."""
        self._commands = _commands(profile)
        self._foreign: tuple[str, int] | None = None
        """A command that somebody else sent last, and when it came."""
        self._gears = {number: gear for gear, number in profile.gear.numbers.items()}
        self.counts: Counter[str] = Counter()
        self.speed_mps, self.speed_ns = 0.0, start_ns
        self.wheel_deg = 0.0
        """The steering wheel's angle, as on the bus."""
        self.command: int | None = None
        """The steering's command as the kit has it, in its own steps."""
        self.gear: Gear | None = None
        """None: one that we do not know."""
        self.enabled: frozenset[Axis] = frozenset()

    def receive(self, frame: CanFrame, now_ns: int) -> None:
        """Take a frame, whatever it is."""
        if (command := self._commands.get((frame.identifier, frame.is_extended))) is not None:  # of any length
            self.counts["foreign_commands"] += 1
            self._foreign = command, now_ns
            return
        decoded = self._profile.codec.decode(frame)
        if decoded is None or (report := self._profile.reports.get(decoded[0])) is None:
            return
        message, values = decoded
        if report.checksum and frame.data[-1] != frame_crc8(
            frame.identifier, frame.data[:-1], extended=frame.is_extended
        ):
            self.counts["wrong_checksum"] += 1
            return
        self._note(message, self._read(message, report, values))
        known = {
            word: number
            for word, signal in report.values.items()
            if (number := values[signal]) is not None and number != report.no_value.get(word)
        }
        self._take(report, known, now_ns)
        if len(known) == len(report.values):
            self._heard_ns[message] = now_ns
        else:
            self.counts["value_unknown"] += 1

    def _note(self, message: str, said: dict[Kind, list[str]]) -> None:
        if said != self._said.get(message):
            self._said[message] = said
            self._all_said = {
                kind: list(dict.fromkeys(words for each in self._said.values() for words in each[kind]))
                for kind in KINDS
            }

    def _take(self, report: ReportSpec, known: Mapping[str, float], now_ns: int) -> None:
        if "speed" in known:
            self.speed_mps, self.speed_ns = known["speed"] / self._profile.speed_per_mps, now_ns
        if "angle" in known:
            self.wheel_deg = known["angle"] / self._profile.angle_per_deg
        if "command" in known:
            self.command = round(known["command"])
        if "gear" in known:
            self.gear = self._gears.get(round(known["gear"]))
        if "enabled" in known:
            axis = next(axis for axis in AXES if axis == report.part)
            self.enabled = self.enabled | {axis} if known["enabled"] else self.enabled - {axis}

    def missing(self, now_ns: int) -> list[str]:
        """Tell which reports are too old to drive by."""
        return [
            f"no {message} for {report.timeout_ns // NS_PER_MS} ms"
            if message in self._heard_ns
            else f"no {message} yet"
            for message, report in self._profile.reports.items()
            if message not in self._heard_ns or now_ns - self._heard_ns[message] >= report.timeout_ns
        ]

    def foreign(self, now_ns: int) -> str:
        """Tell who else commands the kit: a server that was ended and parks the car still, or another program."""
        if self._foreign is None or now_ns - self._foreign[1] >= FOREIGN_NS:
            return ""
        return f"somebody else on the bus commands the kit ({self._foreign[0]})"

    def deadline_ns(self, now_ns: int) -> int | None:
        """Tell when the next report will be too old; None where none will."""
        reports = self._profile.reports
        deadlines = (heard_ns + reports[message].timeout_ns for message, heard_ns in self._heard_ns.items())
        return min((deadline_ns for deadline_ns in deadlines if deadline_ns > now_ns), default=None)

    def said(self, kind: Kind) -> Sequence[str]:
        """Tell what the newest reports say of a kind, in words, each once."""
        return self._all_said[kind]

    def _read(self, message: str, report: ReportSpec, values: Values) -> dict[Kind, list[str]]:
        """Put a report's signs into words."""
        needs = [
            f"{message} has {signal} {self._name(message, signal, values[signal])}"
            for signal, numbers in report.needs.items()
            if values[signal] not in numbers
        ]
        reasons = [
            f"{message} says {self._name(message, signal, values[signal])}"
            for signal in report.reasons
            if values[signal]
        ]
        return {
            "override": _shown(report.override, values),
            "trip": _shown(report.trip, values),
            "lapse": _shown(report.lapse, values),
            "fault": _shown(report.fault, values) + needs,
            "reason": reasons,
        }

    def _name(self, message: str, signal: str, number: float | None) -> str:
        """Give a number as the DBC names it."""
        names = self._profile.codec.messages[message].signals[signal].names
        return "nothing" if number is None else names.get(round(number), f"{number:g}").lower().replace("_", " ")


def _commands(profile: Profile) -> dict[tuple[int, bool], str]:
    """Give the names of the commands that the profile sends, by what is on the bus: own frames are never heard."""
    names = [*(command.message for command in profile.axes.values()), profile.gear.message]
    names += [] if profile.system is None else [profile.system.message]
    messages = profile.codec.messages
    return {(messages[name].identifier, messages[name].is_extended): name for name in names}


def _shown(signs: Iterable[SignalCondition], values: Values) -> list[str]:
    """Give the words of the signs that a report shows."""
    return [
        sign.words
        for sign in signs
        if (values[sign.signal] if sign.number is None else values[sign.signal] == sign.number)
    ]
