"""Make the targets for the gateways of signed messages and for the ciphers of the video.

Each target knows all authentic messages, so any other accepted message is an error. Needs the extra `secure`. The seed
determines the keys, but not nonces and key agreements. So the inputs are not byte-for-byte reproducible.
"""

from __future__ import annotations

from collections import deque
from functools import partial
from typing import Any

from benchmarks.fuzzing.camera import CLIENT_ADDRESS, INPUTS_PER_REPORT, FakeCamera, rtcp_datagrams
from benchmarks.fuzzing.mutation import Chance, Corpus
from benchmarks.fuzzing.operator_side import INPUTS_PER_FRAME, STEP_NS, TOKEN, units, video_corpora
from benchmarks.fuzzing.target import START, NodeBench, Target, expect, total
from benchmarks.fuzzing.vehicle import STRAIGHT

from lavt.assembly.entropy import SeededEntropy
from lavt.domain import NS_PER_MS, Command, SessionReply, SessionRequest, State
from lavt.node import WAKE, Send
from lavt.nodes.camera import CameraNode
from lavt.nodes.payloads import PathToken
from lavt.nodes.receiver import ReceiverNode
from lavt.transport.messages import encode
from lavt.transport.rtp.fec import RepairSender
from lavt.transport.rtp.jitter_buffer import JitterBuffer
from lavt.transport.rtp.rtcp import parse_feedback, picture_loss, sender_report
from lavt.transport.rtp.rtp import Depacketizer, Packetizer
from lavt.transport.security.envelope import OperatorAuthenticator, VehicleAuthenticator
from lavt.transport.security.gateway import ClientGateway, ServerGateway
from lavt.transport.security.keys import PrivateKey
from lavt.transport.video.cipher import SrtpCipher
from lavt.transport.video.path_validation import PathClient, PathServer, is_path_datagram
from lavt.transport.video.stream_sender import StreamSender

GATEWAY_STEP_NS = 4 * NS_PER_MS
"""Time between two inputs; with a shorter time, the rate limiters would reject most inputs unread."""
INPUTS_PER_MESSAGE = 20
"""After this number of inputs the operator sends a true command, or the vehicle a true state."""
EPOCH = 2**63 + 7
EVERY_THIRD_BYTE = tuple((offset, 1) for offset in range(0, 400, 3))
"""Offset and length of the mutated fields. Every third byte is enough, because a signature covers all bytes alike."""
ACQUIRE = encode(SessionRequest("acquire", "alice", 5, 0))
GRANTED = encode(SessionReply(True, "", EPOCH, TOKEN, 5600, "kernel", 0))


def keys(seed: int) -> tuple[PrivateKey, PrivateKey]:
    """Make the vehicle's key and the operator's."""
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey  # noqa: PLC0415 (an extra)

    entropy = SeededEntropy(seed, "keys")
    vehicle, operator = (PrivateKey(Ed25519PrivateKey.from_private_bytes(entropy.token(32))) for _ in range(2))
    return vehicle, operator


def gateway_of_vehicle(seed: int) -> Target:
    """Make a target for the vehicle's gateway.

    Invariants: the gateway accepts only commands that the operator signed, and no request. (A stranger's request is
    unsigned, forged or replayed.) The gateway accepts a replayed command, too: only the command gate rejects it, and
    that is not part of this target.
    """
    vehicle_key, operator_key = keys(seed)
    delivered: list[tuple[str, bytes]] = []
    sent: list[Send] = []
    sequence = 0
    gateway = ServerGateway(
        lambda channel, body, _arrived, _peer: delivered.append((channel, body)),
        lambda *sends: sent.extend(sends),
        lambda: (EPOCH, sequence),
        VehicleAuthenticator("car", vehicle_key, {"alice": operator_key.public}),
    )
    operator = OperatorAuthenticator("car", "alice", operator_key, vehicle_key.public)
    now = START

    def exchange(body: bytes, answer: bytes) -> bytes:
        """Send a request as the operator, with a retry if needed; return the accepted envelope."""
        request = operator.sign_request("session", body)
        gateway.receive("session", request, now, "query")
        if not delivered:
            retry = operator.verify_reply("session", sent.pop().payload).repeated_request
            expect(retry is not None, "the operator got no retry")
            request = retry or b""
            gateway.receive("session", request, now, "query")
        expect(delivered == [("session", body)], "the operator's request was rejected")
        delivered.clear()
        gateway.send(Send("session_reply", answer, "query"))
        expect(operator.verify_reply("session", sent.pop().payload).body == answer, "the operator rejected the reply")
        return request

    signed_bodies: deque[bytes] = deque(maxlen=256)

    def command() -> bytes:
        signed_bodies.append(encode(Command(EPOCH, sequence + 1, 1, 2, 3, 0.1, 0.5, 0.0, STRAIGHT, "drive", 0)))
        return operator.sign_command(signed_bodies[-1])

    corpora = {
        "session": Corpus([exchange(ACQUIRE, GRANTED), exchange(ACQUIRE, GRANTED)], fields=EVERY_THIRD_BYTE),
        "control": Corpus([command() for _ in range(4)], fields=EVERY_THIRD_BYTE),
    }
    # The corpus's commands can come at any time. Of later commands, only the newest 256 are kept in `signed_bodies`.
    corpus_bodies = frozenset(signed_bodies)
    inputs = 0

    def feed(channel: str, data: bytes, _chance: Chance) -> None:
        nonlocal inputs, now, sequence
        inputs += 1
        now = now.later(GATEWAY_STEP_NS)
        gateway.receive(channel, data, now, "stranger")
        for accepted_on, body in delivered:
            is_authentic = accepted_on == "control" and (body in signed_bodies or body in corpus_bodies)
            expect(is_authentic, f"a forged command or a forged or replayed request was accepted on {accepted_on}")
        delivered.clear()
        sent.clear()
        if inputs % INPUTS_PER_MESSAGE == 0:
            signed = command()
            gateway.receive("control", signed, now, None)
            expect(delivered == [("control", signed_bodies[-1])], "the operator's command was rejected")
            delivered.clear()
            corpora["control"].replays.append(signed)
            sequence += 1

    return Target(corpora, feed, lambda: total(gateway.counts, "commands_", "session_"))


def gateway_of_operator(seed: int) -> Target:
    """Make a target for the operator's gateway.

    Invariant: the gateway accepts only states and replies of the vehicle, and each of them once.
    """
    vehicle_key, operator_key = keys(seed)
    vehicle = VehicleAuthenticator("car", vehicle_key, {"alice": operator_key.public})
    delivered: list[bytes] = []
    sent: list[Send] = []
    gateway = ClientGateway(
        lambda _channel, body, _arrived, _peer: delivered.append(body),
        lambda *sends: sent.extend(sends),
        OperatorAuthenticator("car", "alice", operator_key, vehicle_key.public),
    )
    send_inline: Any = sent.append
    gateway._send_in_thread = send_inline  # type: ignore[method-assign]  # noqa: SLF001 (no thread is needed here)
    now = START

    def answer(body: bytes) -> bytes:
        """Reply to the pending request, deliver the reply, and return its envelope.

        The first reply is a retry, after which the gateway sends the request again. So two calls complete one request.
        """
        request = vehicle.verify_request("session", sent.pop().payload)
        assert request is not None
        reply = vehicle.sign_reply(request, b"" if request.must_retry else body)
        gateway.receive("session_reply", reply, now, None)
        return reply

    def state(number: int) -> tuple[bytes, bytes]:
        body = encode(State(number, number, 8.0, 0.0, "drive", "driving", "", number, ""))
        return body, vehicle.sign_state(body)

    gateway.send(Send("session", ACQUIRE))
    replies = [answer(GRANTED), answer(GRANTED)]
    old_states = [state(number)[1] for number in range(8)]
    for envelope in old_states:
        gateway.receive("state", envelope, now, None)
    expect(len(delivered) == 1 + len(old_states), "the vehicle's own messages were rejected")
    delivered.clear()
    corpora = {
        "state": Corpus(old_states, fields=EVERY_THIRD_BYTE),
        "session_reply": Corpus(replies, fields=EVERY_THIRD_BYTE),
        "netem_reply": Corpus(replies, fields=EVERY_THIRD_BYTE),
    }
    inputs = 0

    def feed(channel: str, data: bytes, _chance: Chance) -> None:
        nonlocal inputs, now
        inputs += 1
        now = now.later(GATEWAY_STEP_NS)
        gateway.receive(channel, data, now, None)
        expect(delivered == [], f"a forged or replayed message was accepted on {channel}")
        sent.clear()
        if inputs % INPUTS_PER_MESSAGE == 0:
            body, signed = state(100 + inputs)
            gateway.receive("state", signed, now, None)
            expect(delivered == [body], "the vehicle's state was rejected")
            delivered.clear()
            corpora["state"].replays.append(signed)

    return Target(corpora, feed, lambda: total(gateway.counts, "state", "session_", "netem_"))


def encrypted_video(seed: int) -> Target:
    """Make a target for SRTP at the client's video port. Invariant: only packets that the server sent are accepted."""
    node = ReceiverNode(JitterBuffer(), Depacketizer(), 2_000_000, partial(SrtpCipher, "client"))
    server = PathServer(lambda: bytes(32), partial(SrtpCipher, "server"))
    server.set_token(TOKEN)
    reports = complete_units = inputs = frame = sent_packets = 0

    def on_send(send: Send) -> None:
        nonlocal reports, complete_units
        if send.channel == "access_unit":
            complete_units += send.payload.complete
        elif send.channel == "feedback" and is_path_datagram(send.payload):
            challenge = server.receive(send.payload, CLIENT_ADDRESS, bench.now.mono_ns)
            if challenge is not None:
                bench.deliver("rtp", challenge)
        elif send.channel == "feedback":
            report = server.cipher.unprotect_rtcp(send.payload)
            expect(report is not None, "the server cannot decrypt a report")
            parse_feedback(report or b"")
            reports += 1

    bench = NodeBench(node, on_send)
    bench.deliver("path_token", PathToken(TOKEN, 5600))
    bench.deliver(WAKE, None)
    expect(server.open_address(bench.now.mono_ns) == CLIENT_ADDRESS, "the path was not validated")
    packetizer, repairs = Packetizer(77, 0), RepairSender(78, 0)
    encoded = [unit for _, unit in units(seed, 30)]
    corpora = video_corpora(encoded[:10])
    report = sender_report(77, wall_ns=1, rtp_timestamp=5, packets=9, octets=900, cname="x@lavt", answered=[])
    corpora["rtcp"].replays.append(server.cipher.protect_rtcp(report))

    def next_true_frame() -> list[bytes]:
        nonlocal frame
        datagrams = packetizer.packetize(encoded[frame % len(encoded)], frame * 3000 % 2**32)
        frame += 1
        return [
            server.cipher.protect(datagram) for datagram in (*datagrams, *repairs.make_repair_packets(datagrams, 1))
        ]

    protected = next_true_frame()
    corpora["rtp"] = Corpus(protected, fields=EVERY_THIRD_BYTE)

    def feed(_channel: str, data: bytes, _chance: Chance) -> None:
        nonlocal inputs, sent_packets, protected
        inputs += 1
        if inputs % INPUTS_PER_FRAME == 1:
            protected = protected if inputs == 1 else next_true_frame()
            for datagram in protected:
                bench.deliver("rtp", datagram)
            sent_packets += len(protected)
            corpora["rtp"].replays.extend(protected)
        bench.deliver("rtp", data)
        bench.advance(STEP_NS)
        counted = node.counts.get("packets", 0) + node.counts.get("packets_of_repair", 0)
        expect(counted == sent_packets, f"{sent_packets} packets were sent, {counted} accepted")

    def finish() -> str:
        return f"{complete_units} of {frame} frames complete, {reports} reports"

    return Target(corpora, feed, lambda: total(node.counts, "packets_forged", "challenges_unreadable"), finish)


def encrypted_feedback(seed: int) -> Target:
    """Make a target for SRTCP at the vehicle's video port, where all inputs come from the client's address.

    Invariant: no keyframe is made without a true request.
    """
    entropy, camera = SeededEntropy(seed, "feedback"), FakeCamera()
    path = PathServer(lambda: entropy.token(32), partial(SrtpCipher, "server"))
    node = CameraNode(camera, camera, StreamSender(Packetizer(2, 0), RepairSender(3, 0)), path, start_ns=START.mono_ns)
    client = PathClient(TOKEN, partial(SrtpCipher, "client"))
    bench = NodeBench(node)
    bench.deliver("video_token", TOKEN)
    [challenge] = bench.deliver("feedback", client.hello(0), CLIENT_ADDRESS)
    bench.deliver("feedback", client.answer(challenge.payload), CLIENT_ADDRESS)
    [packet] = Packetizer(77, 0).packetize(b"\0\0\1\x65", 0)
    # The first packet shows the client which of its candidate keys the server uses.
    client.unprotect(path.cipher.protect(packet))
    report, keyframe_request = rtcp_datagrams()[0], picture_loss(1, 2)
    corpus = Corpus(
        [client.protect_rtcp(plain) for plain in (report, keyframe_request, report)],
        fields=tuple((offset, 1) for offset in range(96)),
    )
    for protected in corpus.entries:
        bench.deliver("feedback", protected, CLIENT_ADDRESS)
    inputs, requested = 0, 1

    def feed(channel: str, data: bytes, _chance: Chance) -> None:
        nonlocal inputs, requested
        inputs += 1
        bench.deliver(channel, data, CLIENT_ADDRESS)
        bench.advance(STEP_NS)
        if inputs % INPUTS_PER_REPORT == 0:
            requests_keyframe = inputs % (2 * INPUTS_PER_REPORT) == 0
            sent = client.protect_rtcp(keyframe_request if requests_keyframe else report)
            requested += requests_keyframe
            bench.deliver("feedback", sent, CLIENT_ADDRESS)
            corpus.replays.append(sent)
        expect(node.counts.get("keyframes_on_request", 0) <= requested, "a keyframe was made without a request")

    def finish() -> str:
        expect(path.open_address(bench.now.mono_ns) == CLIENT_ADDRESS, "the path of a client that reports was closed")
        return f"{node.counts['keyframes_on_request']} of {requested} requests for a keyframe accepted"

    return Target({"feedback": corpus}, feed, lambda: total(node.counts, "path_", "feedback_"), finish)
