"""The first test to read: one frame from its capture to the command made from it, without nodes and runtime."""

from __future__ import annotations

from itertools import count

from lavt.control.drive_controller import PRESETS, make_controller
from lavt.domain import NS_PER_MS, NS_PER_S, CameraModel, Command, SessionRequest
from lavt.perception.lane_detector import LaneDetector
from lavt.safety.gate import SafetyGate
from lavt.safety.limiter import Limiter
from lavt.safety.limits import LIMITS
from lavt.transport.emulation.delay_line import DelayLine, DelayModel
from lavt.transport.messages import decode, encode
from lavt.transport.rtp.adaptive_hold import MIN_HOLD_NS
from lavt.transport.rtp.jitter_buffer import JitterBuffer
from lavt.transport.rtp.rtp import MAX_PACKET_BYTES, Depacketizer, Packetizer, parse_packet, split_nal_units
from lavt.transport.video.h264 import Decoder, Encoder
from lavt.transport.video.stamp import read_stamp, rtp_timestamp, stamp_agrees, write_stamp
from lavt.vehicle.sim.rendering.camera import SimCamera
from lavt.vehicle.sim.road.road import load_road
from lavt.vehicle.sim.simulator import Simulator

WALL_NS = 1_790_000_000 * NS_PER_S
START_NS = 100 * NS_PER_S
VIDEO_DELAY_MS, CONTROL_DELAY_MS = 75.0, 20.0


def armed_gate(car: Simulator) -> tuple[SafetyGate, int]:
    """Acquire control of the car and arm it, which takes a second; return the gate and the epoch."""
    capabilities = car.capabilities
    limiter = Limiter(
        LIMITS,
        wheelbase_m=capabilities.wheelbase_m,
        max_steering_rad=capabilities.max_steering_rad,
        max_braking_mps2=capabilities.max_braking_mps2,
    )
    numbers = count(1)
    gate = SafetyGate(LIMITS, limiter, new_epoch=lambda: next(numbers), new_token=lambda: bytes(16))
    epoch = gate.session.answer(SessionRequest("acquire", "newcomer", 1, 0), car.state(), START_NS).epoch
    for number in range(51):
        at_ns = START_NS - (51 - number) * 20 * NS_PER_MS
        gate.issued_stamps.add(WALL_NS + at_ns, number, at_ns, pixel_crc=number)
        arming_command = Command(
            epoch=epoch,
            sequence=number,
            sent_wall_ns=0,
            stamp_ns=WALL_NS + at_ns,
            stamp_received_wall_ns=0,
            steering_rad=0.0,
            throttle=0.0,
            brake=1.0,
            path_curvature_per_m=(0.0,) * 10,
            mode="arm",
            emergency_stop=0,
        )
        assert gate.admit(arming_command, car.state(), at_ns).accepted
    assert gate.state == "driving"
    return gate, epoch


def test_life_of_a_frame() -> None:  # noqa: PLR0915 (one frame, from end to end)
    """A picture leads to a command that moves the vehicle, and its stamp returns with the command."""
    # Before: an armed car with a camera on a road, under the control of a remote client.
    road, model = load_road("a_key"), CameraModel()
    car = Simulator(road=road, seed=1, start_mono_ns=START_NS - 2 * NS_PER_S)
    camera = SimCamera(model=model, rate_hz=30.0, phase_ns=0, road=road, seed=1, scenery="none")
    gate, epoch = armed_gate(car)
    now_ns = START_NS
    car.advance(now_ns)

    # 1. The camera captures a picture with its capture time.
    frame = camera.capture(51, now_ns, car.pose())
    assert frame is not None
    assert (frame.capture_ns, frame.picture.shape) == (START_NS, (480, 640, 3))

    # 2. The stamp, which is the send time, is written into the pixels, and the server remembers it.
    stamp_ns = WALL_NS + now_ns
    write_stamp(frame.picture, stamp_ns)
    gate.issued_stamps.add(stamp_ns, frame.number, now_ns, pixel_crc=51)
    assert set(frame.picture[:64, :64].ravel().tolist()) == {0, 255}

    # 3. The picture is encoded to H.264.
    encoder = Encoder(model.width_px, model.height_px, rate_hz=30.0, bit_rate_bps=4_000_000, gop_frames=30)
    access_unit = encoder.encode(frame.picture)
    assert len(access_unit) < frame.picture.nbytes / 10

    # 4. The access unit is split into RTP packets, whose timestamp is the stamp's time.
    packets = Packetizer(ssrc=7, first_sequence=65_535).packetize(access_unit, rtp_timestamp(stamp_ns))
    assert len(packets) > 1
    assert max(map(len, packets)) <= MAX_PACKET_BYTES

    # 5. The packets cross the network: all packets of a frame have the same delay, and keep their order.
    video = DelayLine(DelayModel(VIDEO_DELAY_MS))
    now_ns = START_NS + 75 * NS_PER_MS
    assert {video.push(packet, START_NS, index=0) for packet in packets} == {now_ns}
    assert video.pop_due(now_ns - 1) == []
    arrived = video.pop_due(now_ns)
    assert arrived == packets

    # 6. The packets arrive, are put in order (here the last two are swapped), and become an access unit.
    arrived[-1], arrived[-2] = arrived[-2], arrived[-1]
    jitter_buffer, depacketizer = JitterBuffer(), Depacketizer()
    ordered = [
        ordered_packet for packet in arrived for ordered_packet in jitter_buffer.push(parse_packet(packet), now_ns)
    ]
    now_ns += MIN_HOLD_NS  # the first packets of a stream wait for any that were sent before them
    ordered += jitter_buffer.expire(now_ns)
    units = [unit for packet, lost_before in ordered for unit in depacketizer.push(packet, lost_before)]
    assert [split_nal_units(unit.data) for unit in units] == [split_nal_units(access_unit)]
    assert (units[0].complete, units[0].keyframe) == (True, True)

    # 7. The access unit is decoded to a picture, without delay.
    decoded = Decoder().decode(units[0].data)
    assert decoded is not None
    assert decoded.picture.shape == frame.picture.shape
    assert not decoded.corrupt

    # 8. The stamp is read from the pixels. It is valid if it agrees with the RTP timestamp.
    read_ns = read_stamp(decoded.luma)
    assert read_ns == stamp_ns
    assert stamp_agrees(read_ns, units[0].timestamp)

    # 9. The lane is detected in the picture: 8 m ahead its centre agrees with the ground truth.
    lane = LaneDetector(model).detect(decoded.picture)
    truth = car.ground_truth()
    detected_y_m = lane.centre[0] + 8 * lane.centre[1] + 64 * lane.centre[2]
    assert lane.confidence > 0.5
    assert abs(detected_y_m - (-truth.cross_track_m - 8 * truth.heading_error_rad)) < 0.1

    # 10. The controller makes a command from the lane: throttle, and steering towards the centre.
    controller = make_controller("lane_keeper", PRESETS["designed"], car.capabilities.wheelbase_m)
    decision = controller.decide(lane, car.state().speed_mps, now_ns)
    assert decision.throttle > 0
    command = Command(
        epoch=epoch,
        sequence=100,
        sent_wall_ns=WALL_NS + now_ns,
        stamp_ns=read_ns,
        stamp_received_wall_ns=WALL_NS + now_ns,
        steering_rad=decision.steering_rad,
        throttle=decision.throttle,
        brake=decision.brake,
        path_curvature_per_m=decision.path_curvature_per_m,
        mode="drive",
        emergency_stop=0,
    )

    # 11. The command crosses the network as bytes, which are checked when they are decoded.
    control = DelayLine(DelayModel(CONTROL_DELAY_MS))
    assert control.push(encode(command), now_ns, index=0) == now_ns + 20 * NS_PER_MS
    now_ns += 20 * NS_PER_MS
    (datagram,) = control.pop_due(now_ns)
    received = decode(Command, datagram)
    assert received == command

    # 12. The gate accepts the command: present epoch, newer sequence, and a stamp that this server issued recently.
    picture_age_ns = now_ns - START_NS
    assert picture_age_ns == round(VIDEO_DELAY_MS + CONTROL_DELAY_MS) * NS_PER_MS + MIN_HOLD_NS
    car.advance(now_ns)
    assert gate.admit(received, car.state(), now_ns).accepted
    assert not gate.admit(received, car.state(), now_ns).accepted, "no command is accepted twice"

    # 13. The vehicle executes the command: it was stationary, and now moves.
    assert car.state().speed_mps == 0.0
    car.apply(gate.watchdog.actuation(car.state(), now_ns), now_ns)
    car.advance(now_ns + NS_PER_S)
    assert car.state().speed_mps > 0.0
