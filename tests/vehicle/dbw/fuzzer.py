"""A fuzzer of the whole by-wire vehicle in virtual time: a hostile bus, a hostile car, and stalls of the process.

A kit of the software car makes valid reports, so that every state is reached; then reports are lost, damaged, forged
and repeated, speeds are stuck, scaled or missing, brakes are weak, frames are not written, the driver acts, and time
jumps. PARK must never be requested while the car moves, unless a fault that the adapter cannot see hides the motion:
see `Fuzzer.is_motion_hidden`.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Callable, Sequence
from typing import Literal

import pytest
from benchmarks.fuzzing.mutation import Chance
from msgspec.structs import replace
from tests.vehicle.dbw.rig import SPEED_SOURCES, START_NS, profile

from lavt.domain import NS_PER_MS, NS_PER_S, Actuation, VehicleState
from lavt.vehicle.can_frame import BusGone, CanFrame, ReceivedCanFrame
from lavt.vehicle.dbw import adapter as adapter_module
from lavt.vehicle.dbw.adapter import ByWireAdapter
from lavt.vehicle.dbw.crc8 import frame_crc8
from lavt.vehicle.dbw.profile import AXES, COMMAND_TIMEOUT_NS, TICK_LIMIT_NS, Axis
from lavt.vehicle.dbw.speed_monitor import ROLLING_RESISTANCE_MPS2, SpeedMonitor
from lavt.vehicle.dbw.states import Situation, State, next_state, states_after
from lavt.vehicle.dbw.vehicle import DbwVehicle
from lavt.vehicle.software_car.kit import Kit
from lavt.vehicle.software_car.state import Gear
from lavt.vehicle.vehicle import Capabilities

CAPABILITIES = Capabilities(
    simulated=True,
    virtual_time=False,
    ground_truth=True,
    reset=False,
    wheelbase_m=2.8,
    max_steering_rad=0.5,
    max_steering_rate_radps=0.5,
    max_acceleration_mps2=3.0,
    max_braking_mps2=8.0,
)
KIT_STEP_NS = 5 * NS_PER_MS
EPISODE_NS = 4 * NS_PER_S
STUCK_EPISODE_NS = 14 * NS_PER_S
"""Enough to stop with a weak brake."""
IDLE_NS = 300 * NS_PER_MS
"""An episode ends early if the adapter is idle this long after driving is no longer wanted."""
MAX_AWAITED = 64
PARK_BELOW_MPS = 0.2
"""A slower car may be parked: reports are up to 20 ms old, and less than 0.1 m/s counts as standstill."""
BRAKE_SHARES = (1.0, 0.5, 0.3)
"""Shares of the brake's force that reach the wheels. Weaker brakes than a quarter are not seen by the adapter."""
DRAWS = 1_000_000
"""Resolution of the probabilities."""
STEPS_MS = (1, 4, 4, 5, 10, 10, 20, 20)
STALLS_MS = (*range(57, 64), *range(95, 106), 130, 250, 400, 1000)
"""Stalls mostly around the limits of 60 ms (age of a command) and 100 ms (the kit's timeout)."""
Kind = Literal["lose", "flip", "forge", "repeat", "garbage", "command"]
KINDS: tuple[Kind, ...] = ("lose", "flip", "forge", "repeat", "garbage", "command")
"""What can happen to a report; `command` adds a command of another sender."""
SpeedPlan = Literal["none", "one", "all from standstill", "all from driving"]
SPEED_PLANS: tuple[SpeedPlan, ...] = ("none", "none", "none", "one", "all from standstill", "all from driving")
"""Which sources of speed are wrong in an episode: one stuck, scaled or missing, or all stuck at 0 from some time on."""
SEEN_FALL_MPS = 1.0
"""Speeds become stuck at 0 only at this speed or above. A fall from less than 0.5 m/s is not seen by the adapter."""


def settled_states(state: State, now: Situation) -> list[tuple[State, str]]:
    """Return the states entered at one instant; check that none is entered twice and that the last one is final."""
    path = states_after(state, now)
    reached = [entered for entered, _ in path]
    assert len({state, *reached}) == 1 + len(reached), (state, path)
    if path:
        assert next_state(reached[-1], replace(now, in_state_ns=0))[0] == reached[-1], (state, path)
    return path


def is_drawn(chance: Chance, probability: float) -> bool:
    """Return True with a probability."""
    return chance.below(DRAWS) < probability * DRAWS


class HostilePort:
    """A bus port that sometimes writes only a part of a set of frames, or is gone."""

    def __init__(self, chance: Chance, on_written: Callable[[Sequence[CanFrame], int], None]) -> None:
        self.counts: Counter[str] = Counter()
        self.waiting: list[ReceivedCanFrame] = []
        self.failure_rate = 0.0
        self._chance, self._on_written = chance, on_written

    def send(self, frames: Sequence[CanFrame], made_ns: int) -> int:
        """Write frames, or some of them."""
        fails = is_drawn(self._chance, self.failure_rate)
        written = self._chance.below(len(frames) + 1) if fails else len(frames)
        self._on_written(frames[:written], made_ns)
        if fails and is_drawn(self._chance, 0.3):
            raise BusGone("no more room", written)
        return written

    def take(self, _now_ns: int) -> list[ReceivedCanFrame]:
        """Return the waiting frames."""
        if is_drawn(self._chance, self.failure_rate / 10):
            raise BusGone("pulled out")
        taken, self.waiting = self.waiting, []
        return taken

    def next_wake_ns(self) -> None:
        """Return None: not known."""

    def close(self) -> None:
        """Do nothing."""


class CommandCheck:
    """A check of every written frame: limits, rates, counters, and the age of the newest tick."""

    def __init__(self, adapter: ByWireAdapter) -> None:
        self.adapter, self.profile = adapter, adapter._profile
        self.parks = 0
        """Number of requests for PARK."""
        self.enabled_sets: Counter[str] = Counter()
        """Number of sets by state and number of enabled axes."""
        self._counts: dict[str, float] = {}
        self._last: dict[Axis, tuple[float, int]] = dict.fromkeys(AXES, (0.0, START_NS))
        """The newest command to each axis: (amount, time)."""

    def check_set(self, frames: Sequence[CanFrame], made_ns: int, visible_mps: float) -> None:
        """Check the written frames of a set. `visible_mps` is the car's speed, or 0 if a fault hides it."""
        if not frames:
            return
        assert self.adapter.tick_ns is not None
        assert made_ns - self.adapter.tick_ns <= TICK_LIMIT_NS
        values = dict(decoded for frame in frames if (decoded := self.profile.codec.decode(frame, short=True)))
        self._check_counts(values)
        gear = self.profile.gear
        if values.get(gear.message, {}).get(gear.value) == gear.codes["park"]:
            self.parks += 1
            assert visible_mps < PARK_BELOW_MPS, f"PARK was requested at {visible_mps:.2f} m/s"
        amounts = {axis: self._check_axis(axis, values, made_ns) for axis in AXES}
        assert not (amounts["throttle"] and amounts["brake"])
        enabled = {axis for axis, amount in amounts.items() if amount is not None}
        self.enabled_sets[f"{self.adapter._state}: {len(enabled)}"] += 1
        if self.adapter._state in {"lost", "parking"} and enabled and self.profile.axes["brake"].message in values:
            assert "brake" in enabled

    def _check_counts(self, values: dict[str, dict[str, float | None]]) -> None:
        for axis in AXES:
            command = self.profile.axes[axis]
            if command.count in values.get(command.message, {}):
                count = values[command.message][command.count] or 0.0
                if command.message in self._counts:
                    assert (count - self._counts[command.message]) % command.modulus == 1
                self._counts[command.message] = count

    def _check_axis(self, axis: Axis, values: dict[str, dict[str, float | None]], now_ns: int) -> float | None:
        """Check an axis's command and return its amount; None if the axis is not enabled."""
        command, limits = self.profile.axes[axis], self.profile.limits
        present = values.get(command.message)
        if present is None:  # not written
            return None
        if not present[command.enable]:
            start = max(-limits.steering_wheel_deg, min(limits.steering_wheel_deg, self.adapter._reports.wheel_deg))
            self._last[axis] = (start if axis == "steering" else 0.0), now_ns
            return None
        amount = (present[command.value] or 0.0) / command.per_unit
        most, rate, step = {
            "steering": (limits.steering_wheel_deg, limits.steering_wheel_rate_degps, 0.1),
            "brake": (limits.brake, limits.brake_rate_per_s, 0.001),
            "throttle": (limits.throttle, limits.throttle_rate_per_s, 0.001),
        }[axis]
        assert abs(amount) <= most + step / 2
        before, before_ns = self._last[axis]
        change = amount - before
        allowed = rate * min(now_ns - before_ns, TICK_LIMIT_NS) / NS_PER_S + step
        assert (abs(change) if axis == "steering" else change) <= allowed, (axis, before, amount, now_ns - before_ns)
        self._last[axis] = amount, now_ns
        return amount


class Fuzzer:
    """A vehicle on a hostile bus. `states` counts the ticks in each of the adapter's states."""

    def __init__(self, generation: Literal[1, 2], seed: int) -> None:
        self.states: Counter[str] = Counter()
        self._chance = Chance(seed, "by wire")
        self._profile = profile(f"dataspeed_gen{generation}")
        self._now_ns = START_NS
        self._generation = generation
        self._kit = Kit(generation, start_ns=START_NS, has_watchdog=is_drawn(self._chance, 0.8))
        self._speed_mps = 0.0
        self._adapter = ByWireAdapter(self._profile, start_ns=START_NS)
        self.check = CommandCheck(self._adapter)
        self._port = HostilePort(self._chance, self._write)
        self._vehicle = DbwVehicle(self._adapter, self._port, CAPABILITIES, start_ns=START_NS)
        self._old_frames: deque[CanFrame] = deque(maxlen=50)
        self._kinds: list[Kind] = []
        self._hostility = self._wire_loss = self._stall_probability = self._action_probability = 0.0
        self._speed_plan: SpeedPlan = "none"
        self._is_stuck = self.is_motion_hidden = False
        """All speeds are stuck at 0, and the driver has pressed the throttle since: the adapter cannot see this."""
        self._turned_rad: float | None = None
        """The angle to which the driver has turned the road wheels, if any."""
        self._lost_identifier = 0
        self._hostile_ns = self._unwanted_ns = self._episode_end_ns = START_NS
        """When the bus becomes hostile, when driving is no longer wanted, and when the episode ends."""
        self._actuation = Actuation(0.0, 0.0, 1.0)
        self._stuck_throttle = 0.0
        """The requested throttle in an episode in which all speeds become stuck."""
        self._stop_brake = 1.0
        """The requested brake while the kit is not engaged."""
        messages = self._profile.codec.messages
        self._used_bits = {
            messages[name].identifier: [messages[name].signals[signal].start for signal in spec.values.values()]
            for name, spec in self._profile.reports.items()
        }
        self._commands = [
            *(command.message for command in self._profile.axes.values()),
            self._profile.gear.message,
        ]

    def tick(self) -> None:
        """Advance by one tick, and check everything."""
        chance = self._chance
        is_over = self._adapter._state == "idle" and self._now_ns >= self._unwanted_ns + IDLE_NS
        if is_over or self._now_ns >= self._episode_end_ns:
            self._begin_episode()
        is_hostile = self._now_ns >= self._hostile_ns
        is_transient = self._adapter._state in {"clearing", "enabling", "parking"}
        stall_probability = 10 * self._stall_probability if is_transient else self._stall_probability
        stalls = is_hostile and is_drawn(chance, stall_probability)
        self._run_car(chance.choice(STALLS_MS if stalls else STEPS_MS) * NS_PER_MS, is_hostile)
        if is_hostile and is_drawn(chance, self._action_probability):
            self._act()
        if self._adapter._state == "clearing" and is_drawn(chance, 0.02):
            self._turn()
        now_ns, vehicle = self._now_ns, self._vehicle
        if is_drawn(chance, 0.5):
            vehicle.advance(now_ns)
        wanted = now_ns < self._unwanted_ns
        if is_drawn(chance, 0.9):
            vehicle.engage(wanted, now_ns)
        vehicle.apply(self._next_actuation(is_hostile), now_ns)
        self._check_vehicle()

    def _check_vehicle(self) -> None:
        adapter = self._adapter
        state = self._vehicle.state()
        assert math.isfinite(state.speed_mps + state.steering_rad)
        if adapter._wanted and adapter._state in {"idle", "lost", "overridden"}:
            assert state.inhibit_reason
        assert self._vehicle.next_wake_ns() > self._adapter._now_ns - COMMAND_TIMEOUT_NS
        assert len(adapter._awaited_echoes) <= MAX_AWAITED
        self._vehicle.advance(self._now_ns)
        self._vehicle.take_reached()
        assert not adapter._events
        assert not adapter._reached
        self.states[adapter._state] += 1

    def _begin_episode(self) -> None:
        """Repair the car, and choose what will happen in the next seconds."""
        chance, kit = self._chance, self._kit
        self._turned_rad = None
        kit.state.setpoint_rad = 0.0
        self._repair_speeds()
        self._port.failure_rate = self._hostility = self._wire_loss = 0.0
        for fault in {f"{part}.{bit}" for part, bits in kit._generation.faults.items() for bit in bits}:
            kit.set_fault(fault, self._now_ns, is_set=False)
        for name in ("angle", "speed"):
            kit.set_unknown(name, is_unknown=False)
        kit.inhibit(None, self._now_ns)
        kit.switch_remote(2, self._now_ns)
        kit.set_bus_off(self._now_ns, is_off=False)
        kit.driver_steers(0.0, self._now_ns)
        kit.driver_throttles(0.0, self._now_ns)
        kit.driver_brakes(0.5, self._now_ns)
        kit.driver_brakes(0.0, self._now_ns)
        self._unwanted_ns = self._hostile_ns = self._now_ns
        self._episode_end_ns = self._now_ns + EPISODE_NS
        for _ in range(30):  # driving is not wanted and the bus is honest, so that the adapter becomes idle
            self._run_car(20 * NS_PER_MS, is_hostile=False)
            self._vehicle.engage(False, self._now_ns)
            self._vehicle.apply(Actuation(0.0, 0.0, 1.0), self._now_ns)
        self._unwanted_ns = self._now_ns + (200 + chance.below(3300)) * NS_PER_MS
        hostile_ms = chance.below(3900)
        self._hostile_ns = chance.choice((self._now_ns, self._unwanted_ns)) + hostile_ms * NS_PER_MS // 4
        self._kinds = [kind for kind in KINDS if chance.below(2)]
        self._hostility = chance.choice((0.003, 0.03, 0.3, 1.0))
        self._wire_loss = chance.choice((0.0, 0.0, 0.02, 0.5))
        self._stall_probability = chance.choice((0.0, 0.01, 0.05))
        self._action_probability = chance.choice((0.0, 0.01, 0.1))
        self._stop_brake = chance.choice((1.0, 1.0, 0.0))
        self._port.failure_rate = chance.choice((0.0, 0.0, 0.02, 0.3))
        self._lost_identifier = chance.choice((0, chance.choice([0, *self._kit._generation.reports])))
        self._plan_speeds()

    def _repair_speeds(self) -> None:
        """Stop the car, repair its speeds and its brake, and let the adapter forget faults of the speed."""
        self._speed_plan, self._is_stuck, self.is_motion_hidden = "none", False, False
        for source in SPEED_SOURCES[self._generation]:
            self._kit.restore_speed(source)
        self._kit.weaken_brake(1.0)
        self._speed_mps = 0.0
        self._set_speed()
        car = self._profile.car
        self._adapter._speed = SpeedMonitor(
            max_acceleration_mps2=car.max_acceleration_mps2, max_braking_mps2=car.max_braking_mps2
        )

    def _plan_speeds(self) -> None:
        """Choose how strong the brake is, and which speeds will be wrong."""
        chance = self._chance
        self._kit.weaken_brake(chance.choice(BRAKE_SHARES))
        self._speed_plan = chance.choice(SPEED_PLANS)
        if self._speed_plan == "one":
            source = chance.choice(SPEED_SOURCES[self._generation])
            faults: tuple[Callable[[], None], ...] = (
                lambda: self._kit.stick_speed(source, 0.0),
                lambda: self._kit.scale_speed(source, 0.5),
                lambda: self._kit.drop_speed(source),
            )
            chance.choice(faults)()
        if self._speed_plan == "all from standstill":
            self._stick_speeds()
        if self._speed_plan.startswith("all"):
            self._kinds = ["lose"] * self._chance.below(2)  # others change speeds, which then seem to answer
            self._episode_end_ns = self._now_ns + STUCK_EPISODE_NS
            self._stuck_throttle = chance.choice((0.3, 0.5, 1.0))
            if chance.below(2):
                self._hostile_ns = self._episode_end_ns

    def _stick_speeds(self) -> None:
        self._is_stuck = True
        for source in SPEED_SOURCES[self._generation]:
            self._kit.stick_speed(source, 0.0)

    def _run_car(self, duration_ns: int, is_hostile: bool) -> None:
        """Let the kit and the car run, and queue their reports with their times."""
        end_ns = self._now_ns + duration_ns
        while self._now_ns < end_ns:
            self._now_ns = min(self._now_ns + KIT_STEP_NS, end_ns)
            wheels = self._kit.actuation(self._now_ns)
            if self._kit.state.gear == Gear.DRIVE:
                acceleration_mps2 = 2.0 * wheels.throttle - 6.0 * wheels.brake - ROLLING_RESISTANCE_MPS2
                self._speed_mps = min(20.0, max(0.0, self._speed_mps + acceleration_mps2 * KIT_STEP_NS / NS_PER_S))
            else:
                self._speed_mps = max(0.0, self._speed_mps - 0.01)
            self._set_speed(wheels.steering_rad)
            may_stick = self._speed_plan == "all from driving" and not self._is_stuck
            if may_stick and self._speed_mps >= SEEN_FALL_MPS and is_drawn(self._chance, 0.01):
                self._stick_speeds()
            self.is_motion_hidden |= self._is_stuck and self._kit.state.driver_throttle > 0
            for frame in self._kit.frames_due(self._now_ns):
                self._old_frames.append(frame)
                frames = self._spoil(frame) if is_hostile else [frame]
                self._port.waiting += [ReceivedCanFrame(frame_or_fake, self._now_ns) for frame_or_fake in frames]

    def _set_speed(self, steering_rad: float = 0.0) -> None:
        angle_rad = steering_rad if self._turned_rad is None else self._turned_rad
        self._kit.sense(VehicleState(self._now_ns, self._speed_mps, angle_rad, "drive"), self._now_ns)

    def _spoil(self, frame: CanFrame) -> list[CanFrame]:
        """Return what arrives instead of a report."""
        chance = self._chance
        if frame.identifier == self._lost_identifier:
            return []
        if not self._kinds or not is_drawn(chance, self._hostility):
            return [frame]
        kind = chance.choice(self._kinds)
        if kind == "lose":
            return []
        if kind in {"flip", "forge"}:
            number = int.from_bytes(frame.data, "little")
            for _ in range(chance.choice((1, 1, 2, 8))):
                number ^= 1 << chance.choice((chance.below(8 * len(frame.data)), self._used_bit(frame)))
            data = number.to_bytes(len(frame.data), "little")
            if kind == "forge" and self._profile.kit == "dataspeed_2":
                data = data[:-1] + bytes([frame_crc8(frame.identifier, data[:-1])])
            return [CanFrame(frame.identifier, data, frame.is_extended)]
        if kind == "repeat":
            return [frame, *(chance.choice(self._old_frames) for _ in range(3))]
        if kind == "garbage":
            identifier = chance.choice((chance.below(0x800), frame.identifier))
            return [frame, CanFrame(identifier, chance.bytes(chance.below(9)), is_drawn(chance, 0.1))]
        command = self._profile.codec.messages[chance.choice(self._commands)]
        return [frame, CanFrame(command.identifier, bytes(command.length))] if is_drawn(chance, 0.05) else [frame]

    def _used_bit(self, frame: CanFrame) -> int:
        """Return a bit of a value that the adapter uses, or bit 0."""
        return self._chance.choice(self._used_bits.get(frame.identifier) or [0])

    def _turn(self) -> None:
        self._turned_rad = self._chance.choice((None, 0.2, 0.6, -0.72))

    def _write(self, frames: Sequence[CanFrame], made_ns: int) -> None:
        """Check the written frames, and let those that the wire does not lose reach the kit."""
        self.check.check_set(frames, made_ns, 0.0 if self.is_motion_hidden else self._speed_mps)
        is_hostile = self._now_ns >= self._hostile_ns
        for frame in frames:
            if not is_hostile or not is_drawn(self._chance, self._wire_loss):
                self._kit.receive(frame, self._now_ns)

    def _act(self) -> None:
        """Let the driver or a fault act on the car."""
        chance, kit, now_ns = self._chance, self._kit, self._now_ns
        faults = [f"{part}.{bit}" for part, bits in kit._generation.faults.items() for bit in bits]
        actions: tuple[Callable[[], None], ...] = (
            self._turn,
            lambda: kit.driver_steers(chance.choice((0.0, 3.0)), now_ns),
            lambda: kit.driver_brakes(chance.choice((0.0, 0.3)), now_ns),
            lambda: kit.driver_throttles(chance.choice((0.0, 0.3)), now_ns),
            lambda: kit.driver_shifts(chance.choice((Gear.PARK, Gear.NEUTRAL, Gear.DRIVE)), now_ns),
            lambda: kit.set_fault(chance.choice(faults), now_ns, is_set=is_drawn(chance, 0.5)),
            lambda: kit.set_unknown(chance.choice(("angle", "speed")), is_unknown=is_drawn(chance, 0.5)),
            lambda: kit.inhibit(chance.choice((None, "door")), now_ns),
            lambda: kit.switch_remote(chance.below(4), now_ns),
            lambda: kit.set_bus_off(now_ns, is_off=is_drawn(chance, 0.3)),
        )
        chance.choice(actions)()

    def _next_actuation(self, is_hostile: bool) -> Actuation:
        """Return an actuation: a random walk, the safe stop after driving, and impossible values."""
        chance, wanted = self._chance, self._now_ns < self._unwanted_ns
        if not self._vehicle.state().is_engaged:
            self._actuation = Actuation(0.0, 0.0, 0.0 if wanted and is_drawn(chance, 0.1) else self._stop_brake)
        elif self._speed_plan.startswith("all"):
            self._actuation = Actuation(0.0, self._stuck_throttle, 0.0)
        elif is_drawn(chance, 0.2):
            brake = chance.choice((0.0, 0.0, 0.3, 1.0, 5.0))
            self._actuation = Actuation(
                (chance.below(2001) - 1000) / 1500, chance.choice((0.0, 0.5, 1.0, 7.0, -1.0)), brake
            )
        if is_hostile and is_drawn(chance, 0.1):
            return Actuation(chance.choice((math.nan, math.inf, 0.0)), 0.3, chance.choice((math.nan, 0.2)))
        return self._actuation


def run_ticks(generation: Literal[1, 2], seed: int, ticks: int) -> Fuzzer:
    """Run a fuzzer, and return it; an error names generation, seed and tick."""
    fuzzer = Fuzzer(generation, seed)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(adapter_module, "states_after", settled_states)
        for number in range(ticks):
            try:
                fuzzer.tick()
            except Exception as error:
                raise AssertionError(f"generation {generation}, seed {seed}, tick {number}: {error!r}") from error
    return fuzzer
