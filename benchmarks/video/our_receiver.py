"""LAVT's receiving process: the receiver node and the watcher node in the real-time runtime."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from benchmarks.video.our_nodes import LOOPBACK, LastPictureDecoder, ProcessRuntime, build_receiver_nodes
from benchmarks.video.picture_log import PictureLog
from benchmarks.video.run import TOKEN, print_json, requested_run, wait_for_line

from lavt.domain import Now
from lavt.nodes.payloads import PathToken


class PictureRecorder:
    """A recorder that notes each picture with its stamp, and the nodes' counts."""

    def __init__(self, log: PictureLog) -> None:
        self.counts: dict[str, int] = {}
        self.decoder: LastPictureDecoder | None = None
        self._log = log

    def write(self, topic: str, payload: Any, now: Now) -> None:  # noqa: ARG002 (part of the protocol)
        """Note a picture whose stamp was read, and finally the nodes' counts."""
        if topic == "picture" and payload.readable and self.decoder is not None:
            self._log.note(payload.stamp_ns, payload.read_wall_ns, self.decoder.last.luma)
        elif topic == "counts":
            self.counts |= {name: count for name, count in payload.items() if name != "node" and count}


def main() -> None:
    """Receive until a line arrives on stdin."""
    run = requested_run()
    log = PictureLog(run)
    recorder = PictureRecorder(log)
    process = ProcessRuntime(channel="rtp", recorder=recorder, remote=(LOOPBACK, run.port))
    nodes, recorder.decoder = build_receiver_nodes(run, process.clock)
    runtime = process.start(nodes)
    runtime.deliver("path_token", PathToken(TOKEN, run.port), process.clock.now())
    print_json({"port": process.port})
    wait_for_line()
    process.close()
    log.save(Path(run.folder) / "read.npz")
    print_json({"counts": recorder.counts})


if __name__ == "__main__":
    main()
