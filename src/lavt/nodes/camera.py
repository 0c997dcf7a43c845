"""Steps 1 to 4 of the life of a frame: picture, stamp, H.264, RTP."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Mapping, Sequence

from lavt.domain import NS_PER_S, Now, Pose, Sight
from lavt.errors import BadPacket
from lavt.node import WAKE, Hop, Message, Send
from lavt.nodes.payloads import FrameWritten, VideoUnit
from lavt.transport.rtp.rtcp import is_rtcp, parse_feedback
from lavt.transport.video.frame_codec import PictureSender
from lavt.transport.video.path_validation import PathServer
from lavt.transport.video.stream_sender import StreamSender
from lavt.value import value
from lavt.vehicle.camera import Camera, CapturedFrame, CountingCamera, FrameTimes, TimedCamera, newest_pose

KEYFRAME_PAUSE_NS = NS_PER_S // 10
"""No more than one keyframe on request in this time, so that requests cannot fill the link; nor for a new bit rate."""
REMEMBERED_STAMPS = 512
"""No stamp is one of so many before: at 60 Hz more than the 5 s for which the safety of the vehicle knows them."""
REMEMBERED_POSES = 512
"""At 240 Hz twice the longest that a picture may take from the opening of the shutter."""


@value
class StampedFrame:
    """A picture with its send time in its pixels."""

    frame: CapturedFrame
    pixel_crc: int
    stamp_ns: int
    stamped_mono_ns: int
    picture: Sight


@value
class EncodedFrame:
    """A stamped picture as H.264."""

    stamped: StampedFrame
    stamp_ns: int
    access_unit: bytes


class CameraNode:
    """Takes a picture whenever one is due, and sends it to whoever has proven to be there.

    A frame is due when its shutter opens; the node wakes for it when its picture is there, which a `TimedCamera` says
    and any other camera is taken to do at once. Late wakes skip frames and count them; a picture is taken at the time
    it was due. `send_to` names plain receivers.
    """

    name = "camera"

    def __init__(
        self,
        camera: Camera,
        pictures: PictureSender,
        stream: StreamSender,
        path: PathServer,
        *,
        start_ns: int,
        send_to: Sequence[tuple[str, int]] = (),
    ) -> None:
        self._counts: Counter[str] = Counter()
        self._take = camera.capture
        self._counting = camera if isinstance(camera, CountingCamera) else None
        self._pictures = pictures
        self._there_after_ns, self._expose = 0, self._take_at_once
        if isinstance(camera, TimedCamera):
            self._there_after_ns, self._expose = camera.exposure_ns + camera.sensor_delay_ns, camera.expose
        self._stream = stream
        self._path = path
        self._opens = FrameTimes(start_ns + camera.phase_ns, camera.rate_hz)
        self._send_to = tuple(send_to)
        self._next_frame = 0
        self._wake_ns = self._opens.due_ns(0) + self._there_after_ns
        self._poses: deque[Pose] = deque(maxlen=REMEMBERED_POSES)
        self._keyframe_wanted = False
        self._keyframe_ns = 0
        self._limit_bps: int | None = None
        self._stamps: deque[int] = deque(maxlen=REMEMBERED_STAMPS)
        self._highest_stamp_ns = 0
        self.chains: Mapping[str, Sequence[Hop]] = {
            WAKE: (
                ("capture", self._capture),
                ("check", self._check),
                ("stamp", self._stamp),
                ("encode", self._encode),
                ("packetize", self._packetize),
            ),
            "pose": (("note", self._note_pose),),
            "video_token": (("note", self._note_token),),
            "feedback": (("feedback", self._hear),),
        }

    @property
    def counts(self) -> Mapping[str, int]:
        """What was counted here, what the camera has, and what the video's path has refused."""
        path = self._path
        counted = {} if self._counting is None else self._counting.counts
        return {
            **self._counts,
            **{f"camera_{name}": number for name, number in counted.items()},
            "path_malformed": path.malformed,
            "path_wrong_token": path.wrong_token,
            "path_wrong_address": path.wrong_address,
            "path_stale": path.stale,
            "path_foreign_reports": path.foreign_reports,
        }

    def next_wake_ns(self) -> int:
        """When the next picture is there."""
        return self._wake_ns

    def _capture(self, _message: Message, now: Now) -> CapturedFrame | None:
        number = self._next_frame
        while (next_ns := self._opens.due_ns(number + 1) + self._there_after_ns) <= now.mono_ns:
            number += 1
        self._counts["frames_skipped"] += number - self._next_frame
        self._next_frame, self._wake_ns = number + 1, next_ns
        due_ns = self._opens.due_ns(number)
        frame = self._expose(number, due_ns, self._poses)
        if frame is None:
            self._counts["frames_missing"] += 1
        return frame

    def _take_at_once(self, number: int, begin_ns: int, poses: Sequence[Pose]) -> CapturedFrame | None:
        """Take a frame with a camera that knows nothing of exposure and delay."""
        return self._take(number, begin_ns, newest_pose(poses, begin_ns))

    def _check(self, frame: CapturedFrame, _now: Now) -> tuple[CapturedFrame, Sight, int]:
        """Do what can be done before the time of the stamp begins, a checksum of the picture among it."""
        return frame, *self._pictures.prepare(frame.picture)

    def _stamp(self, checked: tuple[CapturedFrame, Sight, int], now: Now) -> StampedFrame:
        frame, prepared, pixel_crc = checked
        stamp_ns = now.wall_ns
        if stamp_ns > self._highest_stamp_ns:
            self._highest_stamp_ns = stamp_ns
        else:  # a clock that stands still or was stepped back must not write one twice
            while stamp_ns in self._stamps:
                stamp_ns += 1
            self._highest_stamp_ns = max(self._highest_stamp_ns, stamp_ns)
        self._stamps.append(stamp_ns)
        return StampedFrame(frame, pixel_crc, stamp_ns, now.mono_ns, self._pictures.write_stamp(prepared, stamp_ns))

    def _encode(self, stamped: StampedFrame, now: Now) -> EncodedFrame:
        paused = now.mono_ns - self._keyframe_ns < KEYFRAME_PAUSE_NS
        keyframe = self._keyframe_wanted and not paused
        limit_bps = self._stream.bit_rate_limit_bps
        if limit_bps != self._limit_bps and not paused:
            self._limit_bps, self._keyframe_ns = limit_bps, now.mono_ns
            self._pictures.limit_bit_rate(limit_bps)
        if keyframe:
            self._keyframe_wanted, self._keyframe_ns = False, now.mono_ns
            self._counts["keyframes_on_request"] += 1
        return EncodedFrame(stamped, stamped.stamp_ns, self._pictures.encode(stamped.picture, keyframe=keyframe))

    def _packetize(self, encoded: EncodedFrame, now: Now) -> list[Send]:
        stamped, unit = encoded.stamped, encoded.access_unit
        packets = self._stream.packets(unit, encoded.stamp_ns, now)
        proven = self._path.open_address(now.mono_ns)
        self._counts["frames_sent"] += 1
        self._counts["frames_without_receiver"] += proven is None and not self._send_to
        self._counts["packets_of_repair"] += 0 if proven is None else len(packets.repair)
        frame = FrameWritten(
            stamped.frame.number, encoded.stamp_ns, stamped.stamped_mono_ns, stamped.frame.capture_ns,
            stamped.pixel_crc, len(unit),
        )  # fmt: skip
        # Before its first packet leaves: 5 ms later a command from it may come, and the safety must know its stamp.
        sends = [Send("frame", frame)]
        if proven is not None:
            cipher = self._path.cipher
            sends += [Send("rtp", cipher.protect(each), proven) for each in (*packets.media, *packets.repair)]
            sends += [Send("rtp", cipher.protect_control(each), proven) for each in packets.report]
        plain = [*packets.media, *packets.report]
        sends += [Send("rtp", each, address) for address in self._send_to for each in plain]
        return [*sends, Send("video", VideoUnit(encoded.stamp_ns, unit))]

    def _note_pose(self, message: Message, _now: Now) -> None:
        self._poses.append(message.payload)

    def _note_token(self, message: Message, _now: Now) -> None:
        self._path.set_token(message.payload)
        self._stream.forget_receiver()

    def _hear(self, message: Message, now: Now) -> list[Send] | None:
        """A datagram from somewhere: part of proving the path, or RTCP, which counts from an open path only."""
        if not is_rtcp(message.payload):
            answer = self._path.receive(message.payload, message.peer, now.mono_ns)
            return None if answer is None else [Send("rtp", answer, message.peer)]
        if not self._path.rtcp_admitted(message.peer):
            self._counts["feedback_from_strangers"] += 1
            return None
        packet = self._path.cipher.open_control(message.payload)
        if packet is None:
            self._counts["feedback_forged"] += 1
            return None
        try:
            feedback = parse_feedback(packet)
        except BadPacket:
            self._counts["feedback_unreadable"] += 1
            return None
        self._path.report(message.peer, now.mono_ns)
        self._stream.hear(feedback, now.mono_ns)
        self._keyframe_wanted |= feedback.picture_loss
        return None
