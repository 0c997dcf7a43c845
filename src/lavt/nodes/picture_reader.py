"""The reader of pictures, which decodes access units and verifies the stamps in their pictures."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence

from msgspec import Struct

from lavt.domain import Now, ReceivedPicture
from lavt.errors import BadPacket
from lavt.node import Message, Send, Stage
from lavt.nodes.payloads import DecodedFrame, PictureRead, ReceivedUnit, VideoUnit
from lavt.transport.video.frame_codec import PictureReceiver
from lavt.transport.video.stamp import stamp_agrees


class DecodedUnit(Struct, frozen=True):
    """A received access unit with its decoded picture."""

    unit: ReceivedUnit
    picture: ReceivedPicture | None
    decoded_mono_ns: int


class StampRead(Struct, frozen=True):
    """A decoded picture with its stamp."""

    decoded: DecodedUnit
    stamp_ns: int
    """0: the stamp could not be read."""
    reason: str
    """Why the stamp could not be read; empty: it was read."""


class PictureReader:
    """A reader that decodes every access unit and forwards pictures with a valid stamp.

    A stamp is valid if `agrees(stamp, RTP timestamp)` is true. If that check is weak, `reads_doubtful` should be false:
    stamps of pictures in doubt are then not read, because damaged stamps could agree by chance. `stages` is a node's
    pipeline for "access_unit". It sends a "view" for each picture with a valid stamp, and "picture_lost" if the decoder
    returned no picture or concealed errors in it.
    """

    def __init__(
        self,
        pictures: PictureReceiver,
        agrees: Callable[[int, int], bool] = stamp_agrees,
        *,
        reads_doubtful: bool = True,
    ) -> None:
        self.counts: Counter[str] = Counter()
        self.stages: Sequence[Stage] = (
            ("decode", self._decode),
            ("read_stamp", self._read_stamp),
            ("show", self._show),
        )
        self._pictures = pictures
        self._agrees = agrees
        self._reads_doubtful = reads_doubtful
        self._in_doubt = True

    def _decode(self, message: Message, now: Now) -> DecodedUnit:
        unit: ReceivedUnit = message.payload
        picture = self._pictures.decode(unit.data)
        is_intact = unit.complete and picture is not None and not picture.corrupt
        self._in_doubt = not is_intact or (self._in_doubt and not unit.keyframe)
        return DecodedUnit(unit, picture, now.mono_ns)

    def _read_stamp(self, decoded: DecodedUnit, now: Now) -> StampRead:
        decoded = DecodedUnit(decoded.unit, decoded.picture, now.mono_ns)  # decoding has ended now
        if decoded.picture is None:
            return StampRead(decoded, 0, "no picture")
        if self._in_doubt and not self._reads_doubtful:
            return StampRead(decoded, 0, "in doubt until the next keyframe")
        try:
            stamp_ns = self._pictures.read_stamp(decoded.picture)
        except BadPacket as error:
            return StampRead(decoded, 0, str(error))
        if not self._agrees(stamp_ns, decoded.unit.rtp_timestamp):
            return StampRead(decoded, 0, "stamp and RTP timestamp disagree")
        return StampRead(decoded, stamp_ns, "")

    def _show(self, stamp: StampRead, now: Now) -> list[Send]:
        decoded, unit = stamp.decoded, stamp.decoded.unit
        readable = stamp.reason == ""
        self.counts["frames_decoded"] += decoded.picture is not None
        self.counts["frames_unreadable"] += not readable
        picture = PictureRead(
            stamp.stamp_ns if readable else None,
            readable,
            stamp.reason,
            self._in_doubt,
            decoded.picture is not None,
            unit.rtp_timestamp,
            unit.packet_mono_ns,
            decoded.decoded_mono_ns,
            now.mono_ns,
            now.wall_ns,
        )
        sends = [Send("video", VideoUnit(stamp.stamp_ns, unit.data)), Send("picture", picture)]
        if decoded.picture is None or decoded.picture.corrupt:
            sends.append(Send("picture_lost", None))
        if decoded.picture is not None and readable:
            sends.append(Send("view", DecodedFrame(stamp.stamp_ns, now.wall_ns, decoded.picture)))
        return sends
