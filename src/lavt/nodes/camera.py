"""The camera node, which captures frames, stamps and encodes them, and sends their packets."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Mapping, Sequence

from msgspec import Struct

from lavt.domain import NS_PER_S, FramePayload, Now, Pose
from lavt.errors import BadPacket
from lavt.node import WAKE, Message, Send, Stage
from lavt.nodes.payloads import FrameWritten, VideoUnit
from lavt.transport.rtp.rtcp import is_rtcp, parse_feedback
from lavt.transport.video.frame_codec import PictureSender
from lavt.transport.video.path_validation import PathServer
from lavt.transport.video.stream_sender import StreamSender
from lavt.vehicle.camera import Camera, CapturedFrame, CountingCamera, FrameTimes, TimedCamera, newest_pose

KEYFRAME_PAUSE_NS = NS_PER_S // 10
"""Shortest time between two keyframes that the receiver causes, by a keyframe request or a new bit-rate limit. So
requests cannot fill the link."""
REMEMBERED_STAMPS = 512
"""A new stamp differs from this many previous stamps. At 60 Hz these cover 8.5 s; the safety gate remembers stamps for
5 s."""
REMEMBERED_POSES = 512
"""At 240 Hz these poses cover 2.1 s: twice the longest time from the opening of the shutter until a picture is
ready."""


class PreparedFrame(Struct, frozen=True):
    """A captured frame that is ready to be stamped."""

    frame: CapturedFrame
    picture: FramePayload
    pixel_crc: int


class StampedFrame(Struct, frozen=True):
    """A frame whose picture has the stamp in its pixels."""

    frame: CapturedFrame
    pixel_crc: int
    stamp_ns: int
    stamped_mono_ns: int
    picture: FramePayload


class EncodedFrame(Struct, frozen=True):
    """A stamped picture as H.264."""

    stamped: StampedFrame
    stamp_ns: int
    access_unit: bytes


class CameraNode:
    """The node that captures, stamps and encodes pictures, and sends them to the validated receiver.

    A frame is due when the shutter opens for it. The node wakes when the frame's picture is ready: after exposure and
    sensor delay of a `TimedCamera`, at once for other cameras. A late wake skips frames, which are counted. `send_to`
    lists receivers that get the video without path validation.
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
        self._capture_now = camera.capture
        self._counting_camera = camera if isinstance(camera, CountingCamera) else None
        self._pictures = pictures
        self._ready_after_ns, self._capture_after_exposure = 0, self._capture_inline
        if isinstance(camera, TimedCamera):
            self._ready_after_ns = camera.exposure_ns + camera.sensor_delay_ns
            self._capture_after_exposure = camera.capture_after_exposure
        self._stream = stream
        self.path = path
        """The server's end of the video path."""
        self._shutter_times = FrameTimes(start_ns + camera.phase_ns, camera.rate_hz)
        self._send_to = tuple(send_to)
        self._next_frame = 0
        self._wake_ns = self._shutter_times.due_ns(0) + self._ready_after_ns
        self._poses: deque[Pose] = deque(maxlen=REMEMBERED_POSES)
        self._keyframe_requested = False
        self._keyframe_ns = 0
        self._limit_bps: int | None = None
        """The receiver's bit-rate limit that the encoder uses now."""
        self._stamps: deque[int] = deque(maxlen=REMEMBERED_STAMPS)
        self._highest_stamp_ns = 0
        self.pipelines: Mapping[str, Sequence[Stage]] = {
            WAKE: (
                ("capture", self._capture),
                ("check", self._prepare),  # this name is in records and in `costs.yaml`
                ("stamp", self._stamp),
                ("encode", self._encode),
                ("packetize", self._packetize),
            ),
            "pose": (("note", self._note_pose),),
            "video_token": (("note", self._note_token),),
            "feedback": (("feedback", self._receive_feedback),),
        }

    @property
    def counts(self) -> Mapping[str, int]:
        """Return the counts of the node, the camera and path validation."""
        path = self.path
        camera_counts = {} if self._counting_camera is None else self._counting_camera.counts
        return {
            **self._counts,
            **{f"camera_{name}": number for name, number in camera_counts.items()},
            "path_malformed": path.malformed,
            "path_wrong_token": path.wrong_token,
            "path_wrong_address": path.wrong_address,
            "path_stale": path.stale,
            "path_unneeded": path.unneeded,
            "path_foreign_reports": path.foreign_reports,
        }

    def next_wake_ns(self) -> int:
        """Return when the next picture is ready."""
        return self._wake_ns

    def _capture(self, _message: Message, now: Now) -> CapturedFrame | None:
        number = self._next_frame
        while (next_ns := self._shutter_times.due_ns(number + 1) + self._ready_after_ns) <= now.mono_ns:
            number += 1
        self._counts["frames_skipped"] += number - self._next_frame
        self._next_frame, self._wake_ns = number + 1, next_ns
        due_ns = self._shutter_times.due_ns(number)
        frame = self._capture_after_exposure(number, due_ns, self._poses)
        if frame is None:
            self._counts["frames_missing"] += 1
        return frame

    def _capture_inline(self, number: int, begin_ns: int, poses: Sequence[Pose]) -> CapturedFrame | None:
        """Capture a frame with a camera that has no exposure time and no sensor delay."""
        return self._capture_now(number, begin_ns, newest_pose(poses, begin_ns))

    def _prepare(self, frame: CapturedFrame, _now: Now) -> PreparedFrame:
        """Do the work that needs no stamp, so that it adds no latency: the checksum and the codec's preparation."""
        return PreparedFrame(frame, *self._pictures.prepare(frame.picture))

    def _stamp(self, prepared: PreparedFrame, now: Now) -> StampedFrame:
        stamp_ns = now.wall_ns
        if stamp_ns > self._highest_stamp_ns:
            self._highest_stamp_ns = stamp_ns
        else:  # no stamp is issued twice, even if the clock does not advance or is stepped back
            while stamp_ns in self._stamps:
                stamp_ns += 1
            self._highest_stamp_ns = max(self._highest_stamp_ns, stamp_ns)
        self._stamps.append(stamp_ns)
        picture = self._pictures.write_stamp(prepared.picture, stamp_ns)
        return StampedFrame(prepared.frame, prepared.pixel_crc, stamp_ns, now.mono_ns, picture)

    def _encode(self, stamped: StampedFrame, now: Now) -> EncodedFrame:
        paused = now.mono_ns - self._keyframe_ns < KEYFRAME_PAUSE_NS
        keyframe = self._keyframe_requested and not paused
        limit_bps = self._stream.bit_rate_limit_bps
        if limit_bps != self._limit_bps and not paused:
            self._limit_bps, self._keyframe_ns = limit_bps, now.mono_ns
            self._pictures.limit_bit_rate(limit_bps)
        if keyframe:
            self._keyframe_requested, self._keyframe_ns = False, now.mono_ns
            self._counts["keyframes_on_request"] += 1
        return EncodedFrame(stamped, stamped.stamp_ns, self._pictures.encode(stamped.picture, keyframe=keyframe))

    def _packetize(self, encoded: EncodedFrame, now: Now) -> list[Send]:
        stamped, unit = encoded.stamped, encoded.access_unit
        packets = self._stream.make_packets(unit, encoded.stamp_ns, now)
        validated = self.path.open_address(now.mono_ns)
        self._counts["frames_sent"] += 1
        self._counts["frames_without_receiver"] += validated is None and not self._send_to
        self._counts["packets_of_repair"] += 0 if validated is None else len(packets.repair)
        frame = FrameWritten(
            stamped.frame.number,
            encoded.stamp_ns,
            stamped.stamped_mono_ns,
            stamped.frame.capture_ns,
            stamped.pixel_crc,
            len(unit),
        )
        # Sent first: the gate must know the frame's stamp before a command from this frame arrives, perhaps 5 ms later.
        sends = [Send("frame", frame)]
        if validated is not None:
            cipher = self.path.cipher
            sends += [Send("rtp", cipher.protect(packet), validated) for packet in (*packets.media, *packets.repair)]
            sends += [Send("rtp", cipher.protect_rtcp(report), validated) for report in packets.report]
        unprotected = [*packets.media, *packets.report]
        sends += [Send("rtp", packet, address) for address in self._send_to for packet in unprotected]
        return [*sends, Send("video", VideoUnit(encoded.stamp_ns, unit))]

    def _note_pose(self, message: Message, _now: Now) -> None:
        self._poses.append(message.payload)

    def _note_token(self, message: Message, _now: Now) -> None:
        self.path.set_token(message.payload)
        self._stream.forget_receiver()

    def _receive_feedback(self, message: Message, now: Now) -> list[Send] | None:
        """Process a datagram: path validation, or RTCP, which is accepted from the validated address only."""
        if not is_rtcp(message.payload):
            answer = self.path.receive(message.payload, message.peer, now.mono_ns)
            return None if answer is None else [Send("rtp", answer, message.peer)]
        if not self.path.accepts_rtcp_from(message.peer):
            self._counts["feedback_from_strangers"] += 1
            return None
        packet = self.path.cipher.unprotect_rtcp(message.payload)
        if packet is None:
            self._counts["feedback_forged"] += 1
            return None
        try:
            feedback = parse_feedback(packet)
        except BadPacket:
            self._counts["feedback_unreadable"] += 1
            return None
        self.path.note_report(message.peer, now.mono_ns)
        self._stream.receive_feedback(feedback, now.mono_ns)
        self._keyframe_requested |= feedback.picture_loss
        return None
