"""Make the targets for the messages to the vehicle: commands, session requests and netem requests."""

from __future__ import annotations

from typing import Any

from benchmarks.fuzzing.mutation import Chance, Corpus
from benchmarks.fuzzing.target import START, InvariantViolation, NodeBench, Target, expect, payloads_on, total
from msgspec.structs import replace

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
from lavt.transport.emulation.impairment import check_flows
from lavt.transport.messages import MAX_MESSAGE_BYTES, decode, encode
from lavt.transport.netem.injector import InjectionOrder, InjectionResult
from lavt.vehicle.vehicle import Capabilities, ReachedCommand

STEP_NS = NS_PER_MS
"""Time between two inputs."""
INPUTS_PER_FRAME = NS_PER_S // 30 // STEP_NS
"""After this number of inputs the camera writes a frame, if nobody drives the vehicle."""
INPUTS_PER_COMMAND = 20
"""After this number of inputs the operator, who is not a stranger, sends a command made from a new frame."""
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


class StationaryVehicle:
    """A vehicle that never moves and stores the last actuation."""

    capabilities = CAPABILITIES

    def __init__(self) -> None:
        self.now_ns = START.mono_ns
        self.requested = Actuation(0.0, 0.0, 1.0)

    def advance(self, to_ns: int) -> list[VehicleEvent]:
        """Advance the time."""
        self.now_ns = max(self.now_ns, to_ns)
        return []

    def apply(self, actuation: Actuation, _now_ns: int) -> None:
        """Store the actuation."""
        self.requested = actuation

    def engage(self, wanted: bool, now_ns: int) -> None:
        """Do nothing."""

    def take_reached(self) -> list[ReachedCommand]:
        """Return nothing."""
        return []

    def state(self) -> VehicleState:
        """Return the state at standstill."""
        return VehicleState(self.now_ns, 0.0, 0.0, "drive")

    def ground_truth(self) -> GroundTruth | None:
        """Return None: there is no ground truth."""
        return None

    def next_wake_ns(self) -> int:
        """Return the next time to advance, every 5 ms."""
        return self.now_ns + 5 * NS_PER_MS


class VehicleSide:
    """The actuator node, a camera that writes stamps, and the active operator."""

    def __init__(self, seed: int) -> None:
        entropy = SeededEntropy(seed, "vehicle")
        limiter = Limiter(
            LIMITS, wheelbase_m=2.8448, max_steering_rad=0.513, max_acceleration_mps2=2.0, max_braking_mps2=6.0
        )
        self.gate = SafetyGate(
            LIMITS, limiter, new_epoch=lambda: entropy.number(64), new_token=lambda: entropy.token(16), video_port=5600
        )
        self.vehicle = StationaryVehicle()
        self.node = ActuatorNode(self.vehicle, self.gate, start_ns=START.mono_ns)
        self.bench = NodeBench(self.node)
        self._epoch = self._sequence = self._frame = self.stamp_ns = 0
        self.control = Corpus(old_commands(), packed=True)
        self.session = Corpus(strangers_requests(), packed=True)

    def write_frame(self) -> None:
        """Write the stamp of a new frame, as the camera does."""
        self._frame += 1
        self.stamp_ns = self.bench.now.wall_ns
        frame = FrameWritten(self._frame, self.stamp_ns, self.bench.now.mono_ns, None, self._frame, 5000)
        self.bench.deliver("frame", frame)

    def request(self, operation: Any, number: int = 0) -> SessionReply:
        """Send a session request of the operator and store the granted epoch."""
        request = encode(SessionRequest(operation, "operator", 2**63 + 5, number))
        [payload] = payloads_on(self.bench.deliver("session", request, 1), "session_reply")
        reply = decode(SessionReply, payload)
        self._epoch = reply.epoch or self._epoch
        return reply

    def send_command(self) -> None:
        """Send the operator's next command, and add it to the replays of the corpus."""
        self.write_frame()
        if self.gate.state not in ("arming", "driving", "degraded"):
            reply = self.request("acquire")
            if self.gate.state == "emergency_stop":
                self.request("clear_emergency_stop", reply.emergency_stop)
        self._sequence += 1
        driving = self.gate.state in ("driving", "degraded")
        now_ns = self.bench.now.wall_ns
        command = Command(
            self._epoch,
            self._sequence,
            now_ns,
            self.stamp_ns,
            now_ns,
            steering_rad=0.0,
            throttle=0.3 if driving else 0.0,
            brake=0.0 if driving else 1.0,
            path_curvature_per_m=STRAIGHT,
            mode="drive" if driving else "arm",
            emergency_stop=0,
        )
        payload = encode(command)
        self.control.replays.append(payload)
        self.bench.deliver("control", payload)

    def arm(self) -> None:
        """Arm the vehicle as the operator; before, wait for the end of a reservation for a stranger."""
        for _ in range(3000):
            self.bench.advance(20 * NS_PER_MS)
            self.send_command()
            if self.gate.state == "driving":
                return
        raise InvariantViolation(f"the operator cannot arm the vehicle: {self.gate.last_rejection}")


def old_commands() -> list[bytes]:
    """Return commands of an earlier session, whose stamps belong to no frame of this one."""
    base = Command(
        2**63 + 12345, 2**40, START.wall_ns, START.wall_ns, START.wall_ns, 0.1, 0.5, 0.0, STRAIGHT, "drive", 0
    )
    arm = replace(base, mode="arm", throttle=0.0, brake=1.0, steering_rad=0.0)
    return [
        encode(command)
        for command in (base, arm, replace(base, mode="stop"), replace(base, emergency_stop=START.wall_ns))
    ]


def strangers_requests() -> list[bytes]:
    """Return session requests of a stranger."""
    start_ns = START.wall_ns
    return [
        encode(request)
        for request in (
            SessionRequest("acquire", "stranger", 77, 0),
            SessionRequest("request_handover", "stranger", 77, 0),
            SessionRequest("release", "stranger", 77, 0),
            SessionRequest("emergency_stop", "stranger", 77, start_ns),
            SessionRequest("clear_emergency_stop", "stranger", 77, start_ns),
        )
    ]


def _feed(side: VehicleSide, channel: str, data: bytes) -> list[Send]:
    """Deliver a stranger's input; check that no command is accepted and that the replies can be decoded."""
    sends = side.bench.deliver(channel, data, 2)
    for admission in payloads_on(sends, "admission"):
        expect(admission.verdict == "rejected", "a stranger's command was accepted")
    for reply in payloads_on(sends, "session_reply"):
        decode(SessionReply, reply)
        expect(len(reply) <= MAX_MESSAGE_BYTES, "a reply is too long")
    return sends


def _check_counts(side: VehicleSide, delivered: dict[str, int]) -> None:
    counts = side.node.counts
    commands = counts.get("commands_unreadable", 0) + total(counts, "rejected: ")
    expect(commands == delivered["control"], f"{delivered['control']} commands were delivered, {commands} counted")
    requests = counts.get("session_requests_unreadable", 0) + total(counts, "session ")
    expect(requests == delivered["session"], f"{delivered['session']} requests were delivered, {requests} counted")


def _rejected_count(side: VehicleSide) -> int:
    counts = side.node.counts
    rejections = sum(number for name, number in counts.items() if name.startswith("session ") and "rejected" in name)
    unreadable = counts.get("commands_unreadable", 0) + counts.get("session_requests_unreadable", 0)
    return unreadable + total(counts, "rejected: ") + rejections


def vehicle_at_rest(seed: int) -> Target:
    """Make a target for a vehicle without an operator. Invariants: the vehicle brakes, and strangers cannot arm it."""
    side = VehicleSide(seed)
    delivered = {"control": 0, "session": 0}

    def feed(channel: str, data: bytes, _chance: Chance) -> None:
        delivered[channel] += 1
        side.bench.advance(STEP_NS)
        if sum(delivered.values()) % INPUTS_PER_FRAME == 0:
            side.write_frame()
        _feed(side, channel, data)
        expect(side.gate.state in ("disarmed", "emergency_stop"), f"a stranger caused {side.gate.state}")
        requested = side.vehicle.requested
        expect((requested.throttle, requested.brake) == (0.0, 1.0), "the vehicle does not brake")

    def finish() -> str:
        _check_counts(side, delivered)
        return f"ended {side.gate.state}"

    return Target({"control": side.control, "session": side.session}, feed, lambda: _rejected_count(side), finish)


def vehicle_driven(seed: int) -> Target:
    """Make a target for a driven vehicle. Invariant: no command of a stranger and no replayed command is accepted.

    Anybody can stop the vehicle. Without signatures anybody can also take control of it after an emergency stop, and
    clear the stop. The operator then takes control again and arms the vehicle.
    """
    side = VehicleSide(seed)
    side.request("acquire")
    side.arm()
    inputs = inputs_while_driving = 0

    def feed(channel: str, data: bytes, _chance: Chance) -> None:
        nonlocal inputs, inputs_while_driving
        inputs += 1
        if side.gate.state != "driving" and inputs % 500 == 0:
            side.arm()
        before, active_operator = side.gate.state, side.gate.session.active_operator
        inputs_while_driving += before == "driving"
        _feed(side, channel, data)
        is_taken_over = (
            before == "emergency_stop"
            and side.gate.session.active_operator is not None
            and side.gate.session.active_operator[0] != "operator"
        )
        allowed = (before, "emergency_stop", *(("disarmed",) if is_taken_over else ()))
        expect(side.gate.state in allowed, f"a stranger caused a transition from {before} to {side.gate.state}")
        keeps_control = side.gate.session.active_operator == active_operator or before != "driving"
        expect(keeps_control, "a stranger took control of a driven vehicle")
        side.bench.advance(STEP_NS)
        if inputs % INPUTS_PER_COMMAND == 0 and side.gate.state == "driving":
            side.send_command()
            expect(
                side.vehicle.requested.throttle > 0, f"the operator's command was rejected: {side.gate.last_rejection}"
            )

    return Target(
        {"control": side.control, "session": side.session},
        feed,
        lambda: _rejected_count(side),
        lambda: f"{inputs_while_driving / inputs:.0%} of the inputs in the state driving",
    )


def condition_at_vehicle(seed: int) -> Target:  # noqa: ARG001 (it uses no random numbers)
    """Make a target for requests of a network condition. Invariant: netem supports each condition that is injected."""
    node = InjectionNode(allowed=True, simulated=True, video_port=5600, control=("udp", 7448))
    newest = 0

    def on_send(send: Send) -> None:
        nonlocal newest
        if send.channel == "inject":
            order: InjectionOrder = send.payload
            newest = order.number
            if order.flows:
                check_flows(order.flows)
        elif send.channel == "netem_reply":
            decode(NetemReply, send.payload)

    bench = NodeBench(node, on_send)
    bench.deliver("rest", StationaryStatus(True, None))
    base = NetemRequest("alice", 7, "L4", 5000, 150.0, 0.0, 0.0, "normal", 0.0, 0.0, 0, 0.0, 0.0)
    lossy = replace(base, condition="x", jitter_ms=20.0, loss=0.05, loss_burst_packets=3.0, rate_bps=10**6, reorder=0.1)
    corpus = Corpus([encode(base), encode(lossy), encode(replace(lossy, lease_ms=0))], packed=True)
    inputs = 0

    def feed(channel: str, data: bytes, chance: Chance) -> None:
        nonlocal inputs
        inputs += 1
        bench.deliver(channel, data, inputs)
        bench.advance(STEP_NS * chance.below(20))
        if inputs % 500 == 0:  # netem is slow: before its result, a request for another condition gets no reply
            reason = "" if chance.below(4) else "there is no such interface"
            bench.deliver("injected", InjectionResult(newest, reason, "", (("video", 150.2),)))

    def rejected_count() -> int:
        return node.counts["netem_requests_unreadable"] + node.counts["netem rejected"]

    def finish() -> str:
        answered = rejected_count() + node.counts["netem granted"]
        expect(answered == inputs, f"{inputs} requests were delivered, {answered} counted")
        return f"{node.counts['netem granted']} granted"

    return Target({"netem": corpus}, feed, rejected_count, finish)
