"""The first test to read: a frame and its command through all stages of ARCHITECTURE.md, without nodes and runtime."""

from __future__ import annotations

from contextlib import closing
from itertools import count
from pathlib import Path

import pytest
from msgspec.structs import replace

from lavt.control.drive_controller import make_controller
from lavt.control.preset import PRESETS
from lavt.domain import NS_PER_MS, NS_PER_S, CameraModel, Command, Now, SessionReply, SessionRequest
from lavt.experiment.analysis.latency import frames_with_commands
from lavt.node import Send
from lavt.nodes.payloads import Admission, FrameWritten
from lavt.perception.lane_detector import LaneDetector
from lavt.recording.record import RecordWriter, read_record
from lavt.safety.gate import RejectionReason, SafetyGate
from lavt.safety.limiter import Limiter
from lavt.safety.limits import LIMITS
from lavt.transport.emulation.delay_line import DelayLine, DelayModel
from lavt.transport.messages import decode, encode
from lavt.transport.rtp.adaptive_hold import MIN_HOLD_NS
from lavt.transport.rtp.fec import RepairReceiver, RepairSender
from lavt.transport.rtp.jitter_buffer import JitterBuffer
from lavt.transport.rtp.rtp import MAX_PACKET_BYTES, Depacketizer, Packetizer, parse_packet, split_nal_units
from lavt.transport.security.envelope import OperatorAuthenticator, VehicleAuthenticator
from lavt.transport.security.gateway import ClientGateway, ServerGateway
from lavt.transport.video.cipher import SrtpCipher
from lavt.transport.video.h264 import Decoder, Encoder
from lavt.transport.video.stamp import read_stamp, rtp_timestamp, stamp_agrees, write_stamp
from lavt.vehicle.sim.rendering.camera import SimCamera
from lavt.vehicle.sim.road.road import load_road
from lavt.vehicle.sim.simulator import Simulator

pytest.importorskip("cryptography", reason="an extra: pip install -e '.[secure]'")
pytest.importorskip("pylibsrtp", reason="an extra: pip install -e '.[secure]'")

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from lavt.transport.security.keys import PrivateKey

WALL_MINUS_MONO_NS = 1_790_000_000 * NS_PER_S
"""The wall clock minus the monotonic clock."""
START_NS = 100 * NS_PER_S
VIDEO_DELAY_MS, CONTROL_DELAY_MS = 75.0, 20.0
CHALLENGE = bytes(range(16))
"""Random bytes of the server, which decide the keys of one video path together with the session's token."""
ARMING_FRAMES = 51
"""The frames before the test's frame. Each has an arming command; at 20 ms each, they take just more than a second."""
MEDIA_SSRC, REPAIR_SSRC = 7, 8
"""The numbers (SSRC) of the RTP streams of video packets and of repair packets."""


class Gateways:
    """The gateways of both sides with their keys.

    Messages that the gateways sent wait in `sent`; messages that the gateways accepted are in `passed`.
    """

    def __init__(self, gate: SafetyGate) -> None:
        vehicle, operator = (PrivateKey(Ed25519PrivateKey.generate()) for _ in range(2))
        self.sent: list[Send] = []
        self.passed: list[bytes] = []
        self.server = ServerGateway(
            self._deliver,
            self._carry,
            gate.in_force,
            VehicleAuthenticator("vehicle-1", vehicle, {"operator-1": operator.public}),
        )
        self.client = ClientGateway(
            self._deliver,
            self._carry,
            OperatorAuthenticator("vehicle-1", "operator-1", operator, vehicle.public),
        )
        self.client._send_in_thread = lambda send: self._carry(send)  # type: ignore[method-assign]

    def exchange(self) -> bytes:
        """Deliver the waiting messages and the responses to them; return the last message that passed."""
        while self.sent:
            send = self.sent.pop(0)
            gateway = self.client if send.channel.endswith("_reply") else self.server
            gateway.receive(send.channel, send.payload, Now(START_NS, WALL_MINUS_MONO_NS), peer="query")
        return self.passed[-1]

    def _deliver(self, _channel: str, payload: bytes, _arrived: Now, _peer: object) -> None:
        self.passed.append(payload)

    def _carry(self, *sends: Send) -> None:
        self.sent += sends


def armed_gate(car: Simulator) -> tuple[SafetyGate, Gateways, SessionReply]:
    """Acquire control of the car through both gateways, and arm the car, which takes a second."""
    capabilities = car.capabilities
    limiter = Limiter(
        LIMITS,
        wheelbase_m=capabilities.wheelbase_m,
        max_steering_rad=capabilities.max_steering_rad,
        max_acceleration_mps2=capabilities.max_acceleration_mps2,
        max_braking_mps2=capabilities.max_braking_mps2,
    )
    numbers = count(1)
    gate = SafetyGate(LIMITS, limiter, new_epoch=lambda: next(numbers), new_token=lambda: bytes(16))
    gateways = Gateways(gate)
    gateways.client.send(Send("session", encode(SessionRequest("acquire", "operator-1", instance=1, number=0))))
    request = decode(SessionRequest, gateways.exchange())
    answer = gate.session.answer(request, car.state(), START_NS)
    gateways.server.send(Send("session_reply", encode(answer), peer="query"))
    reply = decode(SessionReply, gateways.exchange())
    for number in range(ARMING_FRAMES):
        at_ns = START_NS - (ARMING_FRAMES - number) * 20 * NS_PER_MS
        gate.issued_stamps.add(WALL_MINUS_MONO_NS + at_ns, number, at_ns, pixel_crc=number)
        arm = Command(
            epoch=reply.epoch,
            sequence=number,
            sent_wall_ns=0,
            stamp_ns=WALL_MINUS_MONO_NS + at_ns,
            stamp_received_wall_ns=0,
            steering_rad=0.0,
            throttle=0.0,
            brake=1.0,
            path_curvature_per_m=(0.0,) * 10,
            mode="arm",
            emergency_stop=0,
        )
        assert gate.admit(arm, car.state(), at_ns, at_ns).accepted
    assert gate.state == "driving"
    return gate, gateways, reply


def test_life_of_a_frame(tmp_path: Path) -> None:  # noqa: PLR0915 (one frame, from end to end)
    """A frame leads to a command that moves the vehicle, and its stamp returns with the command."""
    # Before: an armed car with a camera on a road, under the control of a remote client with keys.
    road, model = load_road("a_key"), CameraModel()
    car = Simulator(road=road, seed=1, start_mono_ns=START_NS - 2 * NS_PER_S)
    camera = SimCamera(model=model, rate_hz=30.0, phase_ns=0, road=road, seed=1, scenery="none")
    gate, gateways, session = armed_gate(car)
    server_cipher = SrtpCipher("server", gate.session.token, CHALLENGE)
    client_cipher = SrtpCipher("client", session.token, CHALLENGE)
    now_ns = START_NS
    car.advance(now_ns)

    # Frame 1. The camera captures a frame with its capture time.
    frame = camera.capture(ARMING_FRAMES, now_ns, car.pose())
    assert frame is not None
    assert (frame.capture_ns, frame.picture.shape) == (START_NS, (480, 640, 3))

    # Frame 2. The stamp, which is the send time, is written into the pixels, and the server remembers it.
    stamp_ns = WALL_MINUS_MONO_NS + now_ns
    write_stamp(frame.picture, stamp_ns)
    gate.issued_stamps.add(stamp_ns, frame.number, now_ns, pixel_crc=frame.number)
    assert set(frame.picture[:64, :64].ravel().tolist()) == {0, 255}

    # Frame 3. The frame is encoded as H.264.
    encoder = Encoder(model.width_px, model.height_px, rate_hz=30.0, bit_rate_bps=4_000_000, gop_frames=30)
    access_unit = encoder.encode(frame.picture)
    assert len(access_unit) < frame.picture.nbytes / 10

    # Frame 4. The unit is split into RTP packets with the stamp's time, repair packets are added, all are encrypted.
    packets = Packetizer(ssrc=MEDIA_SSRC, first_sequence=65_535).packetize(access_unit, rtp_timestamp(stamp_ns))
    assert len(packets) > 3
    assert max(map(len, packets)) <= MAX_PACKET_BYTES
    repairs = RepairSender(ssrc=REPAIR_SSRC, first_sequence=0).make_repair_packets(packets, count=1)
    datagrams = [server_cipher.protect(packet) for packet in (*packets, *repairs)]
    assert all(packet[12:] not in datagram for packet, datagram in zip(packets, datagrams, strict=False))

    # Frame 5. The packets cross the network: all have the same delay, one is lost, and two are reordered.
    video = DelayLine(DelayModel(VIDEO_DELAY_MS))
    now_ns = START_NS + 75 * NS_PER_MS
    assert {video.push(datagram, START_NS, index=0) for datagram in datagrams} == {now_ns}
    assert video.pop_due(now_ns - 1) == []
    arrived = video.pop_due(now_ns)
    assert arrived == datagrams
    del arrived[1]
    arrived[2], arrived[1] = arrived[1], arrived[2]

    # Frame 6. The packets are decrypted, the lost packet is recovered, the order restored, and the unit reassembled.
    repair_receiver, jitter_buffer, depacketizer = RepairReceiver(), JitterBuffer(), Depacketizer()
    ordered = []
    for datagram in arrived:
        plain = client_cipher.unprotect(datagram)
        assert plain is not None
        packet = parse_packet(plain)
        media_packets = [] if packet.ssrc == REPAIR_SSRC else [packet]
        for media_packet in (*media_packets, *repair_receiver.push(packet, now_ns)):
            ordered += jitter_buffer.push(media_packet, now_ns)
    assert repair_receiver.recovered == 1
    now_ns += MIN_HOLD_NS  # the first packets of a stream wait for packets that were sent before them
    ordered += jitter_buffer.expire(now_ns)
    units = [unit for packet, lost_before in ordered for unit in depacketizer.push(packet, lost_before)]
    assert [split_nal_units(unit.data) for unit in units] == [split_nal_units(access_unit)]
    assert (units[0].complete, units[0].keyframe) == (True, True)

    # Frame 7. The access unit is decoded to a picture, without delay.
    decoded = Decoder().decode(units[0].data)
    assert decoded is not None
    assert decoded.picture.shape == frame.picture.shape
    assert not decoded.corrupt

    # Frame 8. The stamp is read from the pixels, and is valid because it agrees with the RTP timestamp.
    read_ns = read_stamp(decoded.luma)
    assert read_ns == stamp_ns
    assert stamp_agrees(read_ns, units[0].timestamp)

    # Frame 9. The lane is detected in the picture: 8 m ahead its centre agrees with the ground truth.
    lane = LaneDetector(model).detect(decoded.picture)
    truth = car.ground_truth()
    detected_y_m = lane.centre[0] + 8 * lane.centre[1] + 8**2 * lane.centre[2]
    assert lane.confidence > 0.5
    assert abs(detected_y_m - (-truth.cross_track_m - 8 * truth.heading_error_rad)) < 0.1

    # Frame 10. The controller decides from the lane: throttle, and steering towards the centre.
    controller = make_controller("lane_keeper", PRESETS["designed"], car.capabilities.wheelbase_m)
    decision = controller.decide(lane, car.state().speed_mps, now_ns)
    assert decision.throttle > 0

    # Command 1. The decision becomes a command with the stamp of its frame, the epoch and the next sequence number.
    command = Command(
        epoch=session.epoch,
        sequence=100,
        sent_wall_ns=WALL_MINUS_MONO_NS + now_ns,
        stamp_ns=read_ns,
        stamp_received_wall_ns=WALL_MINUS_MONO_NS + now_ns,
        steering_rad=decision.steering_rad,
        throttle=decision.throttle,
        brake=decision.brake,
        path_curvature_per_m=decision.path_curvature_per_m,
        mode="drive",
        emergency_stop=0,
    )

    # Command 2, 3 and 4. The command is encoded; the client's gateway authenticates the message and sends it.
    body = encode(command)
    gateways.client.send(Send("control", body))
    (sent,) = gateways.sent
    assert sent.payload.startswith(body)
    assert len(sent.payload) > len(body)

    # Command 5. The command crosses the network.
    control = DelayLine(DelayModel(CONTROL_DELAY_MS))
    assert control.push(sent.payload, now_ns, index=0) == now_ns + 20 * NS_PER_MS
    now_ns += 20 * NS_PER_MS
    assert control.pop_due(now_ns) == [sent.payload]

    # Command 6. The server's gateway verifies the message, and drops a changed copy.
    gateways.sent.insert(0, replace(sent, payload=bytes([sent.payload[0] ^ 1]) + sent.payload[1:]))
    before = len(gateways.passed)
    passed = gateways.exchange()
    assert gateways.passed[before:] == [body]
    assert gateways.server.counts["commands_forged"] == 1

    # Command 7. The command is decoded, and its fields are checked.
    received = decode(Command, passed)
    assert received == command

    # Command 8. The gate accepts the command: current epoch, newer sequence, and a recent stamp of this server.
    # The gate rejects a repetition of the command.
    picture_age_ns = now_ns - START_NS
    assert picture_age_ns == round(VIDEO_DELAY_MS + CONTROL_DELAY_MS) * NS_PER_MS + MIN_HOLD_NS
    car.advance(now_ns)
    verdict = gate.admit(received, car.state(), now_ns, now_ns)
    assert verdict.accepted
    assert gate.admit(received, car.state(), now_ns, now_ns).reason == RejectionReason.OLD_SEQUENCE

    # Command 9. The command is within the limits and stays unchanged. An excessive wheel angle is limited, here to the
    # present angle, because no time has passed in which the wheel could turn.
    actuation = gate.watchdog.actuation(car.state(), now_ns)
    assert (actuation.steering_rad, actuation.throttle) == (received.steering_rad, received.throttle)
    assert gate.limiter.applied_limits == ()
    excessive = gate.limiter.limit(replace(actuation, steering_rad=2.0), car.state(), now_ns)
    assert excessive.steering_rad == actuation.steering_rad
    assert "steering angle" in gate.limiter.applied_limits

    # Command 10. The vehicle executes the command: it was stationary, and now moves.
    assert car.state().speed_mps == 0.0
    car.apply(actuation, now_ns)
    car.advance(now_ns + NS_PER_S)
    assert car.state().speed_mps > 0.0

    # Command 11. The verdict and the time of application are recorded: the loop latency needs the server's clock alone.
    admission = Admission(
        epoch=received.epoch,
        sequence=received.sequence,
        stamp_ns=received.stamp_ns,
        sent_wall_ns=received.sent_wall_ns,
        stamp_received_wall_ns=received.stamp_received_wall_ns,
        received_mono_ns=now_ns,
        received_wall_ns=WALL_MINUS_MONO_NS + now_ns,
        applied_mono_ns=now_ns,
        verdict="accepted",
        reason=verdict.message,
        limited="",
        mode=received.mode,
        steering_rad=received.steering_rad,
        throttle=received.throttle,
        brake=received.brake,
    )
    with closing(RecordWriter(tmp_path / "server.mcap", "server")) as writer:
        stamped = FrameWritten(
            number=frame.number,
            stamp_ns=stamp_ns,
            stamped_mono_ns=START_NS,
            capture_ns=frame.capture_ns,
            pixel_crc=frame.number,
            size_bytes=len(access_unit),
        )
        writer.write("frame", stamped, Now(START_NS, WALL_MINUS_MONO_NS + START_NS))
        writer.write("admission", admission, Now(now_ns, WALL_MINUS_MONO_NS + now_ns))
    record = read_record(tmp_path / "server.mcap")
    paired = frames_with_commands(record.table("frame"), record.table("admission"), now_ns)
    assert paired.loop_ns.tolist() == [picture_age_ns]
