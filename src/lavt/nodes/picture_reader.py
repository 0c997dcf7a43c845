"""Steps 7 and 8 of the life of a frame: an access unit becomes a picture whose send time is known."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence

from lavt.domain import Now
from lavt.errors import BadPacket
from lavt.node import Hop, Message, Send
from lavt.nodes.payloads import DecodedFrame, PictureRead, ReceivedUnit, VideoUnit
from lavt.transport.video.frame_codec import PictureReceiver, ReceivedPicture
from lavt.transport.video.stamp import stamp_agrees
from lavt.value import value


@value
class DecodedUnit:
    """A received access unit and the picture that came of it."""

    unit: ReceivedUnit
    picture: ReceivedPicture | None
    decoded_mono_ns: int


@value
class StampRead:
    """A decoded picture with its stamp; 0 where it could not be read."""

    decoded: DecodedUnit
    stamp_ns: int
    reason: str


class PictureReader:
    """Decodes every access unit, reads its stamp, and shows it where that can be believed.

    `agrees(stamp, RTP timestamp)` says whether it can. Where that check is weak, stamps of pictures in doubt are better
    not shown to it (`reads_doubtful` false): made up ones can agree with each other. `stages` are a node's chain for
    "access_unit"; what comes out is a "view" for whoever looks at pictures, and "picture_lost" where the decoder has
    none or had to make parts of it up.
    """

    def __init__(
        self,
        pictures: PictureReceiver,
        agrees: Callable[[int, int], bool] = stamp_agrees,
        *,
        reads_doubtful: bool = True,
    ) -> None:
        self.counts: Counter[str] = Counter()
        self.stages: Sequence[Hop] = (("decode", self._decode), ("read_stamp", self._read_stamp), ("show", self._show))
        self._pictures = pictures
        self._agrees = agrees
        self._reads_doubtful = reads_doubtful
        self._in_doubt = True

    def _decode(self, message: Message, now: Now) -> DecodedUnit:
        unit: ReceivedUnit = message.payload
        picture = self._pictures.decode(unit.data)
        whole = unit.complete and picture is not None and not picture.corrupt
        self._in_doubt = not whole or (self._in_doubt and not unit.keyframe)
        return DecodedUnit(unit, picture, now.mono_ns)

    def _read_stamp(self, decoded: DecodedUnit, now: Now) -> StampRead:
        decoded = DecodedUnit(decoded.unit, decoded.picture, now.mono_ns)
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

    def _show(self, read: StampRead, now: Now) -> list[Send]:
        decoded, unit = read.decoded, read.decoded.unit
        readable = read.reason == ""
        self.counts["frames_decoded"] += decoded.picture is not None
        self.counts["frames_unreadable"] += not readable
        picture = PictureRead(
            read.stamp_ns if readable else None,
            readable,
            read.reason,
            self._in_doubt,
            decoded.picture is not None,
            unit.rtp_timestamp,
            unit.packet_mono_ns,
            decoded.decoded_mono_ns,
            now.mono_ns,
            now.wall_ns,
        )
        sends = [Send("video", VideoUnit(read.stamp_ns, unit.data)), Send("picture", picture)]
        if decoded.picture is None or decoded.picture.corrupt:
            sends.append(Send("picture_lost", None))
        if decoded.picture is not None and readable:
            sends.append(Send("view", DecodedFrame(read.stamp_ns, now.wall_ns, decoded.picture)))
        return sends
