"""Fuzzes what stands before the nodes where messages are signed and the video is encrypted.

Everything valid may be altered here: what is authentic is known, and nothing else may get in. Needs the extra `secure`.
Keys follow from the seed; nonces and agreements do not, so inputs are not the same to the bit from run to run.
"""

from __future__ import annotations

from collections import deque
from functools import partial
from typing import Any

from benchmarks.fuzzing.camera import HOME, Still, rtcp_reports
from benchmarks.fuzzing.mutation import Chance, Corpus
from benchmarks.fuzzing.operator_side import STEP_NS, TOKEN, units, video_corpora
from benchmarks.fuzzing.target import START, Bench, Target, expect, total
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
"""Between two inputs: more of them a second would stay outside unread."""
EPOCH = 2**63 + 7
EVERYWHERE = tuple((at, 1) for at in range(0, 400, 3))
HOLD = encode(SessionRequest("hold", "alice", 5, 0))
GRANTED = encode(SessionReply(True, "", EPOCH, TOKEN, 5600, "kernel", 0))


def keys(seed: int) -> tuple[PrivateKey, PrivateKey]:
    """Make the vehicle's key and the operator's."""
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey  # noqa: PLC0415 (an extra)

    entropy = SeededEntropy(seed, "keys")
    vehicle, operator = (PrivateKey(Ed25519PrivateKey.from_private_bytes(entropy.token(32))) for _ in range(2))
    return vehicle, operator


def gateway_of_vehicle(seed: int) -> Target:
    """Altered and replayed envelopes at the vehicle's door: only what the operator has said gets in, a query once."""
    vehicle_key, operator_key = keys(seed)
    inside: list[tuple[str, bytes]] = []
    outside: list[Send] = []
    sequence = 0
    gateway = ServerGateway(
        lambda channel, body, _arrived, _peer: inside.append((channel, body)),
        lambda *sends: outside.extend(sends),
        lambda: (EPOCH, sequence),
        VehicleAuthenticator("car", vehicle_key, {"alice": operator_key.public}),
    )
    desk = OperatorAuthenticator("car", "alice", operator_key, vehicle_key.public)
    now = START

    def ask(body: bytes, answer: bytes) -> bytes:
        """Ask as the operator does, twice where the vehicle wants that; gives the request that was taken."""
        request = desk.sign_request("session", body)
        gateway.receive("session", request, now, "query")
        if not inside:
            again = desk.verify_reply("session", outside.pop().payload).retry
            expect(again is not None, "the operator was not told to ask again")
            request = again or b""
            gateway.receive("session", request, now, "query")
        expect(inside == [("session", body)], "the operator's request did not get in")
        inside.clear()
        gateway.send(Send("session_reply", answer, "query"))
        expect(
            desk.verify_reply("session", outside.pop().payload).body == answer, "the operator cannot read his answer"
        )
        return request

    said: deque[bytes] = deque(maxlen=256)

    def command() -> bytes:
        said.append(encode(Command(EPOCH, sequence + 1, 1, 2, 3, 0.1, 0.5, 0.0, STRAIGHT, "drive", 0)))
        return desk.sign_command(said[-1])

    corpora = {
        "session": Corpus([ask(HOLD, GRANTED), ask(HOLD, GRANTED)], fields=EVERYWHERE),
        "control": Corpus([command() for _ in range(4)], fields=EVERYWHERE),
    }
    first = frozenset(said)  # of the corpus; of later ones the newest are said again
    inputs = 0

    def feed(channel: str, data: bytes, _chance: Chance) -> None:
        nonlocal inputs, now, sequence
        inputs += 1
        now = now.later(GATEWAY_STEP_NS)
        gateway.receive(channel, data, now, "stranger")
        for came, body in inside:
            expect(came == "control" and (body in said or body in first), f"what nobody said got in at {came}")
        inside.clear()
        outside.clear()
        if inputs % 20 == 0:
            signed = command()
            gateway.receive("control", signed, now, None)
            expect(inside == [("control", said[-1])], "the operator's command did not get in")
            inside.clear()
            corpora["control"].heard.append(signed)
            sequence += 1

    return Target(corpora, feed, lambda: total(gateway.counts, "commands_", "session_"))


def gateway_of_operator(seed: int) -> Target:
    """Altered and replayed states and replies at the operator's door: only what the vehicle says gets in, once."""
    vehicle_key, operator_key = keys(seed)
    car = VehicleAuthenticator("car", vehicle_key, {"alice": operator_key.public})
    inside: list[bytes] = []
    outside: list[Send] = []
    gateway = ClientGateway(
        lambda _channel, body, _arrived, _peer: inside.append(body),
        lambda *sends: outside.extend(sends),
        OperatorAuthenticator("car", "alice", operator_key, vehicle_key.public),
    )
    hurry: Any = outside.append
    gateway._send_in_thread = hurry  # type: ignore[method-assign]  # noqa: SLF001 (here no thread is needed)
    now = START

    def answer(body: bytes) -> bytes:
        """Answer the request that is outside, and let the door hear it; gives the reply's bytes."""
        request = car.verify_request("session", outside.pop().payload)
        assert request is not None
        reply = car.sign_reply(request, b"" if request.is_stale else body)
        gateway.receive("session_reply", reply, now, None)
        return reply

    def state(number: int) -> tuple[bytes, bytes]:
        body = encode(State(number, number, 8.0, 0.0, "drive", "driving", "", number, ""))
        return body, car.sign_state(body)

    gateway.send(Send("session", HOLD))
    replies = [answer(GRANTED), answer(GRANTED)]
    old = [state(number)[1] for number in range(8)]
    for each in old:
        gateway.receive("state", each, now, None)
    expect(len(inside) == 1 + len(old), "the vehicle's own messages did not get in")
    inside.clear()
    corpora = {
        "state": Corpus(old, fields=EVERYWHERE),
        "session_reply": Corpus(replies, fields=EVERYWHERE),
        "netem_reply": Corpus(replies, fields=EVERYWHERE),
    }
    inputs = 0

    def feed(channel: str, data: bytes, _chance: Chance) -> None:
        nonlocal inputs, now
        inputs += 1
        now = now.later(GATEWAY_STEP_NS)
        gateway.receive(channel, data, now, None)
        expect(inside == [], f"what the vehicle did not say, or said before, got in as {channel}")
        outside.clear()
        if inputs % 20 == 0:
            body, signed = state(100 + inputs)
            gateway.receive("state", signed, now, None)
            expect(inside == [body], "the vehicle's state did not get in")
            inside.clear()
            corpora["state"].heard.append(signed)

    return Target(corpora, feed, lambda: total(gateway.counts, "state", "session_", "netem_"))


def encrypted_video(seed: int) -> Target:
    """Altered and replayed SRTP at the client's video port: not one packet counts that the server has not sent."""
    node = ReceiverNode(JitterBuffer(), Depacketizer(), 2_000_000, partial(SrtpCipher, "client"))
    server = PathServer(lambda: bytes(32), partial(SrtpCipher, "server"))
    server.set_token(TOKEN)
    reported = whole = inputs = frame = sent = 0

    def hear(send: Send) -> None:
        nonlocal reported, whole
        if send.channel == "access_unit":
            whole += send.payload.complete
        elif send.channel == "feedback" and is_path_datagram(send.payload):
            challenge = server.receive(send.payload, HOME, bench.now.mono_ns)
            if challenge is not None:
                bench.give("rtp", challenge)
        elif send.channel == "feedback":
            opened = server.cipher.open_control(send.payload)
            expect(opened is not None, "the server cannot decrypt a report")
            parse_feedback(opened or b"")
            reported += 1

    bench = Bench(node, hear)
    bench.give("path_token", PathToken(TOKEN, 5600))
    bench.give(WAKE, None)
    expect(server.open_address(bench.now.mono_ns) == HOME, "the path was not opened")
    packetizer, repairs = Packetizer(77, 0), RepairSender(78, 0)
    encoded = [unit for _, unit in units(seed, 30)]
    corpora = video_corpora(encoded[:10])
    report = sender_report(77, wall_ns=1, rtp_timestamp=5, packets=9, octets=900, cname="x@lavt", answered=[])
    corpora["rtcp"].heard.append(server.cipher.protect_control(report))

    def true_frame() -> list[bytes]:
        nonlocal frame
        datagrams = packetizer.packetize(encoded[frame % len(encoded)], frame * 3000 % 2**32)
        frame += 1
        return [server.cipher.protect(each) for each in (*datagrams, *repairs.repair(datagrams, 1))]

    signed = true_frame()
    corpora["rtp"] = Corpus(signed, fields=EVERYWHERE)

    def feed(_channel: str, data: bytes, _chance: Chance) -> None:
        nonlocal inputs, sent, signed
        inputs += 1
        if inputs % 33 == 1:
            signed = signed if inputs == 1 else true_frame()
            for datagram in signed:
                bench.give("rtp", datagram)
            sent += len(signed)
            corpora["rtp"].heard.extend(signed)
        bench.give("rtp", data)
        bench.go(STEP_NS)
        counted = node.counts.get("packets", 0) + node.counts.get("packets_of_repair", 0)
        expect(counted == sent, f"{sent} packets were sent, {counted} taken")

    def finish() -> str:
        return f"{whole} of {frame} frames whole, {reported} reports"

    return Target(corpora, feed, lambda: total(node.counts, "packets_forged", "challenges_unreadable"), finish)


def encrypted_feedback(seed: int) -> Target:
    """Altered and replayed SRTCP at the vehicle's video port, from the client's own address: none of it is heard."""
    entropy, still = SeededEntropy(seed, "feedback"), Still()
    path = PathServer(lambda: entropy.token(32), partial(SrtpCipher, "server"))
    node = CameraNode(
        still, still, StreamSender(Packetizer(2, 0), RepairSender(3, 0)), path, start_ns=START.mono_ns
    )  # fmt: skip
    client = PathClient(TOKEN, partial(SrtpCipher, "client"))
    bench = Bench(node)
    bench.give("video_token", TOKEN)
    [challenge] = bench.give("feedback", client.hello(0), HOME)
    bench.give("feedback", client.answer(challenge.payload), HOME)
    report, please = rtcp_reports()[0], picture_loss(1, 2)
    corpus = Corpus(
        [client.protect_control(each) for each in (report, please, report)], fields=tuple((at, 1) for at in range(96))
    )
    for each in corpus.entries:
        bench.give("feedback", each, HOME)
    inputs, requested = 0, 1

    def feed(channel: str, data: bytes, _chance: Chance) -> None:
        nonlocal inputs, requested
        inputs += 1
        bench.give(channel, data, HOME)
        bench.go(STEP_NS)
        if inputs % 500 == 0:
            said = client.protect_control(please if inputs % 1000 == 0 else report)
            requested += inputs % 1000 == 0
            bench.give("feedback", said, HOME)
            corpus.heard.append(said)
        expect(node.counts.get("keyframes_on_request", 0) <= requested, "a keyframe was made that nobody asked for")

    def finish() -> str:
        expect(path.open_address(bench.now.mono_ns) == HOME, "the path of a client that reports was closed")
        return f"{node.counts['keyframes_on_request']} of {requested} requests for a keyframe heard"

    return Target({"feedback": corpus}, feed, lambda: total(node.counts, "path_", "feedback_"), finish)
