"""Fuzzes what the vehicle's side reads: commands, and queries of all kinds."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from benchmarks.fuzzing.mutation import Chance, Corpus
from benchmarks.fuzzing.target import START, Bench, Target, Wrong, expect, of, total

from lavt.assembly.entropy import SeededEntropy
from lavt.domain import (
    NS_PER_MS,
    NS_PER_S,
    Actuation,
    Command,
    GroundTruth,
    NetemReply,
    NetemRequest,
    SessionReply,
    SessionRequest,
    VehicleEvent,
    VehicleState,
)
from lavt.node import Send
from lavt.nodes.actuator import ActuatorNode
from lavt.nodes.injection import InjectionNode
from lavt.nodes.payloads import FrameWritten, StationaryStatus
from lavt.safety.gate import SafetyGate
from lavt.safety.limiter import Limiter
from lavt.safety.limits import LIMITS
from lavt.safety.session import LARGEST_STORED_NUMBER
from lavt.transport.emulation.impairment import check_flows
from lavt.transport.messages import MAX_MESSAGE_BYTES, decode, encode
from lavt.transport.netem.injector import InjectionOrder, InjectionResult
from lavt.vehicle.vehicle import Capabilities, ReachedCommand

FRAME_NS = NS_PER_S // 30
STEP_NS = NS_PER_MS
"""Between two inputs."""
TURN = 20
"""The true operator has a turn, a command from a new picture, after so many inputs."""
STRAIGHT = (0.0,) * 10
CAPABILITIES = Capabilities(
    simulated=True,
    virtual_time=True,
    ground_truth=False,
    reset=False,
    wheelbase_m=2.8448,
    max_steering_rad=0.513,
    max_steering_rate_radps=0.534,
    max_acceleration_mps2=2.0,
    max_braking_mps2=6.0,
)


class Standing:
    """A vehicle on a lift: it never moves, and remembers the last thing it was asked to do."""

    capabilities = CAPABILITIES

    def __init__(self) -> None:
        self.now_ns = START.mono_ns
        self.requested = Actuation(0.0, 0.0, 1.0)

    def advance(self, to_ns: int) -> list[VehicleEvent]:
        """Live until then."""
        self.now_ns = max(self.now_ns, to_ns)
        return []

    def apply(self, actuation: Actuation, _now_ns: int) -> None:
        """Obey."""
        self.requested = actuation

    def engage(self, wanted: bool, now_ns: int) -> None:
        """Do nothing."""

    def take_reached(self) -> list[ReachedCommand]:
        """Tell nothing."""
        return []

    def state(self) -> VehicleState:
        """Stand."""
        return VehicleState(self.now_ns, 0.0, 0.0, "drive")

    def ground_truth(self) -> GroundTruth | None:
        """Know of none."""
        return None

    def next_wake_ns(self) -> int:
        """Ask for a life every 5 ms."""
        return self.now_ns + 5 * NS_PER_MS


class Vehicle:
    """The actuator's node, a camera that writes stamps, and the operator who may drive."""

    def __init__(self, seed: int) -> None:
        entropy = SeededEntropy(seed, "vehicle")
        limiter = Limiter(LIMITS, wheelbase_m=2.8448, max_steering_rad=0.513, max_braking_mps2=6.0)
        self.gate = SafetyGate(
            LIMITS, limiter, new_epoch=lambda: entropy.number(64), new_token=lambda: entropy.token(16), video_port=5600,
        )  # fmt: skip
        self.vehicle = Standing()
        self.node = ActuatorNode(self.vehicle, self.gate, start_ns=START.mono_ns)
        self.bench = Bench(self.node)
        self._epoch = self._sequence = self._frame = self.stamp_ns = 0
        self.control = Corpus(old_commands(), packed=True)
        self.session = Corpus(requests(), packed=True)

    def picture(self) -> None:
        """Write a stamp: whoever sees the video knows it."""
        self._frame += 1
        self.stamp_ns = self.bench.now.wall_ns
        frame = FrameWritten(self._frame, self.stamp_ns, self.bench.now.mono_ns, None, self._frame, 5000)
        self.bench.give("frame", frame)

    def ask(self, operation: Any, number: int = 0) -> SessionReply:
        """Ask as the operator; what is granted is remembered."""
        request = encode(SessionRequest(operation, "operator", 2**63 + 5, number))
        [payload] = of(self.bench.give("session", request, 1), "session_reply")
        reply = decode(SessionReply, payload)
        self._epoch = reply.epoch or self._epoch
        return reply

    def turn(self) -> None:
        """Send the operator's next command, and let others hear it."""
        self.picture()
        if self.gate.state not in ("arming", "driving", "degraded"):
            reply = self.ask("hold")
            if self.gate.state == "emergency_stop":
                self.ask("clear_emergency_stop", reply.emergency_stop)
        self._sequence += 1
        driving = self.gate.state in ("driving", "degraded")
        now_ns = self.bench.now.wall_ns
        command = Command(
            self._epoch, self._sequence, now_ns, self.stamp_ns, now_ns, 0.0, 0.3 if driving else 0.0,
            0.0 if driving else 1.0, STRAIGHT, "drive" if driving else "arm", 0,
        )  # fmt: skip
        payload = encode(command)
        self.control.heard.append(payload)
        self.bench.give("control", payload)

    def arm(self) -> None:
        """Arm the vehicle, with nobody in between; while it is kept for another one the operator goes on asking."""
        for _ in range(3000):
            self.bench.go(20 * NS_PER_MS)
            self.turn()
            if self.gate.state == "driving":
                return
        raise Wrong(f"the operator cannot arm the vehicle: {self.gate.rejected}")


def old_commands() -> list[bytes]:
    """Commands of a session that is over; their stamps are of no picture of this one."""
    base = Command(
        2**63 + 12345, 2**40, START.wall_ns, START.wall_ns, START.wall_ns, 0.1, 0.5, 0.0, STRAIGHT, "drive", 0
    )
    arm = replace(base, mode="arm", throttle=0.0, brake=1.0, steering_rad=0.0)
    return [
        encode(each) for each in (base, arm, replace(base, mode="stop"), replace(base, emergency_stop=START.wall_ns))
    ]


def requests() -> list[bytes]:
    """Session queries of somebody else."""
    known = [SessionRequest(operation, "stranger", 77, 0) for operation in ("hold", "ask", "release")]
    stops = [SessionRequest(operation, "stranger", 77, START.wall_ns) for operation in
             ("emergency_stop", "clear_emergency_stop")]  # fmt: skip
    return [encode(each) for each in (*known, *stops)]


def _feed(side: Vehicle, channel: str, data: bytes) -> list[Send]:
    """Give an input of a stranger's: none of his commands is obeyed, and what he is answered can be read."""
    sends = side.bench.give(channel, data, 2)
    for admission in of(sends, "admission"):
        expect(admission.verdict == "rejected", "a stranger's command was obeyed")
    for reply in of(sends, "session_reply"):
        decode(SessionReply, reply)
        expect(len(reply) <= MAX_MESSAGE_BYTES, "a reply is too long")
    return sends


def _counted(side: Vehicle, given: dict[str, int]) -> None:
    counts = side.node.counts
    commands = counts.get("commands_unreadable", 0) + total(counts, "rejected: ")
    expect(commands == given["control"], f"{given['control']} commands were given, {commands} counted")
    queries = counts.get("session_requests_unreadable", 0) + total(counts, "session ")
    expect(queries == given["session"], f"{given['session']} queries were given, {queries} counted")


def _rejected(side: Vehicle) -> int:
    counts = side.node.counts
    rejections = sum(number for name, number in counts.items() if name.startswith("session ") and "rejected" in name)
    unreadable = counts.get("commands_unreadable", 0) + counts.get("session_requests_unreadable", 0)
    return unreadable + total(counts, "rejected: ") + rejections


def vehicle_at_rest(seed: int) -> Target:
    """Nobody drives, and strangers send commands and queries: the vehicle brakes and is never armed."""
    side = Vehicle(seed)
    given = {"control": 0, "session": 0}

    def feed(channel: str, data: bytes, _chance: Chance) -> None:
        given[channel] += 1
        side.bench.go(STEP_NS)
        if sum(given.values()) % 33 == 0:
            side.picture()
        _feed(side, channel, data)
        expect(side.gate.state in ("disarmed", "emergency_stop"), f"a stranger has led to {side.gate.state}")
        requested = side.vehicle.requested
        expect((requested.throttle, requested.brake) == (0.0, 1.0), "the vehicle does not brake")

    def finish() -> str:
        _counted(side, given)
        return f"ended {side.gate.state}"

    return Target({"control": side.control, "session": side.session}, feed, lambda: _rejected(side), finish)


def vehicle_driven(seed: int) -> Target:
    """An operator drives, and strangers send commands, his own again among them, and queries: only he is obeyed.

    Anybody may stop the vehicle, and without signatures anybody may take one that stands stopped, and clear the stop;
    then the operator takes it back and arms it anew. Most numbers of emergency stops are old ones here.
    """
    side = Vehicle(seed)
    side.ask("hold")
    side.ask("emergency_stop", LARGEST_STORED_NUMBER)
    side.arm()
    inputs = driven = 0

    def feed(channel: str, data: bytes, _chance: Chance) -> None:
        nonlocal inputs, driven
        inputs += 1
        if side.gate.state != "driving" and inputs % 500 == 0:
            side.arm()
        before, active_operator = side.gate.state, side.gate.session.active_operator
        driven += before == "driving"
        _feed(side, channel, data)
        taken = (
            before == "emergency_stop"
            and side.gate.session.active_operator is not None
            and side.gate.session.active_operator[0] != "operator"
        )
        allowed = (before, "emergency_stop", *(("disarmed",) if taken else ()))
        expect(side.gate.state in allowed, f"a stranger has led from {before} to {side.gate.state}")
        expect(
            side.gate.session.active_operator == active_operator or before != "driving",
            "a stranger has taken a driven vehicle",
        )
        side.bench.go(STEP_NS)
        if inputs % TURN == 0 and side.gate.state == "driving":
            side.turn()
            expect(side.vehicle.requested.throttle > 0, f"the operator is not obeyed: {side.gate.rejected}")

    return Target(
        {"control": side.control, "session": side.session},
        feed,
        lambda: _rejected(side),
        lambda: f"{driven / inputs:.0%} while driving",
    )


def condition_at_vehicle(seed: int) -> Target:  # noqa: ARG001 (there is no chance in it)
    """Queries for the network's condition: whatever is granted is one that the queues can do."""
    node = InjectionNode(allowed=True, simulated=True, video_port=5600, control=("udp", 7448))
    newest = 0

    def hear(send: Send) -> None:
        nonlocal newest
        if send.channel == "inject":
            order: InjectionOrder = send.payload
            newest = order.number
            if order.flows:
                check_flows(order.flows)
        elif send.channel == "netem_reply":
            decode(NetemReply, send.payload)

    bench = Bench(node, hear)
    bench.give("rest", StationaryStatus(True, None))
    base = NetemRequest("alice", 7, "L4", 5000, 150.0, 0.0, 0.0, "normal", 0.0, 0.0, 0, 0.0, 0.0)
    lossy = replace(base, condition="x", jitter_ms=20.0, loss=0.05, loss_burst_packets=3.0, rate_bps=10**6, reorder=0.1)
    corpus = Corpus([encode(base), encode(lossy), encode(replace(lossy, lease_ms=0))], packed=True)
    inputs = 0

    def feed(channel: str, data: bytes, chance: Chance) -> None:
        nonlocal inputs
        inputs += 1
        bench.give(channel, data, inputs)
        bench.go(STEP_NS * chance.below(20))
        if inputs % 500 == 0:  # the queues are slow: until then nobody is answered who asked for another condition
            reason = "" if chance.below(4) else "there is no such interface"
            bench.give("injected", InjectionResult(newest, reason, "", (("video", 150.2),)))

    def rejected() -> int:
        return node.counts["netem_requests_unreadable"] + node.counts["netem rejected"]

    def finish() -> str:
        answered = rejected() + node.counts["netem granted"]
        expect(answered == inputs, f"{inputs} queries were given, {answered} counted")
        return f"{node.counts['netem granted']} granted"

    return Target({"netem": corpus}, feed, rejected, finish)
