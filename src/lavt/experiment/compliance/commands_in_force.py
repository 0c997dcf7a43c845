"""What the vehicle acted on at each moment of a drive: the age of its frame, and the latency of its command.

Both are computed from differences of times that one clock measured, so no clock offset enters them. All times are ns
since the start of the drive, on the server's monotonic clock.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lavt.domain import FloatArray
from lavt.experiment.analysis.latency import accepted_commands, look_up
from lavt.experiment.compliance.ramps import Interval, Ramps
from lavt.recording.table import MISSING, IntArray, Table


@dataclass(frozen=True, slots=True)
class CommandsInForce:
    """The accepted commands of a drive in the order of application, each with the bounds of its latency.

    Arrays are (commands,). From `begin_ns` to `end_ns` a command is in force. Its frame was exposed between
    `oldest_ns` and `newest_ns`; these are -inf and +inf if nothing is known. `two_way_low_ns` and `two_way_high_ns`
    bound its two-way latency. `fresh_ns` are the arrivals of the commands from a newer frame than all before, which
    reset the vehicle's command timeout; they include those before the drive.
    """

    begin_ns: FloatArray
    end_ns: FloatArray
    oldest_ns: FloatArray
    newest_ns: FloatArray
    two_way_low_ns: FloatArray
    two_way_high_ns: FloatArray
    fresh_ns: FloatArray
    is_from_capture: bool
    """Whether the capture time of every frame in force is known."""

    def frame_age(self) -> tuple[Ramps, Ramps]:
        """Return the lower and the upper bound of the frame age in ns, which are equal if it is known exactly."""
        bounds = []
        for origin_ns, unknown in ((self.newest_ns, 0.0), (self.oldest_ns, np.inf)):
            is_known = np.isfinite(origin_ns)
            ages = (
                np.where(is_known, times - np.where(is_known, origin_ns, 0.0), unknown)
                for times in (self.begin_ns, self.end_ns)
            )
            bounds.append(Ramps(self.begin_ns, self.end_ns, *ages))
        return bounds[0], bounds[1]

    def two_way_latency(self, outages: list[Interval]) -> tuple[Ramps, Ramps]:
        """Return the lower and the upper bound of the two-way latency in ns of the command in force.

        In an outage, in which nothing arrives, it is the frame age.
        """
        values_ns = (self.two_way_low_ns, self.two_way_high_ns)
        low, high = (
            _replaced_within(Ramps(self.begin_ns, self.end_ns, values, values), outages, age)
            for values, age in zip(values_ns, self.frame_age(), strict=True)
        )
        return low, high


def commands_in_force(
    frames: Table,
    command_verdicts: Table,
    page_pictures: Table | None,
    drive_ns: tuple[int, int],
    camera_ns: int | None,
) -> CommandsInForce:
    """Return the commands in force during a drive, from start to end on the server's monotonic clock.

    `frames`, `command_verdicts` and `page_pictures` are those of `analysis/latency.py`; `page_pictures` is None if no
    person drives. `camera_ns` is the largest possible time from the exposure to the stamp of a frame whose capture time
    the camera did not report; None: unknown. Before the first command, the drive has a piece in which nothing is known.
    """
    began_ns, ended_ns = drive_ns
    commands = accepted_commands(command_verdicts)
    stamps_ns = commands.ints("stamp_ns")
    stamped_ns = look_up(frames.ints("stamp_ns"), frames.ints("stamped_mono_ns"), stamps_ns)
    captured_ns = look_up(frames.ints("stamp_ns"), frames.ints("capture_ns"), stamps_ns)
    applied_ns = commands.ints("applied_mono_ns")
    captured_ns = np.where(
        (captured_ns == MISSING) | (stamped_ns == MISSING), captured_ns, np.minimum(captured_ns, stamped_ns)
    )
    newest_ns, oldest_ns = _exposure(stamped_ns, captured_ns, camera_ns, began_ns)
    applied_since_ns = _since(applied_ns, began_ns)
    is_possible = newest_ns <= applied_since_ns  # a record in which an effect is before its cause tells nothing
    newest_ns, oldest_ns = np.where(is_possible, newest_ns, np.inf), np.where(is_possible, oldest_ns, -np.inf)
    client_low_ns, client_high_ns = _driver_time(commands, page_pictures)
    oldest_age_ns = applied_since_ns - oldest_ns
    two_way_low_ns = np.where(np.isfinite(newest_ns), applied_since_ns - newest_ns - client_high_ns, 0.0)
    # A driver's time that is longer than the frame's age is impossible: then it is unknown.
    two_way_high_ns = np.where(client_low_ns <= oldest_age_ns, oldest_age_ns - client_low_ns, oldest_age_ns)
    starts_ns = np.clip(applied_ns, began_ns, max(began_ns, ended_ns))
    ends_ns = np.append(starts_ns[1:], max(began_ns, ended_ns))[: len(starts_ns)]
    chosen = ends_ns > starts_ns
    first_ns = float(starts_ns[chosen][0] - began_ns) if chosen.any() else float(max(ended_ns - began_ns, 0))
    before = np.zeros(1 if first_ns > 0 else 0)
    return CommandsInForce(
        np.append(before, _since(starts_ns[chosen], began_ns)),
        np.append(before + first_ns, _since(ends_ns[chosen], began_ns)),
        np.append(before - np.inf, oldest_ns[chosen]),
        np.append(before + np.inf, newest_ns[chosen]),
        np.append(before, np.maximum(two_way_low_ns, 0.0)[chosen]),
        np.append(before + np.inf, two_way_high_ns[chosen]),
        _fresh(commands, stamped_ns, began_ns),
        bool(np.all(captured_ns[chosen] != MISSING)) if chosen.any() else False,
    )


def _since(times_ns: IntArray, began_ns: int) -> FloatArray:
    """Return times since the start of the drive: exact, because a drive is shorter than 2^53 ns (104 days)."""
    return (times_ns - began_ns).astype(np.float64)


def _exposure(
    stamped_ns: IntArray, captured_ns: IntArray, camera_ns: int | None, began_ns: int
) -> tuple[FloatArray, FloatArray]:
    """Return the latest and the earliest possible time of the exposure of each command's frame."""
    newest_ns = np.where(captured_ns != MISSING, captured_ns, stamped_ns)
    is_known = newest_ns != MISSING
    newest = np.where(is_known, _since(np.where(is_known, newest_ns, began_ns), began_ns), np.inf)
    oldest = newest if camera_ns is None else newest - camera_ns
    is_bounded = is_known if camera_ns is not None else is_known & (captured_ns != MISSING)
    oldest = np.where(captured_ns != MISSING, newest, oldest)
    return newest, np.where(is_bounded, oldest, -np.inf)


def _driver_time(commands: Table, page_pictures: Table | None) -> tuple[FloatArray, FloatArray]:
    """Return the bounds of the time in ns that each command's driver had: from seeing the frame to the command.

    A program sees a frame when its stamp was read. A person sees it when the page shows it, but not later than the
    command; if the page did not report that, any time from the reading of the stamp to the command is possible. If a
    time is missing, the driver may have had none or all of the time: 0 and infinity.
    """
    sent_ns, read_ns = commands.ints("sent_wall_ns"), commands.ints("stamp_received_wall_ns")
    is_known = (sent_ns != MISSING) & (read_ns != MISSING) & (read_ns > 0)
    longest_ns = np.where(is_known, np.where(is_known, sent_ns, 0) - np.where(is_known, read_ns, 0), 0)
    high = np.where(is_known, np.maximum(longest_ns, 0).astype(np.float64), np.inf)
    if page_pictures is None:
        return np.where(is_known, high, 0.0), high
    stamps_ns = page_pictures.ints("stamp_ns")
    shown_ns = look_up(stamps_ns, page_pictures.ints("shown_wall_ns"), commands.ints("stamp_ns"))
    bound_ns = look_up(stamps_ns, page_pictures.ints("bound_ns"), commands.ints("stamp_ns"))
    is_shown = is_known & (shown_ns != MISSING) & (bound_ns != MISSING)
    middle = np.where(is_shown, np.where(is_shown, sent_ns, 0) - np.where(is_shown, shown_ns, 0), 0).astype(np.float64)
    error = np.where(is_shown, bound_ns, 0).astype(np.float64)
    shown_low, shown_high = np.clip(middle - error, 0.0, high), np.clip(middle + error, 0.0, high)
    return np.where(is_shown, shown_low, 0.0), np.where(is_shown, shown_high, high)


def _fresh(commands: Table, stamped_ns: IntArray, began_ns: int) -> FloatArray:
    """Return the arrivals of the commands that were made from a newer frame than all commands before."""
    is_known = (stamped_ns != MISSING) & (commands.ints("received_mono_ns") != MISSING)
    stamped_ns, received_ns = stamped_ns[is_known], commands.ints("received_mono_ns")[is_known]
    newest_before = np.maximum.accumulate(np.append(MISSING, stamped_ns))[:-1]
    return np.sort(_since(received_ns[stamped_ns > newest_before], began_ns))


def _replaced_within(ramps: Ramps, intervals: list[Interval], other: Ramps) -> Ramps:
    """Return `ramps`, but `other` within the intervals; both have the same pieces."""
    edges = np.array([time for interval in intervals for time in interval], np.float64)
    ramps, other = ramps.split_at(edges), other.split_at(edges)
    middle = (ramps.begin + ramps.end) / 2
    inside = np.zeros(len(middle), np.bool_)
    for begin, end in intervals:
        inside |= (middle > begin) & (middle < end)
    first, last = np.where(inside, other.first, ramps.first), np.where(inside, other.last, ramps.last)
    return Ramps(ramps.begin, ramps.end, first, last)
