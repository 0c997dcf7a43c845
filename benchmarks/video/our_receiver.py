"""The receiving process of ours: the receiver and the driver in their runtime."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from benchmarks.video.product import LOOPBACK, Ends, WatchedPictures, receiver_nodes
from benchmarks.video.run import TOKEN, requested_run, tell, wait_for_line
from benchmarks.video.watch import Watch

from lavt.domain import Now
from lavt.nodes.payloads import PathToken


class ReadPictures:
    """In the place of the record: notes each picture with its stamp."""

    def __init__(self, watch: Watch) -> None:
        self.counts: dict[str, int] = {}
        self.watched: WatchedPictures | None = None
        self._watch = watch

    def write(self, topic: str, payload: Any, now: Now) -> None:  # noqa: ARG002 (the recorder's)
        """Note a picture that was read, and at the end what the nodes counted."""
        if topic == "picture" and payload.readable and self.watched is not None:
            self._watch.note(payload.stamp_ns, payload.read_wall_ns, self.watched.last.luma)
        elif topic == "counts":
            self.counts |= {name: count for name, count in payload.items() if name != "node" and count}


def main() -> None:
    """Receive until it is told to end."""
    run = requested_run()
    watch = Watch(run)
    read = ReadPictures(watch)
    ends = Ends("rtp", read, remote=(LOOPBACK, run.port))
    nodes, read.watched = receiver_nodes(run, ends.clock)
    runtime = ends.start(nodes)
    runtime.deliver("path_token", PathToken(TOKEN, run.port), ends.clock.now())
    tell({"port": ends.port})
    wait_for_line()
    ends.close()
    watch.save(Path(run.folder) / "read.npz")
    tell({"counts": read.counts})


if __name__ == "__main__":
    main()
