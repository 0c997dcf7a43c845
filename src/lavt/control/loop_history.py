"""What a client knows of its loop: the vehicle's reported motions, its own commands, and when these take effect.

All times of a prediction are on the vehicle's wall clock, which stamps both the pictures and the states. When a command
takes effect on it follows from the states, too, so no clocks of two machines are compared. Nothing here reads a clock.
"""

from __future__ import annotations

from collections import deque
from typing import Final

from lavt.control.prediction import MAX_LOOP_NS, Motion, SteeringCommand
from lavt.domain import NS_PER_MS, NS_PER_S, State

MAX_STATES: Final = 256
"""How many states are remembered: five seconds, which is longer than any loop delay with a prediction."""
MAX_COMMANDS: Final = 512
STATE_AGE_NS: Final = 300 * NS_PER_MS
"""Nothing is predicted from an older state."""
STATE_GAP_NS: Final = 100 * NS_PER_MS
"""Two states that are further apart do not tell when a command between them was applied."""
CLOCK_STEP_NS: Final = 30 * NS_PER_MS
"""If the vehicle's wall clock gains or loses more than this against its monotonic clock between two states, it was set.
Less can be the age of the reported state, which differs from state to state."""
DELAY_WINDOW_NS: Final = NS_PER_S // 2
"""The delay of the commands is measured from the states of this time."""


class EffectDelay:
    """When a command takes effect: the vehicle's wall clock at that time minus this machine's clock at its sending.

    A command was applied between the last state that does not report it and the first state that does. The delay lies
    between the largest lower and the smallest upper bound of the last `DELAY_WINDOW_NS`.
    """

    def __init__(self) -> None:
        self._sent: deque[tuple[int, int]] = deque(maxlen=MAX_COMMANDS)
        """Sequence numbers and send times of commands that the vehicle has not applied yet."""
        self._newest: State | None = None
        self._bounds: deque[tuple[int, int, int]] = deque(maxlen=MAX_STATES)
        """Arrival of a state, lower and upper bound."""
        self._last_ns: int | None = None

    def note_command(self, sequence: int, now_ns: int) -> None:
        """Note a command that is sent now."""
        self._sent.append((sequence, now_ns))

    def note_state(self, state: State, now_ns: int) -> None:
        """Note a state that arrived now."""
        before, self._newest = self._newest, state
        sent_ns = None
        while self._sent and self._sent[0][0] <= state.applied_sequence:
            sequence, at_ns = self._sent.popleft()
            sent_ns = at_ns if sequence == state.applied_sequence else None
        if sent_ns is None or before is None or before.instance != state.instance:
            return
        if state.sent_wall_ns <= before.sent_wall_ns:  # the vehicle's clock was set back
            self._bounds.clear()
        if 0 < state.sent_wall_ns - before.sent_wall_ns <= STATE_GAP_NS:
            self._bounds.append((now_ns, before.sent_wall_ns - sent_ns, state.sent_wall_ns - sent_ns))

    def forget_clock(self) -> None:
        """Forget what was measured with the vehicle's clock, because it was set."""
        self._newest = self._last_ns = None
        self._bounds.clear()

    def at_ns(self, now_ns: int) -> int | None:
        """Return the delay; None: the vehicle has reported no newly applied command lately."""
        while self._bounds and self._bounds[0][0] < now_ns - DELAY_WINDOW_NS:
            self._bounds.popleft()
        if not self._bounds:
            return None
        return (max(low for _, low, _ in self._bounds) + min(high for _, _, high in self._bounds)) // 2

    def last_ns(self, now_ns: int) -> int | None:
        """Return the delay or, if it is unknown, what the last call returned; None: there was none with this clock."""
        measured_ns = self.at_ns(now_ns)
        if measured_ns is not None:
            self._last_ns = measured_ns
        return self._last_ns


class LoopHistory:
    """The states of a vehicle that this client has control of, and the commands that this client has sent to it."""

    def __init__(self) -> None:
        self.delay = EffectDelay()
        self._states: deque[State] = deque(maxlen=MAX_STATES)
        self._state_ns = 0
        """When the newest state arrived."""
        self._commands: deque[tuple[int, float]] = deque(maxlen=MAX_COMMANDS)
        """Send times and steering angles of commands."""
        self._set_at: tuple[int, int] | None = None
        """When this client has seen that the vehicle's clock was set, and the time after which only the clock as it is
        now can stamp a picture."""

    def note_command(self, sequence: int, steering_rad: float, now_ns: int) -> None:
        """Note a command that is sent now."""
        self.delay.note_command(sequence, now_ns)
        self._commands.append((now_ns, steering_rad))

    def note_state(self, state: State, now_ns: int) -> None:
        """Note a newer state of a vehicle that this client has control of."""
        if self._states and self._states[-1].instance != state.instance:
            self.forget()
        if self._states:
            self._check_clock(self._states[-1], state, now_ns)
        self.delay.note_state(state, now_ns)
        self._states.append(state)
        self._state_ns = now_ns

    def forget(self) -> None:
        """Note that this client has no control, or that the vehicle's server is another process."""
        self.delay = EffectDelay()
        self._states.clear()
        self._commands.clear()
        self._set_at = None

    def _check_clock(self, before: State, state: State, now_ns: int) -> None:
        """Forget the times of the vehicle's wall clock if it was set between two states."""
        expected_ns = before.sent_wall_ns + state.state_mono_ns - before.state_mono_ns
        if abs(state.sent_wall_ns - expected_ns) <= CLOCK_STEP_NS:
            return
        self.delay.forget_clock()
        self._states.clear()
        self._set_at = now_ns, max(expected_ns, state.sent_wall_ns)

    def is_comparable(self, picture_ns: int, now_ns: int) -> bool:
        """Return whether a picture's stamp is of the same clock as the states, which it is unless the clock was set.

        After that, pictures with stamps of the clock as it was may still be on the way, for `MAX_LOOP_NS` at most.
        """
        if self._set_at is None:
            return True
        seen_ns, later_than_ns = self._set_at
        if picture_ns > later_than_ns or now_ns - seen_ns > MAX_LOOP_NS:
            self._set_at = None
        return self._set_at is None

    def current_state(self, now_ns: int) -> State | None:
        """Return the newest state; None: there is none, or it arrived `STATE_AGE_NS` ago or earlier."""
        return self._states[-1] if self._states and now_ns - self._state_ns < STATE_AGE_NS else None

    def motions(self, since_ns: int) -> list[Motion]:
        """Return the reported motions, the oldest first, beginning with the last one before a time."""
        motions: list[Motion] = []
        for state in reversed(self._states):
            motions.append(Motion(state.sent_wall_ns, state.speed_mps, state.steering_rad))
            if state.sent_wall_ns <= since_ns:
                break
        return motions[::-1]

    def commands(self, delay_ns: int, since_ns: int) -> list[SteeringCommand]:
        """Return the commands, each with its send time plus `delay_ns`, the oldest first.

        The first one is the last that takes effect before `since_ns`.
        """
        commands: list[SteeringCommand] = []
        for at_ns, steering_rad in reversed(self._commands):
            commands.append(SteeringCommand(at_ns + delay_ns, steering_rad))
            if commands[-1].at_ns <= since_ns:
                break
        return commands[::-1]
